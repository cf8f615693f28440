"""Whether the marks of a film are darker or brighter than what is around them: by first looks at both, balls and needles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import faint_beside
from rsa_vision.detect.balls.find import COARSE_SIGMA_PX, ROUNDNESS, STRENGTH, distinct, first_look
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.leftover import BESIDE_NEEDLES, noise_at_marks
from rsa_vision.detect.balls.optics import CAP, ball_evidence, estimate_optics
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.marks.pairs import optics_of_pairs
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.noise_along import noise_under_needles
from rsa_vision.detect.needles.pins import is_slim, look_for_pins, on_pins, optics_of_pins
from rsa_vision.detect.needles.tees import GUESS, first_tees, optics_of_tees
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Float

CLEAR_JUNCTION = 6.0  # strength from which a junction of three arms tells the polarity; crossing edges reach about 5
_STRONGEST = 100  # candidates of each polarity that are looked at first
_BEYOND_DOUBT = 600.0  # evidence of a dozen clear balls or needles; then less than either of the next is no rival
_NO_RIVAL, _NO_RIVAL_OF_NEEDLES = 60.0, 150.0
_RIVAL = 0.25  # of the evidence of the better polarity, from which the other is looked at as well
_LEAST_EVIDENCE = 1.0  # of balls, below which their blur is anybody's
_MOTTLE = 0.1  # part of the evidence of a polarity that the other has as well: of marks it has next to none
_OF_A_TEE = 4.0  # evidence that the thick ends of a tee's arms may feign


def first_looks(film: NDArray[Any], candidates: Candidates, pins: list[NeedleFit], noise: NoiseModel) -> tuple[BallFits, list[int]]:
    """Look at candidates of both polarities, of one where the strongest leave no doubt which is the markers'.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
    pins : list of NeedleFit
        That were found on the film.
    noise : NoiseModel

    Returns
    -------
    looks : BallFits
    signs : list of int
        Of depth, that were looked at.
    """
    candidates = candidates.rows(candidates.roundness > ROUNDNESS)
    sign = -np.sign(candidates.strength)

    def look(index: Any) -> BallFits:
        return _look(film, candidates.rows(index), pins, noise)

    strongest = np.concatenate([np.flatnonzero(sign == this)[:_STRONGEST] for this in (-1, 1)])
    first = look(strongest)
    looks = {this: first.rows(np.sign(first.depth) == this) for this in (-1, 1)}
    evidence = {this: ball_evidence(distinct(fits, noise), noise) for this, fits in looks.items()}
    best = max(evidence, key=lambda this: evidence[this])
    needles = {
        this: sum(min(p.significance, CAP) for p in pins if np.sign(p.depth) == this)
        + _of_tees(candidates, this)
        + _of_arms(candidates.strokes, this)
        for this in looks
    }
    rest = ~np.isin(np.arange(len(sign)), strongest)
    if evidence[best] + needles[best] > _BEYOND_DOUBT and evidence[-best] < _NO_RIVAL and needles[-best] < _NO_RIVAL_OF_NEEDLES:
        del looks[-best]
        rest &= sign == best
    return distinct(join([*looks.values(), look(rest)]), noise), list(looks)


def _look(film: NDArray[Any], candidates: Candidates, pins: list[NeedleFit], noise: NoiseModel) -> BallFits:
    return off_pins(first_look(film, candidates, noise), pins)


def off_pins(fits: BallFits, pins: list[NeedleFit]) -> BallFits:
    """Leave out first looks at what pins explain."""
    return fits.rows(~on_pins(fits.position_px, 1 - fits.explained, [p for p in pins if is_slim(p)]))


def is_mottled(looks: BallFits, sign: int, noise: NoiseModel) -> bool:
    """Say whether first looks of the other sign of depth show nearly as much: shadows that cross, and the gaps between them.

    Parameters
    ----------
    looks : BallFits
        Of both.
    sign : int
        Of the marks.
    noise : NoiseModel

    Returns
    -------
    bool
    """
    mine, others = (ball_evidence(looks.rows(np.sign(looks.depth) == this), noise) for this in (sign, -sign))
    return others > _MOTTLE * mine


def _of_tees(candidates: Candidates, sign: int) -> float:
    """Evidence of junctions for tees of one polarity."""
    return float(np.clip(-sign * candidates.junctions[:, 4] - CLEAR_JUNCTION, 0.0, 20.0).sum())


def _of_arms(strokes: Float, sign: int) -> float:
    """The same of strokes at junctions."""
    strength = -sign * STRENGTH * strokes[:, 5]
    return float(np.clip(strength, 0.0, CAP).sum())


def polarities(
    film: NDArray[Any], signs: list[int], seeds: BallFits, pins: list[NeedleFit], candidates: Candidates, noise: NoiseModel
) -> list[tuple[int, Optics, BallFits, NoiseModel]]:
    """Choose the signs of depth worth looking at: both only where neither is clearly the markers'.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    signs : list of int
    seeds : BallFits
        First looks.
    pins : list of NeedleFit
    candidates : Candidates
    noise : NoiseModel

    Returns
    -------
    list of tuples
        Sign, optics, first looks and noise (with that at marks of this polarity).
    """
    weight, optics, looks, noises = {-1: 0.0, 1: 0.0}, {}, {}, {}
    for sign in signs:
        # by mottle no blur of pins is told
        slim = [p for p in pins if is_slim(p) and np.sign(p.depth) == sign]
        mine = seeds.rows((np.sign(seeds.depth) == sign) & ~faint_beside(seeds, slim, COARSE_SIGMA_PX, noise))
        strength = -sign * candidates.junctions[:, 4]
        clear = strength > CLEAR_JUNCTION
        needles = bool(clear.any() or slim)
        noises[sign] = noise_at_marks(film, mine, noise, *[BESIDE_NEEDLES] * needles)
        round_ones = candidates.rows((np.sign(candidates.strength) == -sign) & (candidates.roundness > ROUNDNESS))
        if noises[sign] is not noise:  # not all that was unlike a ball in less noise is none
            mine = distinct(_look(film, round_ones, pins, noises[sign]), noises[sign])
            mine = mine.rows(~faint_beside(mine, slim, COARSE_SIGMA_PX, noises[sign]))
        looks[sign] = mine
        optics[sign], balls = estimate_optics(film, mine, noises[sign])
        pairs = None if clear.any() else optics_of_pairs(film, round_ones, mine, optics[sign], noises[sign])
        if pairs is not None:
            optics[sign], balls, found = pairs
            looks[sign] = distinct(join([found, mine]), noises[sign])
        if balls < _OF_A_TEE * max(int(clear.sum()), 1):
            tees = first_tees(film, candidates.junctions[clear if clear.any() else strength > 0], noises[sign])
            if noises[sign] is noise:
                noises[sign] = noise_under_needles(film, tees or slim, GUESS, noise)
            of_tees, evidence = optics_of_tees(film, tees, noises[sign])
            if clear.any() or evidence > balls:
                optics[sign] = of_tees
            elif balls < _LEAST_EVIDENCE:
                more = look_for_pins(film, candidates.strokes, noises[sign])
                of_pins, evidence = optics_of_pins(film, [p for p in pins + more if np.sign(p.depth) == sign], noises[sign])
                if evidence > 0 or not len(mine.depth):  # else even one faint ball knows more of its blur than nobody
                    optics[sign] = of_pins
            balls += evidence
        weight[sign] = balls + _of_tees(candidates, sign)
    best = max(signs, key=lambda sign: weight[sign])
    if weight[best] == 0 and len(seeds.depth) == 0:
        return []
    least = _RIVAL * weight[best] if weight[best] > _LEAST_EVIDENCE else 0.0
    rivals = [sign for sign in signs if sign == best or weight[sign] >= least]
    return [(sign, optics[sign], looks[sign], noises[sign]) for sign in sorted(rivals, key=lambda sign: sign != best)]
