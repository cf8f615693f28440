"""Tees on and beside the edges of bones and implants, fitted with the edge.

A mark takes away its part of what is there: on a film that is linear in exposure less behind a bone than beside it, so that its arms are of
other depths. How depths go with the background, tees on edges tell better than those on even ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.usual import proportion_of_all
from rsa_vision.detect.film.least_squares import weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, needle_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import Window, fit_crossing, window_of
from rsa_vision.detect.needles.fits import excess_of, under
from rsa_vision.detect.needles.sets import others_beside

_AROUND, _DIRECTIONS = 1.3, np.linspace(0, 2 * np.pi, 32, endpoint=False)  # lengths from a tip at which no arms are, on which sides
_UNEVEN = 1.5  # variance beside the arms, in units of the noise, from which there is an edge
_FEWEST = 60  # pixels beside arms that tell: ten times the terms of a surface
_ROUNDS = 2  # of estimates of the proportion, from the edges that it makes better understood


def tees_beside_edges(
    film: NDArray[Any], tees: list[NeedleFit], optics: Optics, noise: NoiseModel, is_tee: Callable[[NeedleFit], bool]
) -> tuple[list[NeedleFit], Optics]:
    """Fit again, with an edge in the background, the tees that leave more than noise where the film beside them is uneven.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    tees : list of NeedleFit
        All of the film.
    optics : Optics
        With the proportion that tees on even ground show.
    noise : NoiseModel
    is_tee : callable
        Says whether a fit is a clean one.

    Returns
    -------
    tees : list of NeedleFit
        In another order; as they were where an edge explains no more.
    optics : Optics
        With the proportion that explains most.
    """
    others = [others_beside(t, [o for o in tees if o is not t], optics) for t in tees]
    near = [
        excess_of(t, noise) > 1.0 and _is_uneven(window_of(film, [t], optics, noise, o), t, optics, noise)
        for t, o in zip(tees, others, strict=True)
    ]
    even = [t for t, at_edge in zip(tees, near, strict=True) if not at_edge]
    unlike = list(compress(tees, near))
    if not unlike:
        return tees, optics
    others = list(compress(others, near))
    trials: dict[float, list[NeedleFit]] = {}

    def with_slope(slope: float) -> None:
        seen = replace(optics, proportion=slope)
        trials[slope] = [fit_crossing(film, [t], seen, noise, others=o, edge=True)[0] for t, o in zip(unlike, others, strict=True)]

    def best() -> float:
        return min(trials, key=lambda slope: sum(math.log(excess_of(f, noise)) for f in trials[slope]))

    linear = float(np.median([t.depth / max(t.background, 1.0) for t in even or tees]))
    for slope in (optics.proportion, 0.0, linear):
        with_slope(slope)
    for _ in range(_ROUNDS):
        clean = [t for t in [*even, *trials[best()]] if is_tee(t)]
        if (slope := proportion_of(film, clean, optics)) not in trials:
            with_slope(slope)
    both = zip(trials[best()], unlike, strict=True)
    fits = [replace(fit, edged=True) if excess_of(fit, noise) < excess_of(t, noise) else t for fit, t in both]
    return even + fits, replace(optics, proportion=best())


def proportion_of(film: NDArray[Any], tees: list[NeedleFit], optics: Optics) -> float:
    """Return how the depths of tees go with their backgrounds."""
    depth, background = (np.array([getattr(t, name) for t in tees]) for name in ("depth", "background"))
    return proportion_of_all(depth, background, np.array([_beside(film, t, optics) for t in tees]))[0]


def _beside(film: NDArray[Any], tee: NeedleFit, optics: Optics) -> float:
    """Value of the film around a tee, a median: it has no share in the errors of the fit."""
    reach = _AROUND * tee.shape.length_px + 4 * optics.sigma_px
    place = tee.position_px[:, None] + reach * np.array([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)])
    cols, rows = (np.clip(np.rint(at).astype(np.intp), 0, size - 1) for at, size in zip(place, film.shape[::-1], strict=True))
    return float(np.nanmedian(film[rows, cols]))


def _is_uneven(window: Window, tee: NeedleFit, optics: Optics, noise: NoiseModel) -> bool:
    """Say whether no quadratic surface describes the film beside the arms of a tee: what their own form leaves lies under them."""
    image = needle_image(window.cols - tee.position_px[0], window.rows - tee.position_px[1], tee, optics)
    free = ~under(image)
    if np.count_nonzero(free) < _FEWEST:
        return False
    surface, data = window.surface[:, free].T, (window.data - image)[free]
    weight = 1.0 / noise.variance_at((window.data + window.beside)[free])
    left = data - surface @ weighted_least_squares(surface, weight, data)
    return float(np.mean(weight * left**2)) > _UNEVEN
