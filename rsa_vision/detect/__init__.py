"""Marker images of one film: tantalum balls, pointed pins and tees, without knowing the cage.

Nothing about the film is taken for granted: polarity, blur, attenuation (with it the bend of the film curve) and noise are
estimated from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import are_balls, faint_beside
from rsa_vision.detect.balls.find import MISFIT, STRENGTH, fit_at, plausible, significance_limit
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.leftover import noise_under
from rsa_vision.detect.balls.surroundings import free_places
from rsa_vision.detect.film.noise import NoiseModel, estimate_noise
from rsa_vision.detect.marks.mixed import part
from rsa_vision.detect.marks.polarity import first_looks, is_mottled, off_pins, polarities
from rsa_vision.detect.marks.resolve import resolve_balls
from rsa_vision.detect.marks.response import BITS, high_balls, in_film_values, is_straighter, log_odds
from rsa_vision.detect.marks.second_look import look_again
from rsa_vision.detect.marks.settle import STRUCTURE, settle
from rsa_vision.detect.marks.table import WHOLE, table_of, what_is_left
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.painted import paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.pins import MOST_STROKES, find_pins, look_for_pins
from rsa_vision.detect.needles.sets import is_located, on_arms
from rsa_vision.detect.needles.tees import find_tees, is_tee
from rsa_vision.detect.neighbours.beside import images_beside, lapping_balls
from rsa_vision.detect.neighbours.oblong import are_oblong
from rsa_vision.detect.neighbours.rims import goes_on
from rsa_vision.detect.search.candidates import Candidates, find_candidates
from rsa_vision.detect.search.strokes import at_junctions
from rsa_vision.threads import in_one_thread
from rsa_vision.types import Bool, Float, MarkerImages

__all__ = ["Detection", "detect_markers"]

_BEYOND = 4.0  # times what first looks show of the other polarity: marks that are found leave it no chance
_OVER, _PULL = 0.1, 0.1  # of the depth of a ball, from which a needle lies over it; of its radius, by which that moves its centre
BENT = 1.5  # of what a ball may leave, once an edge or bending surfaces around it could have taken it up


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


@in_one_thread
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
    seeds, signs = first_looks(values, candidates, pins, noise)
    found: list[tuple[float, Detection]] = []
    for sign, optics, mine, of_marks, weight in polarities(values, signs, seeds, pins, candidates, noise):
        if found and found[0][0] > _BEYOND * weight:
            break
        bright = high_balls(mine, of_marks)
        if len(bright.depth) and not as_it_is:
            other, its_noise = log_odds(values, bits, noise)
            if is_straighter(values, noise, other, its_noise, bright, optics):
                detection = _detect(other, BITS, its_noise, limit, as_it_is=True)
                return replace(detection, images=in_film_values(detection.images, bits))
        mottled = is_mottled(seeds, sign, noise)
        found.append(_one_polarity(values, bits, sign, optics, mine, pins, candidates, faint, of_marks, limit, mottled))
    return max(found, key=lambda item: item[0])[1] if found else Detection(MarkerImages.empty(), True, Optics(1.0, 0.5), noise)


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
    mottled: bool,
) -> tuple[float, Detection]:
    junctions = candidates.junctions[np.sign(candidates.junctions[:, 4]) == -sign]
    mine = replace(candidates.rows(np.sign(candidates.strength) == -sign), junctions=junctions)
    strokes = faint.strokes[np.sign(faint.strokes[:, 5]) == -sign]
    tees, doubtful, tee_optics = find_tees(film, junctions, strokes, optics, noise)
    tees = [fit for fit in tees if np.sign(fit.depth) == sign]
    tees = [fit for fit, ball in zip(tees, _are_rather_balls(film, tees, seeds, optics, noise), strict=True) if not ball]
    more_pins = look_for_pins(film, candidates.strokes[~on_arms(candidates.strokes[:, :2], tees)], noise)
    seeds = off_pins(seeds, more_pins)
    pins, pin_optics = find_pins(film, [p for p in rough_pins + more_pins if np.sign(p.depth) == sign], tees, optics, noise)
    pins = [p for p in pins if is_located(p)]

    needles = paint([(t, tee_optics) for t in tees] + [(p, pin_optics) for p in pins]) if tees or pins else None

    balls, touching, edged, drawn = resolve_balls(film, mine, seeds, limit, optics, noise, needles)
    high = ~faint_beside(balls, tees + pins, optics.sigma_px, noise)
    balls, touching, edged, drawn = balls.rows(high), touching[high], edged[high], drawn[high]
    keep = are_balls(balls, limit, optics.sigma_px, noise, mottled=mottled) & (np.sign(balls.depth) == sign) & ~_on_arms(balls, tees + pins)
    balls, touching, edged, drawn = balls.rows(keep), touching[keep], edged[keep], drawn[keep]
    more, at_edge, crossed = look_again(film, faint.rows(np.sign(faint.strength) == -sign), balls, limit, optics, noise, needles)
    both = join([balls, more])
    like = are_balls(both, limit, optics.sigma_px, noise, mottled=mottled)[len(balls.depth) :]
    like &= (np.sign(more.depth) == sign) & ~_on_arms(more, tees + pins) & ~faint_beside(more, tees + pins, optics.sigma_px, noise)
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
    balls, ratio, by_size, covered = settle(film, balls, places, under, ~touching & ~drawn, edged, beside, optics, noise)
    if needles is not None:  # one shadow takes from what the other has left, and what a tee's arm shows of itself is the ball's as well
        over = needles.under(balls.position_px, balls.radius_px) > _OVER * np.abs(balls.depth)
        touching, by_size = touching | over, by_size + over * (_PULL * balls.radius_px) ** 2
    left, poor = what_is_left(balls, under, optics.sigma_px, noise)
    poor |= covered
    keep = left < BENT * MISFIT
    ends = goes_on(film, balls, np.arange(len(poor)), beside, optics.sigma_px)
    keep &= ~(poor & ends)
    poor |= are_oblong(film, balls, beside, optics, noise)
    touching |= ends  # something as high as itself beside it, which a ball on the end of a bar has as well
    balls, ratio, by_size, touching, poor = balls.rows(keep), ratio[keep], by_size[keep], touching[keep], poor[keep]
    poor = np.asarray(lapping_balls(balls)[:, poor].any(axis=1))  # what one of them leaves may be another's
    images, evidence = table_of(film, bits, balls, under, ratio, by_size, touching, poor, others, optics, noise)
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
