"""Rigid bodies of markers at random places, as measured: noise, lost, extra and loose markers, and rays of single foci."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.poses import Cloud
from rsa_vision.types import Float, Int

FOCI_MM = np.array([[-240.0, 100, 1120], [240, 100, 1120]])
RIGID_MM = 0.03  # by which markers of one bone really move
Name = tuple[int, int]
STRAY = (-1, -1)


def random_body(rng: np.random.Generator, n: int, size_mm: float = 18.0, gap_mm: float = 3.0) -> Float:
    """Return n places that keep a gap from each other."""
    places = [rng.normal(0, size_mm, 3)]
    while len(places) < n:
        place = rng.normal(0, size_mm, 3)
        if min(np.linalg.norm(place - other) for other in places) > gap_mm:
            places.append(place)
    return np.array(places)


def measured(rng: np.random.Generator, places: Float, sd_mm: float) -> Cloud:
    """Return places with noise, larger in depth, and its covariance."""
    sd = sd_mm * np.array([1, 1, 2.5])
    return Cloud(places + rng.normal(0, 1, places.shape) * sd, np.tile(np.diag(sd**2), (len(places), 1, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Points of an examination, and the body and marker that each is (:data:`STRAY` for none)."""

    points: Cloud
    truth: list[Name]


def examination(
    rng: np.random.Generator,
    bodies: list[Float],
    sd_mm: float,
    *,
    lost: float = 0.08,
    loose: float = 0.04,
    strays: float = 1.5,
    mirrored: bool = False,
) -> Found:
    """Return bodies at any pose, one along the other, with markers lost, loose (0.7 mm) and extra."""
    places, truth = [], []
    for index, body in enumerate(bodies):
        shape = body * [-1, 1, 1] if mirrored else body
        moved = Rotation.random(random_state=rng).apply(shape) + rng.normal(0, 15, 3) + np.array([0, 40 * index, 100])
        for marker, place in enumerate(moved):
            fate = rng.random()
            if fate >= lost:
                places.append(place + rng.normal(0, RIGID_MM, 3) + (rng.normal(0, 0.7, 3) if fate > 1 - loose else 0))
                truth.append((index, marker))
    for _ in range(rng.poisson(strays)):
        places.append(rng.normal(0, 20, 3) + np.array([0, 20, 100]))
        truth.append(STRAY)
    order = rng.permutation(len(places))
    return Found(measured(rng, np.array(places).reshape(-1, 3)[order], sd_mm), [truth[k] for k in order])


def seen_from(rng: np.random.Generator, places: Float, foci: Int, sd_mm: float = 0.02) -> RayBundle:
    """Return a ray of one focus through each place, with an error of its image in the plane z = 0."""
    origin = FOCI_MM[foci]
    through = origin + (places - origin) * (origin[:, 2:] / (origin[:, 2:] - places[:, 2:]))
    through[:, :2] += rng.normal(0, sd_mm, (len(places), 2))
    covariance = np.zeros((len(places), 6, 6))
    covariance[:, 0, 0] = covariance[:, 1, 1] = sd_mm**2
    return RayBundle(np.arange(len(places)), foci + 1, origin, through, covariance, np.zeros((len(places), 6, 0)))
