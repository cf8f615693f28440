"""Waves that JPEG 2000 makes out of nothing: coefficients of wavelets, those less than a step set to zero.

As with the cosine transform of JPEG (`compression.py`) even film has lost all noise, and where noise came to a step or more there is a
wave, as round as a mark. The steps show in the film: coefficients are zero, or leave a gap (ITU-T T.800, annexes E and F: the irreversible
transform of Daubechies' 9 and 7 taps, by lifting).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.tiles import nowhere_saturated, tiles_of
from rsa_vision.types import Float

_LIFTING = (-1.586134342059924, -0.052980118572961, 0.882911075530934, 0.443506852043971)
_SIDE, _MARGIN = 128, 32  # pixels of a tile, and at its sides, where what lies beyond would change coefficients
_ASKED, _MOST = 9, 64  # tiles that may tell that it was not compressed, and how much it was
_NOT_ZERO = 2.0  # seven times the error of pixels that are whole numbers
_ZERO = 0.5  # part of the coefficients
_GAP, _BEYOND, _EMPTY, _ENOUGH = (0.4, 0.6), (0.6, 1.2), 0.25, 32  # of the usual size of those not zero; part; coefficients that tell
_RECONSTRUCTED = 1.5  # steps, that most coefficients which are not zero come to
_TOLD_BY = (1, 2)  # levels: strong compression leaves nothing of the finest
_LIKE_MARKS = 2  # level whose diagonal waves are the highest of those as wide as marks


def height_of_waves(film: NDArray[Any], floor: float = -np.inf, ceiling: float = np.inf) -> float:
    """Return the height of the waves that a single coefficient makes, if it is just not zero.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    floor, ceiling : float
        Values at which pixels are saturated.

    Returns
    -------
    float
        Film values; zero for films that JPEG 2000 has not compressed, or not noticeably.
    """
    some = _diagonal(_tiles(film, _ASKED, floor, ceiling), 1)
    if np.count_nonzero(np.abs(some) > _NOT_ZERO) >= (1 - _ZERO) * some.size:  # or there is no tile
        return 0.0
    tiles = _tiles(film, _MOST, floor, ceiling)
    step = next((of for of in (_step(_diagonal(tiles, level)) for level in _TOLD_BY) if of), 0.0)
    wave = _wave(_LIKE_MARKS)  # coders make all bands of equal worth: the step in the pixels is one for all
    return _RECONSTRUCTED * step * float(np.abs(wave).max() / np.linalg.norm(wave))


def _step(band: Float) -> float:
    """Return the step of a band; zero if its coefficients leave no gap."""
    size = np.abs(band[np.abs(band) > _NOT_ZERO])
    if len(size) < _ENOUGH or len(size) > (1 - _ZERO) * band.size:
        return 0.0
    usual = float(np.median(size))
    if _GAP[0] * usual < _NOT_ZERO:
        return 0.0
    inside, beyond = (np.count_nonzero((size >= low * usual) & (size < high * usual)) / (high - low) for low, high in (_GAP, _BEYOND))
    return usual / _RECONSTRUCTED if inside < _EMPTY * beyond else 0.0


def _tiles(film: NDArray[Any], most: int, floor: float, ceiling: float) -> Float:
    """Tiles spread over the film that are nowhere saturated, shape (n, side, side)."""
    tiles = tiles_of(film, _SIDE, most)
    return np.asarray(tiles[nowhere_saturated(tiles, floor, ceiling)], np.float64)


def _diagonal(tiles: Float, level: int) -> Float:
    """Coefficients of tiles (n, s, s), high both along and across, in units of the pixels that one makes (L2)."""
    for _ in range(level - 1):
        tiles = _split(_split(tiles, 1)[0], 2)[0]
    inside = slice(_MARGIN >> level, -_MARGIN >> level)
    return np.asarray(np.linalg.norm(_wave(level)) * _split(_split(tiles, 1)[1], 2)[1][:, inside, inside])


def _split(of: Float, axis: int) -> tuple[Float, Float]:
    even, odd = (np.moveaxis(of, axis, 0)[k::2].copy() for k in (0, 1))
    for into, by, step, factor in _lifted(even, odd):
        into += factor * _neighbours(by, after=step)
    return np.moveaxis(even, 0, axis), np.moveaxis(odd, 0, axis)


def _joined(even: Float, odd: Float, axis: int) -> Float:
    even, odd = np.moveaxis(even, axis, 0).copy(), np.moveaxis(odd, axis, 0).copy()
    for into, by, step, factor in reversed(_lifted(even, odd)):
        into -= factor * _neighbours(by, after=step)
    return np.moveaxis(np.stack([even, odd], axis=1).reshape(-1, *even.shape[1:]), 0, axis)


def _lifted(even: Float, odd: Float) -> list[tuple[Float, Float, bool, float]]:
    """Return what is lifted, by the neighbours of what, whether by those after it, and how far."""
    return [(odd, even, True, factor) if k % 2 == 0 else (even, odd, False, factor) for k, factor in enumerate(_LIFTING)]


def _neighbours(of: Float, *, after: bool) -> Float:
    """Each with the next, or the one before; the last stands for what is beyond."""
    return np.asarray(of + np.concatenate([of[1:], of[-1:]] if after else [of[:1], of[:-1]]))


@lru_cache(maxsize=4)
def _wave(level: int) -> Float:
    """Return what one diagonal coefficient in the middle makes."""
    side = _SIDE >> level
    band = np.zeros((side, side))
    band[side // 2, side // 2] = 1.0
    image = _joined(np.zeros((2 * side, side)), _joined(np.zeros_like(band), band, axis=0), axis=1)
    for _ in range(level - 1):
        wider = _joined(image, np.zeros_like(image), axis=1)
        image = _joined(wider, np.zeros_like(wider), axis=0)
    return image
