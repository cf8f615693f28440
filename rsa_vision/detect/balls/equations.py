"""Least squares for balls in square windows: pixels in the order in which balls reach them, backgrounds eliminated."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.least_squares import RIDGE, invert, polynomial
from rsa_vision.types import Float, Int


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Pixels of a window that are looked at, in the order of their distance from its middle: a ball reaches only the first of them.

    Attributes
    ----------
    place, back : ndarray of int, shape (p,)
        Where they lie in the window, and where its pixels are among them (of windows of which all are looked at).
    cols, rows : ndarray of shape (p,)
    distance, side : ndarray of shape (p,)
        From the middle, and the larger one of that along rows and columns.
    surface : ndarray of shape (p, 6)
        The background's monomials.
    squares : ndarray of shape (p, 36)
        Their products.
    """

    place: Int
    back: Int
    cols: NDArray[Any]  # single precision, as the rows
    rows: NDArray[Any]
    distance: Float
    side: Float
    surface: Float
    squares: Float


@lru_cache(maxsize=64)
def pixels_of(size: int, stride: int) -> Pixels:
    """Return every so-manieth pixel of a window either way, the middle one among them."""
    half = size // 2
    axis = np.arange(half % stride, size, stride)
    cols, rows = (g.ravel() for g in np.meshgrid(axis, axis))
    distance = np.hypot(cols - half, rows - half)
    order = np.argsort(distance, kind="stable")
    cols, rows = cols[order], rows[order]
    dx, dy = (cols - half).astype(np.float64), (rows - half).astype(np.float64)
    surface = polynomial(half, dx, dy)
    squares = (surface[:, :, None] * surface[:, None]).reshape(len(surface), -1)
    place = rows * size + cols
    single = [np.asarray(axis, np.float32) for axis in (cols, rows)]
    return Pixels(place, np.argsort(order), single[0], single[1], distance[order], np.maximum(abs(dx), abs(dy)), surface, squares)


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Least squares for balls of depth one in windows, the background's coefficients eliminated.

    Attributes
    ----------
    surface : ndarray of shape (p, 6)
        The background's monomials.
    data, weight : ndarray of shape (n, p)
    exact : ndarray of shape (n, p)
        The weights in double precision, for sums.
    inverse : ndarray of shape (n, 6, 6)
        Of the normal matrices of the backgrounds alone.
    right : ndarray of shape (n, 6)
        Their right sides.
    """

    surface: Float
    data: NDArray[Any]  # single precision, as the weights
    weight: NDArray[Any]
    exact: Float
    inverse: Float
    right: Float

    def normal(self, images: Float, of: Any, damping: float = RIDGE) -> tuple[Float, Float, Float]:
        """Return normal matrices (n, 4, 4) and right sides (n, 4) of some windows, and what backgrounds take of the images (n, 4, 6)."""
        # added up in double precision: radius and depth of a ball that is small against the blur can all but stand for each other
        n, _, reached = images.shape
        images = images.astype(np.float64)
        weighted = images * self.exact[of, None, :reached]
        mixed = (weighted.reshape(4 * n, -1) @ self.surface[:reached]).reshape(n, 4, -1)
        taken = np.matmul(mixed, self.inverse[of])
        own = np.matmul(weighted, images.transpose(0, 2, 1))
        normal = own - np.matmul(taken, mixed.transpose(0, 2, 1))
        each = np.arange(4)  # what the background can stand for has a variance that is large, not infinite
        normal[:, each, each] = np.maximum(normal[:, each, each], 0.0) + damping * np.maximum(own[:, each, each], 1e-30)
        right = np.matmul(weighted, self.data[of, :reached, None]) - np.matmul(taken, self.right[of, :, None])
        return normal, right[:, :, 0], taken

    def background(self, images: Float, depth: Float) -> Float:
        """Return the background's coefficients for balls of these depths, shape (n, 6)."""
        reached = images.shape[2]
        of_balls = (self.weight[:, :reached] * images[:, 3] * depth[:, None]) @ self.surface[:reached]
        return np.asarray(np.matmul(self.inverse, (self.right - of_balls)[:, :, None])[:, :, 0])

    def model(self, images: Float, depth: Float) -> NDArray[Any]:
        """Return what is expected in every pixel, shape (n, p), single precision."""
        out: NDArray[Any] = (self.background(images, depth) @ self.surface.T).astype(np.float32)
        out[:, : images.shape[2]] += depth[:, None].astype(np.float32) * images[:, 3]
        return out


def weighted(pixels: Pixels, data: NDArray[Any], weight: NDArray[Any], held: Float) -> Equations:
    """Return the equations of windows with these weights (n, p), slopes and bends of the backgrounds held near none so strongly (n, 5)."""
    k = pixels.surface.shape[1]
    exact = weight.astype(np.float64)
    normal = (exact @ pixels.squares).reshape(len(data), k, k)
    bends = np.arange(1, k)
    normal[:, bends, bends] += held
    return Equations(pixels.surface, data, weight, exact, invert(normal), (weight * data) @ pixels.surface)
