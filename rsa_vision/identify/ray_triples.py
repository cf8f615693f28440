"""Poses of a body at which three of its markers lie on three rays, of one focus or of several.

Perspective from three points has up to four solutions for one focus (Grunert 1841) and up to eight for several (Nistér and Stewénius
2007). They are found here by going along the first ray: each place on it puts the second and the third marker on spheres, which their rays
pierce twice each; where the places on these two have the right distance there is a solution.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.types import Bool, Float, Int

PLACES: Final = 64  # tried on the first ray
GRAZING_MM: Final = 1.0  # by which a ray may miss a sphere, or a solution the third distance
THIN_MM: Final = 3.0  # height of a triangle that is not used
CHUNK: Final = 4000  # combinations that are solved at once
MOST: Final = 60_000  # combinations; more are refused
SIGNS: Final = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses, shapes (p, 3, 3) and (p, 3), with the three markers and the three rays of each, shape (p, 3)."""

    rotation: Float
    translation: Float
    markers: Int
    rays: Int


def depth_range(rays: RayBundle, around_mm: Float, margin_mm: float) -> Float:
    """Return how far from its focus a marker on each ray may be, shape (r, 2): as far as some places, and a margin either way."""
    along = np.einsum("mrj,rj->rm", around_mm[:, None] - rays.origin_mm, rays.direction)
    result: Float = np.stack([along.min(axis=1) - margin_mm, along.max(axis=1) + margin_mm], axis=1)
    return result


def marker_triples(body_mm: Float) -> list[tuple[int, int, int]]:
    """Return triangles, the largest first, so many that any four markers hold one (of those that are not in line)."""

    def height(triple: tuple[int, int, int]) -> float:
        a, b, c = body_mm[list(triple)]
        sides = [np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a)]
        return float(np.linalg.norm(np.cross(b - a, c - a)) / max(sides))

    wide = sorted(((height(t), t) for t in combinations(range(len(body_mm)), 3)), reverse=True)
    left = set(combinations(range(len(body_mm)), 4))
    chosen = []
    for high, triple in wide:
        held = {four for four in left if set(triple) <= set(four)}
        if high > THIN_MM and (held or len(body_mm) == 3):
            chosen.append(triple)
            left -= held
    return chosen


def poses_by_rays(body_mm: Float, rays: RayBundle, depth_mm: Float) -> Iterator[Poses] | None:
    """Return all poses at which three markers lie on three rays.

    Parameters
    ----------
    body_mm : ndarray of shape (n, 3)
    rays : RayBundle
    depth_mm : ndarray of shape (r, 2)
        Least and largest distance of a marker from the focus.

    Returns
    -------
    iterator of Poses, or None
        For one set of markers after the other of :func:`marker_triples`; None if there are too many combinations to try.
    """
    apart = np.linalg.norm(body_mm[:, None] - body_mm, axis=-1)
    near = _least_distance(rays, depth_mm)
    work = []
    total = 0
    for i, j, k in marker_triples(body_mm):
        first, second = np.nonzero(near < apart[i, j])
        row, third = np.nonzero((near < apart[i, k])[first] & (near < apart[j, k])[second])
        hits = np.stack([first[row], second[row], third], axis=1)
        work.append(((i, j, k), hits))
        total += len(hits)
    if total > MOST:
        return None
    return (_solved(body_mm, rays, depth_mm, marks, hits[c : c + CHUNK]) for marks, hits in work for c in range(0, len(hits), CHUNK))


def _least_distance(rays: RayBundle, depth_mm: Float) -> Float:
    """Return how near two rays come to each other within their depths, a little less; infinite for rays of one image, shape (r, r)."""
    fraction = np.linspace(0, 1, 24)
    depth = depth_mm[:, :1] + fraction * (depth_mm[:, 1:] - depth_mm[:, :1])
    place = rays.origin_mm[:, None] + depth[..., None] * rays.direction[:, None]  # (r, 24, 3)
    offset = place[:, :, None] - rays.origin_mm
    along = np.einsum("rgsj,sj->rgs", offset, rays.direction)
    away = np.linalg.norm(offset - along[..., None] * rays.direction, axis=-1).min(axis=1)
    step = float((depth[:, 1] - depth[:, 0]).max(initial=0.0))
    least: Float = np.minimum(away, away.T) - GRAZING_MM - step / 4
    least[rays.image[:, None] == rays.image] = np.inf
    return least


def _solved(body_mm: Float, rays: RayBundle, depth_mm: Float, marks: tuple[int, int, int], hits: Int) -> Poses:
    origin, direction = rays.origin_mm[hits], rays.direction[hits]  # (h, 3, 3)
    side = [float(np.linalg.norm(body_mm[marks[a]] - body_mm[marks[b]])) for a, b in ((0, 1), (0, 2), (1, 2))]
    low, high = depth_mm[hits[:, 0]].T
    depth = low[:, None] + np.linspace(0, 1, PLACES) * (high - low)[:, None]
    off, valid = _misfit(origin, direction, side, depth)  # (h, 4, g)
    size = np.where(valid, np.abs(off), np.inf)
    before, after = np.roll(size, 1, axis=2), np.roll(size, -1, axis=2)
    before[:, :, 0] = after[:, :, -1] = np.inf
    least = (size <= before) & (size < after) & (size < GRAZING_MM)
    crossing = valid[..., :-1] & valid[..., 1:] & (np.sign(off[..., :-1]) != np.sign(off[..., 1:]))
    h, s, g = np.nonzero(crossing)
    share = off[h, s, g] / (off[h, s, g] - off[h, s, g + 1])
    at = depth[h, g] + share * (depth[h, g + 1] - depth[h, g])
    h2, s2, g2 = np.nonzero(least)
    h, s, at = np.concatenate([h, h2]), np.concatenate([s, s2]), np.concatenate([at, depth[h2, g2]])
    first, feet, halves, _ = _spheres(origin[h], direction[h], side, at[:, None])
    others = [feet[m][:, 0] + SIGNS[s, m, None] * halves[m] * direction[h, m + 1] for m in range(2)]
    places = np.stack([first[:, 0], *others], axis=1)
    rotation, translation = _moved(body_mm[list(marks)], places)
    return Poses(rotation, translation, np.tile(marks, (len(h), 1)), hits[h])


def _spheres(origin: Float, direction: Float, side: list[float], depth: Float) -> tuple[Float, list[Float], list[Float], Bool]:
    """Return the places of the first marker, where the other rays pass it (each of shape (h, g, 3)), half their chords, which exist."""
    first = origin[:, None, 0] + depth[..., None] * direction[:, None, 0]
    feet, halves, exist = [], [], np.ones(depth.shape, bool)
    for m, radius in ((1, side[0]), (2, side[1])):
        along = np.einsum("hgj,hj->hg", first - origin[:, None, m], direction[:, m])
        feet.append(origin[:, None, m] + along[..., None] * direction[:, None, m])
        square = radius**2 - ((feet[-1] - first) ** 2).sum(-1)
        exist &= square > -2 * radius * GRAZING_MM
        halves.append(np.sqrt(np.maximum(square, 0.0)))
    return first, feet, halves, exist


def _misfit(origin: Float, direction: Float, side: list[float], depth: Float) -> tuple[Float, Bool]:
    """Return by how much the distance of the second and third marker differs from what it must be, for each choice of sides, (h, 4, g)."""
    _, feet, halves, exist = _spheres(origin, direction, side, depth)
    between = feet[0] - feet[1]
    by_first, by_second = (halves[m] * np.einsum("hgj,hj->hg", between, direction[:, m + 1]) for m in range(2))
    both = halves[0] * halves[1] * (direction[:, 1] * direction[:, 2]).sum(-1)[:, None]
    fixed = (between**2).sum(-1) + halves[0] ** 2 + halves[1] ** 2
    square = np.stack([fixed + 2 * (a * by_first - b * by_second - a * b * both) for a, b in SIGNS], axis=1)
    return np.sqrt(np.maximum(square, 0.0)) - side[2], np.broadcast_to(exist[:, None], square.shape)


def _moved(body_mm: Float, places: Float) -> tuple[Float, Float]:
    """Return the motions of three markers to triples of places, shape (p, 3, 3), by least squares."""
    middle, onto = body_mm.mean(axis=0), places.mean(axis=1)
    left, _, right = np.linalg.svd(np.einsum("pka,kb->pab", places - onto[:, None], body_mm - middle))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]  # a mirror image is no motion
    rotation: Float = left @ right
    return rotation, onto - rotation @ middle
