"""Pins laid over places of a film, every way round: what is like one is worth a fit, however strongly it answers the search.

Between bones the search answers to more than pins, and to these no stronger than to the rest; but little else looks like them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.least_squares import polynomial
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape, needle_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.fits import unfit
from rsa_vision.types import Float, Int

LIKENESS = 0.5  # correlation coefficient from which a place is worth a fit
_AT = (0.45, 0.65, 0.85)  # of the length from the tip, where a pin may answer the search most
_DIRECTIONS = np.linspace(0, 2 * np.pi, 24, endpoint=False).tolist()  # of which each quarter is the first, turned
_SCALE = 2  # films are compared at half resolution
_AT_ONCE = 256  # places
_KEPT = 12  # pins whose images are kept: those that are laid over every film, and a few of its own


@dataclass(frozen=True, slots=True, eq=False)
class LaidOver:
    """A pin as it lies over a place.

    Attributes
    ----------
    place : ndarray of shape (2,)
        (col, row).
    likeness : float
        Correlation coefficient with the film there, less a quadratic surface.
    pin : NeedleFit
        Where it begins a fit, with depth and background as they look there.
    """

    place: Float
    likeness: float
    pin: NeedleFit


def laid_over(film: NDArray[Any], places: Float, pins: Sequence[NeedleFit], optics: Optics) -> list[LaidOver]:
    """Return for every place, once a pixel, how one of these pins lies over it most like the film, likest first.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    places : ndarray of shape (n, 2)
        On the pins, (col, row).
    pins : sequence of NeedleFit
        Sizes and depths; where they point does not count.
    optics : Optics

    Returns
    -------
    list of LaidOver
    """
    pixel = np.rint(places).astype(np.intp)
    first_there = np.sort(np.unique(pixel, axis=0, return_index=True)[1])
    places, pixel = places[first_there], pixel[first_there]
    best = np.full(len(places), -1.0)
    which = np.zeros((len(places), 2), np.intp)
    seen = np.zeros((len(places), 2))  # depth and background
    coarse = optics.pooled(_SCALE)
    for k, pin in enumerate(pins):
        half = _SCALE * math.ceil((pin.shape.length_px + 2 * optics.sigma_px) / _SCALE)
        surface, images, length = _bare_images(pin.shape, half, coarse)
        for first in range(0, len(places), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            values = _around(film, pixel[part], half)
            background = values.mean(axis=1)
            values -= values @ surface @ surface.T
            answer = np.sign(pin.depths[0]) * (values @ images.T)
            way = answer.argmax(axis=1)
            most = answer[np.arange(len(way)), way]
            like = most / np.maximum(np.linalg.norm(values, axis=1), 1e-9)
            better = like > best[part]
            seen[part][better] = np.column_stack([np.sign(pin.depths[0]) * most / length[way], background])[better]
            best[part][better], which[part][better] = like[better], np.column_stack([np.full(len(way), k), way])[better]
    out = []
    for i in np.argsort(-best, kind="stable"):
        pin = pins[which[i, 0]]
        tip, angle = _lying(pin.shape.length_px)[which[i, 1]]
        start = replace(pin, position_px=pixel[i] + tip, angles=np.array([angle]), depth=float(seen[i, 0]), background=float(seen[i, 1]))
        out.append(LaidOver(places[i], float(best[i]), start))
    return out


def _lying(length_px: float) -> list[tuple[Float, float]]:
    """Where tips are, against the place that a pin of this length lies over, and which way it points from there; by directions."""
    ways = ((np.array([math.cos(angle), -math.sin(angle)]), angle) for angle in _DIRECTIONS)
    return [(-at * length_px * way, angle) for way, angle in ways for at in _AT]


@lru_cache(maxsize=_KEPT)
def _bare_images(shape: NeedleShape, half: int, optics: Optics) -> tuple[Float, Float, Float]:
    """Return quadratic surfaces (n, 6), what a bright pin shows besides them each way round (ways, n), both of length one, and how long."""
    axis = np.arange(-half, half, _SCALE) + (_SCALE - 1) / 2
    cols, rows = (grid.ravel() for grid in np.meshgrid(axis, axis))
    surface = np.linalg.qr(polynomial(half, cols, rows))[0]
    ways, bright = _lying(shape.length_px), replace(unfit(np.zeros(2), np.zeros(1), shape), depths=np.ones(1))
    quarter = [needle_image(cols - x, rows - y, replace(bright, angles=np.array([a])), optics) for (x, y), a in ways[: len(ways) // 4]]
    square = np.reshape(quarter, (-1, len(axis), len(axis)))
    images = np.concatenate([np.rot90(square, turn, axes=(1, 2)) for turn in range(4)]).reshape(len(ways), -1)
    images -= images @ surface @ surface.T
    length = np.linalg.norm(images, axis=1)
    return surface, images / length[:, None], length


def _around(film: NDArray[Any], pixel: Int, half: int) -> Float:
    """Return squares around pixels (n, 2) at half resolution, shape (n, pixels)."""
    axis = np.arange(-half, half)
    rows, cols = (np.clip(pixel[:, k, None] + axis, 0, film.shape[1 - k] - 1) for k in (1, 0))
    values = film[rows[:, :, None], cols[:, None]]
    side = len(axis) // _SCALE
    return np.array([cv2.resize(square, (side, side), interpolation=cv2.INTER_AREA).ravel() for square in values], np.float64)
