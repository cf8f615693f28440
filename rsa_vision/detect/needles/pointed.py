"""Whether fits are pointed pins: against rods, against the same the other way round, and by the kind that a film's clear pins show.

Noise may hide the point of a pin, not its size: where a film has shown a few clear ones, the others are asked whether they are like those.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import MISFIT
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, needle_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import chi2_of, window_of
from rsa_vision.detect.needles.fits import STANDS_OUT, explains, fit_needles, significant_misfit
from rsa_vision.detect.needles.sets import on_arms
from rsa_vision.types import Float

SLIM = 4.5  # length over half the width; two balls side by side have four
EXPLAINED = 0.95  # of a pin's image; long shadows and the strokes of letters leave more
_SIGNIFICANT, _CHANCE = 9.0, 2.0  # and standard deviations of what noise leaves under a pin
SURER_THAN_ROD = 12.0  # half the chi2 by which a rod must be worse
_ALONE = 5.0  # standard deviations of one pixel: lower ones, of which there are fewer, may be anything as long
_RATHER_THAN_ROD, _RATHER_THAN_TURNED = 2.5, 7.0
_ROD = 0.02  # taper of a rod: blunt
LEAST_OF_A_KIND = 3  # clear pins from which a film is one of pins: others then need less
STANDS_OUT_ROUGHLY = 11.0  # significance from which noise may hide the form of a first look, and of one of a kind
_SAMPLE = 6
_MOST_IN_VAIN = 60  # places in a row at which there are none
_THICKER, _DIRECTIONS = 0.65, np.linspace(0, 2 * np.pi, 24, endpoint=False).tolist()  # of the length, where a pin answers the search most
_ODD = 6.0  # half the chi2 by which chance makes a pin of the known size worse than a rod, or a pin, of free size
_PALE = 0.5  # of the typical depth
_ROUGHLY = 0.5  # of what a pin must have, for a closer look
_OF_A_KIND = 2.0  # ratio of length to the typical one: the pins of a film are of few sizes


def is_slim(fit: NeedleFit) -> bool:
    """Say whether a fit is longer than two balls side by side."""
    return fit.shape.length_px > SLIM * fit.shape.half_width_px


def is_pin(fit: NeedleFit, noise: NoiseModel, stands_out: float = STANDS_OUT) -> bool:
    """Say whether a fit looks like a pin: little misfit that chance does not explain, slim, all of it on the film.

    ``stands_out``: significance from which noise may hide its form.
    """
    if not np.isfinite(fit.misfit) or fit.significance < _SIGNIFICANT or fit.valid_fraction < 0.9:
        return False
    by_chance = _CHANCE * float(noise.scatter(np.array(fit.n_core)))
    return bool(is_slim(fit) and significant_misfit(fit, noise) < MISFIT and explains(fit, EXPLAINED, stands_out, by_chance))


def pointed(film: NDArray[Any], pins: list[NeedleFit], places: Float, optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Keep what is no rod; where noise hides the points of some, those of their kind tell that they are pins.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    pins : list of NeedleFit
        What may be pins, best first.
    places : ndarray of shape (n, 2)
        Where others of the kind of the clear ones may be, (col, row), likeliest first.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
    """
    surer = [_surer_than_rod(film, f, optics, noise) for f in pins]
    alone = [by > SURER_THAN_ROD and is_pin(f, noise) for f, by in zip(pins, surer, strict=True)]
    clear = [f for f, enough in zip(pins, alone, strict=True) if enough]
    typical = float(np.median([f.shape.length_px for f in clear[:_SAMPLE]])) if clear else np.nan
    clear = [f for f in clear if _of_a_kind(f, typical)]
    if len(clear) < LEAST_OF_A_KIND:
        return standing_out(clear, noise)
    kept = list(clear)
    for fit, enough in zip(pins, alone, strict=True):
        if not enough:
            ways = [fit, fit_needles(film, *_turned(fit), fit.shape, optics, noise)]
            best, other = sorted(ways, key=unexplained)
            rather = is_pin(best, noise, STANDS_OUT_ROUGHLY) and _of_a_kind(best, typical)
            rather = rather and _worse_by(film, best, other, optics, noise) > _RATHER_THAN_TURNED
            kept += [best] if rather and _surer_than_rod(film, best, optics, noise) > _RATHER_THAN_ROD else []
    return kept + _others_like(film, clear, kept, places, optics, noise)


def _others_like(
    film: NDArray[Any], clear: list[NeedleFit], known: list[NeedleFit], places: Float, optics: Optics, noise: NoiseModel
) -> list[NeedleFit]:
    """Find at places the pins of the size of the clear ones that noise hides too much for a size of their own."""
    width, length, depth = (float(np.median(of)) for of in zip(*((*_size(f), f.depth) for f in clear), strict=True))
    typical, out, in_vain = replace(clear[0], shape=replace(clear[0].shape, half_width_px=width, length_px=length)), list[NeedleFit](), 0
    for place in places:
        if on_arms(place[None], [*known, *out]).any():
            continue
        in_vain += 1
        if in_vain > _MOST_IN_VAIN:
            break
        tip, angles = _laid_over(film, place, typical, optics)
        first = fit_needles(film, tip, angles, typical.shape, optics, noise, quick=True, sized=True)
        if first.significance < _ROUGHLY * _SIGNIFICANT or not explains(first, _ROUGHLY):
            continue
        at = (first.position_px, first.angles), _turned(first)
        best, other = sorted((fit_needles(film, *way, typical.shape, optics, noise, sized=True) for way in at), key=unexplained)
        free = fit_needles(film, best.position_px, best.angles, typical.shape, optics, noise)
        if (
            is_pin(best, noise, STANDS_OUT_ROUGHLY)
            and not any(same_body(best, k) for k in (*known, *out))
            and _PALE < best.depth / depth < 1 / _PALE
            and _worse_by(film, best, other, optics, noise) > _RATHER_THAN_TURNED
            and _worse_by(film, best, free, optics, noise) > -_ODD
            and _surer_than_rod(film, best, optics, noise) > -_ODD
        ):
            out.append(best)
            in_vain = 0
    return out if len(out) <= len(known) else []  # of more than there are clear ones noise is not what makes them unclear


def _laid_over(film: NDArray[Any], place: Float, pin: NeedleFit, optics: Optics) -> tuple[Float, Float]:
    """Return the tip and direction with which a pin whose thicker half is at a place looks most like the film there."""
    half, length = math.ceil(pin.shape.length_px), pin.shape.length_px
    col, row = np.rint(place).astype(np.intp)
    rows, cols = np.mgrid[max(row - half, 0) : row + half + 1, max(col - half, 0) : col + half + 1]
    rows, cols = (np.clip(at, 0, size - 1).ravel() for at, size in zip((rows, cols), film.shape, strict=True))
    values = film[rows, cols].astype(np.float64)
    values -= values.mean()

    def tip(angle: float) -> Float:
        return np.asarray(place - _THICKER * length * np.array([math.cos(angle), -math.sin(angle)]))

    def likeness(angle: float) -> float:
        start = replace(pin, position_px=tip(angle), angles=np.array([angle]))
        return float(values @ needle_image(cols - start.position_px[0], rows - start.position_px[1], start, optics))

    best = max(_DIRECTIONS, key=likeness)
    return tip(best), np.array([best])


def _size(fit: NeedleFit) -> tuple[float, float]:
    return fit.shape.half_width_px, fit.shape.length_px


def _of_a_kind(fit: NeedleFit, typical_px: float) -> bool:
    return 1 / _OF_A_KIND < fit.shape.length_px / typical_px < _OF_A_KIND


def standing_out(pins: list[NeedleFit], noise: NoiseModel) -> list[NeedleFit]:
    """Keep the pins whose form no noise hides: few have no company that tells what they are."""
    return [f for f in pins if f.height > _ALONE * float(np.sqrt(noise.variance_at(np.array(f.background))))]


def _turned(fit: NeedleFit) -> tuple[Float, Float]:
    """Tip and direction of the same pin the other way round."""
    way = np.array([np.cos(fit.angles[0]), -np.sin(fit.angles[0])])
    return fit.position_px + fit.shape.length_px * way, fit.angles + np.pi


def _surer_than_rod(film: NDArray[Any], fit: NeedleFit, optics: Optics, noise: NoiseModel) -> float:
    """Return half the chi2 by which a rod of free length, width and direction in the pin's place is worse."""
    thinner = replace(fit.shape, taper=_ROD, half_width_px=0.7 * fit.shape.half_width_px, length_px=0.8 * fit.shape.length_px)
    back = fit.position_px + 0.2 * fit.shape.length_px * np.array([np.cos(fit.angles[0]), -np.sin(fit.angles[0])])
    return _worse_by(film, fit, fit_needles(film, back, fit.angles, thinner, optics, noise), optics, noise)


def _worse_by(film: NDArray[Any], fit: NeedleFit, other: NeedleFit, optics: Optics, noise: NoiseModel) -> float:
    """Return half the chi2 by which another fit in the place of one is worse, on the same pixels."""
    window = window_of(film, [fit], optics, noise, None)
    of_fit, of_other = (chi2_of(window, f, optics, noise) for f in (fit, other))
    return 0.5 * (of_other - of_fit) / max(of_fit / len(window.data), 1.0)


def unexplained(fit: NeedleFit) -> float:
    """Return what the model leaves."""
    return fit.misfit + 1 - fit.explained


def same_body(a: NeedleFit, b: NeedleFit) -> bool:
    """Say whether two fits lie on the same stroke, perhaps the other way round."""
    return math.dist(middle(a), middle(b)) < 0.25 * a.shape.length_px


def middle(fit: NeedleFit) -> Float:
    """Return the middle of a pin, (col, row)."""
    half, angle = 0.5 * fit.shape.length_px, float(fit.angles[0])
    return np.asarray(fit.position_px + half * np.array([math.cos(angle), -math.sin(angle)]))
