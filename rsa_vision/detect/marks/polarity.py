"""Whether the marks of a film are darker or brighter than what is around them: by first looks at both, balls and needles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from rsa_vision.detect.balls.decide import CLOSE, LEAST_KNOWN, faint_beside, height_of, look_clear
from rsa_vision.detect.balls.find import COARSE_SIGMA_PX, ROUNDNESS, distinct, first_look
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.leftover import BESIDE_NEEDLES, noise_at_marks
from rsa_vision.detect.balls.optics import CAP, ball_evidence, estimate_optics
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within
from rsa_vision.detect.marks.pairs import optics_of_pairs
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.first_pins import look_for_pins
from rsa_vision.detect.needles.noise_along import noise_under_needles
from rsa_vision.detect.needles.optics import GUESS
from rsa_vision.detect.needles.pins import on_pins, optics_of_pins
from rsa_vision.detect.needles.pointed import is_slim
from rsa_vision.detect.needles.tees import first_tees, optics_of_tees
from rsa_vision.detect.neighbours.holes import are_holes
from rsa_vision.detect.neighbours.rows import in_rows
from rsa_vision.detect.search.candidates import STRENGTH, Candidates
from rsa_vision.detect.search.junctions import ALONE
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Bool, Float, MarkerImages

CLEAR_JUNCTION = 6.0  # strength from which a junction of three arms tells the polarity; crossing edges reach about 5
_STRONGEST = 100  # candidates of each polarity that are looked at first
_BEYOND_DOUBT = 600.0  # evidence of a dozen clear balls or needles; then less than either of the next is no rival
_NO_RIVAL, _NO_RIVAL_OF_NEEDLES = 60.0, 150.0
_RIVAL = 0.1  # of the evidence of the better polarity, from which the other is looked at as well
_ONE_BALL, _OF_PINS = CAP, 3 * CAP  # evidence of balls, up to which all may be a speck, and of pins, from which they know better
_LEAST_EVIDENCE = 1.0  # of balls, below which their blur is anybody's
_CONTESTED = 0.4, 0.15  # of the evidence for a polarity, from which the other may be that of the marks; where both are of one kind
_ONE_SIZE, _BY_CHANCE = 0.08, 0.01  # logarithms of the radii of balls of one kind; that as many are alike by chance
_MOTTLE = 0.1  # part of the evidence of a polarity that the other has as well: of marks it has next to none
_REACH = 3.0  # of the radius of the ring on which a junction's arms are seen, that these reach
_A_SET = 5  # junctions
_OF_A_TEE = 4.0  # evidence that the thick ends of a tee's arms may feign


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a film shows if its marks are of one sign of depth.

    Attributes
    ----------
    sign : int
        Of depth: negative for marks darker than their surroundings.
    looks : BallFits
        First looks at what may be balls.
    rowed : BallFits
        Those in rows, as threads of screws make them: they do not say what balls of the film are like.
    optics : Optics
    noise : NoiseModel
        With that at marks of this polarity.
    weight : float
        Evidence for it.
    rival : bool
        It is looked at even if the other sign has shown marks.
    junctions : bool
        Where three arms meet there are enough for a set of tees.
    """

    sign: int
    looks: BallFits
    rowed: BallFits
    optics: Optics
    noise: NoiseModel
    weight: float
    rival: bool = True
    junctions: bool = False


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
    return off_pins(look_off_holes(film, candidates, noise), pins)


def look_off_holes(film: NDArray[Any], candidates: Candidates, noise: NoiseModel) -> BallFits:
    """Look at candidates for balls, and leave out the gaps between others, and what lossy compression may have made."""
    looks = first_look(film, candidates, noise)
    looks = looks.rows(noise.rises_above(height_of(looks, COARSE_SIGMA_PX), looks.background))
    return looks.rows(~are_holes(film, looks, COARSE_SIGMA_PX))


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


def _at_junctions(position_px: Float, junctions: Float) -> Bool:
    """Say which places may lie on the arms of tees."""
    return are_within(position_px, junctions[:, :2], _REACH * junctions[:, 3])


def _of_arms(strokes: Float, sign: int) -> float:
    """The same of strokes at junctions."""
    strength = -sign * STRENGTH * strokes[:, 5]
    return float(np.clip(strength, 0.0, CAP).sum())


def polarities(
    film: NDArray[Any], signs: list[int], seeds: BallFits, pins: list[NeedleFit], candidates: Candidates, noise: NoiseModel
) -> list[Seen]:
    """Say in which order the signs of depth are worth looking at, and which is one where the other has shown marks.

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
    list of Seen
        Most evidence first.
    """
    seen = {sign: _seen_as(sign, film, seeds, pins, candidates, noise) for sign in signs}
    best = max(signs, key=lambda sign: seen[sign].weight)
    if seen[best].weight == 0 and len(seeds.depth) == 0:
        return []
    least = _RIVAL * seen[best].weight if seen[best].weight > _LEAST_EVIDENCE else 0.0
    rivals = [replace(seen[sign], rival=sign == best or seen[sign].weight >= least) for sign in signs]
    # what surrounds marks of hardly any noise answers to the search as well: if there is nothing in it, the marks are the others
    return sorted(rivals, key=lambda s: s.sign != best)


def _seen_as(sign: int, film: NDArray[Any], seeds: BallFits, pins: list[NeedleFit], candidates: Candidates, noise: NoiseModel) -> Seen:
    of_sign = [p for p in pins if np.sign(p.depth) == sign]
    slim = [p for p in of_sign if is_slim(p)]  # by mottle no blur of pins is told
    looks = seeds.rows((np.sign(seeds.depth) == sign) & ~faint_beside(seeds, slim, COARSE_SIGMA_PX, noise))
    junctions = candidates.junctions[-sign * candidates.junctions[:, 4] > 0]
    clear = junctions[np.abs(junctions[:, 4]) > CLEAR_JUNCTION]
    round_ones = candidates.rows((np.sign(candidates.strength) == -sign) & (candidates.roundness > ROUNDNESS))
    looks, rowed = _off_rows(looks, noise)
    # parts of arms leave what no ball does, and that is no noise
    arms = _at_junctions(looks.position_px, junctions if len(clear) else clear) & (looks.explained < CLOSE)
    under = noise_at_marks(film, looks.rows(~arms), noise, *[BESIDE_NEEDLES] * bool(len(clear) or slim))
    if under is not noise:  # not all that was unlike a ball in less noise is none
        looks = distinct(_look(film, round_ones, pins, under), under)
        looks, rowed = _off_rows(looks.rows(~faint_beside(looks, slim, COARSE_SIGMA_PX, under)), under)
    optics, balls = estimate_optics(film, looks, under)
    pairs = None if len(clear) else optics_of_pairs(film, round_ones, looks, optics, under)
    if pairs is not None:
        optics, balls, found = pairs
        looks = distinct(join([found, looks]), under)
    needles = 0.0
    if balls < _OF_A_TEE * max(len(clear), 1):
        tees = first_tees(film, clear if len(clear) else junctions, under)
        under = noise_under_needles(film, tees or slim, GUESS, noise) if under is noise else under
        of_tees, needles = optics_of_tees(film, tees, under)
        if len(clear) or needles > balls:
            optics = of_tees
    if needles <= balls < _ONE_BALL and (not len(clear) or needles == 0):  # where no tee is, clear junctions are something else
        strokes = candidates.strokes[np.sign(candidates.strokes[:, 5]) == -sign]
        more = [p for p in look_for_pins(film, strokes, under) if np.sign(p.depth) == sign]
        of_pins, evidence = optics_of_pins(film, of_sign + more, under)
        if balls < _LEAST_EVIDENCE or evidence > _OF_PINS:
            needles = evidence
            if needles > 0 or not len(looks.depth):  # else even one faint ball knows more of its blur than nobody
                optics = of_pins
    meet = np.count_nonzero(np.abs(junctions[:, 4]) > ALONE) >= _A_SET
    return Seen(sign, looks, rowed, optics, under, balls + needles + _of_tees(candidates, sign), junctions=bool(meet))


def _off_rows(looks: BallFits, noise: NoiseModel) -> tuple[BallFits, BallFits]:
    """Part first looks into others and those in rows, unless too few of the others show what balls are like."""
    rowed = in_rows(looks.position_px, looks.radius_px, looks.depth)
    if np.count_nonzero(look_clear(looks.rows(~rowed), noise)) < LEAST_KNOWN:
        rowed[:] = False
    return looks.rows(~rowed), looks.rows(rowed)


def likelier(found: list[MarkerImages], evidence: list[float]) -> tuple[int, bool]:
    """Choose among what was found of either polarity: marks are of one kind, bubbles and pores are of any size; else that of more evidence.

    Parameters
    ----------
    found : list of MarkerImages
        One or two.
    evidence : list of float
        For each.

    Returns
    -------
    which : int
    contested : bool
        The other shows marks as well.
    """
    of_one_kind = [are_of_one_kind(images) for images in found]
    which, *others = sorted(range(len(found)), key=lambda k: (of_one_kind[k], evidence[k]), reverse=True)
    least = _CONTESTED[of_one_kind[which]] * evidence[which]
    return which, any(evidence[k] > least and of_one_kind[k] == of_one_kind[which] for k in others)


def are_of_one_kind(images: MarkerImages) -> bool:
    """Say whether there are tees, or more balls of one size than chance makes of sizes that lie anywhere within a factor of two.

    Parameters
    ----------
    images : MarkerImages
        Of one polarity.

    Returns
    -------
    bool
    """
    sure = images.rows(images.flags & ~(MarkerFlag.OVERLAP | MarkerFlag.EDGE | MarkerFlag.SATURATED) == 0)
    if np.count_nonzero(sure.shape == "tee") >= LEAST_KNOWN:
        return True
    size = np.log(sure.radius_px[sure.shape == "ball"])
    company = (np.abs(size[:, None] - size) < _ONE_SIZE).sum(axis=1).max(initial=0)
    return bool(company > 1 and len(size) * bdtrc(company - 2, len(size) - 1, 2 * _ONE_SIZE / np.log(2)) < _BY_CHANCE)


def of_doubtful_polarity(images: MarkerImages) -> MarkerImages:
    """Flag all marks of a film of which nobody knows whether they are the marks, or the gaps between others."""
    return replace(images, flags=images.flags | MarkerFlag.UNLIKE)
