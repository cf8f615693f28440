from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.homography import apply_homography, fit_homography, homography_jacobians, parameter_gain

GRID_MM = np.array([(x, y) for y in (0, 100, 200) for x in (-65, 0, 65)], float)
PLANE_FROM_FILM = np.array([[0.1, 0.01, -110.0], [0.008, -0.1, 230.0], [1e-5, -2e-5, 1.0]])
ROUNDING_MM = 1e-9
finite = st.floats(-1, 1)


def film_of(plane_mm: np.ndarray) -> np.ndarray:
    return apply_homography(np.linalg.inv(PLANE_FROM_FILM), plane_mm)


def noisy_film(sd_px: float = 0.5) -> np.ndarray:
    return film_of(GRID_MM) + np.random.default_rng(3).normal(0, sd_px, (9, 2))


def test_exact_marks_return_the_transformation() -> None:
    found = fit_homography(film_of(GRID_MM), GRID_MM)
    assert found[2, 2] == 1
    np.testing.assert_allclose(found, PLANE_FROM_FILM, rtol=1e-9, atol=1e-13)


def test_minimum_is_in_the_plane() -> None:
    film = noisy_film()

    def cost(parameters: np.ndarray) -> np.ndarray:
        return (apply_homography(np.append(parameters, 1).reshape(3, 3), film) - GRID_MM).ravel()

    found = fit_homography(film, GRID_MM)
    best = least_squares(cost, PLANE_FROM_FILM.ravel()[:8], x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    ours = (cost(found.ravel()[:8]) ** 2).sum()
    assert ours <= 2 * best.cost * (1 + 1e-10)
    _, design = homography_jacobians(found, film)
    gradient = design.reshape(-1, 8).T @ cost(found.ravel()[:8])
    assert np.abs(gradient / np.linalg.norm(design.reshape(-1, 8), axis=0)).max() < 1e-7


@settings(deadline=None)
@given(st.tuples(finite, finite, finite, finite), st.booleans(), st.tuples(finite, finite))
def test_affine_deformation_is_absorbed(change: tuple[float, ...], mirror: bool, shift: tuple[float, float]) -> None:
    affine = np.diag([-1.0 if mirror else 1.0, 1.0]) @ (np.eye(2) + 0.3 * np.array(change).reshape(2, 2))
    film, other = noisy_film(), np.array([[700.0, 900.0], [1500.0, 400.0]])
    deformed = [points @ affine.T + 1e3 * np.array(shift) for points in (film, other)]
    expected = apply_homography(fit_homography(film, GRID_MM), other)
    found = apply_homography(fit_homography(deformed[0], GRID_MM), deformed[1])
    np.testing.assert_allclose(found, expected, atol=1e-7)


def test_jacobians_against_differences() -> None:
    film, step = film_of(GRID_MM), 1e-3
    by_point, by_parameter = homography_jacobians(PLANE_FROM_FILM, film)
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        numeric = (apply_homography(PLANE_FROM_FILM, film + shift) - apply_homography(PLANE_FROM_FILM, film - shift)) / (2 * step)
        np.testing.assert_allclose(by_point[:, :, axis], numeric, atol=1e-9)
    for index in range(8):
        small = 1e-6 * max(abs(PLANE_FROM_FILM.ravel()[index]), 1e-3)
        change = np.zeros(9)
        change[index] = small
        plus, minus = (apply_homography(PLANE_FROM_FILM + sign * change.reshape(3, 3), film) for sign in (1, -1))
        np.testing.assert_allclose(by_parameter[:, :, index], (plus - minus) / (2 * small), rtol=1e-5, atol=1e-3)


def test_gain_against_refit() -> None:
    film = film_of(GRID_MM)
    _, by_parameter = homography_jacobians(PLANE_FROM_FILM, film)
    shift = np.random.default_rng(5).normal(0, 1e-4, (9, 2))
    change = (fit_homography(film, GRID_MM + shift) - PLANE_FROM_FILM).ravel()[:8]
    np.testing.assert_allclose(parameter_gain(by_parameter) @ shift.ravel(), change, rtol=1e-3)


@pytest.mark.parametrize(
    ("plane", "message"),
    [
        (GRID_MM[:3], "at least 4"),
        (GRID_MM[[0, 1, 2, 4]], "on one line"),
        (GRID_MM[[0, 4, 8]].repeat(2, axis=0)[:5], "coincide"),
        (np.vstack([GRID_MM[:8], [[np.nan, 0]]]), "not finite"),
    ],
)
def test_undetermined_is_said(plane: np.ndarray, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        fit_homography(film_of(plane), plane)


def test_four_marks_of_two_rows_are_enough() -> None:
    marks = GRID_MM[[0, 2, 6, 8]]
    np.testing.assert_allclose(fit_homography(film_of(marks), marks), PLANE_FROM_FILM, rtol=1e-8, atol=1e-12)


def test_marks_that_cannot_be_a_film_are_said() -> None:
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float) * 100
    with pytest.raises(GeometryError, match="wrong number"):
        fit_homography(square[[0, 2, 1, 3]], square)  # a crossed quadrangle: the horizon passes through it
