from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.rays import RayBundle, closest_approach, cross, intersect_lines, intersection_jacobians
from rsa_vision.geometry.resection import locate_focus

FOCI_MM = np.array([[-240.0, 100, 1120], [240, 100, 1120], [0, -300, 1100]])
coordinate = st.floats(-100, 100)


def lines(seed: int, count: int = 3, spread: float = 10) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    through = rng.normal(0, spread, (count, 3))
    return through, through + rng.normal(0, 3 * spread, (count, 3))


@given(st.tuples(coordinate, coordinate, st.floats(5, 500)), st.integers(2, 3))
def test_project_and_intersect(point: tuple[float, float, float], count: int) -> None:
    foci = FOCI_MM[:count]
    away = np.array(point) - foci
    through = foci - away * (foci[:, 2] / away[:, 2])[:, None]
    found, residuals = intersect_lines(foci, through - foci)
    np.testing.assert_allclose(found, point, atol=1e-9)
    np.testing.assert_allclose(residuals, 0, atol=1e-9)


@settings(deadline=None)
@given(st.integers(0, 1000), st.tuples(coordinate, coordinate, coordinate))
def test_change_of_frame(seed: int, shift: tuple[float, float, float]) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    through, origin = lines(seed)
    found, residuals = intersect_lines(origin, origin - through)
    moved, moved_residuals = intersect_lines(origin @ rotation.T + shift, (origin - through) @ rotation.T)
    # ill-conditioned draws lose digits by as much
    scale = max(1.0, float(np.abs(found).max()))
    np.testing.assert_allclose(moved, found @ rotation.T + shift, atol=1e-8 * scale)
    np.testing.assert_allclose(moved_residuals, residuals @ rotation.T, atol=1e-8 * scale)


def test_two_lines_give_the_midpoint_of_the_closest_approach() -> None:
    through, origin = lines(1, 2)
    found, residuals = intersect_lines(origin, origin - through)
    point_a, point_b, *_ = closest_approach(through[0], origin[0], through[1], origin[1])
    np.testing.assert_allclose(found, (point_a + point_b) / 2, atol=1e-10)
    np.testing.assert_allclose(residuals[1] - residuals[0], point_b - point_a, atol=1e-10)
    np.testing.assert_allclose([(point_b - point_a) @ (origin - through)[k] for k in (0, 1)], 0, atol=1e-8)


def test_jacobians_against_differences_at_large_residuals() -> None:
    through, origin = lines(2)
    point, residuals = intersect_lines(origin, origin - through)
    assert np.linalg.norm(residuals, axis=1).max() > 1
    of_point, of_residuals = intersection_jacobians(through, origin, point)
    step = 1e-5
    for line in range(3):
        for column in range(6):
            change = np.zeros((2, 3, 3))
            change[column // 3, line, column % 3] = step
            (plus, plus_r), (minus, minus_r) = (
                intersect_lines(origin + s * change[1], origin - through + s * (change[1] - change[0])) for s in (1, -1)
            )
            np.testing.assert_allclose(of_point[line, :, column], (plus - minus) / (2 * step), rtol=1e-6, atol=1e-8)
            np.testing.assert_allclose(of_residuals[:, :, line, column], (plus_r - minus_r) / (2 * step), rtol=1e-6, atol=1e-8)


def test_parallel_lines_give_nan() -> None:
    through = np.array([[0.0, 0, 0], [10, 0, 0]])
    assert np.isnan(intersect_lines(through, np.tile([1.0, 2, 3], (2, 1)))[0]).all()
    assert np.isnan(closest_approach(through[0], through[0] + 1, through[1], through[1] + 1)[0]).all()


def bundle(focus: int, count: int, rng: np.random.Generator, sd_mm: float = 0.01) -> RayBundle:
    through = rng.normal(0, 50, (count, 3)) * [1, 1, 0]
    root = rng.normal(0, sd_mm, (count, 6, 6))
    origin = np.tile(FOCI_MM[focus - 1], (count, 1))
    effect = rng.normal(0, sd_mm, (count, 6, 4))
    return RayBundle(np.arange(count), np.full(count, focus), origin, through, root @ root.swapaxes(1, 2), effect)


def test_cross_agrees_with_the_intersection_and_its_jacobian() -> None:
    rng = np.random.default_rng(7)
    a, b = bundle(1, 3, rng), bundle(2, 4, rng)
    points, crossing, sigma = cross(a, b)
    assert points.shape == (3, 4, 3)
    assert crossing.shape == sigma.shape == (3, 4)
    for i, j in np.ndindex(3, 4):
        through, origin = np.stack([a.through_mm[i], b.through_mm[j]]), np.stack([a.origin_mm[i], b.origin_mm[j]])
        point, residuals = intersect_lines(origin, origin - through)
        error = residuals[1] - residuals[0]
        _, of_residuals = intersection_jacobians(through, origin, point)
        gradient = error / np.linalg.norm(error) @ (of_residuals[1] - of_residuals[0]).reshape(3, 12)
        variance = gradient[:6] @ a.covariance_mm2[i] @ gradient[:6] + gradient[6:] @ b.covariance_mm2[j] @ gradient[6:]
        variance += ((gradient @ np.vstack([a.cage_effect_mm[i], b.cage_effect_mm[j]])) ** 2).sum()
        np.testing.assert_allclose(points[i, j], point, atol=1e-9)
        np.testing.assert_allclose([crossing[i, j], sigma[i, j]], [np.linalg.norm(error), np.sqrt(variance)], rtol=1e-9)


def test_cross_of_parallel_rays_is_nan() -> None:
    rng = np.random.default_rng(8)
    a, b = bundle(1, 1, rng), bundle(2, 1, rng)
    b.through_mm[0] = b.origin_mm[0] + (a.through_mm[0] - a.origin_mm[0])
    points, crossing, sigma = cross(a, b)
    assert np.isnan(points).all()
    assert np.isnan(crossing).all()
    assert np.isnan(sigma).all()


def test_cross_of_nothing_is_empty() -> None:
    rng = np.random.default_rng(9)
    points, crossing, sigma = cross(bundle(1, 0, rng), bundle(2, 2, rng))
    assert points.shape == (0, 2, 3)
    assert crossing.shape == sigma.shape == (0, 2)


@given(st.tuples(coordinate, coordinate, st.floats(600, 1500)))
def test_resection_returns_the_focus(focus: tuple[float, float, float]) -> None:
    controls = np.array([(x, y, 140.0) for x in (-65, 0, 65) for y in (0, 100, 200)])
    away = controls - np.array(focus)
    through = np.array(focus) - away * (focus[2] / away[:, 2])[:, None]
    found, residuals = locate_focus(through, controls)
    np.testing.assert_allclose(found, focus, atol=1e-8)
    np.testing.assert_allclose(residuals, 0, atol=1e-9)


def test_resection_minimises_the_distances() -> None:
    rng = np.random.default_rng(4)
    controls = np.array([(x, y, 140.0) for x in (-65, 0, 65) for y in (0, 100, 200)])
    through = controls * [1.14, 1.14, 0] + rng.normal(0, 0.1, (9, 3)) * [1, 1, 0]
    focus, residuals = locate_focus(through, controls)
    best = (residuals**2).sum()
    unit = (controls - through) / np.linalg.norm(controls - through, axis=1, keepdims=True)
    for shift in rng.normal(0, 1, (20, 3)):
        assert (np.cross(unit, focus + shift - through) ** 2).sum() > best


@pytest.mark.parametrize(("count", "message"), [(1, "at least 2"), (3, "parallel")])
def test_undetermined_focus_is_said(count: int, message: str) -> None:
    through = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])[:count]
    with pytest.raises(GeometryError, match=message):
        locate_focus(through, through + np.array([0, 0, 140]))


def test_control_point_in_the_plane_is_said() -> None:
    through = np.array([[0.0, 0, 0], [10, 0, 0]])
    with pytest.raises(GeometryError, match="no direction"):
        locate_focus(through, through * [1, 1, 0])
