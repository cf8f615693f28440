"""Tiles of a film, and what is left of them without the quadratic surfaces that quiet anatomy nearly is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Bool, Float

ENOUGH_TILES = 12  # that are nowhere saturated
MAX_TILES = 900  # spread over the film: more do not sharpen the estimate noticeably
QUANTISATION = 1.0 / 12.0  # variance of rounding to whole values
NO_NOISE = 1.0  # less variance, in steps of the values, is no film's
_BLANK = 0.5  # part of the pixels of a tile that are like the one beside them, in areas of one value
_OF_ONE_VALUE = 0.25  # part of such tiles that a frame has, all of them of its value
_QUIET = 0.25  # of the tiles of a film, whose noise tells whether it has any


def whole_tiles(film: NDArray[Any], side: int, floor: float, ceiling: float) -> NDArray[Any]:
    """Tiles that are nowhere saturated, shape (n, side, side)."""
    tiles = tiles_of(film, side)
    whole = nowhere_saturated(tiles, floor, ceiling)
    # shutters and frames of one value, amid those of the film, are no film where that has noise; of film without noise, areas differ
    blank = whole & ((tiles[:, :, 1:] == tiles[:, :, :-1]).mean((1, 2)) > _BLANK)
    if blank.any():
        value = np.median(tiles[blank], axis=(1, 2))
        blank[blank] = (value[:, None] == value).mean(axis=1) > _OF_ONE_VALUE
        rest = tiles[whole & ~blank]
        if len(rest) >= ENOUGH_TILES and np.quantile(without_surfaces(rest)[2], _QUIET) > NO_NOISE:
            whole &= ~blank
    return np.asarray(tiles[whole])


def nowhere_saturated(tiles: NDArray[Any], floor: float, ceiling: float) -> Bool:
    """Say of which tiles (n, side, side) all values lie between these."""
    return np.asarray((tiles.min((1, 2)) > floor) & (tiles.max((1, 2)) < ceiling))


def tiles_of(film: NDArray[Any], side: int, most: int = MAX_TILES) -> NDArray[Any]:
    """Tiles spread evenly over a film, about so many at the most, shape (n, side, side)."""
    n_rows, n_cols = film.shape[0] // side, film.shape[1] // side
    step = max(1, int(np.ceil(np.sqrt(n_rows * n_cols / most))))
    tiles = film[: n_rows * side, : n_cols * side].reshape(n_rows, side, n_cols, side)[::step, :, ::step].swapaxes(1, 2)
    return tiles.reshape(-1, side, side)


def without_surfaces(tiles: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], Float]:
    """Medians of tiles (n,), what quadratic surfaces leave of them (n, p) and its variance (n,)."""
    axis = np.linspace(-1, 1, tiles.shape[1])
    gx, gy = np.meshgrid(axis, axis)
    basis = np.linalg.qr(np.stack([b.ravel() for b in (np.ones_like(gx), gx, gy, gx * gx, gx * gy, gy * gy)], axis=1))[0]
    flat = tiles.reshape(len(tiles), -1)
    mean = medians(flat)  # a mark in a tile must not make it a level of its own
    rest = flat.astype(np.float32) - mean[:, None].astype(np.float32)  # single precision does once the level is off
    single = basis.astype(np.float32)
    rest -= (rest @ single) @ single.T
    return mean, rest, np.einsum("ij,ij->i", rest, rest).astype(np.float64) / (flat.shape[1] - basis.shape[1])


def roughness(tiles: NDArray[Any], variance: Float) -> Float:
    """Variance of tiles over what second differences, which edges in them hardly change, make of it, shape (n,)."""
    some = tiles[:, ::2].astype(np.float32)
    bend = np.abs(some[:, :, 2:] - 2 * some[:, :, 1:-1] + some[:, :, :-2])
    return np.asarray(variance / np.maximum(medians(bend.reshape(len(tiles), -1)) ** 2, QUANTISATION), np.float64)


def skewness(rest: NDArray[Any]) -> Float:
    """Skewness of what surfaces leave of tiles (n, p): marks are all darker, or all brighter, than what is between them."""
    spread = np.sqrt(np.mean(np.square(rest), axis=1, dtype=np.float64))
    return np.asarray(np.mean(rest**3, axis=1, dtype=np.float64) / np.maximum(spread, 1e-9) ** 3)


def medians(values: NDArray[Any]) -> NDArray[Any]:
    """Return the medians along the last axis: those of numpy, which looks for NaN besides, in a tenth of the time."""
    half = values.shape[-1] // 2
    parted = np.partition(values, half)
    upper = parted[..., half]
    return np.asarray(upper if values.shape[-1] % 2 else upper / 2 + parted[..., :half].max(-1) / 2)
