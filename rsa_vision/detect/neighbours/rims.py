"""Whether what looks like a ball goes on beyond its rim, as the ends, kinks and crossings of wires, bars and letters do."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.places import on_film, sample
from rsa_vision.detect.models.shown import Beside
from rsa_vision.types import Bool, Int

BEYOND: Final = 2.0  # blur widths outside the rim, where hardly anything of a ball is left
AS_HIGH: Final = 0.8  # of the height: a ball over the strongest thing that it still outdoes has half
HALF: Final = 0.5
MOST_OF_A_RIM: Final = 0.4  # what takes up more on one side is the edge of something that a ball may lie on
_DIRECTIONS = 2 * np.pi * np.arange(24) / 24
_WITHIN: Final = 0.5  # of the radius: the middle
_OF_OUTLINES: Final = 0.25  # of all balls of a film


def goes_on(film: NDArray[Any], balls: BallFits, number: Int, beside: Beside, sigma_px: float) -> Bool:
    """Say which images are as high beyond their rims, in a narrow part of it or on two sides that face each other, as in their middle.

    A ball adds its image to what it lies on, so it is higher than that all round, but where an edge passes by. The end of a bar is not.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    number : ndarray of int, shape (n,)
        What ``beside`` calls each.
    beside : callable
        The images of other marks are subtracted.
    sigma_px : float
        Blur of the film.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    out = np.zeros(len(balls.depth), bool)
    for i, (place, radius, depth) in enumerate(zip(balls.position_px, balls.radius_px, balls.depth, strict=True)):
        reach = np.append(np.repeat([0.0, _WITHIN], [1, len(_DIRECTIONS)]) * radius, np.full(len(_DIRECTIONS), radius + BEYOND * sigma_px))
        angle = np.concatenate([[0.0], _DIRECTIONS, _DIRECTIONS])
        cols, rows = place[0] + reach * np.cos(angle), place[1] + reach * np.sin(angle)
        values = np.sign(depth) * (sample(film, cols, rows) - beside(int(number[i]), cols, rows)[0])
        middle, around = np.median(values[: -len(_DIRECTIONS)]), values[-len(_DIRECTIONS) :]
        seen = on_film(film, cols, rows)[-len(_DIRECTIONS) :]
        around = np.where(seen, around, np.percentile(around[seen], 25) if seen.any() else 0.0)
        around = (np.roll(around, 1) + around + np.roll(around, -1)) / 3
        low = np.percentile(around, 25)
        height = (around - low) / max(middle - low, 1e-9)
        narrow = (height > HALF).mean() < MOST_OF_A_RIM
        opposite = np.minimum(height, np.roll(height, len(_DIRECTIONS) // 2))
        out[i] = (narrow and height.max() > AS_HIGH) or opposite.max() > AS_HIGH
    return out


def cut_from_outlines(touching: Bool, ends: Bool) -> Bool:
    """Say of all balls of a film, where none stands alone and many go on beyond their rims, that they are pieces of outlines.

    Parameters
    ----------
    touching : ndarray of bool, shape (n,)
        With others, or with anything as high as itself, beside it.
    ends : ndarray of bool, shape (n,)
        As of :func:`goes_on`.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    return np.full(len(ends), len(ends) > 0 and bool(touching.all()) and bool(ends.mean() > _OF_OUTLINES))
