"""What lies beside a ball: which touch each other, the images of all others, to be taken away, and what is around them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rsa_vision.detect.balls.fits import BallFits, ball_image
from rsa_vision.detect.film.patches import Box
from rsa_vision.detect.film.places import pairs_within
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.types import Bool, Float, Int

TOUCH = 3.0  # blur widths between two rims within which one ball disturbs the fit of the other
MOST_IN_GROUP = 5


def groups_of(fits: BallFits, optics: Optics) -> list[list[int]]:
    """Sets of balls whose images touch."""
    return heaps_of(fits, TOUCH * optics.sigma_px)


def heaps_of(fits: BallFits, apart_px: float = 0.0) -> list[list[int]]:
    """Sets of balls whose shadows lie over each other, or less than this apart, from one to the next."""
    n = len(fits.depth)
    if n == 0:
        return []
    one, other = lapping_balls(fits, apart_px)
    _, label = connected_components(coo_array((np.ones(len(one)), (one, other)), shape=(n, n)), directed=False)
    return [np.nonzero(label == k)[0].tolist() for k in range(label.max() + 1)]


def lapping_balls(fits: BallFits, apart_px: float = 0.0) -> tuple[Int, Int]:
    """Return which balls have shadows that lie over which others, or less than this apart: each pair of them either way round."""
    one, other = pairs_within(fits.position_px, fits.position_px, fits.radius_px + apart_px, fits.radius_px)
    return one[one != other], other[one != other]


def all_but(known: BallFits, members: Int, optics: Optics, needles: Images | None) -> Images:
    """Return the images of the needles and of all balls but ``members``, as a function of pixels (cols, rows)."""
    return lambda cols, rows: images_beside(known, members, optics, needles, cols, rows)[0]


def images_beside(known: BallFits, members: Int, optics: Optics, needles: Images | None, cols: Float, rows: Float) -> tuple[Float, Bool]:
    """Return the images of the needles and of all balls but ``members`` at these pixels, and the pixels well under one of those balls."""
    total = np.zeros(cols.shape) if needles is None else needles(cols, rows)
    doubtful: Bool = np.zeros(cols.shape, np.bool_)
    reach = known.radius_px + 4 * optics.sigma_px
    low, high = (np.array([end(cols), end(rows)]) for end in (np.min, np.max))
    near = np.array(((known.position_px > low - reach[:, None]) & (known.position_px < high + reach[:, None])).all(1))
    near[members] = False
    for j in np.nonzero(near)[0]:
        dx, dy = cols - known.position_px[j, 0], rows - known.position_px[j, 1]
        image = ball_image(dx.reshape(1, -1), dy.reshape(1, -1), known.radius_px[[j]], optics)
        total = total + known.depth[j] * image.reshape(cols.shape)
        doubtful = doubtful | (np.hypot(dx, dy) < known.radius_px[j] + optics.sigma_px)
    return total, doubtful


def take_balls(box: Box, balls: BallFits, optics: Optics) -> None:
    """Take the images of balls away from a box of the film, in place."""
    film, size = box.values, box.values.shape[::-1]
    for at, radius, depth in zip(balls.position_px - box.corner_px, balls.radius_px, balls.depth, strict=True):
        reach = radius + 4 * optics.sigma_px
        (left, top), (right, bottom) = (np.clip(np.rint(at + step), 0, size).astype(np.intp) for step in (-reach, reach + 1))
        if left < right and top < bottom:
            dx, dy = np.meshgrid(np.arange(left, right) - at[0], np.arange(top, bottom) - at[1])
            film[top:bottom, left:right] -= depth * ball_image(dx[None], dy[None], np.array([radius]), optics)[0]


def deep_at(film: NDArray[Any], peaks: Float, radius: float, needles: Images | None) -> Float:
    """How far the film less its needles differs at these places from the median of a ring well outside a ball there."""
    angle = 2 * np.pi * np.arange(16) / 16
    reach = 2 * radius + 3
    cols = np.rint(peaks[:, :1] + reach * np.cos(angle)).astype(np.intp).clip(0, film.shape[1] - 1)
    rows = np.rint(peaks[:, 1:] + reach * np.sin(angle)).astype(np.intp).clip(0, film.shape[0] - 1)
    col, row = np.rint(peaks).astype(np.intp).T
    middle = film[row.clip(0, film.shape[0] - 1), col.clip(0, film.shape[1] - 1)].astype(np.float64)
    if needles is not None:
        middle -= needles(*peaks.T)
    return np.asarray(np.abs(middle - np.median(film[rows, cols], axis=1)))
