"""Where single pins may be: elongated islands of the filter's answer.

The answer to a pin is one island along it, strongest towards the thick end and fading before the tip. Which end is the tip, the fits tell.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rsa_vision.types import Bool, Float, Int

LEAST_PEAK = 2.0  # of an island, in units of what counts as significant
SLIM = 1.5  # ratio of an island's length to its width
LENGTHS_PX = (4.0, 130.0)  # film pixels; needles and wires are longer
COLUMNS = 6
_ALONG, _ASIDE_PX = (0.3, 1.6), 4.0  # of its length, from its middle; or by its width: where the tip of an arm is
_MOST_ARMS = 200  # of each polarity
_STRAIGHT, _ALIKE = 0.95, 0.6  # cosine between the halves of a bar; logarithm of the lengths of strokes
_REACH, _OFF = (0.4, 2.5), 0.15  # from tip to the middle of a stroke, over its length; errors of places, over that
_RING = 0.85  # of that: where rings around tips meet arms
_LEAST_AREA = 4  # pixels of the answer


def find_strokes(answer: NDArray[Any], place: Int, strength: Float, level: int) -> Float:
    """Find elongated islands.

    Parameters
    ----------
    answer : ndarray of shape (rows, cols)
        Filter answer of one pyramid level; positive for dark marks.
    place : ndarray of int, shape (k,)
        Where it is significant, in the order of the film.
    strength : ndarray of shape (k,)
        Answer there in units of what counts as significant.
    level : int
        Pyramid level.

    Returns
    -------
    ndarray of shape (n, 6)
        col_px, row_px of the middle, angle of the axis towards the thicker end (radians, counter-clockwise as displayed), length and width
        in film pixels, strength (the largest of an island); negative strength for bright marks.
    """
    r, c = np.divmod(place, answer.shape[1])
    weight = answer.ravel()[place].astype(np.float64)
    dark = strength > 0
    return np.concatenate(
        [
            _one_polarity(r[mine], c[mine], np.abs(weight[mine]), np.abs(strength[mine]), level, sign)
            for sign, mine in ((1, dark), (-1, ~dark))
        ]
    )


def at_junctions(strokes: Float, junctions: Float) -> Bool:
    """Say which strokes end at a junction of the same polarity: they are arms of tees, most likely, and no single pins.

    Parameters
    ----------
    strokes : ndarray of shape (n, 6)
    junctions : ndarray of shape (m, 5)
        As of :func:`rsa_vision.detect.search.junctions.find_junctions`.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    col, row, angle, length, width, strength = strokes.T[:, :, None]
    dx, dy, c, s = junctions[:, 0] - col, junctions[:, 1] - row, np.cos(angle), -np.sin(angle)
    along, across = np.abs(dx * c + dy * s) / length, np.abs(dy * c - dx * s)
    on = (along > _ALONG[0]) & (along < _ALONG[1]) & (across < np.maximum(width, _ASIDE_PX))
    return np.asarray((on & (np.sign(junctions[:, 4]) == np.sign(strength))).any(axis=1))


def where_three_meet(strokes: Float, junctions: Float) -> Float:
    """Find where three strokes point at one place in the shape of a T: tees whose arms fade out far before the tip.

    Parameters
    ----------
    strokes : ndarray of shape (n, 6)
        Strongest first; that many of a film are looked at.
    junctions : ndarray of shape (m, 5)
        Known ones.

    Returns
    -------
    ndarray of shape (k, 5)
        As ``junctions``, none of them.
    """
    found = [np.zeros((0, 5))]
    for sign in (1, -1):
        col, row, angle, length, _, strength = strokes[np.sign(strokes[:, 5]) == sign][:_MOST_ARMS].T
        at, way = np.stack([col, row], axis=1), np.stack([np.cos(angle), -np.sin(angle)], axis=1)
        # both halves of the bar: opposite ways, each away from the other's thin end
        apart = at[:, None] - at
        reach = np.einsum("ijk,ik->ij", apart, way) / 2
        aside = np.abs(apart[:, :, 0] * way[:, None, 1] - apart[:, :, 1] * way[:, None, 0])
        alike = np.abs(np.log(length[:, None] / length)) < _ALIKE
        near = (reach > _REACH[0] * length[:, None]) & (reach < _REACH[1] * length[:, None])
        i, j = np.nonzero((way @ way.T < -_STRAIGHT) & near & alike & (aside < _OFF * 2 * reach))
        middle, reach = (at[i] + at[j]) / 2, reach[i, j]
        # the stem: as far from the middle, square to the bar
        away = (at - middle[:, None]) / reach[:, None, None]
        square = np.abs(np.einsum("pks,ps->pk", away, way[i])) < 2 * _OFF
        outward = np.abs(np.einsum("pks,ks->pk", away, way) - 1) < 2 * _OFF
        pair, stem = np.nonzero(
            square & outward & (np.abs(way[i] @ way.T) < 2 * _OFF) & (np.abs(np.log(length[i, None] / length)) < _ALIKE)
        )
        least = np.minimum(np.abs(strength[stem]), np.minimum(np.abs(strength[i]), np.abs(strength[j]))[pair])
        found.append(np.column_stack([middle[pair], angle[stem], _RING * reach[pair], sign * least]))
    table, kept = np.concatenate(found), junctions
    for place in table[np.argsort(-np.abs(table[:, 4]))]:
        if (np.hypot(*(kept[:, :2] - place[:2]).T) > _RING * place[3]).all():
            kept = np.vstack([kept, place])
    return kept[len(junctions) :]


def _one_polarity(r: Int, c: Int, weight: Float, over: Float, level: int, sign: int) -> Float:
    size = 2**level
    if len(r) == 0:
        return np.zeros((0, COLUMNS))
    island = _islands(r, c)
    strength = np.zeros(island.max() + 1)
    np.maximum.at(strength, island, over)
    wanted = (strength > LEAST_PEAK) & (np.bincount(island) >= _LEAST_AREA)
    if not wanted.any():
        return np.zeros((0, COLUMNS))
    mine = wanted[island]
    r, c, weight, island, strength = r[mine], c[mine], weight[mine], (np.cumsum(wanted) - 1)[island[mine]], strength[wanted]

    def mean(values: Float) -> Float:
        total: Float = np.bincount(island, weight * values) / np.bincount(island, weight)
        return total

    def extent(values: NDArray[np.intp]) -> NDArray[np.intp]:
        low, high = np.full(len(strength), values.max()), np.full(len(strength), values.min())
        np.minimum.at(low, island, values)
        np.maximum.at(high, island, values)
        return np.asarray(high - low + 1)

    side = np.maximum(extent(r), extent(c)) * size
    x, y = mean(c.astype(np.float64)), mean(r.astype(np.float64))
    dx, dy = c - x[island], y[island] - r
    xx, yy, xy = mean(dx * dx) + 1 / 12, mean(dy * dy) + 1 / 12, mean(dx * dy)
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    length, width = (np.sqrt(12 * np.maximum(m, 0.0)) * size for m in (middle + apart, middle - apart))
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    along = dx * np.cos(angle)[island] + dy * np.sin(angle)[island]
    angle += np.pi * (mean(along**3) > 0)  # the answer fades out towards the tip
    rows: Float = np.stack([(x + 0.5) * size - 0.5, (y + 0.5) * size - 0.5, angle, length, width, sign * strength], axis=1)
    seen = (side > LENGTHS_PX[0] / 2) & (side < LENGTHS_PX[1])
    slim: Float = rows[seen & (length > SLIM * width) & (length > LENGTHS_PX[0]) & (length < LENGTHS_PX[1])]
    return slim


def _islands(r: NDArray[np.intp], c: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return which island each pixel belongs to, from their rows and columns in the order of a film; pixels touch by sides and corners.

    Few pixels answer, so runs along the rows are joined instead of labelling all pixels of the film.
    """
    width = int(c.max()) + 3  # a gap between the end of one row and the start of the next
    flat = r * width + c
    begins = np.flatnonzero(np.diff(flat, prepend=-2) != 1)
    first, last = flat[begins], flat[np.append(begins[1:], len(flat)) - 1]
    low, high = np.searchsorted(last, first + width - 1), np.searchsorted(first, last + width + 1, side="right")
    n = np.maximum(high - low, 0)
    upper = np.repeat(np.arange(len(first)), n)
    lower = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + np.repeat(low, n)
    touching = csr_array((np.ones(len(upper), np.int8), (upper, lower)), shape=(len(first), len(first)))
    island = connected_components(touching, directed=False)[1]
    return np.asarray(np.repeat(island, np.diff(np.append(begins, len(flat)))), np.intp)
