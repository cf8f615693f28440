"""Holes in plates, and gaps between shadows, which look like marks of the other polarity: beyond the rim the film is as it is in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.types import Bool, Float

_NEAR, _FAR, _STEP, _BLURS = 1.5, 5.0, 0.4, 1.5  # of the radius, where rays begin and end, and their steps; blurs to that
_WAYS = 16
_AS_MUCH = 0.6  # of the height over what lies around
_OPPOSITE = 4  # pairs of opposite rays of eight: along a plate there is no end near
_PLATE = 3  # holes of one size: one bright disc beyond which all is dark may as well be a ball in a small field
_SIZE, _HEIGHT = 0.15, 0.7  # logarithms by which they differ
_ACROSS = np.array([[0.0, 0.0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * 0.3  # of the radius: pixels that are averaged


def are_holes(film: NDArray[Any], fits: BallFits, sigma_px: float) -> Bool:
    """Say beyond the surroundings of which images the film is on opposite sides what it is within them.

    Marks add to whatever lies around them. What is beside a hole is a plate, and beyond that the film is no more covered than in the hole.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
    sigma_px : float
        Blur of the film.

    Returns
    -------
    ndarray of bool, shape (n,)
        None where there are fewer of one size than a plate has.
    """
    radius, sign = fits.radius_px[:, None, None], np.sign(fits.depth)
    middle = sign * _values(film, fits.position_px[:, None], radius)[:, 0]
    angle = 2 * np.pi * np.arange(_WAYS) / _WAYS
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    apart = np.arange(_NEAR, _FAR, _STEP)[:, None, None, None] * radius + _BLURS * sigma_px  # (distances, n, 1, 1)
    beyond = sign[:, None] * np.stack([_values(film, fits.position_px[:, None] + far * way, radius) for far in apart])
    around = np.median(beyond[0], axis=1)
    as_much = np.max(beyond - around[:, None], axis=0) > _AS_MUCH * (middle - around)[:, None]
    both = as_much[:, : _WAYS // 2] & as_much[:, _WAYS // 2 :]
    holes = (middle > around) & (both.sum(axis=1) >= _OPPOSITE)
    size, height = np.log(fits.radius_px[holes]), np.log((middle - around)[holes])
    alike = (np.abs(size[:, None] - size) < _SIZE) & (np.abs(height[:, None] - height) < _HEIGHT)
    holes[holes] = alike.sum(axis=1) >= _PLATE
    return np.asarray(holes)


def _values(film: NDArray[Any], places: Float, radius: Float) -> Float:
    """Return the mean of a few pixels at places (n, k, 2), those of the border beyond it; shape (n, k)."""
    col, row = np.rint(places[:, :, None] + _ACROSS * radius[:, :, :, None]).astype(np.intp).transpose(3, 0, 1, 2)
    last = np.array(film.shape) - 1
    return np.asarray(film[np.clip(row, 0, last[0]), np.clip(col, 0, last[1])].mean(axis=2, dtype=np.float64))
