"""Whether faint balls are more than the strongest of a crowd: trabeculae and mottle make blobs without end, and some are like any ball."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool

_ROUND = 0.4  # roundness of what may look like a ball at a glance
_AS_STRONG = 0.6  # of the filter's answer
_MANY = 3  # times as many others as balls, all so strong
_NEAR_PX = 2.0  # beyond the rim, what still is an answer to a ball


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
    gap = np.hypot(*(candidates.position_px[:, None] - balls.position_px).transpose(2, 0, 1))
    at = gap < balls.radius_px + _NEAR_PX
    strength = np.abs(candidates.strength)
    own = np.where(at, strength[:, None], 0.0).max(axis=0, initial=0.0)
    others = strength[~at.any(axis=1) & (candidates.roundness > _ROUND)]
    crowd, like = ((these >= _AS_STRONG * own[:, None]).sum(axis=1) for these in (others, own))
    return np.asarray((crowd <= _MANY * like) | (own == 0.0))
