"""Places on a film, (col, row): how far apart they are, which lie on it, and what it shows there."""

from __future__ import annotations

from itertools import chain
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from rsa_vision.types import Bool, Float, Int

_ROUNDED = 1 + 1e-9  # by less a tree errs


def gaps(places: Float, others: Float) -> Float:
    """Return the distances of places (n, 2) from others (m, 2), shape (n, m): of few, that is."""
    return np.asarray(np.hypot(*(places[:, None] - others).transpose(2, 0, 1)))


def pairs_within(places: Float, others: Float, reach_px: Float | float, own_px: Float | float = 0.0) -> tuple[Int, Int]:
    """Return which places (n, 2) are nearer to which others (m, 2) than the reach of these, (m,), and their own, (n,), together."""
    reach, own = np.broadcast_to(reach_px, len(others)), np.broadcast_to(own_px, len(places))
    near = KDTree(places).query_ball_point(others, _ROUNDED * (reach + own.max(initial=0.0)))
    other = np.repeat(np.arange(len(others)), [len(these) for these in near])
    one = np.fromiter(chain.from_iterable(near), np.intp, len(other))
    within = np.hypot(*(places[one] - others[other]).T) < own[one] + reach[other]
    return one[within], other[within]


def are_within(places: Float, others: Float, reach_px: Float | float, own_px: Float | float = 0.0) -> Bool:
    """Say which places are so near to any of others, as of :func:`pairs_within`."""
    return np.isin(np.arange(len(places)), pairs_within(places, others, reach_px, own_px)[0])


def on_film(film: NDArray[Any], cols: Float, rows: Float) -> Bool:
    """Say which places lie on the film."""
    return np.asarray((cols > -0.5) & (cols < film.shape[1] - 0.5) & (rows > -0.5) & (rows < film.shape[0] - 0.5))


def sample(film: NDArray[Any], cols: Float, rows: Float) -> Float:
    """Return values between pixels, (n,), of a film that goes on beyond its border as it ends there."""
    corner = np.floor([cols.min(), rows.min()]).astype(int).clip(0, np.array(film.shape[::-1]) - 1)
    end = np.ceil([cols.max(), rows.max()]).astype(int).clip(corner, np.array(film.shape[::-1]) - 1) + 1
    patch = film[corner[1] : end[1], corner[0] : end[0]].astype(np.float32)
    at = (cols - corner[0]).astype(np.float32), (rows - corner[1]).astype(np.float32)
    return np.asarray(cv2.remap(patch, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64).ravel()
