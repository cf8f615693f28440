from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from exposures import disturbed, expose, exposure, film_from_plane, objects_of, to_plane, with_sd
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsa_vision.cages import Cage, load_cage
from rsa_vision.errors import GeometryError
from rsa_vision.flags import MarkerFlag
from rsa_vision.settings import Limits
from rsa_vision.types import ImagePoints, Reconstruction
from rsa_vision.xray import check_controls, reconstruct

EXACT_MM = 1e-6
CAGES = ("1A", "1B", "1B-420", "2")
LIMITS = Limits()


def row_of(points: ImagePoints, focus: int, role: str, number: str) -> int:
    (row,) = np.flatnonzero((points.focus == focus) & (points.role == role) & (points.number == number))
    return int(row)


def moved(points: ImagePoints, row: int, by_px: tuple[float, float]) -> ImagePoints:
    position = points.position_px.copy()
    position[row] += by_px
    return replace(points, position_px=position)


def worst_mm(found: Reconstruction, objects: np.ndarray) -> float:
    return float(np.linalg.norm(found.markers.position_mm - objects, axis=1).max())


@pytest.mark.parametrize("name", CAGES)
@pytest.mark.parametrize("sd_px", [np.nan, 0.0, 0.05])
def test_exact_points(name: str, sd_px: float) -> None:
    cage, foci, objects, points = exposure(name, np.random.default_rng(1))
    found = reconstruct(with_sd(points, sd_px), cage, LIMITS)
    assert worst_mm(found, objects) < EXACT_MM
    assert [focus.focus for focus in found.foci] == [1, 2]
    for focus in found.foci:
        np.testing.assert_allclose(focus.position_mm, foci[focus.focus], atol=EXACT_MM)
        assert focus.fiducial_max_um < 1e-6
        assert focus.line_max_um < 1e-4
    assert found.used.all()
    flag = MarkerFlag.NO_COVARIANCE if np.isnan(sd_px) else MarkerFlag.NONE
    assert (found.markers.flags == flag).all()
    assert (found.points.flags == flag).all()
    assert found.markers.crossing_um.max() < 1e-3
    assert (found.markers.n_views == 2).all()
    assert found.markers.name.tolist() == [f"bone/{k + 1}" for k in range(len(objects))]
    eigenvalues = np.linalg.eigvalsh(found.markers.covariance_mm2)
    assert np.isfinite(eigenvalues).all()
    assert (eigenvalues > 0).all()


@pytest.mark.parametrize("name", CAGES)
def test_points_in_the_fiducial_plane(name: str) -> None:
    cage, foci, objects, points = exposure(name, np.random.default_rng(2))
    found = reconstruct(points, cage, LIMITS)
    for focus, position in foci.items():
        origin, basis = cage.plane_of(focus).lab_from_plane()
        rows = (points.focus == focus) & (points.role == "object")
        np.testing.assert_allclose(found.plane_mm[rows], origin + to_plane(position, objects, origin, basis) @ basis, atol=EXACT_MM)
    if name == "2":
        assert np.ptp(found.plane_mm[points.focus == 2][:, 0]) == 0
        assert np.ptp(found.plane_mm[points.focus == 1][:, 2]) == 0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), mirror=st.booleans(), name=st.sampled_from(CAGES))
def test_affine_deformation_and_mirror_of_the_film_change_nothing(seed: int, mirror: bool, name: str) -> None:
    rng = np.random.default_rng(seed)
    cage, _, _, points = exposure(name, rng)
    points = disturbed(with_sd(points, 0.2), 0.2, rng)
    affine = np.eye(2) + rng.uniform(-0.3, 0.3, (2, 2))
    affine[:, 0] *= -1 if mirror else 1
    other = replace(
        points,
        position_px=points.position_px @ affine.T + rng.uniform(-500, 500, 2),
        covariance_px2=affine @ points.covariance_px2 @ affine.T,
    )
    first, second = reconstruct(points, cage, LIMITS), reconstruct(other, cage, LIMITS)
    np.testing.assert_allclose(second.markers.position_mm, first.markers.position_mm, atol=EXACT_MM)
    np.testing.assert_allclose(second.markers.covariance_mm2, first.markers.covariance_mm2, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(second.markers.crossing_um, first.markers.crossing_um, atol=1e-3)


def turned(cage: Cage, rotation: np.ndarray, shift: np.ndarray) -> Cage:
    """The same cage in another laboratory frame."""
    data = cage.model_dump()
    for mark in data["mark"]:
        mark["xyz"] = tuple(rotation @ mark["xyz"] + shift)
        mark["arms"] = tuple(tuple(rotation @ arm) for arm in mark["arms"])
    for plane in data["plane"]:
        plane["origin"] = tuple(rotation @ plane["origin"] + shift)
        plane["u"], plane["v"] = tuple(rotation @ plane["u"]), tuple(rotation @ plane["v"])
    data["foci"] = {focus: tuple(rotation @ position + shift) for focus, position in data["foci"].items()}
    return Cage.model_validate(data)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), name=st.sampled_from(("1A", "2")))
def test_change_of_laboratory_frame(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    cage, _, _, points = exposure(name, rng)
    points = disturbed(with_sd(points, 0.2), 0.2, rng)
    rotation, shift = Rotation.random(rng=rng).as_matrix(), rng.uniform(-300, 300, 3)
    first, second = reconstruct(points, cage, LIMITS), reconstruct(points, turned(cage, rotation, shift), LIMITS)
    np.testing.assert_allclose(second.markers.position_mm, first.markers.position_mm @ rotation.T + shift, atol=EXACT_MM)
    expected = rotation @ first.markers.covariance_mm2 @ rotation.T
    np.testing.assert_allclose(second.markers.covariance_mm2, expected, rtol=1e-4, atol=1e-9)


def test_three_foci() -> None:
    data = load_cage("1A").model_dump()
    data["foci"][3] = (0.0, -150.0, 1100.0)
    data["plane"][0]["foci"] = (1, 2, 3)
    for mark in data["mark"]:
        mark["foci"] = (1, 2, 3)
    cage = Cage.model_validate(data)
    rng = np.random.default_rng(4)
    objects = objects_of(cage)
    points = expose(cage, {k: np.array(v) for k, v in cage.foci.items()}, objects, {k: film_from_plane(rng) for k in cage.foci})
    found = reconstruct(points, cage, LIMITS)
    assert worst_mm(found, objects) < EXACT_MM
    assert (found.markers.n_views == 3).all()
    assert np.isnan(found.markers.parallax_um).all()
    points = with_sd(points, 0.1)
    without = points.rows(np.arange(len(points)) != row_of(points, 3, "object", "bone/4"))
    three, two = reconstruct(points, cage, LIMITS), reconstruct(without, cage, LIMITS)
    assert two.markers.n_views.tolist() == [3, 3, 3, 2] + [3] * 9
    assert worst_mm(two, objects) < EXACT_MM
    gain = np.diagonal(two.markers.covariance_mm2, axis1=1, axis2=2) / np.diagonal(three.markers.covariance_mm2, axis1=1, axis2=2)
    assert (gain[3, :2] > 1.05).all()
    ratios = [reconstruct(disturbed(points, 0.1, rng), cage, LIMITS).markers.crossing_um / three.markers.crossing_sd_um for _ in range(60)]
    assert 0.9 < np.sqrt(np.mean(np.square(ratios))) < 1.1  # twice the RMS distance of rays, against its expectation


def test_error_vector_points_from_the_first_to_the_second_ray() -> None:
    cage, foci, _, points = exposure("1A", np.random.default_rng(5))
    row = row_of(points, 2, "object", "bone/5")
    found = reconstruct(points, cage, LIMITS)
    origin, basis = cage.plane_of(2).lab_from_plane()
    # shift the image of focus 2 by +0.1 mm along y in the plane, on the film
    local = np.linalg.lstsq(
        np.column_stack([points.position_px[points.focus == 2], np.ones((points.focus == 2).sum())]),
        (found.plane_mm[points.focus == 2] - origin) @ basis.T,
        rcond=None,
    )[0][:2].T
    found = reconstruct(moved(points, row, tuple(np.linalg.solve(local, [0, 0.1]))), cage, LIMITS)
    expected = 100 * (foci[2][2] - 40) / foci[2][2]
    assert found.markers.parallax_um[4] == pytest.approx(expected, rel=0.02)
    assert found.markers.crossing_um[4] == pytest.approx(expected, rel=0.02)
    assert np.abs(np.delete(found.markers.parallax_um, 4)).max() < 1e-3
    assert found.residual_um[row] == pytest.approx(found.markers.crossing_um[4] / 2)


@pytest.mark.parametrize("name", CAGES)
def test_gross_errors_are_left_out(name: str) -> None:
    cage, _, objects, points = exposure(name, np.random.default_rng(6))
    fiducial, control = row_of(points, 1, "fiducial", "2"), row_of(points, 2, "control", "18" if name in ("1A", "2") else "22")
    wrong = moved(moved(points, fiducial, (8, 3)), control, (30, 40))
    found = reconstruct(wrong, cage, LIMITS)
    assert np.flatnonzero(~found.used).tolist() == [fiducial, control]
    assert found.points.flags[fiducial] & MarkerFlag.REJECTED
    assert found.points.flags[control] & MarkerFlag.REJECTED
    assert found.residual_um[fiducial] > LIMITS.fiducial_um
    assert found.residual_um[control] > LIMITS.line_mm * 1000
    assert worst_mm(found, objects) < EXACT_MM
    assert found.foci[0].n_fiducials == sum(1 in m.foci and m.role == "fiducial" for m in cage.mark) - 1
    assert found.foci[1].n_controls == len(cage.marks_of(2, "control")) - 1


def test_what_the_rule_cannot_mend_is_flagged() -> None:
    cage, _, _, points = exposure("1A", np.random.default_rng(7))
    wrong = points
    for number in ("1", "2", "3"):
        wrong = moved(wrong, row_of(points, 1, "fiducial", number), (40, 30 * int(number)))
    found = reconstruct(with_sd(wrong, 0.05), cage, Limits(fiducial_um=1e-3))
    focus = found.foci[0]
    rejected = (found.points.focus == 1) & ((found.points.flags & MarkerFlag.REJECTED) > 0)
    assert focus.n_fiducials + rejected[found.points.role == "fiducial"].sum() == 9
    # four controls of a focus with wrong positions cannot be reduced further
    four = points.rows(~((points.focus == 2) & (points.role == "control") & ~np.isin(points.number, ["11", "13", "17", "19"])))
    found = reconstruct(moved(four, row_of(four, 2, "control", "13"), (60, -80)), cage, LIMITS)
    assert found.foci[1].n_controls == 4
    assert found.foci[1].line_max_um > 2000
    large = (found.points.flags & MarkerFlag.LARGE_RESIDUAL) > 0
    assert large[(found.points.focus == 2) & (found.points.role == "control")].any()


def test_one_view_gives_a_row_without_coordinates() -> None:
    cage, _, objects, points = exposure("1B", np.random.default_rng(8))
    gone = row_of(points, 1, "object", "bone/3")
    found = reconstruct(points.rows(np.arange(len(points)) != gone), cage, LIMITS)
    assert len(found.markers) == len(objects)
    row = int(np.flatnonzero(found.markers.name == "bone/3")[0])
    assert np.isnan(found.markers.position_mm[row]).all()
    assert found.markers.n_views[row] == 1
    assert found.markers.flags[row] & MarkerFlag.ONE_VIEW
    image = row_of(found.points, 2, "object", "bone/3")
    assert found.points.flags[image] & MarkerFlag.ONE_VIEW
    assert not found.used[image]
    others = np.flatnonzero(np.arange(len(objects)) != row)
    position = dict(zip(found.markers.name, found.markers.position_mm, strict=True))
    assert max(np.linalg.norm(position[f"bone/{k + 1}"] - objects[k]) for k in range(len(objects)) if k != 2) < EXACT_MM
    assert not (found.markers.flags[others] & MarkerFlag.ONE_VIEW).any()


def test_one_focus_alone_gives_rows_too() -> None:
    cage, foci, objects, points = exposure("1A", np.random.default_rng(9))
    found = reconstruct(points.rows(points.focus == 1), cage, LIMITS)
    assert len(found.markers) == len(objects)
    assert (found.markers.flags & MarkerFlag.ONE_VIEW).all()
    np.testing.assert_allclose(found.foci[0].position_mm, foci[1], atol=EXACT_MM)


def test_rays_that_meet_nowhere_are_flagged() -> None:
    cage, foci, _, points = exposure("1A", np.random.default_rng(10))
    film_from_plane_of = [np.linalg.inv(focus.plane_from_film) for focus in reconstruct(points, cage, LIMITS).foci]
    direction = np.array([0.0, 100, 0]) - foci[1]
    parallel = foci[2] - direction * foci[2][2] / direction[2]
    diverging = parallel + 0.3 * (foci[2] - foci[1]) * [1, 1, 0]  # they meet behind the foci
    for second in (parallel, diverging):
        position = points.position_px.copy()
        for focus, plane in ((1, foci[1] + direction), (2, second)):
            homogeneous = film_from_plane_of[focus - 1] @ np.append(plane[:2], 1)
            position[row_of(points, focus, "object", "bone/1")] = homogeneous[:2] / homogeneous[2]
        found = reconstruct(replace(points, position_px=position), cage, LIMITS)
        assert np.isnan(found.markers.position_mm[0]).all()
        assert found.markers.flags[0] & MarkerFlag.LARGE_RESIDUAL
        assert not found.used[row_of(points, 1, "object", "bone/1")]
        assert np.isfinite(found.markers.position_mm[1:]).all()


def test_large_crossing_is_flagged() -> None:
    cage, _, _, points = exposure("1A", np.random.default_rng(12))
    points = with_sd(points, 0.05)
    found = reconstruct(moved(points, row_of(points, 1, "object", "bone/2"), (2.0, 2.0)), cage, LIMITS)
    assert np.flatnonzero(found.markers.flags & MarkerFlag.LARGE_RESIDUAL).tolist() == [1]
    assert found.markers.crossing_um[1] > LIMITS.crossing_sigma * found.markers.crossing_sd_um[1]


def test_controls_of_both_foci_are_recomputed() -> None:
    rng = np.random.default_rng(13)
    for name, numbers in (("1A", 9), ("1B", 2), ("2", 0)):
        cage, _, _, points = exposure(name, rng)
        exact = check_controls(reconstruct(points, cage, LIMITS), cage)
        assert len(exact.number) == numbers
        noisy = check_controls(reconstruct(disturbed(with_sd(points, 0.1), 0.1, rng), cage, LIMITS), cage)
        if numbers:
            assert exact.radial_max_um < 1e-3
            assert 1 < noisy.radial_rms_um < noisy.radial_max_um < 300
            assert noisy.crossing_rms_um > 0.1
            np.testing.assert_allclose(noisy.radial_um, np.linalg.norm(noisy.computed_mm - noisy.given_mm, axis=1) * 1000)
        else:
            assert np.isnan(exact.radial_rms_um)


def test_temperature_scales_the_coordinates() -> None:
    cage, _, objects, points = exposure("1A", np.random.default_rng(14))
    warm = reconstruct(points, cage.at_temperature(cage.calibrated_at_c + 10), LIMITS)
    np.testing.assert_allclose(warm.markers.position_mm, objects * (1 + 10 * 75e-6), atol=EXACT_MM)


def test_marks_that_this_focus_is_not_meant_to_see_are_not_used() -> None:
    cage, foci, objects, _ = exposure("1B", np.random.default_rng(15))
    data = cage.model_dump()
    for mark in data["mark"]:
        mark["foci"] = (1, 2)
    rng = np.random.default_rng(15)
    points = expose(Cage.model_validate(data), foci, objects, {k: film_from_plane(rng) for k in foci})
    found = reconstruct(points, cage, LIMITS)
    foreign = (found.points.flags & MarkerFlag.FOREIGN_MARK) > 0
    assert foreign.sum() == 12
    assert not found.used[foreign].any()
    assert worst_mm(found, objects) < EXACT_MM


def test_unassigned_images_are_kept_and_transformed() -> None:
    cage, _, objects, points = exposure("1A", np.random.default_rng(16))
    row = row_of(points, 1, "object", "bone/1")
    role, number, focus = points.role.astype("U10"), points.number.copy(), points.focus.copy()
    role[row], number[row] = "unassigned", ""
    other = row_of(points, 2, "object", "bone/1")
    role[other], number[other], focus[other] = "unassigned", "", 0
    found = reconstruct(replace(points, role=role, number=number, focus=focus), cage, LIMITS)
    assert len(found.markers) == len(objects) - 1
    assert np.isfinite(found.plane_mm[row]).all()
    assert np.isnan(found.plane_mm[other]).all()
    assert not found.used[[row, other]].any()


def renamed(points: ImagePoints, row: int, number: str) -> ImagePoints:
    numbers = points.number.copy()
    numbers[row] = number
    return replace(points, number=numbers)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.rows(~((p.focus == 2) & (p.role == "fiducial") & (p.number > "3"))), "focus 2: 3 fiducial marks"),
        (lambda p: p.rows(~((p.focus == 2) & (p.role == "fiducial") & ~np.isin(p.number, ["1", "2", "3", "5"]))), "one line"),
        (lambda p: p.rows(~((p.focus == 1) & (p.role == "control") & (p.number > "11"))), "focus 1: 1 control points"),
        (lambda p: renamed(p, row_of(p, 1, "fiducial", "3"), "2"), "fiducial mark 2 occurs twice"),
        (lambda p: renamed(p, row_of(p, 1, "fiducial", "3"), "77"), "no fiducial mark 77 in cage 1A"),
        (lambda p: renamed(p, row_of(p, 2, "object", "bone/3"), "bone/4"), "object point bone/4 occurs twice at focus 2"),
        (lambda p: renamed(p, row_of(p, 2, "object", "bone/3"), ""), "has no number"),
        (lambda p: replace(p, focus=np.where(p.focus == 2, 5, p.focus)), "no focus 5"),
        (lambda p: replace(p, focus=np.where(p.focus == 2, 0, p.focus)), "has no focus"),
        (lambda p: p.rows(p.role == "nothing"), "none is named"),
    ],
)
def test_what_cannot_be_computed_is_said(change, message: str) -> None:
    cage, _, _, points = exposure("1A", np.random.default_rng(17))
    with pytest.raises(GeometryError, match=message):
        reconstruct(change(points), cage, LIMITS)


def test_points_of_a_former_run_are_judged_anew() -> None:
    cage, _, _, points = exposure("1A", np.random.default_rng(18))
    old = MarkerFlag.REJECTED | MarkerFlag.LARGE_RESIDUAL | MarkerFlag.ONE_VIEW | MarkerFlag.NO_COVARIANCE
    flags = np.full(len(points), int(old | MarkerFlag.EDGE))
    found = reconstruct(replace(with_sd(points, 0.1), flags=flags), cage, LIMITS)
    assert (found.points.flags == MarkerFlag.EDGE).all()
    assert (found.markers.flags == MarkerFlag.EDGE).all()
    assert (flags == int(old | MarkerFlag.EDGE)).all()  # the input is not changed


TIME_LIMIT_MS = 20.0  # of one examination with 13 objects; the best of several, for other work on the machine


def test_speed() -> None:
    cage, _, _, points = exposure("1A", np.random.default_rng(19))
    times = []
    for _ in range(10):
        start = time.perf_counter()
        reconstruct(points, cage, LIMITS)
        times.append((time.perf_counter() - start) * 1000)
    assert min(times) < TIME_LIMIT_MS
