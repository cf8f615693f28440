"""Selvik's formulas (5:1), (5:2), (5:4), (5:5), (3:4), (3:5), his tables 7, 9, 11, 12, and the full geometry against them."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.geometry.error_formulas import base_effect, common_shift_effect, model_error, model_sd, plate_effect
from rsa_vision.geometry.rays import intersect_lines
from rsa_vision.geometry.resection import locate_focus

PRINTED = 0.55  # tables without decimals: half a unit, and a little for his rounding of the input
TENTH = 0.06  # tables with one decimal
TABLE_7_Z = 35.3  # printed 35.2; the formula gives 35.3


@pytest.mark.parametrize(
    ("set_up", "image", "expected"),
    [
        ({"c_mm": 1120, "b_mm": 480, "h_mm": 1105}, (11.0, 4.6), (7.7, 3.2, TABLE_7_Z)),
        ({"c_mm": 1210, "b_mm": 660, "h_mm": 980}, (26.1, 30.1), (15.0, 17.2, 44.4)),
        ({"c_mm": 1210, "b_mm": 660, "h_mm": 900}, (23.9, 28.1), (12.6, 14.8, 34.3)),
    ],
)
def test_tables_7_and_9(set_up: dict[str, float], image: tuple[float, float], expected: tuple[float, ...]) -> None:
    np.testing.assert_allclose(model_sd(*image, **set_up), expected, atol=TENTH)


def test_end_of_the_rod() -> None:
    # comment on table 7: 4.5 um at y = 100 mm
    assert model_sd(11.0, 4.6, c_mm=1120, b_mm=480, h_mm=1105, y_mm=100)[1] == pytest.approx(4.5, abs=TENTH)


HEIGHT = 80.0  # between the planes of the test object


@pytest.mark.parametrize(("z_focus", "focus_sd", "expected"), [(1120, (116, 22, 620), (8, 1.6, 44)), (1000, (98, 49, 218), (8, 4, 17))])
def test_table_11(z_focus: float, focus_sd: tuple[float, ...], expected: tuple[float, ...]) -> None:
    found = common_shift_effect(np.array(focus_sd, float), z_focus_mm=z_focus, z_mm=HEIGHT)
    np.testing.assert_allclose(found, expected, atol=PRINTED)


@pytest.mark.parametrize(("z_focus", "base", "focus_sd_x", "expected"), [(1120, 480, 116, (8, 3.5, 36)), (1000, 660, 98, (8, 2.4, 22))])
def test_table_12(z_focus: float, base: float, focus_sd_x: float, expected: tuple[float, ...]) -> None:
    found = base_effect(2 * focus_sd_x, b_mm=base, z_focus_mm=z_focus, z_mm=HEIGHT, h_mm=z_focus - HEIGHT, y_mm=100)
    np.testing.assert_allclose(found, expected, atol=PRINTED)


C, B = 1120.0, 480.0
FOCI = np.array([[-B / 2, 100, C], [B / 2, 100, C]])
POINT = np.array([0.0, 160, 90])
SET_UP = {"c_mm": C, "b_mm": B, "h_mm": C - POINT[2], "y_mm": POINT[1] - 100}
SMALL = 1e-4
SECOND_ORDER = 0.01  # the crossing distance is least, not the y residual: rays are oblique to y by up to 60 mm in 1 m


def images(point: np.ndarray, foci: np.ndarray = FOCI) -> np.ndarray:
    away = point - foci
    return foci - away * (foci[:, 2] / away[:, 2])[:, None]


def test_formula_5_1_is_the_derivative_of_the_intersection() -> None:
    for shift, parallax, mean in ((np.array([[SMALL, 0, 0], [0, 0, 0]]), SMALL, 0.0), (np.tile([0, SMALL, 0], (2, 1)), 0.0, SMALL)):
        found = intersect_lines(FOCI, images(POINT) + shift - FOCI)[0] - POINT
        # plumb line coordinates: a larger parallax lifts the point, so dz and with it the term of y take the sign of the figure
        expected = model_error(parallax, mean, **SET_UP) * [1 if parallax else 0, -1 if parallax else 1, 1]
        np.testing.assert_allclose(found, expected, rtol=SECOND_ORDER, atol=SMALL * 1e-3)


def test_formulas_5_4_and_5_5_are_derivatives_of_the_intersection() -> None:
    shift = np.array([0.3, -0.2, 0.5]) * SMALL
    found = intersect_lines(FOCI + shift, images(POINT) - FOCI - shift)[0] - POINT
    np.testing.assert_allclose(found, common_shift_effect(shift, z_focus_mm=C, z_mm=POINT[2]), rtol=1e-4)
    wider = FOCI + np.array([[0, 0, 0], [SMALL, 0, 0]])
    found = intersect_lines(wider, images(POINT) - wider)[0] - POINT
    expected = base_effect(SMALL, b_mm=B, z_focus_mm=C, z_mm=POINT[2], h_mm=SET_UP["h_mm"], y_mm=SET_UP["y_mm"])
    np.testing.assert_allclose(np.abs(found), expected, rtol=SECOND_ORDER)


def test_formulas_3_4_and_3_5_are_exact() -> None:
    controls = np.array([(x, y, 140.0) for x in (-65, 0, 65) for y in (0, 100, 200)])
    shift = np.array([0.4, -0.3, 0])
    found = []
    for focus in FOCI:
        away = controls - focus
        through = focus - away * (focus[2] / away[:, 2])[:, None]
        found.append(locate_focus(through, controls + shift)[0])
    np.testing.assert_allclose(np.array(found) - FOCI, np.tile(plate_effect(shift, z_plate_mm=140, z_mm=C), (2, 1)), atol=1e-9)
    point, residuals = intersect_lines(np.array(found), images(POINT) - np.array(found))
    np.testing.assert_allclose(point - POINT, plate_effect(shift, z_plate_mm=140, z_mm=POINT[2]), atol=1e-9)
    np.testing.assert_allclose(residuals, 0, atol=1e-9)  # the rays still meet: only a test object shows this error
