"""Square windows of a film as one array, with the weights that mask what is not to be fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.types import Bool, Float, Int


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Windows of equal size around marker candidates.

    Attributes
    ----------
    values : ndarray of shape (n, s, s)
        Film values, float64.
    valid : ndarray of bool, shape (n, s, s)
        False outside the film and where the film is saturated.
    corner_px : ndarray of int, shape (n, 2)
        (col, row) of the first pixel of each window.
    """

    values: Float
    valid: Bool
    corner_px: Int

    @property
    def size(self) -> int:
        """Side of the windows in pixels."""
        return int(self.values.shape[1])

    def places(self, window: int) -> tuple[Float, Float]:
        """Return the columns and rows on the film of the pixels of a window, shape (s, s)."""
        cols, rows = np.meshgrid(*(np.arange(float(self.size)) + self.corner_px[window][:, None]))
        return cols, rows


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A part of a film, with something taken away.

    Attributes
    ----------
    values : ndarray of float32, shape (rows, cols)
    corner_px : ndarray of int, shape (2,)
        (col, row) of its first pixel.
    """

    values: NDArray[np.float32]
    corner_px: Int


def box_of(film: NDArray[Any], place_px: Float, half: int) -> Box:
    """Copy a box of ``2 half + 1`` pixels, or what the film has of that, around a place (col, row)."""
    low = np.maximum(np.rint(place_px).astype(np.intp) - half, 0)
    high = np.maximum(np.rint(place_px).astype(np.intp) + half + 1, 0)
    return Box(film[low[1] : high[1], low[0] : high[0]].astype(np.float32), low)


def cut(film: NDArray[Any], centres_px: Float, half: int, noise: NoiseModel) -> Patches:
    """Cut windows of ``2 half + 1`` pixels around rounded centres.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    centres_px : ndarray of shape (n, 2)
        (col, row).
    half : int
    noise : NoiseModel
        Says which values are saturated.

    Returns
    -------
    Patches
    """
    corner = np.rint(centres_px).astype(np.int64) - half
    side = 2 * half + 1
    if len(corner) and corner.min() >= 0 and (corner.max(0) + side <= film.shape[::-1]).all():
        values = np.array([film[row : row + side, col : col + side] for col, row in corner.tolist()], np.float64)
        return Patches(values, (values > noise.floor) & (values < noise.ceiling), corner)
    step = np.arange(side)
    cols = corner[:, 0, None] + step
    rows = corner[:, 1, None] + step
    inside_c = (cols >= 0) & (cols < film.shape[1])
    inside_r = (rows >= 0) & (rows < film.shape[0])
    values = film[np.clip(rows, 0, film.shape[0] - 1)[:, :, None], np.clip(cols, 0, film.shape[1] - 1)[:, None, :]].astype(np.float64)
    valid = inside_r[:, :, None] & inside_c[:, None, :] & (values > noise.floor) & (values < noise.ceiling)
    return Patches(values, valid, corner)


def apart_from_repairs(patches: Patches, noise: NoiseModel) -> Patches:
    """Return the same with lines masked that were made up from those beside them (what is left of a mark is not less whole for that)."""
    valid = patches.valid
    for k, lines in enumerate(noise.repaired):
        if len(lines):
            seen = ~np.isin(patches.corner_px[:, k, None] + np.arange(patches.size), lines)
            valid = valid & (seen[:, None, :] if k == 0 else seen[:, :, None])
    return replace(patches, valid=valid)
