"""The single pins of a film: elongated islands of the filter's answer that a pointed pin explains and a rod does not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import COARSE_MU_PX, COARSE_SIGMA_PX
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import chi2_of, window_of
from rsa_vision.detect.needles.fits import excess_of, explains, fit_needles, significant_misfit
from rsa_vision.detect.needles.optics import common_optics
from rsa_vision.detect.needles.pointed import (
    EXPLAINED,
    LEAST_OF_A_KIND,
    STANDS_OUT_ROUGHLY,
    SURER_THAN_ROD,
    is_pin,
    middle,
    pointed,
    same_body,
    standing_out,
    unexplained,
)
from rsa_vision.detect.needles.sets import MOST_TOGETHER, NEAREST_PX, TAPERS, fit_all, on_arms
from rsa_vision.detect.needles.shared import fit_shared
from rsa_vision.types import Bool, Float

BLURS_PX = (0.6, 0.8, 1.0, 1.25, 1.6, 2.1)
MOST_STROKES = 120  # strongest of a film, most of them seen by two filters
_ROUGH = 0.85  # explained by a first look, with guessed optics
_MOST_IN_VAIN = 20  # strokes in a row that are no pins
_KNOWN = 0.12  # of its length, to which the tip of a pin is known even at CNR 5: trabeculae are pointed anyhow
_PRIOR = 0.5  # proportions expected: between 0 (logarithmic) and all of depth over background (linear)
_POINT = 0.005  # of the half width: error along a pin without any noise
# errors along a pin over its length, by the fourth power of the curve, by it and the logarithm of the depth, by the others
_OF_CURVE, _OF_UNLIKE, _OF_TAIL, _OF_MISFIT = 0.01, 0.05, 0.03, 2.0
_AGAIN = 0.3  # part of a stroke's length within which another is the same
_SAMPLE = 6
_MOST_ASKED = 18  # for the optics that they have in common
_CLOSE_FIT = 0.03  # misfit and what is not explained, of a pin whose taper is right


def look_for_pins(film: NDArray[Any], strokes: Float, noise: NoiseModel) -> list[NeedleFit]:
    """Fit a pin either way round to each stroke with guessed optics, strongest first, and keep what may be one.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    strokes : ndarray of shape (n, 6)
        As of :func:`rsa_vision.detect.search.strokes.find_strokes`, strongest first.
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        Best first.
    """
    found: list[NeedleFit] = []
    tried = np.zeros((0, 2))
    in_vain = 0
    guess = Optics(COARSE_SIGMA_PX, COARSE_MU_PX)
    for col, row, angle, length, width, _ in strokes:
        if (np.hypot(*(tried - [col, row]).T) < _AGAIN * length).any():
            continue  # the same stroke, seen by another filter
        tried = np.append(tried, [[col, row]], axis=0)
        in_vain += 1
        fits: list[NeedleFit] = []
        for turn in (angle, angle + np.pi):
            if fits and unexplained(fits[0]) < _CLOSE_FIT:
                break
            start = NeedleShape(max(0.9, 0.5 * width), 1.45 * length, TAPERS[0])  # the answer fades before the tip
            tip = np.array([col, row]) - 0.6 * start.length_px * np.array([np.cos(turn), -np.sin(turn)])
            fits.append(fit_needles(film, tip, np.array([turn]), start, guess, noise, quick=True))
        best = max(fits, key=lambda f: f.explained)
        if explains(best, _ROUGH, STANDS_OUT_ROUGHLY):
            found.append(best)
            in_vain = 0
        if in_vain == _MOST_IN_VAIN:
            break
    return _distinct(found)


def find_pins(
    film: NDArray[Any], rough: list[NeedleFit], places: Float, tees: list[NeedleFit], optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], Optics]:
    """Fit what may be single pins, and keep those that are.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    rough : list of NeedleFit
        As of :func:`look_for_pins`, one polarity, perhaps of several looks.
    places : ndarray of shape (n, 2)
        Where others may be, (col, row), likeliest first.
    tees : list of NeedleFit
        Their arms are no single pins.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    pins : list of NeedleFit
    optics : Optics
        With the attenuation that suits the pins.
    """
    on_tees = on_arms(np.array([middle(f) for f in rough]).reshape(-1, 2), tees)
    rough = _distinct([f for f, on in zip(rough, on_tees, strict=True) if not on])
    if not rough:
        return [], optics
    _, taper, sample = _likeliest(film, rough[:_SAMPLE], [optics], noise)
    if not any(is_pin(f, noise) for f in sample):
        return [], optics
    optics = replace(optics, proportion=_proportion([f for f in rough if f.explained > EXPLAINED]))
    more = [_refit(film, replace(f, shape=replace(f.shape, taper=taper)), optics, noise) for f in rough[_SAMPLE:_MOST_ASKED]]
    optics = common_optics(film, [f for f in sample + more if is_pin(f, noise)], optics, noise)
    _, taper, sample = _likeliest(film, [f for f in sample if is_pin(f, noise)], [optics], noise)  # a wide blur feigns a short point
    width, length = (float(np.median([getattr(f.shape, name) for f in sample])) for name in ("half_width_px", "length_px"))
    starts = [(replace(f.shape, taper=taper), NeedleShape(width, length, taper)) for f in rough]
    pins = [
        min((_refit(film, replace(f, shape=shape), optics, noise) for shape in shapes), key=unexplained)
        for f, shapes in zip(rough, starts, strict=True)
    ]
    pins = pointed(film, _distinct([f for f in pins if is_pin(f, noise, STANDS_OUT_ROUGHLY)]), places, optics, noise)
    pins = [f for f in fit_all(film, pins, optics, noise, again=MOST_TOGETHER) if is_pin(f, noise, STANDS_OUT_ROUGHLY)]
    pins, optics = fit_shared(film, pins, optics, noise, parallel=False, alike=True)
    if not tees:  # beside those a pin may be what is seen of one, and says so
        pins = [f for f in pins if np.linalg.eigvalsh(f.covariance_px2)[-1] < (_KNOWN * f.shape.length_px) ** 2]
        pins = pins if len(pins) >= LEAST_OF_A_KIND else standing_out(pins, noise)
    typical = float(np.median([f.depth for f in pins])) if pins else 0.0
    return [_less_sure_along(f, typical, optics, noise) for f in pins if is_pin(f, noise, STANDS_OUT_ROUGHLY)], optics


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
        return Optics(COARSE_SIGMA_PX, COARSE_MU_PX, rough=True), 0.0
    trials = [Optics(sigma, COARSE_MU_PX, rough=True) for sigma in BLURS_PX]
    optics, _, sample = _likeliest(film, rough[:_SAMPLE], trials, noise)
    return optics, float(sum(min(f.significance, 50.0) for f in sample if is_pin(f, noise)))


def _likeliest(
    film: NDArray[Any], sample: list[NeedleFit], trials: list[Optics], noise: NoiseModel
) -> tuple[Optics, float, list[NeedleFit]]:
    """Choose of these optics and of all tapers those with which pins leave least, each of them on the same pixels.

    What no pin explains has a say that is bounded.
    """
    widest = max(trials, key=lambda optics: optics.sigma_px)
    windows = [window_of(film, [f], widest, noise, None) for f in sample]
    fits, chi2 = {}, {}
    for optics in trials:
        tried, last = sample, np.full(len(sample), np.inf)
        for taper in TAPERS:  # each from the one before: a cone is longer than the pin with a short point that it stands for
            tried = [_refit(film, replace(f, shape=replace(f.shape, taper=taper)), optics, noise) for f in tried]
            left = np.array([chi2_of(window, f, optics, noise) for window, f in zip(windows, tried, strict=True)])
            fits[optics, taper], chi2[optics, taper] = tried, left
            if np.mean(left > last) > 0.5:
                break
            last = left
    least = np.min(list(chi2.values()), axis=0)
    scale = 2 * np.maximum(least / [len(window.data) for window in windows], 1.0)
    worse = {trial: float(np.minimum((left - least) / scale, SURER_THAN_ROD).sum()) for trial, left in chi2.items()}
    best = min(worse, key=lambda trial: worse[trial])
    return *best, fits[best]


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


def _refit(film: NDArray[Any], fit: NeedleFit, optics: Optics, noise: NoiseModel) -> NeedleFit:
    return fit_needles(film, fit.position_px, fit.angles, fit.shape, optics, noise)


def _proportion(pins: list[NeedleFit]) -> float:
    """Estimate how the depth goes with the background, from pins on different backgrounds."""
    if not pins:
        return 0.0
    depth, background = (np.array([getattr(f, name) for f in pins]) for name in ("depth", "background"))
    ratio = float(np.median(depth) / np.median(background))
    slack = _PRIOR * abs(ratio) / max(float(np.median(np.abs(depth - np.median(depth)))), 1e-3 * abs(float(np.median(depth))))
    b, d = background - np.median(background), depth - np.median(depth)
    return float((b @ d + 0.5 * ratio / slack**2) / (b @ b + 1 / slack**2))


def _less_sure_along(fit: NeedleFit, typical: float, optics: Optics, noise: NoiseModel) -> NeedleFit:
    """Add an error along the pin: of film curve and blur as far as their models go, of what else lies there, of a point that is no cone.

    ``typical`` is the depth of the film's pins. Across the pin there is nothing that these could move.
    """
    by_rest = _OF_MISFIT * significant_misfit(fit, noise) / np.sqrt(excess_of(fit, noise))  # by that the table widens all of it
    # where film responds more or less than usual, it is bent more or less as well
    unlike = abs(math.log(fit.depth / typical))
    by_model = np.array([_OF_CURVE * optics.curve[0] ** 4, _OF_UNLIKE * optics.curve[0] * unlike, _OF_TAIL * optics.tail, by_rest])
    parts = [_POINT * fit.shape.half_width_px, *(fit.shape.length_px * by_model)]
    error_px = float(np.linalg.norm(parts))
    way = np.array([np.cos(fit.angles[0]), -np.sin(fit.angles[0])])
    return replace(fit, covariance_px2=fit.covariance_px2 + error_px**2 * np.outer(way, way))


def _distinct(pins: list[NeedleFit]) -> list[NeedleFit]:
    kept: list[NeedleFit] = []
    for fit in sorted(pins, key=unexplained):
        if all(math.dist(fit.position_px, k.position_px) > NEAREST_PX and not same_body(fit, k) for k in kept):
            kept.append(fit)
    return kept
