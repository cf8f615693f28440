"""First looks at what may be single pins, with guessed optics: at strokes, and wherever a pin of any size looks like the film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape, turned, unexplained
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.fits import explains, fit_needles, unfit
from rsa_vision.detect.needles.laid_over import LIKENESS, laid_over
from rsa_vision.detect.needles.optics import BLURS_PX, GUESS
from rsa_vision.detect.needles.pointed import STANDS_OUT_ROUGHLY
from rsa_vision.detect.needles.sets import TAPERS, is_apart, on_arms, same_body
from rsa_vision.types import Float

MOST_STROKES = 120  # strongest of a film, most of them seen by two filters
_ROUGH = 0.85  # explained by a first look, with guessed optics
# from which a first look with a sharper guess is worth it, which has to explain so much; those in a row that are tried in vain
_NEARLY, _SHARPLY, _MOST_SHARPER = 0.7, 0.95, 4
_SHARP = replace(GUESS, sigma_px=BLURS_PX[0])
_MOST_IN_VAIN = 20  # strokes in a row that are no pins
_AGAIN = 0.3  # part of a stroke's length within which another is the same
_CLOSE_FIT = 0.03  # misfit and what is not explained, of a pin whose taper is right
_WIDTHS_PX, _RATIOS = (1.5, 2.5, 4.0, 6.0), (9.0, 15.0)  # half widths that are laid over a film, and lengths over them
_MOST_PLACES, _MOST_FOUND = 1000, 40


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
    in_vain, sharper = 0, 0
    for stroke in strokes:
        if (np.hypot(*(tried - stroke[:2]).T) < _AGAIN * stroke[3]).any():
            continue  # the same stroke, seen by another filter
        tried = np.append(tried, stroke[None, :2], axis=0)
        in_vain += 1
        best = _either_way(film, stroke, GUESS, noise)
        if not explains(best, _ROUGH, STANDS_OUT_ROUGHLY) and best.explained > _NEARLY and sharper < _MOST_SHARPER:
            sharp = _either_way(film, stroke, _SHARP, noise)  # as sharpened films show thin pins
            sharper = 0 if explains(sharp, _SHARPLY) else sharper + 1
            best = sharp if sharper == 0 else best
        if explains(best, _ROUGH, STANDS_OUT_ROUGHLY):
            found.append(best)
            in_vain = 0
        if in_vain == _MOST_IN_VAIN:
            break
    return distinct_pins(found)


def _either_way(film: NDArray[Any], stroke: Float, optics: Optics, noise: NoiseModel) -> NeedleFit:
    """Fit a pin to a stroke either way round; return what explains more."""
    col, row, angle, length, width, _ = stroke
    fits: list[NeedleFit] = []
    for turn in (angle, angle + np.pi):
        if fits and unexplained(fits[0]) < _CLOSE_FIT:
            break
        start = NeedleShape(max(0.9, 0.5 * width), 1.45 * length, TAPERS[0])  # the answer fades before the tip
        tip = np.array([col, row]) - 0.6 * start.length_px * np.array([np.cos(turn), -np.sin(turn)])
        fits.append(fit_needles(film, tip, np.array([turn]), start, optics, noise, quick=True))
    return max(fits, key=lambda f: f.explained)


def likest_pins(film: NDArray[Any], places: Float, sign: int, noise: NoiseModel) -> list[NeedleFit]:
    """Fit a pin of some size where one looks most like the film, with guessed optics, and keep what may be one.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    places : ndarray of shape (n, 2)
        Where the search answers, (col, row), strongest first.
    sign : int
        Of depth.
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        Best first.
    """
    shapes = [NeedleShape(width, ratio * width, TAPERS[1]) for width in _WIDTHS_PX for ratio in _RATIOS]
    pins = [replace(unfit(np.zeros(2), np.zeros(1), shape), depths=np.array([float(sign)])) for shape in shapes]
    out: list[NeedleFit] = []
    for start in laid_over(film, places[:_MOST_PLACES], pins, GUESS):
        if start.likeness < LIKENESS or len(out) == _MOST_FOUND:
            break
        if on_arms(start.place[None], out).any():
            continue
        ways = (start.pin.position_px, start.pin.angles), turned(start.pin)
        fits = [fit_needles(film, *way, start.pin.shape, GUESS, noise, quick=True) for way in ways]
        best = max(fits, key=lambda f: f.explained)
        if explains(best, _ROUGH, STANDS_OUT_ROUGHLY) and best.depth * sign > 0:
            out.append(best_tapered(film, best, noise))
    return distinct_pins(out)


def distinct_pins(pins: list[NeedleFit]) -> list[NeedleFit]:
    """Return one fit of every pin, best first."""
    kept: list[NeedleFit] = []
    for fit in sorted(pins, key=unexplained):
        if is_apart(fit, kept) and not any(same_body(fit, k) for k in kept):
            kept.append(fit)
    return kept


def best_tapered(
    film: NDArray[Any],
    first: NeedleFit,
    noise: NoiseModel,
    optics: Optics = GUESS,
    tapers: Sequence[float] = TAPERS,
    *,
    quick: bool = True,
) -> NeedleFit:
    """Fit with the other tapers as well: what is a cylinder with a short point is longer as a cone, and leaves more.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    first : NeedleFit
        With one taper.
    noise : NoiseModel
    optics : Optics
    tapers : sequence of float
    quick : bool
        As of :func:`rsa_vision.detect.needles.fits.fit_needles`.

    Returns
    -------
    NeedleFit
        That leaves least.
    """
    fits = [first]
    for taper in (t for t in tapers if t != first.shape.taper):
        shape = replace(fits[-1].shape, taper=taper)
        fits.append(fit_needles(film, fits[-1].position_px, fits[-1].angles, shape, optics, noise, quick=quick))
    return min(fits, key=unexplained)
