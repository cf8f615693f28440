"""Where on a film the fiducial marks may lie: all affine maps that put enough of them onto marker images.

Three well spread fiducial marks fix an affine map; its scale is known but for the film's distance and the pixel pitch, so that few triples
of images are possible at all. Each map is then asked how many of the other marks it puts onto images.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from rsa_vision.types import Bool, Float

SCALE: Final = (0.94, 1.11)  # film / plane: pitch +-3 %, anisotropy +-1 %, gap up to 40 mm of at least 700 mm
SHEAR: Final = 0.025  # largest half anisotropy or half shear
NEAR_MM: Final = 1.2  # an affine map leaves a tilted film's perspective: 2 deg on 200 mm are 0.7 mm
SAME_MM: Final = 0.8  # maps whose marks all lie closer than this are one
SHIFT_MM: Final = 0.6  # images of two foci that are closer than this are told apart by the full model only
FEWER: Final = 2  # marks are enough for a shifted grid: two unknowns only, and images of two foci may melt into one
LARGEST: Final = 60  # candidate maps looked at closely


def needed(count: int, least: int, missing: float) -> int:
    """Return how many of ``count`` marks must be found (at least ``least``)."""
    return max(least, count - int(count * missing + 1e-9))


@lru_cache(maxsize=64)
def _triples(marks: tuple[tuple[float, float], ...], least: int) -> tuple[tuple[int, int, int], ...]:
    """Choose spread triples such that one of them is whole whichever ``least`` marks are there (small cages: proven by trying)."""
    points = np.array(marks)
    count = len(points)
    usable = range(count) if count <= 30 else np.linspace(0, count - 1, 30).astype(int).tolist()
    ranked: list[tuple[float, tuple[int, int, int]]] = []
    for triple in combinations(usable, 3):
        a, b, c = points[list(triple)]
        sides = sorted(
            [(float(np.hypot(*(b - a))), (0, 1, 2)), (float(np.hypot(*(c - b))), (1, 2, 0)), (float(np.hypot(*(a - c))), (2, 0, 1))]
        )
        longest, order = sides[-1]
        area = abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
        if area > 0.05 * longest**2:
            ranked.append((area, (triple[order[0]], triple[order[1]], triple[order[2]])))
    ranked.sort(key=lambda item: -item[0])
    unhit = {frozenset(s) for s in combinations(range(count), least)} if count <= 12 else set()
    used = np.zeros(count)
    chosen: list[tuple[int, int, int]] = []
    while ranked and (unhit if count <= 12 else len(chosen) < 24):
        gains = [(sum(1 for s in unhit if s.issuperset(t)) or 1) * area / (1 + used[list(t)].sum()) for area, t in ranked[:200]]
        _, triple = ranked.pop(int(np.argmax(gains)))
        chosen.append((triple[0], triple[1], triple[2]))
        used[list(triple)] += 1
        unhit = {s for s in unhit if not s.issuperset(triple)}
    return tuple(chosen)


class _Raster:
    """A map of the film that tells fast whether a point lies near an image."""

    CELL: Final = 0.5

    def __init__(self, points: Float, radius: float) -> None:
        self.low = points.min(axis=0) - 4 * radius
        shape = tuple(np.minimum((points.max(axis=0) + 4 * radius - self.low) / self.CELL + 1, 8000).astype(int))
        self.cells = np.zeros(shape, bool)
        reach = int(np.ceil(radius / self.CELL))
        step = np.arange(-reach, reach + 1)
        disc = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
        disc = disc[np.hypot(*disc.T) * self.CELL <= radius]
        cells = ((points - self.low) / self.CELL).astype(int)[:, None] + disc
        cells = cells.reshape(-1, 2)
        inside = ((cells >= 0) & (cells < shape)).all(axis=1)
        self.cells[tuple(cells[inside].T)] = True

    def near(self, points: Float) -> Bool:
        shape = np.array(self.cells.shape)
        index = ((points - self.low) / self.CELL).astype(int)
        inside = ((index >= 0) & (index < shape)).all(axis=-1)
        index = np.clip(index, 0, shape - 1)
        result: Bool = self.cells[index[..., 0], index[..., 1]] & inside
        return result


def find_grids(
    images_mm: Float,
    fiducials_mm: Float,
    *,
    turn_deg: float,
    foci: int,
    largest_shift_mm: float,
    missing: float,
    near_mm: float = NEAR_MM,
) -> list[tuple[Float, Float, int]]:
    """Find all places of a grid of fiducial marks among the images of a film.

    Parameters
    ----------
    images_mm : ndarray of shape (n, 2)
        Marker images in the film frame.
    fiducials_mm : ndarray of shape (m, 2)
        Fiducial marks in the plane.
    turn_deg : float
        Largest angle between the axes of plane and film; 180 for any.
    foci : int
        Exposures on this film: every grid may occur that often, shifted.
    largest_shift_mm : float
        Between two of them.
    missing : float
        Largest fraction of the marks without an image.
    near_mm : float
        How far from its image an affine map may put a mark.

    Returns
    -------
    list of (ndarray of shape (2, 2), ndarray of shape (2,), int)
        Film from plane (``A @ x + b``) and the number of marks on images, best first.
    """
    n, m = len(images_mm), len(fiducials_mm)
    least = needed(m, 4, missing)
    if n < least or n < 4:
        return []
    tree = cKDTree(images_mm)
    maps = _hypotheses(images_mm, tree, fiducials_mm, turn_deg, least, near_mm)
    anchors = _distinct(maps, fiducials_mm, 1.5 * near_mm)[:LARGEST]
    found: list[tuple[Float, int]] = []
    for affine, _ in anchors:
        refined = _refine(affine, images_mm, tree, fiducials_mm, least, near_mm)
        if refined is None or not _plausible(refined[0][None], turn_deg)[0]:
            continue
        if foci == 1:
            found.append(refined)
        else:
            found += _shifts(refined[0], images_mm, tree, fiducials_mm, max(4, least - FEWER), largest_shift_mm, near_mm)
    grids = _distinct(found, fiducials_mm, SAME_MM)[:LARGEST]
    return [(affine[:2].T, affine[2], count) for affine, count in grids]


def _hypotheses(images: Float, tree: cKDTree, marks: Float, turn_deg: float, least: int, near_mm: float) -> list[tuple[Float, int]]:
    """Return affine maps, shape (3, 2) for rows (u, v, 1), by all triples of images that fit a triple of marks."""
    difference = images[None] - images[:, None]
    length = np.hypot(difference[..., 0], difference[..., 1])
    direction = np.arctan2(difference[..., 1], difference[..., 0])
    raster = _Raster(images, near_mm)
    homogeneous = np.column_stack([marks, np.ones(len(marks))])
    found: list[tuple[Float, int]] = []
    for a, b, c in _triples(tuple(map(tuple, marks.tolist())), least):
        side = marks[b] - marks[a]
        base = np.hypot(*side)
        low, high = SCALE[0] * (1 - SHEAR) * base, SCALE[1] * (1 + SHEAR) * base
        first, second = np.nonzero((length > low) & (length < high))
        if turn_deg < 180:
            turn = (direction[first, second] - np.arctan2(side[1], side[0]) + np.pi) % (2 * np.pi) - np.pi
            upright = np.abs(turn) < np.deg2rad(turn_deg + 3)
            first, second = first[upright], second[upright]
        if not len(first):
            continue
        # the third mark by a similarity, then the image nearest to it
        z = complex(*(marks[c] - marks[a])) / complex(*side)
        span = difference[first, second]
        third = images[first] + np.column_stack([z.real * span[:, 0] - z.imag * span[:, 1], z.imag * span[:, 0] + z.real * span[:, 1]])
        reach = 2.2 * SHEAR * float(max(np.hypot(*(marks[c] - marks[a])), np.hypot(*(marks[c] - marks[b])))) + near_mm
        near = min(4, len(images))
        distance, index = (np.asarray(part) for part in tree.query(third, k=near, distance_upper_bound=reach))
        pair, which = np.nonzero(np.isfinite(distance.reshape(-1, near)))
        chosen = index.reshape(-1, near)[pair, which]
        corners = np.stack([images[first[pair]], images[second[pair]], images[chosen]], axis=1)
        affine = np.linalg.inv(homogeneous[[a, b, c]]) @ corners
        affine = affine[_plausible(affine, turn_deg)]
        counts = raster.near(homogeneous @ affine).sum(axis=1)
        found += [(affine[i], int(counts[i])) for i in np.flatnonzero(counts >= least)]
    return found


def _plausible(affine: Float, turn_deg: float) -> Bool:
    a, c, b, d = affine[:, 0, 0], affine[:, 0, 1], affine[:, 1, 0], affine[:, 1, 1]
    cos, sin = (a + d) / 2, (c - b) / 2
    size = np.hypot(cos, sin)
    shear = np.hypot((a - d) / 2, (b + c) / 2)
    result: Bool = (
        (size > SCALE[0]) & (size < SCALE[1]) & (shear < 1.4 * SHEAR * size) & (np.abs(np.arctan2(sin, cos)) < np.deg2rad(turn_deg + 2))
    )
    return result


def _distinct(maps: list[tuple[Float, int]], marks: Float, tolerance: float) -> list[tuple[Float, int]]:
    """Keep the best of those that put every mark to nearly the same place."""
    if not maps:
        return []
    order = np.argsort([-count for _, count in maps], kind="stable")
    extremes = np.unique(np.concatenate([marks.argmin(axis=0), marks.argmax(axis=0), marks @ [1, 1] == marks.sum(1).max()]).astype(int))
    homogeneous = np.column_stack([marks, np.ones(len(marks))])[extremes]
    places = np.einsum("mi,nij->nmj", homogeneous, np.array([maps[i][0] for i in order]))
    left = np.ones(len(order), bool)
    kept = []
    for rank, index in enumerate(order):
        if left[rank]:
            kept.append(maps[index])
            left[rank:] &= (np.abs(places[rank:] - places[rank]) > tolerance).any(axis=(1, 2))
            if len(kept) >= LARGEST:
                break
    return kept


def _refine(affine: Float, images: Float, tree: cKDTree, marks: Float, least: int, near_mm: float) -> tuple[Float, int] | None:
    homogeneous = np.column_stack([marks, np.ones(len(marks))])
    for reach in (1.5 * near_mm, near_mm):
        distance, index = (np.asarray(part) for part in tree.query(homogeneous @ affine, distance_upper_bound=reach))
        near = np.isfinite(distance)
        if near.sum() < least or len(np.unique(index[near])) < least:
            return None
        affine, _, rank, _ = np.linalg.lstsq(homogeneous[near], images[index[near]], rcond=None)
        if rank < 3:
            return None
    return affine, int(near.sum())


def _shifts(
    affine: Float, images: Float, tree: cKDTree, marks: Float, least: int, largest: float, near_mm: float
) -> list[tuple[Float, int]]:
    """Find by voting the shifts of a grid that again put enough marks onto images, no shift included."""
    places = np.column_stack([marks, np.ones(len(marks))]) @ affine
    neighbours = [tree.query_ball_point(place, largest + near_mm) for place in places]
    owner = np.repeat(np.arange(len(marks)), [len(some) for some in neighbours])
    shifts = images[np.concatenate([np.array(some, int) for some in neighbours])] - places[owner]
    apart = np.maximum(*(np.abs(along[:, None] - along) for along in shifts.T))
    starts = np.flatnonzero(np.diff(owner, prepend=-1))  # one mark may have many images near a shift, and counts once
    nearest = np.minimum.reduceat(apart, starts, axis=1) < near_mm
    votes = nearest.sum(axis=1)
    found: list[tuple[Float, int]] = []
    for index in np.argsort(-votes, kind="stable"):
        if votes[index] < least or len(found) >= 8:
            break
        if any(np.abs(affine[2] + shifts[index] - other[2]).max() < SHIFT_MM for other, _ in found):
            continue
        agreeing = [
            first + int(np.argmin(apart[index, first:last])) for first, last in zip(starts, [*starts[1:], len(shifts)], strict=True)
        ]
        shift = np.median(shifts[[i for i in agreeing if apart[index, i] < near_mm]], axis=0)
        if all(np.abs(affine[2] + shift - other[2]).max() > SHIFT_MM for other, _ in found):
            moved = affine.copy()
            moved[2] += shift
            found.append((moved, int(votes[index])))
    return found
