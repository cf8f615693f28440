"""Where single pins may be: elongated islands of the filter's answer.

The answer to a pin is one island along it, strongest towards the thick end and fading before the tip. Which end is the tip, the fits tell.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Float

LEAST_PEAK = 2.0  # of an island, in units of what counts as significant
SLIM = 1.5  # ratio of an island's length to its width
LENGTHS_PX = (4.0, 130.0)  # film pixels; needles and wires are longer
COLUMNS = 6


def find_strokes(answer: NDArray[Any], limit: NDArray[Any], level: int) -> Float:
    """Find elongated islands.

    Parameters
    ----------
    answer : ndarray of shape (rows, cols)
        Filter answer of one pyramid level; positive for dark marks.
    limit : ndarray of the same shape
        Answer that counts as significant.
    level : int
        Pyramid level.

    Returns
    -------
    ndarray of shape (n, 6)
        col_px, row_px of the middle, angle of the axis (radians, counter-clockwise as displayed), length and width in film pixels, strength
        (largest answer in units of ``limit``); negative strength for bright marks.
    """
    found = [_one_polarity(answer, limit, level), _one_polarity(-answer, limit, level)]
    found[1][:, 5] *= -1
    return np.concatenate(found)


def _one_polarity(answer: NDArray[Any], limit: NDArray[Any], level: int) -> Float:
    size = 2**level
    _, labels, stats, _ = cv2.connectedComponentsWithStats((answer > limit).astype(np.uint8))
    side = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(1) * size
    wanted = (side > LENGTHS_PX[0] / 2) & (side < LENGTHS_PX[1]) & (stats[:, cv2.CC_STAT_AREA] >= 4)
    wanted[0] = False
    if not wanted.any():
        return np.zeros((0, COLUMNS))
    place = np.flatnonzero(wanted[labels])
    r, c = np.divmod(place, answer.shape[1])
    island = (np.cumsum(wanted) - 1)[labels.ravel()[place]]
    weight = answer.ravel()[place].astype(np.float64)
    strength = np.zeros(wanted.sum())
    np.maximum.at(strength, island, weight / limit.ravel()[place])

    def mean(values: Float) -> Float:
        total: Float = np.bincount(island, weight * values) / np.bincount(island, weight)
        return total

    x, y = mean(c.astype(np.float64)), mean(r.astype(np.float64))
    dx, dy = c - x[island], y[island] - r
    xx, yy, xy = mean(dx * dx) + 1 / 12, mean(dy * dy) + 1 / 12, mean(dx * dy)
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    length, width = (np.sqrt(12 * np.maximum(m, 0.0)) * size for m in (middle + apart, middle - apart))
    rows: Float = np.stack(
        [(x + 0.5) * size - 0.5, (y + 0.5) * size - 0.5, 0.5 * np.arctan2(2 * xy, xx - yy), length, width, strength], axis=1
    )
    slim: Float = rows[(strength > LEAST_PEAK) & (length > SLIM * width) & (length > LENGTHS_PX[0]) & (length < LENGTHS_PX[1])]
    return slim
