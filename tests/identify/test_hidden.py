"""Markers that one focus alone shows: found among single rays with true stated errors, never decisive at a wrong pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.identify.constellation import match_segments
from rsa_vision.identify.hidden import find_with_rays, hidden_markers
from rsa_vision.identify.poses import TOLERANCE_MM, Cloud, volume_mm3
from tests.identify.bodies import measured, random_body, seen_from

POSTERIOR = 0.999


def scene(rng: np.random.Generator, n: int, both: int, single: int, strays: int):
    """A body of n markers of which some are seen by both foci and some by one; strays among the points and the rays."""
    body = random_body(rng, n, 15.0)
    middle = np.array([0, 100, 150.0]) + rng.normal(0, 20, 3)
    places = Rotation.random(random_state=rng).apply(body) + middle + rng.normal(0, TOLERANCE_MM, (n, 3))
    order = rng.permutation(n).tolist()
    extra = int(rng.poisson(0.7))
    points = measured(rng, np.concatenate([places[order[:both]], middle + rng.normal(0, 20, (extra, 3))]), 0.03)
    hidden = order[both : both + single]
    rays = seen_from(rng, np.concatenate([places[hidden], middle + rng.normal(0, 20, (strays, 3))]), rng.integers(0, 2, single + strays))
    return body, places, points, order[:both] + [-1] * extra, rays, hidden + [-1] * strays


def test_hidden_markers_of_a_known_pose_get_true_coordinates_with_true_errors() -> None:
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(60):
        body, places, points, names, rays, seen = scene(rng, 7, 4, 2, 2)
        (known,) = match_segments([Cloud.exact(body)], points, POSTERIOR)
        if known.placement is None:
            continue
        volume = max(volume_mm3(points), volume_mm3(Cloud.exact(body)))
        found = hidden_markers(Cloud.exact(body), points, known.pairs, known.placement, rays, set(known.lost), volume, POSTERIOR)
        assert all(names[a] == i for i, a in found.pairs)
        assert all(seen[r] == i for i, r in found.sights)
        for i, _ in found.sights:
            at, covariance = found.placement.predict(body[[i]])
            error = at[0] - places[i]
            squares.append(error @ np.linalg.solve(covariance[0] + TOLERANCE_MM**2 * np.eye(3), error))
    assert len(squares) > 90
    assert 0.7 < np.mean(squares) / 3 < 1.3


@pytest.mark.parametrize(("n", "both", "single"), [(6, 2, 3), (5, 1, 4)])
def test_a_segment_with_fewer_than_three_points_is_found_by_its_rays(n: int, both: int, single: int) -> None:
    rng = np.random.default_rng(both)
    decisive = 0
    for _ in range(4):
        body, places, points, names, rays, seen = scene(rng, n, both, single, 1)
        (found,) = find_with_rays([Cloud.exact(body)], points, rays, 1e5, POSTERIOR)
        if found.decisive:
            decisive += 1
            assert all(names[a] == i for i, a in found.pairs)
            assert all(seen[r] == i for i, r in found.sights)
            assert np.abs(found.placement.predict(body)[0] - places).max() < 1.0
    assert decisive >= 2


def test_what_does_not_determine_a_pose_is_not_decisive() -> None:
    rng = np.random.default_rng(8)
    for both, single in ((1, 2), (2, 1)):
        body, _, points, _, rays, _ = scene(rng, 5, both, single, 0)
        assert not find_with_rays([Cloud.exact(body)], points, rays, 1e5, POSTERIOR)[0].decisive


def test_a_symmetric_body_has_more_than_one_pose() -> None:
    rng = np.random.default_rng(9)
    square = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0.0]])
    places = square + np.array([0, 100, 150.0])
    (found,) = find_with_rays(
        [Cloud.exact(square)], measured(rng, places[:2], 0.01), seen_from(rng, places[2:], np.array([0, 1])), 1e5, POSTERIOR
    )
    assert found.placement is not None
    assert not found.decisive


def test_a_segment_without_any_point_is_found_by_rays_of_one_focus_with_true_errors() -> None:
    rng = np.random.default_rng(5)
    decisive, squares = 0, []
    for _ in range(3):
        body, places, points, _, _, seen = scene(rng, 6, 0, 6, 2)
        one = seen_from(rng, np.concatenate([places[seen[:6]], places[:2] + rng.normal(0, 15, (2, 3))]), np.zeros(8, int))
        (found,) = find_with_rays([Cloud.exact(body)], points, one, 1e5, POSTERIOR, around_mm=places + rng.normal(0, 20, places.shape))
        (mirrored,) = find_with_rays([Cloud.exact(body * [-1, 1, 1])], points, one, 1e5, POSTERIOR, around_mm=places)
        assert not mirrored.decisive
        if found.decisive:
            decisive += 1
            assert all(seen[r] == i for i, r in found.sights)
            at, covariance = found.placement.predict(body)
            error = at - places
            stated = covariance + TOLERANCE_MM**2 * np.eye(3)
            squares += np.einsum("ni,nij,nj->n", error, np.linalg.inv(stated), error).tolist()
    assert decisive >= 2
    assert 0.2 < np.mean(squares) / 3 < 3  # the errors of one pose are common to its markers
    assert max(squares) < 25


def test_an_image_beside_a_hidden_marker_takes_its_name_from_neither_or_the_right_one() -> None:
    rng = np.random.default_rng(6)
    named = 0
    for _ in range(3):
        body, places, points, _, _, seen = scene(rng, 6, 2, 4, 0)
        beside = places[seen[:1]] + np.array([0.25, 0.1, 0])
        rays = seen_from(rng, np.concatenate([places[seen], beside]), np.zeros(5, int))
        (found,) = find_with_rays([Cloud.exact(body)], points, rays, 1e5, POSTERIOR)
        if found.decisive:
            assert all(r < 4 and seen[r] == i for i, r in found.sights)
            named += len(found.sights)
    assert named >= 5
