"""The single pins of a film: what a pointed pin explains and a rod does not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.optics import CAP
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.film_curve import skewness_of_log
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape, either_way, middle, unexplained
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.balls_beside import BallsBeside
from rsa_vision.detect.needles.crossing import chi2_of, window_of
from rsa_vision.detect.needles.first_pins import best_tapered, distinct_pins, likest_pins
from rsa_vision.detect.needles.fits import between, excess_of, fit_needles, significant_misfit
from rsa_vision.detect.needles.of_a_kind import (
    are_alike,
    are_as_thick,
    are_of_a_kind,
    are_of_one_size,
    odd_lengths,
    of_usual_width,
    others_like,
    without_company,
)
from rsa_vision.detect.needles.optics import BLURS_PX, GUESS, common_optics
from rsa_vision.detect.needles.pointed import (
    EXPLAINED,
    LEAST_OF_A_KIND,
    STANDS_OUT_ROUGHLY,
    SURER_THAN_ROD,
    is_pin,
    pointed,
    points_one_way,
    shows_its_form,
)
from rsa_vision.detect.needles.sets import MOST_TOGETHER, TAPERS, fit_all, is_located, on_arms, others_beside
from rsa_vision.detect.needles.shared import fit_shared
from rsa_vision.types import Bool, Float

_OTHER_BLURS_PX = BLURS_PX[1::2]  # of pins on films whose balls have another
_KNOWN = 0.12  # of its length, to which the tip of a pin is known even at CNR 5: trabeculae are pointed anyhow
_PRIOR = 0.5  # proportions expected: between 0 (logarithmic) and all of depth over background (linear)
_FAR = 4.0  # median deviations of depths, beyond which one is no better known
_POINT = 0.005  # of the half width: error along a pin without any noise
# errors along a pin over its length: of what beams and film curves are besides, by the curve and the logarithm of the depth, by the others
_OF_MODEL, _OF_UNLIKE, _OF_TAIL, _OF_MISFIT = 0.0015, 0.05, 0.03, 2.0
# by how far the skewness of a curve is from those of logarithms and roots (in units of their bend), and the more so the steeper it is where
# it is less than theirs, as of transmitted light; by how far beams of several energies bend the light under thick metal
_OF_CURVE, _OF_STEEP, _OF_ROOTS, _OF_BEAM = 0.03, 0.007, -0.2, 0.003
# tail below which a film may have been sharpened, by how much less it surely was, and error along a pin by that in units of the blur
_OF_LIGHT, _OF_LIGHT_ERROR, _BY_SHARPENING = -0.1, 0.1, 0.8
_NO_OTHER = 0.15  # from a usual taper: the last fit gets there itself
_SAMPLE = 6
_MOST_ASKED = 18  # for the optics that they have in common


def find_pins(
    film: NDArray[Any],
    rough: list[NeedleFit],
    places: Float,
    long_places: Float,
    tees: list[NeedleFit],
    sign: int,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[list[NeedleFit], Optics]:
    """Fit what may be single pins, and keep those that are.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    rough : list of NeedleFit
        As of :func:`rsa_vision.detect.needles.first_pins.look_for_pins`, one polarity, perhaps of several looks.
    places, long_places : ndarray of shape (n, 2)
        Where others may be, (col, row), likeliest first; where the search answers along a line, and no ball is seen.
    tees : list of NeedleFit
        Their arms are no single pins.
    sign : int
        Of depth.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    pins : list of NeedleFit
    optics : Optics
        With the attenuation that suits the pins; where they are of a kind, with their blur, which beads between bones may not share.
    """
    found = _found_from(film, rough, places, tees, sign, [optics], noise)
    if tees or are_of_a_kind(found[0]):
        return found
    rough = [best_tapered(film, f, noise) for f in rough] + likest_pins(film, long_places, sign, noise)
    if not are_alike([f for f in distinct_pins(rough) if is_pin(f, noise)]):
        return found
    trials = [optics, *(replace(optics, sigma_px=sigma) for sigma in _OTHER_BLURS_PX)]
    more = _found_from(film, rough, places, tees, sign, trials, noise)
    better = are_as_thick(more[0]) and sum(map(is_located, more[0])) > sum(map(is_located, found[0]))
    return more if better or are_of_a_kind(more[0]) else found


def _found_from(
    film: NDArray[Any], rough: list[NeedleFit], places: Float, tees: list[NeedleFit], sign: int, trials: list[Optics], noise: NoiseModel
) -> tuple[list[NeedleFit], Optics]:
    """Find pins from first looks; ``trials``: what the film is known to be like, and what else it may be."""
    known = trials[0]
    on_tees = on_arms(np.array([middle(f) for f in rough]).reshape(-1, 2), tees)
    rough = distinct_pins([f for f, on in zip(rough, on_tees, strict=True) if not on])
    if not rough:
        return [], known
    optics, taper, sample = _likeliest(film, rough[:_SAMPLE], trials, noise)
    if not any(is_pin(f, noise) for f in sample):
        return [], known
    optics = replace(optics, proportion=proportion_of_pins([f for f in rough if f.explained > EXPLAINED]))
    more = [_refit(film, replace(f, shape=replace(f.shape, taper=taper)), optics, noise) for f in rough[_SAMPLE:_MOST_ASKED]]
    optics, told = common_optics(film, [f for f in sample + more if is_pin(f, noise)], optics, noise)
    tapers = TAPERS if min(abs(told - t) for t in TAPERS) < _NO_OTHER else sorted([*TAPERS, told], reverse=True)
    # a wide blur feigns a short point
    _, taper, sample = _likeliest(film, [f for f in sample if is_pin(f, noise)], [optics], noise, tapers)
    width, length = (float(np.median([getattr(f.shape, name) for f in sample])) for name in ("half_width_px", "length_px"))
    usual = NeedleShape(width, length, taper)
    even = replace(optics, uneven=(0.0, 0.0))  # which way of those is the best does not hang on that, and it takes a table for each angle
    fits = [_of_either_size(film, f, usual, even, noise) for f in rough]
    if len(trials) > 1:  # optics were guessed at first: whichever way round a pin began says little
        fits = [[*ways, *(_refit(film, either_way(f)[1], even, noise) for f in ways)] for ways in fits]
    best = [min(ways, key=unexplained) for ways in fits]
    pins = pointed(film, distinct_pins(_still(best, noise)), optics, noise)
    if len(pins) >= LEAST_OF_A_KIND:  # then there may be others, with as sharp a point on another length
        odd = [best_tapered(film, f, noise, even, tapers, quick=False) for f in best if not is_pin(f, noise, STANDS_OUT_ROUGHLY)]
        others = pointed(film, distinct_pins(_still(odd, noise)), optics, noise)
        pins = distinct_pins([*pins, *others]) if others else pins
    pins = _still(fit_all(film, pins, optics, noise, again=MOST_TOGETHER), noise)
    start = _without_what_they_told(optics, known)
    pins, optics = fit_shared(film, of_usual_width(pins), start, noise, parallel=False, alike=True)
    if more := others_like(film, pins, places, optics, noise):
        pins = _still(fit_all(film, [*pins, *more], optics, noise, again=MOST_TOGETHER), noise)
        pins, optics = fit_shared(film, pins, replace(start, proportion=proportion_of_pins(pins)), noise, parallel=False, alike=True)
    if not tees:  # beside those a pin may be what is seen of one, and says so
        pins = [f for f in pins if np.linalg.eigvalsh(f.covariance_px2)[-1] < (_KNOWN * f.shape.length_px) ** 2]
        pins = [f for f, alone in zip(pins, without_company(pins), strict=True) if not alone or shows_its_form(f, noise)]
    return _stated(film, pins, sign, optics, noise, None), optics


def fit_beside_balls(
    film: NDArray[Any], pins: list[NeedleFit], balls: BallsBeside, known: Optics, optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], Optics]:
    """Fit all pins of a film once more, with the balls beside them and on them.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    pins : list of NeedleFit
    balls : BallsBeside
    known, optics : Optics
        Of the film, and as pins have told them.
    noise : NoiseModel

    Returns
    -------
    pins : list of NeedleFit
    optics : Optics
    """
    fitted, optics = fit_shared(film, pins, _without_what_they_told(optics, known), noise, parallel=False, alike=True, balls=balls)
    return _stated(film, fitted, int(np.sign(pins[0].depth)), optics, noise, balls), optics


def _without_what_they_told(optics: Optics, known: Optics) -> Optics:
    """Return where a fit of all pins begins: at their blur; what they have told of the film curve does not count twice."""
    return replace(optics, curve=known.curve, tail=known.tail, mu_px=known.mu_px)


def _stated(
    film: NDArray[Any], pins: list[NeedleFit], sign: int, optics: Optics, noise: NoiseModel, balls: BallsBeside | None
) -> list[NeedleFit]:
    """Keep what still looks like a pin once all are fitted, and state its errors."""
    others = [others_beside(f, [o for o in pins if o is not f], optics) for f in pins]
    if balls:
        others = [balls.and_others(o) for o in others]
    unseen = balls.over if balls else None
    pins = [f for f, beside in zip(pins, others, strict=True) if points_one_way(film, f, beside, optics, noise, unseen)]
    pins = [f for f in _still(pins, noise) if np.sign(f.depth) == sign]  # a fit among others may end up as the gap between them
    typical = float(np.median([f.depth for f in pins])) if pins else 0.0
    return [_less_sure_along(f, typical, odd, optics, noise) for f, odd in zip(pins, odd_lengths(pins), strict=True)]


def optics_of_pins(film: NDArray[Any], rough: list[NeedleFit], noise: NoiseModel) -> tuple[Optics, float]:
    """Estimate the blur from the best of what may be pins, for films without balls and tees.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    rough : list of NeedleFit
    noise : NoiseModel

    Returns
    -------
    Optics
    evidence : float
        Significance of the pins.
    """
    if not rough:
        return replace(GUESS, rough=True), 0.0
    nearest_first = sorted(BLURS_PX, key=lambda sigma: abs(sigma - GUESS.sigma_px))
    trials = [replace(GUESS, sigma_px=sigma, rough=True) for sigma in nearest_first]
    optics, _, sample = _likeliest(film, rough[:_SAMPLE], trials, noise)
    return optics, float(sum(min(f.significance, CAP) for f in sample if is_pin(f, noise)))


def _likeliest(
    film: NDArray[Any], sample: list[NeedleFit], trials: list[Optics], noise: NoiseModel, tapers: Sequence[float] = TAPERS
) -> tuple[Optics, float, list[NeedleFit]]:
    """Choose of these optics and tapers those with which pins leave least, each of them on the same pixels.

    From the first on, blurs are tried that are ever sharper, and ever wider, until they leave more. What no pin explains has a say that is
    bounded.
    """
    widest = max(trials, key=lambda optics: optics.sigma_px)
    windows = [window_of(film, [f], widest, noise, None) for f in sample]
    pixels = np.array([len(window.data) for window in windows])
    fits: dict[tuple[Optics, float], list[NeedleFit]] = {}
    chi2: dict[tuple[Optics, float], Float] = {}

    def worse(left: Float, other: Float) -> float:
        scale = np.maximum(np.minimum(left, other) / pixels, 1.0)
        by = np.clip((left - other) / (2 * scale), -SURER_THAN_ROD, SURER_THAN_ROD)
        return float((by / scale).sum())

    def tapered(optics: Optics, tried: list[NeedleFit]) -> Float:
        """Fit with one taper after the other until they leave more; return what the best leaves."""
        least = np.full(len(tried), np.inf)
        for taper in tapers:  # each from the one before: a cone is longer than the pin with a short point that it stands for
            tried = [_refit(film, replace(f, shape=replace(f.shape, taper=taper)), optics, noise) for f in tried]
            left = np.array([chi2_of(window, f, optics, noise) for window, f in zip(windows, tried, strict=True)])
            fits[optics, taper], chi2[optics, taper] = tried, left
            if worse(left, least) > 0:
                break
            least = left
        return least

    by_blur = sorted(trials, key=lambda optics: optics.sigma_px)
    start = by_blur.index(trials[0])
    at_start = tapered(trials[0], sample)
    for way in (by_blur[start + 1 :], by_blur[:start][::-1]):
        last, tried = at_start, fits[trials[0], tapers[0]]
        for optics in way:
            left = tapered(optics, tried)
            if worse(left, last) > 0:
                break
            last, tried = left, fits[optics, tapers[0]]
    least = np.min(list(chi2.values()), axis=0)
    best = min(chi2, key=lambda trial: worse(chi2[trial], least))
    return *best, fits[best]


def _of_either_size(film: NDArray[Any], rough: NeedleFit, usual: NeedleShape, optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Fit from the size of a first look, and from the usual one unless that is where the fit has come to."""
    own = _refit(film, replace(rough, shape=replace(rough.shape, taper=usual.taper)), optics, noise)
    usually = replace(rough, shape=usual)
    if is_pin(own, noise) and own.explained > EXPLAINED and are_of_one_size(own, usually):  # noise makes many ends of one fit
        return [own]
    return [own, _refit(film, usually, optics, noise)]


def on_pins(position_px: Float, left: Float, pins: list[NeedleFit]) -> Bool:
    """Say which images lie on a pin that explains more there than they do.

    Parameters
    ----------
    position_px : ndarray of shape (n, 2)
    left : ndarray of shape (n,)
        What each leaves unexplained of its image.
    pins : list of NeedleFit

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    on = np.zeros(len(position_px), bool)
    for pin in pins:
        on |= (left > 1 - pin.explained) & on_arms(position_px, [pin])
    return on


def _still(pins: list[NeedleFit], noise: NoiseModel) -> list[NeedleFit]:
    """Leave out what looks like none."""
    return [f for f in pins if is_pin(f, noise, STANDS_OUT_ROUGHLY)]


def _refit(film: NDArray[Any], fit: NeedleFit, optics: Optics, noise: NoiseModel) -> NeedleFit:
    return fit_needles(film, fit.position_px, fit.angles, fit.shape, optics, noise)


def proportion_of_pins(pins: list[NeedleFit]) -> float:
    """Estimate how the depth goes with the background, from pins on different backgrounds.

    Depths are known badly before the film curve is; one that is far off is drawn in, or it alone would tell.

    Parameters
    ----------
    pins : list of NeedleFit

    Returns
    -------
    float
        As :attr:`Optics.proportion`; without pins 0.
    """
    if not pins:
        return 0.0
    depth, background = (np.array([getattr(f, name) for f in pins]) for name in ("depth", "background"))
    ratio, usual = float(np.median(depth) / np.median(background)), float(np.median(depth))
    scatter = max(float(np.median(np.abs(depth - usual))), 1e-3 * abs(usual))
    slack = _PRIOR * abs(ratio) / scatter
    b, d = background - np.median(background), np.clip(depth - usual, -_FAR * scatter, _FAR * scatter)
    return float((b @ d + 0.5 * ratio / slack**2) / (b @ b + 1 / slack**2))


def _less_sure_along(fit: NeedleFit, typical: float, odd_px: float, optics: Optics, noise: NoiseModel) -> NeedleFit:
    """Add an error along the pin: of film curve and blur as far as their models go, of what else lies there, of a point that is no cone.

    No light has a negative tail: software has sharpened such a film, and what stands in for that bends the curve.

    ``typical`` is the depth of the film's pins; ``odd_px`` as of :func:`odd_lengths`. Across the pin nothing of this could move it.
    """
    by_rest = _OF_MISFIT * significant_misfit(fit, noise) / np.sqrt(excess_of(fit, noise))  # by that the table widens all of it
    # where film responds more or less than usual, it is bent more or less as well
    unlike = abs(math.log(fit.depth / typical))
    shift, skewness = optics.curve
    usual = sorted([skewness_of_log(shift), _OF_ROOTS * shift])
    odd = skewness - between(skewness, *usual)
    by_curve = [(_OF_CURVE + _OF_STEEP * abs(shift) ** 3 * (odd < 0)) * odd, _OF_BEAM * shift, _OF_UNLIKE * shift * unlike]
    by_model = np.array([_OF_MODEL, *by_curve, _OF_TAIL * optics.tail, by_rest])
    sharpened = between((_OF_LIGHT - optics.tail) / _OF_LIGHT_ERROR, 0.0, 1.0)
    parts = [odd_px, _POINT * fit.shape.half_width_px, _BY_SHARPENING * sharpened * optics.sigma_px, *(fit.shape.length_px * by_model)]
    error_px = float(np.linalg.norm(parts))
    return replace(fit, covariance_px2=fit.covariance_px2 + error_px**2 * np.outer(fit.way, fit.way))
