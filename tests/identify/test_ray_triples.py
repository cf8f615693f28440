"""Poses from three rays: the true one is among them, and each puts its markers on its rays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.identify.ray_triples import GRAZING_MM, depth_range, marker_triples, poses_by_rays
from tests.identify.bodies import random_body, seen_from


@pytest.mark.parametrize("foci", [1, 2])
def test_the_true_pose_is_among_the_poses_of_exact_rays(foci: int) -> None:
    rng = np.random.default_rng(foci)
    met = 0
    for _ in range(25):
        body = random_body(rng, 4, 15.0)
        places = Rotation.random(random_state=rng).apply(body) + np.array([0, 100, 150.0]) + rng.normal(0, 20, 3)
        rays = seen_from(rng, places, rng.integers(0, foci, 4), 0.0)
        off = []
        for poses in poses_by_rays(body, rays, depth_range(rays, places.mean(axis=0)[None], 150.0)) or ():
            moved = np.einsum("pij,nj->pni", poses.rotation, body) + poses.translation[:, None]
            np.testing.assert_allclose(np.linalg.det(poses.rotation), 1.0)
            p = np.arange(len(moved))[:, None]
            offset = moved[p, poses.markers] - rays.through_mm[poses.rays]
            away = np.linalg.norm(np.cross(offset, rays.direction[poses.rays]), axis=-1)
            assert away.max(initial=0.0) < 3 * GRAZING_MM  # first poses: they are fitted afterwards
            right = (poses.markers == poses.rays).all(axis=1)
            off += np.linalg.norm(moved - places, axis=2).max(axis=1)[right].tolist()
        met += min(off, default=np.inf) < 3.0
    assert met >= 24


@pytest.mark.parametrize("n", [4, 6, 9])
def test_any_four_markers_hold_a_triangle_that_is_used(n: int) -> None:
    from itertools import combinations

    body = np.random.default_rng(n).normal(0, 15, (n, 3))
    triples = [set(triple) for triple in marker_triples(body)]
    assert all(any(triple <= set(four) for triple in triples) for four in combinations(range(n), 4))
    line = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0.5]])
    assert marker_triples(line) == []


def test_too_many_combinations_are_refused() -> None:
    rng = np.random.default_rng(1)
    body = random_body(rng, 6, 15.0)
    rays = seen_from(rng, rng.normal(0, 5, (60, 3)) + np.array([0, 100, 150.0]), np.zeros(60, int), 0.01)
    assert poses_by_rays(body, rays, depth_range(rays, np.array([[0, 100, 150.0]]), 50.0)) is None
