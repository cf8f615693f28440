"""Whether faint balls are more than the strongest of a crowd: trabeculae and mottle make blobs without end, and some are like any ball."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.decide import CLOSE
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.places import pairs_within
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool, Float

_ROUND = 0.4  # roundness of what may look like a ball at a glance
_AS_STRONG = 0.6  # of the filter's answer
_MANY = 3  # times as many others as balls, all so strong
_NEAR_PX = 2.0  # beyond the rim, what still is an answer to a ball
_BY_NOISE = 5.5  # local spreads, to which noise alone makes the filter answer hardly anywhere on a film
_PLAIN = 1 / 3  # of their number: as much else, at the most, shows a film that is noise but for them
_CLOSER = 0.98  # part of the variance that is explained of a ball among those that are lost
_PASSES = 1 / 20  # of what stands out of a texture, this part passes for balls


def all_but_noise(balls: BallFits, which: Bool, candidates: Candidates) -> bool:
    """Say whether a film shows hardly anything beyond noise that is none of these balls.

    Parameters
    ----------
    balls : BallFits
    which : ndarray of bool, shape (n,)
    candidates : Candidates
        As for :func:`out_of_a_crowd`.

    Returns
    -------
    bool
    """
    _, others = _answers(balls, candidates)
    return bool(np.count_nonzero(others > _BY_NOISE) <= _PLAIN * np.count_nonzero(which)) and bool(which.any())


def out_of_a_crowd(balls: BallFits, candidates: Candidates) -> Bool:
    """Say which balls are not outnumbered by what the filter answers nearly as strongly, and is no mark.

    Marks on a film without noise enough to hide them are few and strong, and what is left is far weaker; in a texture the strength
    of blobs falls off little by little, and those that pass for balls are its end.

    Parameters
    ----------
    balls : BallFits
    candidates : Candidates
        Of the same polarity, those at other marks left out.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    own, others = _answers(balls, candidates)
    crowd, like = ((these >= _AS_STRONG * own[:, None]).sum(axis=1) for these in (others, own))
    return np.asarray((crowd <= _MANY * like) | (own == 0.0))


def lost_in_a_crowd(balls: BallFits, candidates: Candidates) -> Bool:
    """Say which balls may be texture though others of the film are marks: so much of that is as strong that one is expected to look so.

    What noise alone may make is no texture, and what a model explains closely is a ball; more closely still, where most are lost.

    Parameters
    ----------
    balls : BallFits
    candidates : Candidates
        As for :func:`out_of_a_crowd`.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    own, others = _answers(balls, candidates)
    as_strong = (others >= np.maximum(own, _BY_NOISE)[:, None]).sum(axis=1)
    perhaps = (_PASSES * as_strong > 1) & (own > 0.0)
    lost = perhaps & (balls.explained < CLOSE)
    return np.asarray(perhaps & (balls.explained < _CLOSER) if np.count_nonzero(lost) > len(lost) / 2 else lost)


def _answers(balls: BallFits, candidates: Candidates) -> tuple[Float, Float]:
    """Strongest answers of the filter to balls (n,), and those to all that is round and none of them."""
    at, ball = pairs_within(candidates.position_px, balls.position_px, balls.radius_px + _NEAR_PX)
    strength, own, free = np.abs(candidates.strength), np.zeros(len(balls.depth)), candidates.roundness > _ROUND
    np.maximum.at(own, ball, strength[at])
    free[at] = False
    return own, strength[free]
