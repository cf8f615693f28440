"""Exact image points by the forward geometry alone: a ray from focus through mark to the plane, then any projective film."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsa_vision.cages import Cage, load_cage
from rsa_vision.types import ImagePoints

LOWER = [(-45, 55, 40), (45, 55, 40), (-45, 145, 40), (45, 145, 40), (0, 100, 40)]
UPPER = [(-40, 60, 90), (40, 60, 90), (-40, 140, 90), (40, 140, 90), (0, 100, 90), (10, 80, 65), (-20, 120, 70), (25, 95, 55)]
OBJECTS = np.array([*LOWER, *UPPER], float)


def objects_of(cage: Cage) -> np.ndarray:
    return OBJECTS + (np.array([0, 100, 0]) if cage.name.startswith("1B") else 0)


def film_from_plane(rng: np.random.Generator, mirror: bool = False) -> np.ndarray:
    """A film of about 10 px/mm: turned, sheared, unequally scaled, and tilted a little."""
    angle = rng.uniform(-0.6, 0.6)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    scale = np.array([[10 + rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1)], [0, -10 + rng.uniform(-0.2, 0.2)]])
    matrix = np.eye(3)
    matrix[:2, :2] = turn @ scale @ np.diag([-1 if mirror else 1, 1])
    matrix[:2, 2] = rng.uniform(800, 1600, 2)
    matrix[2, :2] = rng.uniform(-2e-5, 2e-5, 2)
    return matrix


def to_plane(focus_mm: np.ndarray, points_mm: np.ndarray, origin: np.ndarray, basis: np.ndarray) -> np.ndarray:
    normal = np.cross(basis[0], basis[1])
    away = points_mm - focus_mm
    seen = focus_mm + away * (((origin - focus_mm) @ normal) / (away @ normal))[:, None]
    return (seen - origin) @ basis.T


def expose(
    cage: Cage,
    foci_mm: dict[int, np.ndarray],
    objects_mm: np.ndarray,
    films: dict[int, np.ndarray],
    marks_mm: np.ndarray | None = None,
) -> ImagePoints:
    """Image every mark that a focus sees, and all objects; `marks_mm` are the true marks where they differ from the cage's."""
    marks_mm = np.array([mark.xyz for mark in cage.mark]) if marks_mm is None else marks_mm
    columns: list[list] = [[], [], [], []]
    for focus, position in foci_mm.items():
        origin, basis = cage.plane_of(focus).lab_from_plane()
        seen = [index for index, mark in enumerate(cage.mark) if focus in mark.foci]
        points = np.vstack([marks_mm[seen], objects_mm])
        uv = np.column_stack([to_plane(position, points, origin, basis), np.ones(len(points))]) @ films[focus].T
        columns[0] += [focus] * len(points)
        columns[1] += [cage.mark[index].role for index in seen] + ["object"] * len(objects_mm)
        columns[2] += [str(cage.mark[index].number) for index in seen] + [f"bone/{k + 1}" for k in range(len(objects_mm))]
        columns[3] += (uv[:, :2] / uv[:, 2:]).tolist()
    n = len(columns[0])
    return ImagePoints(
        np.array(columns[0]), np.array(columns[1]), np.array(columns[2]), np.full(n, "ball"), np.array(columns[3]),
        np.full((n, 2, 2), np.nan), np.zeros(n, np.int64), np.zeros(n, np.int64),
    )  # fmt: skip


def with_sd(points: ImagePoints, sd_px: float | np.ndarray) -> ImagePoints:
    return replace(points, covariance_px2=np.broadcast_to(np.square(sd_px), (len(points),))[:, None, None] * np.eye(2))


def disturbed(points: ImagePoints, sd_px: float | np.ndarray, rng: np.random.Generator) -> ImagePoints:
    noise = rng.normal(size=points.position_px.shape) * np.broadcast_to(sd_px, (len(points),))[:, None]
    return replace(points, position_px=points.position_px + noise)


def exposure(name: str, rng: np.random.Generator) -> tuple[Cage, dict[int, np.ndarray], np.ndarray, ImagePoints]:
    """Cage, foci near nominal, objects and their exact images."""
    cage = load_cage(name)
    foci = {focus: np.array(position) + rng.uniform(-10, 10, 3) for focus, position in cage.foci.items()}
    objects = objects_of(cage)
    return cage, foci, objects, expose(cage, foci, objects, {focus: film_from_plane(rng) for focus in foci})
