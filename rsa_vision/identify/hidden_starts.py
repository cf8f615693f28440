"""First poses of a body of which some markers are points, and others are seen by one focus only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Final

import numpy as np

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.constellation import STRAY
from rsa_vision.identify.poses import GATE, GATE_SCALE, TOLERANCE_MM, Cloud, Pairs, distances, rotation_by
from rsa_vision.identify.ray_triples import depth_range, poses_by_rays
from rsa_vision.types import Float

TURNS: Final = 90  # poses tried around the line through two known places
COARSE_MM: Final = 3.0  # how near a ray must come to be tried then
GRAZING_MM: Final = 0.5  # by which a ray may miss the sphere on which its marker lies
LEAST_ALONE: Final = 4  # markers that rays alone must meet: three fit any three rays
MARGIN_MM: Final = 100.0  # by which a body may lie deeper or higher than the other markers
DEPTHS: Final = np.array([0.3, 1.02])  # without any: parts of the way from the focus to the plane


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A body, and the points and rays that may be its markers, in a volume (mm³) with so many stray points."""

    body: Cloud
    points: Cloud
    rays: RayBundle
    volume: float
    stray: float

    @property
    def worth(self) -> tuple[float, float]:
        """Log worth of a point (3-D) and of a ray (2-D) that need not be explained otherwise."""
        area = self.volume ** (2 / 3)
        return float(np.log(self.volume / self.stray)), float(np.log(area / (STRAY + len(self.rays))))


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A first pose, what it rests on, and how many markers it brings near a point or a ray."""

    rotation: Float
    translation: Float
    pairs: Pairs
    sights: Pairs
    met: int
    off_mm: float = 0.0  # sum of how far its markers pass rays, as far as they do


def first_poses(scene: Scene, around_mm: Float | None) -> list[Start]:
    """List first poses: what meets most markers first, then what meets them best.

    Parameters
    ----------
    scene : Scene
    around_mm : ndarray of shape (k, 3), optional
        Places of other markers: how deep along the rays to look.

    Returns
    -------
    list of Start
    """
    return sorted([*_starts(scene), *_by_rays_alone(scene, around_mm)], key=lambda start: (-start.met, start.off_mm))


def _starts(scene: Scene) -> Iterator[Start]:
    body, places = scene.body, scene.points.position_mm
    length, variance = distances(body)
    for i, j in permutations(range(len(body)), 2):
        for a, base in enumerate(places):
            ends: list[tuple[Float, Pairs, Pairs]] = []
            for b, end in enumerate(places if i < j else ()):
                spread = scene.points.covariance_mm2[a] + scene.points.covariance_mm2[b]
                sd = np.sqrt(GATE_SCALE**2 * (np.linalg.eigvalsh(spread)[-1] + variance[i, j]) + 2 * TOLERANCE_MM**2)
                if a != b and abs(float(np.linalg.norm(end - base)) - length[i, j]) < GATE * sd:
                    ends.append((end, ((i, a), (j, b)), ()))
            for r in range(len(scene.rays)):
                ends += [(end, ((i, a),), ((j, r),)) for end in _pierced(scene, base, float(length[i, j]), r)]
            for end, pairs, sights in ends:
                yield from _turned(scene, (i, j), (base, end), pairs, sights)


def _by_rays_alone(scene: Scene, around_mm: Float | None) -> list[Start]:
    """Return poses at which three markers lie on rays and a fourth one comes near another: of poses nearly alike the best."""
    body, rays = scene.body.position_mm, scene.rays
    if len(body) < LEAST_ALONE or len(rays) < LEAST_ALONE:
        return []
    size = float(distances(scene.body)[0].max())
    if around_mm is None or not len(around_mm):
        depth = np.linalg.norm(rays.through_mm - rays.origin_mm, axis=1)[:, None] * DEPTHS
    else:
        depth = depth_range(rays, around_mm, MARGIN_MM + size)
    best: dict[bytes, Start] = {}
    for poses in poses_by_rays(body, rays, depth) or ():
        moved = np.einsum("pij,nj->pni", poses.rotation, body) + poses.translation[:, None]
        offset = moved[:, :, None] - rays.through_mm
        off = np.sqrt(np.maximum((offset**2).sum(-1) - np.einsum("pnrj,rj->pnr", offset, rays.direction) ** 2, 0.0)).min(axis=2)
        away = np.linalg.norm(moved[:, :, None] - scene.points.position_mm, axis=-1).min(axis=2, initial=np.inf)
        off = np.minimum(np.minimum(off, away), COARSE_MM)
        met, total = (off < COARSE_MM).sum(axis=1), off.sum(axis=1)
        alike = np.concatenate([np.round(4 * poses.rotation.reshape(-1, 9)), np.round(poses.translation / 10)], axis=1).astype(np.int16)
        for p in np.flatnonzero(met >= LEAST_ALONE).tolist():
            key = alike[p].tobytes()
            if key not in best or (met[p], -total[p]) > (best[key].met, -best[key].off_mm):
                sights = tuple(sorted(zip(poses.markers[p].tolist(), poses.rays[p].tolist(), strict=True)))
                best[key] = Start(poses.rotation[p], poses.translation[p], (), sights, int(met[p]), float(total[p]))
    return list(best.values())


def _pierced(scene: Scene, base: Float, radius: float, r: int) -> list[Float]:
    """Return where a ray meets a sphere, or comes next to it if it just misses."""
    through, direction = scene.rays.through_mm[r], scene.rays.direction[r]
    along = float((base - through) @ direction)
    foot = through + along * direction
    square = radius**2 - float(((foot - base) ** 2).sum())
    if square < -2 * radius * GRAZING_MM:
        return []
    half = float(np.sqrt(max(square, 0.0)))
    return [foot + half * direction, foot - half * direction] if half > 0 else [foot]


def _turned(scene: Scene, ends: tuple[int, int], places: tuple[Float, Float], pairs: Pairs, sights: Pairs) -> Iterator[Start]:
    """Turn the body about the line through two places; yield the poses at which another marker passes a ray."""
    (i, j), (base, end), body = ends, places, scene.body.position_mm
    line = end - base
    first, axis = _aligning(body[j] - body[i], line), line / np.linalg.norm(line)
    angle = (np.arange(TURNS) * 2 * np.pi / TURNS)[:, None, None]
    by_axis = np.cross(np.eye(3), axis)  # the matrix of the product with it (Rodrigues)
    turns = (np.eye(3) + np.sin(angle) * by_axis + (1 - np.cos(angle)) * by_axis @ by_axis) @ first
    moved = np.einsum("tij,nj->tni", turns, body - body[i]) + base  # (t, n, 3)
    off = np.linalg.norm(np.cross(moved[:, :, None] - scene.rays.through_mm, scene.rays.direction), axis=-1)  # (t, n, r)
    away = np.linalg.norm(moved[:, :, None] - scene.points.position_mm, axis=-1)
    met = ((off < COARSE_MM).any(axis=2) | (away < COARSE_MM).any(axis=2)).sum(axis=1)
    least = (off < COARSE_MM) & (off <= np.roll(off, 1, axis=0)) & (off < np.roll(off, -1, axis=0))
    for t, marker, ray in np.argwhere(least).tolist():
        if marker not in ends and ray not in {r for _, r in sights}:
            seen = tuple(sorted([*sights, (marker, ray)]))
            yield Start(turns[t], base - turns[t] @ body[i], pairs, seen, int(met[t]))


def _aligning(source: Float, target: Float) -> Float:
    """Return a rotation that turns one direction into another."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        other = np.cross(a, [1.0, 0, 0] if abs(a[0]) < 0.9 else [0, 1.0, 0])
        return np.eye(3) if a @ b > 0 else rotation_by(np.pi * other / np.linalg.norm(other))
    return rotation_by(axis / sine * np.arctan2(sine, a @ b))
