"""Pairs that rays cannot decide: the constellation decides for the true ones only, and where it cannot they stay open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.geometry.rays import cross
from rsa_vision.identify.contested import settle
from rsa_vision.identify.poses import TOLERANCE_MM, Cloud
from rsa_vision.types import Float
from tests.identify.bodies import FOCI_MM, measured, random_body, seen_from

POSTERIOR = 0.999
SD_MM = 0.02


def in_plane_of(place: Float, other: Float) -> Float:
    """Move a place into the plane through another one and both foci."""
    normal = np.cross(FOCI_MM[0] - other, FOCI_MM[1] - other)
    normal /= np.linalg.norm(normal)
    return place - normal * ((place - other) @ normal)


def scene(rng: np.random.Generator, n: int, contested: int) -> tuple[Float, Cloud, Cloud, list[tuple[int, int]], list[int]]:
    """A body of which some markers lie in one epipolar plane: body, other points, candidates, images of each, and its marker or -1."""
    places = Rotation.random(random_state=rng).apply(random_body(rng, n, 15.0)) + np.array([0, 100, 150.0])
    for k in range(1, contested):
        places[k] = in_plane_of(places[k], places[0])
    turn = Rotation.random(random_state=rng).as_matrix()
    body = (places - places.mean(axis=0)) @ turn
    places = places + rng.normal(0, TOLERANCE_MM, places.shape)
    rays = [seen_from(rng, places[:contested], np.full(contested, focus), SD_MM) for focus in (0, 1)]
    at, distance, _ = cross(*rays)
    pairs = [(a, b) for a in range(contested) for b in range(contested) if distance[a, b] < 1.0]
    points = np.array([at[a, b] for a, b in pairs])
    covariance = np.tile(np.diag([0.02, 0.02, 0.05]) ** 2, (len(pairs), 1, 1))
    return (
        body,
        measured(rng, places[contested:], 0.02),
        Cloud(points, covariance),
        [(a, contested + b) for a, b in pairs],
        [a if a == b else -1 for a, b in pairs],
    )


@pytest.mark.parametrize(("n", "contested"), [(6, 2), (7, 3), (5, 2)])
def test_the_constellation_decides_for_true_pairs_and_for_no_others(n: int, contested: int) -> None:
    rng = np.random.default_rng(n)
    settled = possible = rivals = 0
    for _ in range(15):
        body, sure, candidates, images, truth = scene(rng, n, contested)
        rivals += len(candidates) - contested
        chances = settle([Cloud.exact(body)], sure, candidates, images, rng.normal(3.0, 1.0, len(images)))
        decided = np.flatnonzero(chances >= POSTERIOR)
        apart = candidates.position_mm - candidates.position_mm[[truth.index(i) for i, _ in images]]
        wrong = [c for c in decided if truth[c] < 0 and np.linalg.norm(apart[c]) > 0.5]
        assert wrong == []
        settled += sum(truth[c] >= 0 for c in decided)
        possible += contested
    assert rivals > 15  # crossed by each other's rays
    assert settled / possible > 0.8


def test_pairs_stay_open_without_the_segment_and_where_two_ways_fit() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        body, sure, candidates, images, _ = scene(rng, 6, 2)
        if len(images) < 4:
            continue
        alike = np.full(len(images), 3.0)
        assert (settle([Cloud.exact(random_body(rng, 6, 15.0))], sure, candidates, images, alike) < POSTERIOR).all()
        assert (settle([Cloud.exact(body * [-1, 1, 1])], sure, candidates, images, alike) < POSTERIOR).all()
    # two candidates that share an image, both where the marker must be: the odds of their rays alone tell them apart
    body = random_body(rng, 5, 15.0)
    sure, places = Cloud.exact(body[:4]), Cloud.exact(body[[4, 4]] + [[0.01, 0, 0], [-0.01, 0, 0]])
    for odds in (0.0, 2.0):
        chances = settle([Cloud.exact(body)], sure, places, [(0, 1), (0, 2)], np.array([3.0, 3.0 + odds]))
        assert chances.sum() == pytest.approx(1.0, abs=0.01)
        assert np.log(chances[1] / chances[0]) == pytest.approx(odds, abs=0.1)


def test_a_false_image_on_the_epipolar_line_is_not_paired_by_a_loose_marker() -> None:
    """The partner of a marker that has moved in its bone is the one that its rays say, not a false one nearer to its old place."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        body, sure, candidates, images, truth = scene(rng, 6, 2)
        moved = candidates.position_mm + rng.normal(0, 1.5, 3)
        chances = settle([Cloud.exact(body)], sure, Cloud(moved, candidates.covariance_mm2), images, np.full(len(images), 3.0))
        assert all(truth[c] >= 0 for c in np.flatnonzero(chances >= POSTERIOR))
