"""Where tees and single pins may be: what the filter's answer looks like on rings around a point.

Around the common tip of a tee a ring meets three arms, 90 degrees apart, and nothing else; around the tip of a pin it meets one. The rings
are sampled only where the filter answers at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Float

RINGS_PX = (6.0, 9.0, 13.0, 19.0)  # film pixels; a tee shows on the rings that lie within its arms
DIRECTIONS = 24
LEAST = 1.5  # score, in units of what counts as significant
_CHUNK = 8192  # points whose rings fit into the cache
_GAP = 0.5  # between the arms the answer may reach this part of the weakest arm


def find_junctions(answer: NDArray[Any], limit: NDArray[Any], level: int) -> Float:
    """Find points with three arms in the shape of a T.

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
    ndarray of shape (n, 5)
        col_px, row_px, angle of the stem (radians, counter-clockwise as displayed), ring radius in film pixels, strength (score in units of
        ``limit``); negative strength for bright marks.
    """
    found = [_one_polarity(answer, limit, level), _one_polarity(-answer, limit, level)]
    found[1][:, 4] *= -1
    return np.concatenate(found)


def _one_polarity(answer: NDArray[Any], limit: NDArray[Any], level: int) -> Float:
    size = 2**level
    strong = (answer > limit).astype(np.uint8)
    if not strong.any():
        return np.zeros((0, 5))
    # the tips fade out, so the centre itself may answer weakly: look a little around what answers
    row, col = np.nonzero(cv2.dilate(strong, np.ones((5, 5), np.uint8)))
    theta = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    quarter, eighth = DIRECTIONS // 4, DIRECTIONS // 8
    margin = int(RINGS_PX[-1] / size) + 1
    scaled = np.pad(np.divide(answer, limit, dtype=np.float32), margin, mode="edge")
    best = np.zeros(answer.shape, np.float32)
    angle, ring = np.zeros(answer.shape, np.float32), np.zeros(answer.shape, np.float32)
    around_c, around_r = (np.rint(np.outer(RINGS_PX, way) / size).astype(np.intp) for way in (np.cos(theta), -np.sin(theta)))
    for radius, offset in zip(RINGS_PX, around_r * scaled.shape[1] + around_c, strict=True):
        for begin in range(0, len(row), _CHUNK):
            r, c = row[begin : begin + _CHUNK], col[begin : begin + _CHUNK]
            samples = scaled.ravel().take((r + margin) * scaled.shape[1] + c + margin + offset[:, None])
            beside = _turned(samples)
            near = _turned(np.maximum(beside(1), np.maximum(samples, beside(-1))))
            arms = np.minimum(near(0), np.minimum(near(quarter), near(-quarter)))
            gaps = beside(2 * quarter)  # opposite to the stem
            for turn in (eighth, -eighth, quarter + eighth, -quarter - eighth):
                gaps = np.maximum(gaps, beside(turn))
            score = np.where(gaps < _GAP * arms, arms - np.maximum(gaps, 0), 0)
            k = score.argmax(0)
            value = score[k, np.arange(len(r))]
            better = value > best[r, c]
            r, c, k = r[better], c[better], k[better]
            best[r, c], angle[r, c], ring[r, c] = value[better], theta[k], radius
    peak = (best > LEAST) & (best == cv2.dilate(best, np.ones((9, 9), np.uint8)))
    r, c = np.nonzero(peak)
    return np.stack([(c + 0.5) * size - 0.5, (r + 0.5) * size - 0.5, angle[r, c], ring[r, c], best[r, c]], axis=1).astype(np.float64)


def _turned(samples: NDArray[Any]) -> Callable[[int], NDArray[Any]]:
    """Return views of samples (directions along the first axis) as seen after a turn by so many directions."""
    twice = np.concatenate([samples, samples])
    return lambda turn: twice[turn % DIRECTIONS : turn % DIRECTIONS + DIRECTIONS]
