"""Two tees that lie nearly on each other, as the images of one mark from two foci can: told from one tee by what one tee cannot explain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.types import Float

Judge = Callable[[NeedleFit], bool]

APART_PX = (2.5, 5.0, 8.0)  # separations tried; what is closer than half the first cannot be told apart
_UNLIKE, _LEAST_UNLIKE = 2.5, 0.05  # misfits that call for a second look: against the film's typical one, and at least
_BETTER = 0.6  # part of one tee's misfit that two may leave
_EIGHTHS = np.pi / 4 * np.arange(4)
_BLURRIER = (-0.25, 0.2, 0.4, 0.6)  # logarithms of a mark's own blur over the film's that are tried: a penumbra is no second tee
_ALIKE = 4.0  # ratio of depths: images of one kind of mark, with more or less light


def split_twins(
    film: NDArray[Any],
    tees: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    is_tee: Judge,
    others: Callable[[list[NeedleFit]], Images | None],
) -> list[NeedleFit]:
    """Replace every tee that is none by two, where two explain it.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    tees : list of NeedleFit
    optics : Optics
    noise : NoiseModel
    is_tee : callable
        Says whether a fit is good enough for a tee.
    others : callable
        Images of all tees but the given ones, for the fits to subtract.

    Returns
    -------
    list of NeedleFit
        What one tee explains, and what two explain; the rest unchanged.
    """
    clean = [t for t in tees if is_tee(t)]
    if not clean:
        return tees
    # two that lie nearly on each other may still pass for one, if not for a good one
    good = max(_UNLIKE * float(np.median([t.misfit for t in clean])), _LEAST_UNLIKE)
    out = []
    offsets: list[Float] = []  # twins of one film tend to be apart by the same vector: what worked once is tried first
    for tee in tees:
        if is_tee(tee) and tee.misfit < good:
            out.append(tee)
            continue
        model = clean[int(np.argmin([abs(c.shape.length_px - tee.shape.length_px) for c in clean]))]
        beside = others([tee])
        blurred = [_blurred(film, tee, b, optics, noise, beside) for b in _BLURRIER]
        one = min([tee, *(b for b in blurred if is_tee(b) and math.dist(b.position_px, tee.position_px) < APART_PX[0])], key=_left)
        pair = _split(film, tee, model, offsets, optics, noise, is_tee, beside)
        better = bool(pair) and max(map(_left, pair)) < _BETTER * _left(one)
        out += pair if better else [one]
        if better:
            offsets.insert(0, pair[1].position_px - pair[0].position_px)
    return out


def _left(fit: NeedleFit) -> float:
    """What a fit leaves, in film values."""
    return fit.misfit * abs(fit.depth)


def _blurred(film: NDArray[Any], tee: NeedleFit, blurrier: float, optics: Optics, noise: NoiseModel, beside: Images | None) -> NeedleFit:
    """Fit a tee with a blur of its own."""
    return fit_crossing(film, [replace(tee, blurrier=blurrier)], optics, noise, others=beside, steps=10)[0]


def _split(
    film: NDArray[Any],
    tee: NeedleFit,
    model: NeedleFit,
    offsets: list[Float],
    optics: Optics,
    noise: NoiseModel,
    is_tee: Judge,
    others: Images | None,
) -> list[NeedleFit]:
    fresh = [d * np.array([np.cos(a), np.sin(a)]) for d in APART_PX for a in _EIGHTHS]
    best: tuple[float, list[NeedleFit]] = (np.inf, [])
    for tried, offset in enumerate([*offsets[:1], *fresh]):
        if tried == 1 and offsets and best[1]:
            break
        starts = [replace(model, position_px=tee.position_px + side * offset / 2) for side in (-1, 1)]
        pair = fit_crossing(film, starts, optics, noise, others=others, steps=10)
        depths = sorted(abs(p.depth) for p in pair)
        apart = np.hypot(*(pair[1].position_px - pair[0].position_px)) > APART_PX[0] / 2
        alike = depths[1] < _ALIKE * depths[0] and np.sign(pair[0].depth) == np.sign(pair[1].depth) == np.sign(model.depth)
        near = max(np.hypot(*(p.position_px - tee.position_px)) for p in pair) < APART_PX[-1]
        misfit = max(p.misfit for p in pair)
        if apart and alike and near and all(is_tee(p) for p in pair) and misfit < best[0]:
            best = (misfit, pair)
    return best[1]
