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

from rsa_vision.types import Float, Int

RINGS_PX = (6.0, 9.0, 13.0, 19.0)  # film pixels; a tee shows on the rings that lie within its arms
DIRECTIONS = 24
LEAST, ALONE = 1.2, 1.5  # scores, in units of what counts as significant; a weaker one than that needs company
_CHUNK = 8192  # points whose rings fit into the cache
_APART = 4  # pixels of the answer; of junctions nearer than this, the best
_GAP = 0.5  # between the arms the answer may reach this part of the weakest arm


def find_junctions(answer: NDArray[Any], place: Int, strength: Float, level: int) -> Float:
    """Find points with three arms in the shape of a T.

    Parameters
    ----------
    answer : ndarray of shape (rows, cols)
        Filter answer of one pyramid level in units of what counts as significant; positive for dark marks.
    place : ndarray of int, shape (k,)
        Where it is significant.
    strength : ndarray of shape (k,)
        Answer there.
    level : int
        Pyramid level.

    Returns
    -------
    ndarray of shape (n, 5)
        col_px, row_px, angle of the stem (radians, counter-clockwise as displayed), ring radius in film pixels, strength (score); negative
        strength for bright marks.
    """
    return np.concatenate([_one_polarity(answer, place[mine], sign, level) for sign, mine in ((1, strength > 0), (-1, strength < 0))])


def _one_polarity(scaled: NDArray[Any], place: Int, sign: int, level: int) -> Float:
    size = 2**level
    margin = int(RINGS_PX[-1] / size) + 1  # of the film; bands overlap
    # the tips fade out, so the centre itself may answer weakly: look a little around what answers
    strong = np.zeros(scaled.shape, np.uint8)
    strong.ravel()[place] = 1
    looked = np.asarray(cv2.dilate(strong, np.ones((5, 5), np.uint8)))
    for edge in (looked[:margin], looked[-margin:], looked[:, :margin], looked[:, -margin:]):
        edge[:] = 0
    at = np.flatnonzero(looked.view(bool))
    theta = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    quarter, eighth = DIRECTIONS // 4, DIRECTIONS // 8
    best, angle, ring = np.zeros((3, len(at)), np.float32)
    around_c, around_r = (np.rint(np.outer(RINGS_PX, way) / size).astype(np.intp) for way in (np.cos(theta), -np.sin(theta)))
    for radius, offset in zip(RINGS_PX, around_r * scaled.shape[1] + around_c, strict=True):
        for begin in range(0, len(at), _CHUNK):
            point = np.arange(begin, min(begin + _CHUNK, len(at)))
            samples = scaled.ravel().take(at[point] + offset[:, None])
            # three arms that are strong enough: most points can be left out before their scores are formed
            arm = _turned(_widened(samples > LEAST if sign > 0 else samples < -LEAST))
            worth = (arm(0) & arm(quarter) & arm(-quarter)).any(0)
            point, samples = point[worth], sign * samples[:, worth]
            if len(point) == 0:
                continue
            beside, near = _turned(samples), _turned(_widened(samples))
            arms = np.minimum(near(0), np.minimum(near(quarter), near(-quarter)))
            gaps = beside(2 * quarter)  # opposite to the stem
            for turn in (eighth, -eighth, quarter + eighth, -quarter - eighth):
                gaps = np.maximum(gaps, beside(turn))
            score = np.where(gaps < _GAP * arms, arms - np.maximum(gaps, 0), 0)
            k = score.argmax(0)
            value = score[k, np.arange(len(k))]
            better = value > best[point]
            best[point[better]], angle[point[better]], ring[point[better]] = value[better], theta[k[better]], radius
    row, col = np.divmod(at[best > LEAST], scaled.shape[1])
    angle, ring, best = (v[best > LEAST] for v in (angle, ring, best))
    around = np.zeros([n + 2 * _APART for n in scaled.shape], np.float32)
    around[row + _APART, col + _APART] = best
    windows = np.lib.stride_tricks.sliding_window_view(around, (2 * _APART + 1,) * 2)
    peak = best == windows[row, col].max((1, 2), initial=0.0)
    table = np.stack([(col + 0.5) * size - 0.5, (row + 0.5) * size - 0.5, angle, ring, sign * best], axis=1)
    return np.asarray(table[peak], np.float64)


def _widened(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the largest of each direction and the two beside it."""
    beside = _turned(samples)
    return np.asarray(np.maximum(beside(1), np.maximum(samples, beside(-1))))


def _turned(samples: NDArray[Any]) -> Callable[[int], NDArray[Any]]:
    """Return views of samples (directions along the first axis) as seen after a turn by so many directions."""
    twice = np.concatenate([samples, samples])
    return lambda turn: twice[turn % DIRECTIONS : turn % DIRECTIONS + DIRECTIONS]
