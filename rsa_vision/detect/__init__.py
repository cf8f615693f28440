"""Marker images of one film: tantalum balls, pointed pins and tees, without knowing the cage.

Nothing about the film is taken for granted: polarity, blur, attenuation (with it the bend of the film curve) and noise are
estimated from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits, join
from rsa_vision.detect.beside import images_beside, lapping_balls
from rsa_vision.detect.candidates import Candidates, find_candidates
from rsa_vision.detect.decide import EDGE, are_balls
from rsa_vision.detect.find import (
    CHANCE,
    DOUBTFUL,
    MISFIT,
    ROUNDNESS,
    STRENGTH,
    distinct,
    first_look,
    fit_at,
    misfit,
    plausible,
    significance_limit,
)
from rsa_vision.detect.leftover import noise_at_marks, noise_under
from rsa_vision.detect.mixed import part
from rsa_vision.detect.needle_images import NeedleFit
from rsa_vision.detect.noise import NoiseModel, estimate_noise
from rsa_vision.detect.optics import ball_evidence, estimate_optics
from rsa_vision.detect.painted import paint
from rsa_vision.detect.pins import MOST_STROKES, find_pins, is_slim, look_for_pins, on_arms, on_pins, optics_of_pins
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.resolve import doubt_of_number, resolve_balls
from rsa_vision.detect.response import BITS, in_film_values, is_straighter, log_odds, scale_matters
from rsa_vision.detect.rims import goes_on
from rsa_vision.detect.second_look import look_again
from rsa_vision.detect.settle import STRUCTURE, settle
from rsa_vision.detect.strokes import at_junctions
from rsa_vision.detect.surroundings import free_places
from rsa_vision.detect.tees import find_tees, is_tee, optics_of_tees
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Bool, Float, MarkerImages

__all__ = ["Detection", "detect_markers"]

CLEAR_JUNCTION = 6.0  # strength from which a junction of three arms tells the polarity; crossing edges reach about 5
EXACT_PX = 0.002  # error of a centre without any noise: what areas of pixels and rims of balls are rounded to, here and in other programs
WHOLE, CUT_OFF = 0.999, 0.8  # part of the pixels under a ball
BENT = 1.5  # the same once an edge or bending surfaces around it could have taken it up
_LOST = 0.3  # of the radius: larger standard deviations are of what lies beside an image, which is hardly told from it
_SOMEWHERE = 0.1  # of the squared radius: variance of a centre whose image the model does not describe
_STRONGEST = 100  # candidates of each polarity that are looked at first
_BEYOND_DOUBT = 600.0  # evidence of a dozen clear balls or needles; then less than either of the next is no rival
_NO_RIVAL, _NO_RIVAL_OF_NEEDLES = 60.0, 150.0
_CAP = 50.0  # significance beyond which a needle is no better evidence
_OF_CUT_OFF = 0.2  # of the evidence of a whole mark, of one that is cut off: plateaus have rims as well
_LEAST_EVIDENCE = 1.0  # of balls, below which their blur is anybody's
_OF_A_TEE = 4.0  # evidence that the thick ends of a tee's arms may feign


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """What was found on one film, and how the film is.

    Attributes
    ----------
    images : MarkerImages
    dark_markers : bool
        Markers have lower values than their surroundings.
    optics : Optics
        Blur (with the pixel's own) and attenuation.
    noise : NoiseModel
        In the scale in which the film was measured.
    """

    images: MarkerImages
    dark_markers: bool
    optics: Optics
    noise: NoiseModel


def detect_markers(values: NDArray[Any], *, bits: int, response: str = "auto", false_detections: float = 0.1) -> Detection:
    """Find and measure all marker images of a film.

    Parameters
    ----------
    values : ndarray of shape (rows, cols)
        uint8 or uint16.
    bits : int
        Significant bits.
    response : str
        ``auto``, ``density``, ``transmission``, ``linear`` or ``log``. The model takes the bend of the response from the film (it shows in
        the profiles as more or less attenuation), so this is a statement about the film, not a switch; it is kept for ``run.json``.
    false_detections : float
        Expected number of marker images on a film that are noise alone.

    Returns
    -------
    Detection
    """
    limit = significance_limit(values.size, 2.5, false_detections)
    return _detect(values, bits, estimate_noise(values, bits), limit)


def _detect(values: NDArray[Any], bits: int, noise: NoiseModel, limit: float, *, as_it_is: bool = False) -> Detection:
    """``as_it_is``: in no other scale of the values."""
    faint = find_candidates(values, STRENGTH, noise)
    candidates = faint.rows(np.abs(faint.strength) > STRENGTH)
    # strokes at junctions are arms of tees, most likely: they are looked at once it is known that there are none
    strokes = candidates.strokes[:MOST_STROKES]
    arms = at_junctions(strokes, candidates.junctions)
    pins, candidates = look_for_pins(values, strokes[~arms], noise), replace(candidates, strokes=strokes[arms])
    seeds, signs = _seeds(values, candidates, pins, noise)
    found = []
    for sign, optics, mine, of_marks in _polarities(values, signs, seeds, pins, candidates, noise):
        if sign > 0 and not as_it_is and scale_matters(mine, of_marks):
            other, its_noise = log_odds(values, bits, noise)
            if is_straighter(values, noise, other, its_noise, mine, optics):
                detection = _detect(other, BITS, its_noise, limit, as_it_is=True)
                return replace(detection, images=in_film_values(detection.images, bits))
        found.append(_one_polarity(values, bits, sign, optics, mine, pins, candidates, faint, of_marks, limit))
    return max(found, key=lambda item: item[0])[1] if found else Detection(MarkerImages.empty(), True, Optics(1.0, 0.5), noise)


def _seeds(film: NDArray[Any], candidates: Candidates, pins: list[NeedleFit], noise: NoiseModel) -> tuple[BallFits, list[int]]:
    """First looks, and the signs of depth that were looked at: one where the strongest candidates leave no doubt which is the markers'."""
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
        this: sum(min(p.significance, _CAP) for p in pins if np.sign(p.depth) == this)
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
    return _off_pins(first_look(film, candidates, noise), pins)


def _off_pins(fits: BallFits, pins: list[NeedleFit]) -> BallFits:
    return fits.rows(~on_pins(fits.position_px, 1 - fits.explained, [p for p in pins if is_slim(p)]))


def _of_tees(candidates: Candidates, sign: int) -> float:
    """Evidence of junctions for tees of one polarity."""
    return float(np.clip(-sign * candidates.junctions[:, 4] - CLEAR_JUNCTION, 0.0, 20.0).sum())


def _of_arms(strokes: Float, sign: int) -> float:
    """The same of strokes at junctions."""
    strength = -sign * STRENGTH * strokes[:, 5]
    return float(np.clip(strength, 0.0, _CAP).sum())


def _polarities(
    film: NDArray[Any], signs: list[int], seeds: BallFits, pins: list[NeedleFit], candidates: Candidates, noise: NoiseModel
) -> list[tuple[int, Optics, BallFits, NoiseModel]]:
    """Signs of depth worth looking at, with their optics, first looks and noise; both only where neither is clearly the markers'."""
    weight, optics, looks, noises = {-1: 0.0, 1: 0.0}, {}, {}, {}
    for sign in signs:
        mine = seeds.rows(np.sign(seeds.depth) == sign)
        noises[sign] = noise_at_marks(film, mine, noise)
        if noises[sign] is not noise:  # not all that was unlike a ball in less noise is none
            round_ones = candidates.rows((np.sign(candidates.strength) == -sign) & (candidates.roundness > ROUNDNESS))
            mine = distinct(_look(film, round_ones, pins, noises[sign]), noises[sign])
        looks[sign] = mine
        optics[sign], balls = estimate_optics(film, mine, noises[sign])
        strength = -sign * candidates.junctions[:, 4]
        clear = strength > CLEAR_JUNCTION
        if clear.any() and balls < max(_LEAST_EVIDENCE, _OF_A_TEE * clear.sum()):
            optics[sign] = optics_of_tees(film, candidates.junctions[clear], noise)
        elif balls < _LEAST_EVIDENCE:
            of_pins, balls = optics_of_pins(
                film, [p for p in pins + look_for_pins(film, candidates.strokes, noise) if np.sign(p.depth) == sign], noise
            )
            if balls > 0 or not len(mine.depth):  # else even one faint ball knows more of its blur than nobody
                optics[sign] = of_pins
        weight[sign] = balls + _of_tees(candidates, sign)
    best = max(signs, key=lambda sign: weight[sign])
    if weight[best] == 0 and len(seeds.depth) == 0:
        return []
    return [(sign, optics[sign], looks[sign], noises[sign]) for sign in ((best,) if weight[-best] < 0.25 * weight[best] else (best, -best))]


def _one_polarity(
    film: NDArray[Any],
    bits: int,
    sign: int,
    optics: Optics,
    seeds: BallFits,
    rough_pins: list[NeedleFit],
    candidates: Candidates,
    faint: Candidates,
    noise: NoiseModel,
    limit: float,
) -> tuple[float, Detection]:
    junctions = candidates.junctions[np.sign(candidates.junctions[:, 4]) == -sign]
    mine = replace(candidates.rows(np.sign(candidates.strength) == -sign), junctions=junctions)
    tees, doubtful, tee_optics = find_tees(film, junctions, optics, noise)
    tees = [fit for fit in tees if np.sign(fit.depth) == sign]
    tees = [fit for fit, ball in zip(tees, _are_rather_balls(film, tees, seeds, optics, noise), strict=True) if not ball]
    more_pins = look_for_pins(film, candidates.strokes[~on_arms(candidates.strokes[:, :2], tees)], noise)
    seeds = _off_pins(seeds, more_pins)
    pins, pin_optics = find_pins(film, [p for p in rough_pins + more_pins if np.sign(p.depth) == sign], tees, optics, noise)

    needles = paint([(t, tee_optics) for t in tees] + [(p, pin_optics) for p in pins]) if tees or pins else None

    balls, touching, edged, drawn = resolve_balls(film, mine, seeds, limit, optics, noise, needles)
    keep = are_balls(balls, limit, optics.sigma_px, noise) & (np.sign(balls.depth) == sign) & ~_on_arms(balls, tees + pins)
    balls, touching, edged, drawn = balls.rows(keep), touching[keep], edged[keep], drawn[keep]
    more, at_edge, crossed = look_again(film, faint.rows(np.sign(faint.strength) == -sign), balls, limit, optics, noise, needles)
    both = join([balls, more])
    like = are_balls(both, limit, optics.sigma_px, noise)[len(balls.depth) :]
    like &= (np.sign(more.depth) == sign) & ~_on_arms(more, tees + pins)
    balls, edged, added = join([balls, more.rows(like)]), np.append(edged, at_edge[like]), np.zeros(np.count_nonzero(like), bool)
    touching, drawn = np.append(touching, added), np.append(drawn, crossed[like])  # the last fit does not know what was masked either
    for fit in doubtful:
        if found := part(film, fit, balls, optics, tee_optics, noise, needles or _nothing, is_tee):
            tee, ball = found
            apart = np.hypot(*(balls.position_px - ball.position_px[0]).T) > ball.radius_px[0]
            balls = join([balls.rows(apart), ball])
            touching, edged, drawn = np.append(touching[apart], True), np.append(edged[apart], False), np.append(drawn[apart], False)
            tees = [*tees, tee]

    def beside(i: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return images_beside(known, np.array([i]), optics, needles, cols, rows)

    known = balls
    others = tees + pins
    place = np.array([t.position_px for t in others]).reshape(-1, 2)
    reach = np.array([t.shape.length_px + t.shape.half_width_px + 3 * optics.sigma_px for t in others])
    places = free_places(film, balls, place, reach, optics, noise)
    clear = balls.rows(~touching & ~drawn & (balls.valid_fraction > WHOLE) & (balls.chi2_ring < STRUCTURE))
    under = noise_under(clear.chi2_uneven, clear.radius_px, STRUCTURE, places, optics, noise)
    balls, ratio, covered = settle(film, balls, places, under, ~touching & ~drawn, edged, beside, optics, noise)
    left, poor = _what_is_left(balls, under, noise)
    poor |= covered
    keep = left < BENT * MISFIT
    ends = goes_on(film, balls, np.arange(len(poor)), beside, optics.sigma_px)
    keep &= ~(poor & ends)
    touching |= ends  # something as high as itself beside it, which a ball on the end of a bar has as well
    balls, ratio, touching, poor = balls.rows(keep), ratio[keep], touching[keep], poor[keep]
    poor = np.asarray(lapping_balls(balls)[:, poor].any(axis=1))  # what one of them leaves may be another's
    images, evidence = _table(film, bits, balls, under, ratio, touching, poor, others, optics, noise)
    return evidence, Detection(images, sign < 0, optics, noise)


def _nothing(cols: Float, _: Float) -> Float:
    return np.zeros(cols.shape)


def _are_rather_balls(film: NDArray[Any], tees: list[NeedleFit], seeds: BallFits, optics: Optics, noise: NoiseModel) -> list[bool]:
    """Say which tees a ball over their tip explains better: three thick arms that run into each other make a disc."""
    result = [False] * len(tees)
    tips = np.array([t.position_px for t in tees]).reshape(-1, 2)
    gap = np.hypot(*(tips[:, None] - seeds.position_px[None]).transpose(2, 0, 1))
    tee, seed = np.nonzero(gap < seeds.radius_px[None] + 1)
    if len(tee):
        balls = fit_at(film, seeds.position_px[seed], seeds.radius_px[seed], optics, noise, quick=True)
        as_ball = plausible(balls, noise) & (np.hypot(*(balls.position_px - tips[tee]).T) < balls.radius_px + 1)
        for k in np.flatnonzero(as_ball):
            result[tee[k]] |= bool(balls.chi2_core[k] < tees[tee[k]].chi2_core)
    return result


def _on_arms(balls: BallFits, tees: list[NeedleFit]) -> Bool:
    """Say which balls are left-overs of the thick ends of tees."""
    out = np.zeros(len(balls.depth), bool)
    for t in tees:
        dx, dy = (balls.position_px - t.position_px).T
        for angle, depth in zip(t.angles, t.depths, strict=True):
            c, s = np.cos(angle), -np.sin(angle)
            along, across = dx * c + dy * s, -dx * s + dy * c
            on = (along > -2) & (along < t.shape.length_px + t.shape.half_width_px) & (np.abs(across) < t.shape.half_width_px + 1.5)
            out |= on & (np.abs(balls.depth) < 0.5 * abs(depth))
    return out


def _what_is_left(balls: BallFits, usual: float, noise: NoiseModel) -> tuple[Float, Bool]:
    """Return the misfit of each ball, and which are not described well."""
    under = replace(balls, chi2_core=balls.chi2_core / max(usual, 1.0))  # noise that all balls have under them is no misfit of one
    left = misfit(under, noise, CHANCE)
    return left, (left > DOUBTFUL * MISFIT) | (balls.chi2_ring > EDGE)


def _table(
    film: NDArray[Any],
    bits: int,
    balls: BallFits,
    usual: float,
    ratio: Float,
    touching: Bool,
    poor_ball: Bool,
    tees: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
) -> tuple[MarkerImages, float]:
    """Put balls and tees into one table, film order (row by row), with flags; return the evidence for marks as well.

    ``usual`` is the noise under balls, ``ratio`` what :func:`rsa_vision.detect.settle.settle` says of their surroundings.
    """
    full = float(2**bits - 1)
    n, m = len(balls.depth), len(tees)
    position = np.concatenate([balls.position_px, np.array([t.position_px for t in tees]).reshape(-1, 2)])
    # a model that leaves more than the noise has errors of its own: they widen the statement, once they are significant
    left = balls.chi2_uneven / usual
    excess = np.where(left > 1 + CHANCE * noise.scatter(balls.n_core), left, 1.0)
    # structure around a ball that its background does not hold goes on under it
    excess = np.maximum(excess, np.where(balls.chi2_ring > STRUCTURE, balls.chi2_ring, 0.0)) * ratio
    covariance = np.concatenate(
        [
            balls.covariance[:, :2, :2] * excess[:, None, None],
            np.array([t.covariance_px2 * _excess(t, noise) for t in tees]).reshape(-1, 2, 2),
        ]
    )
    radius = np.concatenate([balls.radius_px, [t.shape.half_width_px for t in tees]])
    depth = np.abs(np.concatenate([balls.depth, [t.depth for t in tees]]))
    background = np.concatenate([balls.background, [t.background for t in tees]])
    flags = np.zeros(n + m, np.int64)
    reach = np.concatenate([balls.radius_px + 1, [t.shape.length_px for t in tees]])
    edge = (position < reach[:, None]).any(1) | (position[:, 0] > film.shape[1] - 1 - reach) | (position[:, 1] > film.shape[0] - 1 - reach)
    flags[edge] |= MarkerFlag.EDGE
    valid = np.concatenate([balls.valid_fraction, [t.valid_fraction for t in tees]])
    flags[(valid < WHOLE) & ~edge] |= MarkerFlag.SATURATED
    flags[valid < CUT_OFF] |= MarkerFlag.CLIPPED
    flags[:n][touching] |= MarkerFlag.OVERLAP
    poor = np.concatenate([poor_ball, np.array([t.misfit for t in tees]) > DOUBTFUL * MISFIT])
    flags[poor] |= MarkerFlag.POOR_FIT
    # what the model does not describe may be two marks in one: its centre is only somewhere in it
    covariance[poor] += (_SOMEWHERE * radius[poor] ** 2)[:, None, None] * np.eye(2)
    # whatever lies around it, what was found of a ball lies under its image: evenly spread over a disc at worst
    most = 0.25 * (balls.radius_px + optics.sigma_px) ** 2
    covariance[:n] *= np.minimum(1.0, most / np.linalg.eigvalsh(covariance[:n])[:, -1])[:, None, None]
    covariance[:n] += EXACT_PX**2 * np.eye(2) + doubt_of_number(balls)
    lost = np.linalg.eigvalsh(covariance[:n])[:, -1] > (_LOST * balls.radius_px) ** 2
    flags[:n][lost] |= MarkerFlag.POOR_FIT
    angle = np.concatenate([np.full(n, np.nan), [np.rad2deg(np.angle(np.exp(1j * t.angles[0]))) for t in tees]])
    shape = np.array(["ball"] * n + [{1: "pin", 3: "tee"}[len(t.angles)] for t in tees], dtype="U4")
    snr = depth / np.sqrt(noise.variance_at(background))
    table = MarkerImages(position, covariance, shape, radius, angle, depth / full, background / full, snr, flags)
    trust = np.where(poor, 0.0, np.interp(valid, (CUT_OFF, WHOLE), (_OF_CUT_OFF, 1.0)))
    return table.rows(np.lexsort((position[:, 0], np.rint(position[:, 1])))), float(trust @ np.minimum(snr, _CAP))


def _excess(fit: NeedleFit, noise: NoiseModel) -> float:
    return fit.chi2_core if fit.chi2_core > 1 + CHANCE * noise.scatter(np.array(fit.n_core)) else 1.0
