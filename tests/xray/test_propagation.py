"""Stated errors against finite differences of the whole computation, against drawn errors, and against Selvik's formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exposures import disturbed, expose, exposure, film_from_plane, objects_of, with_sd

from rsa_vision.cages import Cage, load_cage
from rsa_vision.flags import MarkerFlag
from rsa_vision.geometry.error_formulas import model_sd
from rsa_vision.geometry.focus import rays_of, tip_shift
from rsa_vision.geometry.rays import cross
from rsa_vision.settings import Limits
from rsa_vision.types import ImagePoints, Reconstruction
from rsa_vision.xray import reconstruct

WIDE = Limits(fiducial_um=1e6, line_mm=1e6)  # no gross-error rule: it would cut the tails of drawn errors
LINEAR = 2e-4  # relative, at exact points
WITH_RESIDUALS = 0.02  # relative: the second-order terms that are left out, at residuals of 0.1 mm


def outputs(found: Reconstruction) -> np.ndarray:
    foci = [np.concatenate([focus.position_mm for focus in found.foci])]
    return np.concatenate([found.markers.position_mm.ravel(), found.controls.position_mm.ravel(), *foci])


def stated(found: Reconstruction) -> np.ndarray:
    blocks = [*found.markers.covariance_mm2, *found.controls.covariance_mm2, *(focus.covariance_mm2 for focus in found.foci)]
    return np.array(blocks)


def by_differences(points: ImagePoints, cage: Cage, step_px: float = 1e-3) -> np.ndarray:
    columns = []
    for row in range(len(points)):
        for axis in range(2):
            both = []
            for sign in (1, -1):
                position = points.position_px.copy()
                position[row, axis] += sign * step_px
                both.append(outputs(reconstruct(replace(points, position_px=position), cage, WIDE)))
            columns.append((both[0] - both[1]) / (2 * step_px))
    return np.array(columns).T  # (outputs, coordinates)


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
@pytest.mark.parametrize(("noise_px", "tolerance"), [(0.0, LINEAR), (0.4, WITH_RESIDUALS)])
def test_covariance_is_that_of_the_differences(name: str, noise_px: float, tolerance: float) -> None:
    rng = np.random.default_rng(21)
    cage, _, _, points = exposure(name, rng)
    points = points.rows((points.role != "object") | np.isin(points.number, ["bone/1", "bone/10", "bone/13"]))
    root = rng.normal(0, 1, (len(points), 2, 2))
    points = replace(disturbed(points, noise_px, rng), covariance_px2=root @ root.swapaxes(1, 2) + 0.2 * np.eye(2))
    found = reconstruct(points, cage, WIDE)
    assert all(focus.fiducial_birge == focus.control_birge == 1 for focus in found.foci)
    jacobian = by_differences(points, cage).reshape(-1, 3, len(points), 2)
    expected = np.einsum("aikp,kpq,ajkq->aij", jacobian, points.covariance_px2, jacobian)
    scale = np.sqrt(np.einsum("aii,ajj->aij", expected, expected))
    assert np.abs((stated(found) - expected) / scale).max() < tolerance


DRAWS = 200
# 13 markers share two foci, so that 200 draws hold some hundred independent ones; 1 % of the draws are inflated by chance
BAND = (0.88, 1.12)


@pytest.mark.parametrize(("name", "sd_px"), [("1A", 0.01), ("1A", 0.1), ("1A", 1.0), ("1B", 0.1), ("2", 0.1)])
def test_drawn_errors_are_as_large_as_stated(name: str, sd_px: float) -> None:
    rng = np.random.default_rng(22)
    cage, foci, objects, points = exposure(name, rng)
    sd = sd_px * rng.uniform(0.5, 2, len(points))  # unequal errors
    points = with_sd(points, sd)
    markers, focus_errors, crossing = [], [], []
    for _ in range(DRAWS):
        found = reconstruct(disturbed(points, sd, rng), cage, WIDE)
        error = found.markers.position_mm - objects
        markers.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error) / 3)
        crossing.append((found.markers.crossing_um / found.markers.crossing_sd_um) ** 2)
        for focus in found.foci:
            error = focus.position_mm - foci[focus.focus]
            focus_errors.append(error @ np.linalg.solve(focus.covariance_mm2, error) / 3)
    for ratio in (np.sqrt(np.mean(markers)), np.sqrt(np.mean(focus_errors)), np.sqrt(np.mean(crossing))):
        assert BAND[0] < ratio < BAND[1]
    within = np.mean(np.array(markers) * 3 < 7.8147)  # 95 % of chi-squared with three degrees of freedom
    assert 0.92 < within < 0.98


@pytest.mark.parametrize("name", ["1A", "2"])
def test_errors_of_the_cage_are_carried_through(name: str) -> None:
    rng = np.random.default_rng(23)
    cage, foci, objects, points = exposure(name, rng)
    data = cage.model_dump()
    for mark in data["mark"]:
        mark["sd"] = (0.02, 0.015, 0.01)
    uncertain = Cage.model_validate(data)
    sd = np.array([mark.sd for mark in uncertain.mark])
    nominal = np.array([mark.xyz for mark in uncertain.mark])
    films = {focus: film_from_plane(rng) for focus in foci}
    markers, crossing, inflated = [], [], []
    for _ in range(DRAWS):
        points = with_sd(expose(uncertain, foci, objects, films, nominal + rng.normal(size=sd.shape) * sd), 0.02)
        found = reconstruct(disturbed(points, 0.02, rng), uncertain, WIDE)
        error = found.markers.position_mm - objects
        markers.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error) / 3)
        crossing.append((found.markers.crossing_um / found.markers.crossing_sd_um) ** 2)
        inflated += [focus.fiducial_birge > 1 or focus.control_birge > 1 for focus in found.foci]
    assert BAND[0] < np.sqrt(np.mean(markers)) < BAND[1]
    assert BAND[0] < np.sqrt(np.mean(crossing)) < BAND[1]
    assert np.mean(inflated) < 0.06
    points = with_sd(expose(cage, foci, objects, films), 0.02)
    with_cage, exact = (reconstruct(points, which, WIDE).markers.covariance_mm2 for which in (uncertain, cage))
    assert (np.einsum("nii->n", with_cage) > 1.5 * np.einsum("nii->n", exact)).all()


@pytest.mark.parametrize("name", ["1A", "2"])
def test_effect_of_every_cage_coordinate_against_differences(name: str) -> None:
    rng = np.random.default_rng(29)
    cage, foci, objects, _ = exposure(name, rng)
    data = cage.model_dump()
    for mark in data["mark"]:
        mark["sd"] = (1.0, 2.0, 3.0)
    cage = Cage.model_validate(data)
    nominal = np.array([mark.xyz for mark in cage.mark])
    films = {focus: film_from_plane(rng) for focus in foci}
    step = 1e-3

    def parameters(marks: np.ndarray) -> np.ndarray:
        found = reconstruct(with_sd(expose(cage, foci, objects, films, marks), 1.0), cage, WIDE)
        return np.array([np.append(focus.plane_from_film.ravel()[:8], focus.position_mm) for focus in found.foci])

    stated_effects = [focus.cage_effect for focus in reconstruct(with_sd(expose(cage, foci, objects, films), 1.0), cage, WIDE).foci]
    for column in range(nominal.size):
        change = np.zeros(nominal.size)
        change[column] = step
        shift = change.reshape(-1, 3)
        # the given coordinates are too large by `step` where the true mark lies that much lower
        numeric = (parameters(nominal - shift) - parameters(nominal + shift)) / (2 * step) * (1.0, 2.0, 3.0)[column % 3]
        for effect, expected in zip(stated_effects, numeric, strict=True):
            scale = np.abs(effect).max(axis=1)
            assert (np.abs(effect[:, column] - expected) / scale).max() < LINEAR


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
def test_missing_covariances_are_estimated(name: str) -> None:
    rng = np.random.default_rng(24)
    cage, _, objects, points = exposure(name, rng)
    sd_px, variances, ratios = 0.3, [], []
    for _ in range(DRAWS):
        found = reconstruct(disturbed(points, sd_px, rng), cage, WIDE)
        variances += [focus.image_sd_px**2 for focus in found.foci]
        error = found.markers.position_mm - objects
        ratios.append((error**2).sum() / np.einsum("nii->", found.markers.covariance_mm2))
        assert (found.markers.flags & MarkerFlag.NO_COVARIANCE).all()
    assert 0.95 < np.sqrt(np.mean(variances)) / sd_px < 1.05
    assert BAND[0] < np.sqrt(np.median(ratios) / 0.85) < 1.3  # few degrees of freedom: skewed


def test_four_fiducials_estimate_by_the_lines() -> None:
    rng = np.random.default_rng(25)
    cage, _, _, points = exposure("1A", rng)
    four = points.rows((points.role != "fiducial") | np.isin(points.number, ["1", "3", "7", "9"]))
    found = [reconstruct(disturbed(four, 0.3, rng), cage, WIDE) for _ in range(60)]
    estimate = np.sqrt(np.mean([focus.image_sd_px**2 for result in found for focus in result.foci]))
    assert 0.9 < estimate / 0.3 < 1.1
    assert all(focus.fiducial_birge == 1 for result in found for focus in result.foci)
    two = four.rows((four.role != "control") | np.isin(four.number, ["11", "19"]))
    assert np.isfinite(reconstruct(disturbed(two, 0.3, rng), cage, WIDE).markers.covariance_mm2).all()


def test_understated_errors_are_inflated() -> None:
    rng = np.random.default_rng(26)
    cage, _, objects, points = exposure("1A", rng)
    ratios, factors = [], []
    for _ in range(60):
        found = reconstruct(disturbed(with_sd(points, 0.05), 0.25, rng), cage, WIDE)
        error = found.markers.position_mm - objects
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error) / 3)
        factors += [focus.fiducial_birge for focus in found.foci]
    assert 4.5 < np.sqrt(np.mean(np.square(factors))) < 5.5
    assert np.sqrt(np.mean(ratios)) < 1.4
    # controls alone disagree with the cage: the focus is inflated, the images are not
    shifted = points.position_px.copy()
    shifted[points.role == "control"] += rng.normal(0, 3, ((points.role == "control").sum(), 2))
    found = reconstruct(with_sd(replace(points, position_px=shifted), 0.1), cage, WIDE)
    assert all(focus.fiducial_birge == 1 and focus.control_birge > 5 for focus in found.foci)
    for focus, agreeing in zip(found.foci, reconstruct(with_sd(points, 0.1), cage, WIDE).foci, strict=True):
        expected = np.diag(agreeing.covariance_mm2) * focus.control_birge**2
        np.testing.assert_allclose(np.diag(focus.covariance_mm2), expected, rtol=0.1)  # other residuals, another Jacobian


def test_selvik_formula_5_2() -> None:
    """Errors of the object's images alone, half-way between the foci; film coordinates are those of the plane."""
    cage = load_cage("1A")
    foci = {1: np.array([-240.0, 100, 1120]), 2: np.array([240.0, 100, 1120])}
    objects = np.array([[0.0, y, z] for y in (100, 150, 200) for z in (20, 100, 250)])
    points = expose(cage, foci, objects, {1: np.eye(3), 2: np.eye(3)})
    sx, sy = 0.011, 0.0046
    covariance = np.zeros((len(points), 2, 2))
    covariance[points.role == "object"] = np.diag([sx**2, sy**2])
    found = reconstruct(replace(points, covariance_px2=covariance), cage, WIDE)
    for (_, y, z), variance in zip(objects, found.markers.covariance_mm2, strict=True):
        expected = model_sd(sx, sy, c_mm=1120, b_mm=480, h_mm=1120 - z, y_mm=y - 100)
        np.testing.assert_allclose(np.sqrt(np.diag(variance)), expected, rtol=0.01)


def test_shift_of_the_control_plate() -> None:
    """(3:4) is the sum of the effects of all control points."""
    data = load_cage("1A").model_dump()
    for mark in data["mark"]:
        mark["sd"] = (1.0, 1.0, 1.0)
    cage = Cage.model_validate(data)
    rng = np.random.default_rng(27)
    foci = {k: np.array(v) for k, v in cage.foci.items()}
    points = with_sd(expose(cage, foci, objects_of(cage), {k: film_from_plane(rng) for k in foci}), 0.1)
    controls = [index for index, mark in enumerate(cage.mark) if mark.role == "control"]
    for focus in reconstruct(points, cage, WIDE).foci:
        effect = focus.cage_effect.reshape(11, -1, 3)[8:, controls, :2].sum(axis=1)
        np.testing.assert_allclose(effect, np.eye(3)[:, :2] * 1120 / 140, atol=1e-6)


def test_rays_of_unnamed_images_cross_within_their_sigma() -> None:
    rng = np.random.default_rng(28)
    cage, _, objects, points = exposure("1A", rng)
    ratios = []
    for _ in range(DRAWS):
        noisy = disturbed(with_sd(points, 0.2), 0.2, rng)
        found = reconstruct(noisy, cage, WIDE)
        bundles = []
        for focus in found.foci:
            rows = np.flatnonzero((noisy.focus == focus.focus) & (noisy.role == "object"))
            stated = replace(focus, image_factor=1.0)  # by which crossings are judged
            bundles.append(rays_of(noisy.position_px[rows], noisy.covariance_px2[rows], stated, cage, rows))
        position, crossing, sigma = cross(*bundles)
        diagonal = np.arange(len(objects))
        np.testing.assert_allclose(position[diagonal, diagonal], found.markers.position_mm, atol=1e-6)
        np.testing.assert_allclose(crossing[diagonal, diagonal] * 1000, found.markers.crossing_um, atol=1e-4)
        np.testing.assert_allclose(sigma[diagonal, diagonal] * 1000, found.markers.crossing_sd_um, rtol=1e-6)
        ratios.append((crossing / sigma)[diagonal, diagonal])
    assert BAND[0] < np.sqrt(np.mean(np.square(ratios))) < BAND[1]


def test_tips_that_are_all_seen_too_far_out_are_within_the_stated_error() -> None:
    rng = np.random.default_rng(31)
    cage, foci, objects, _ = exposure("1A", rng)
    nominal = np.array([mark.xyz for mark in cage.mark])
    tips = np.array([tip_shift(mark) for mark in cage.mark])
    assert np.allclose(tips, [0, -0.25, 0])  # stems along y, half widths of 0.25 mm
    films = {focus: film_from_plane(rng) for focus in foci}
    tip_error, stated, blind = 0.02, [], []
    for _ in range(DRAWS):
        points = with_sd(expose(cage, foci, objects, films, nominal + rng.normal(0, tip_error) * tips), 0.005)
        points = disturbed(points, 0.005, rng)
        for error, ratios in ((tip_error, stated), (0.0, blind)):
            found = reconstruct(points, cage, WIDE, error).markers
            off = found.position_mm - objects
            ratios.append(off[:, 1] ** 2 / found.covariance_mm2[:, 1, 1])
            assert (found.crossing_um < 5 * found.crossing_sd_um).all()  # nothing in the crossings tells
    assert BAND[0] < np.sqrt(np.mean(stated)) < BAND[1]
    assert np.sqrt(np.mean(blind)) > 3


def test_crossings_tell_of_errors_that_the_cage_does_not_show() -> None:
    rng = np.random.default_rng(31)
    cage, _, objects, points = exposure("1A", rng)
    ours = points.role == "object"
    ratios = []
    for _ in range(40):
        sd = np.where(ours, 0.2, 0.05)[:, None]
        shaken = replace(points, position_px=points.position_px + sd * rng.standard_normal(points.position_px.shape))
        found = reconstruct(with_sd(shaken, 0.05), cage, WIDE)
        assert all(focus.fiducial_birge < 2 for focus in found.foci)
        error = found.markers.position_mm - objects
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error) / 3)
        assert all(focus.image_factor > 1 for focus in found.foci)
    assert 0.8 < np.sqrt(np.mean(ratios)) < 1.3


def test_film_errors_that_no_detector_states_widen_the_markers() -> None:
    rng = np.random.default_rng(32)
    cage, _, objects, points = exposure("1B", rng)
    ratios = []
    for _ in range(60):
        shaken = replace(points, position_px=points.position_px + 0.1 * rng.standard_normal(points.position_px.shape))
        found = reconstruct(with_sd(shaken, 0.03), cage, WIDE)
        error = found.markers.position_mm - objects
        ratios.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.markers.covariance_mm2), error))
    assert np.sqrt(np.mean(ratios) / 3) < 1.3
    assert np.mean(np.sqrt(ratios) > 6) < 0.002
