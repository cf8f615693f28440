from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from exposures import disturbed, with_sd
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsa_vision.errors import CalibrationError, GeometryError
from rsa_vision.flags import MarkerFlag
from rsa_vision.geometry.camera import camera_centre, pixel_rays, project
from rsa_vision.settings import Limits
from rsa_vision.types import ImagePoints
from rsa_vision.xray import reconstruct_calibrated

EXACT_MM = 1e-6
LIMITS = Limits()
BEADS_MM = np.random.default_rng(31).uniform(-40, 40, (17, 3))


@dataclass(frozen=True)
class Pinhole:
    matrix: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def camera(angle_deg: float, tilt_deg: float = 5.0) -> Pinhole:
    matrix = np.array([[6167.0, 0, 803], [0, 6165, 866], [0, 0, 1]])
    rotation = Rotation.from_euler("yx", [angle_deg, tilt_deg], degrees=True).as_matrix()
    return Pinhole(matrix, rotation, np.array([-16.0, -20, 901]))


CAMERAS = {1: camera(-35), 2: camera(50), 3: camera(10, 60)}


def views(count: int) -> ImagePoints:
    n, beads = count * len(BEADS_MM), len(BEADS_MM)
    pixels = np.vstack([project(CAMERAS[k + 1], BEADS_MM) for k in range(count)])
    names = np.array([f"radius/{k + 1}" for k in range(beads)] * count)
    none = np.zeros(n, np.int64)
    covariance = np.full((n, 2, 2), np.nan)
    focus = np.repeat(np.arange(count) + 1, beads)
    return ImagePoints(focus, np.full(n, "object"), names, np.full(n, "ball"), pixels, covariance, none, none)


def test_project_follows_the_convention() -> None:
    view = CAMERAS[1]
    point = np.array([3.0, -4, 5])
    x, y, z = view.rotation @ point + view.translation
    np.testing.assert_allclose(project(view, point[None])[0], [6167 * x / z + 803, 6165 * y / z + 866])


@settings(deadline=None)
@given(st.tuples(*[st.floats(-100, 100)] * 3))
def test_rays_pass_through_what_was_projected(point: tuple[float, float, float]) -> None:
    for view in CAMERAS.values():
        origin, through, by_pixel = pixel_rays(view, project(view, np.array([point])))
        np.testing.assert_allclose(origin, camera_centre(view))
        np.testing.assert_allclose(np.cross(point - origin, through[0] - origin) / np.linalg.norm(through[0] - origin), 0, atol=1e-8)
        np.testing.assert_allclose(pixel_rays(view, np.array([[1.0, 0]]))[1] - pixel_rays(view, np.zeros((1, 2)))[1], by_pixel[:, :, 0])


@pytest.mark.parametrize("count", [2, 3])
def test_exact_points(count: int) -> None:
    found = reconstruct_calibrated(views(count), CAMERAS, LIMITS)
    np.testing.assert_allclose(found.markers.position_mm, BEADS_MM, atol=EXACT_MM)
    assert (found.markers.n_views == count).all()
    assert np.isnan(found.markers.parallax_um).all()
    assert np.isnan(found.markers.covariance_mm2).all()  # no cage shows how large the image errors are
    assert (found.markers.flags == MarkerFlag.NO_COVARIANCE).all()
    assert found.used.all()
    assert len(found.controls) == 0
    for focus in found.foci:
        np.testing.assert_allclose(focus.position_mm, camera_centre(CAMERAS[focus.focus]))
        assert np.isnan(focus.fiducial_rmse_um)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("sd_px", [0.05, 1.0])
def test_drawn_errors_are_as_large_as_stated(count: int, sd_px: float) -> None:
    rng = np.random.default_rng(32)
    points = with_sd(views(count), sd_px)
    markers, crossing = [], []
    for _ in range(100):
        found = reconstruct_calibrated(disturbed(points, sd_px, rng), CAMERAS, LIMITS)
        error = found.markers.position_mm - BEADS_MM
        markers.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error) / 3)
        crossing.append((found.markers.crossing_um / found.markers.crossing_sd_um) ** 2)
    # 1,700 independent markers
    assert 0.95 < np.sqrt(np.mean(markers)) < 1.05
    assert 0.93 < np.sqrt(np.mean(crossing)) < 1.07


def test_one_view_and_other_roles_keep_their_rows() -> None:
    points = views(2)
    role = points.role.astype("U10")
    role[0], role[1] = "unassigned", "control"
    found = reconstruct_calibrated(replace(with_sd(points, 0.1), role=role), CAMERAS, LIMITS)
    assert len(found.markers) == 17
    lonely = np.isin(found.markers.name, ["radius/1", "radius/2"])
    assert (found.markers.n_views[lonely] == 1).all()
    assert np.isnan(found.markers.position_mm[lonely]).all()
    assert ((found.markers.flags & MarkerFlag.ONE_VIEW) > 0).tolist() == lonely.tolist()
    assert not found.used[:2].any()


def test_what_cannot_be_computed_is_said() -> None:
    points = views(3)
    with pytest.raises(CalibrationError, match="focus 3 has no camera"):
        reconstruct_calibrated(points, {1: CAMERAS[1], 2: CAMERAS[2]}, LIMITS)
    with pytest.raises(CalibrationError, match="singular"):
        reconstruct_calibrated(points, {**CAMERAS, 2: replace(CAMERAS[2], matrix=np.zeros((3, 3)))}, LIMITS)
    number = points.number.copy()
    number[0] = number[1]
    with pytest.raises(GeometryError, match="twice"):
        reconstruct_calibrated(replace(points, number=number), CAMERAS, LIMITS)
