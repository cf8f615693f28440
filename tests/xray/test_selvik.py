"""Selvik's printed tests of X-RAY, GROWTH and KINEMA, through the whole chain: images with his errors, photogrammetry, kinematics.

Tables 7 and 9 (object coordinates), 13 and 14 (test rod), 17 and 18 (glass plate). A printed figure is compared with the simulated one by
the F distribution of its own number of repeats: none is tuned. Where print and simulation differ, the test says so, and the page on the
method by how much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from exposures import expose, film_from_plane
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import f as fisher

from rsa_vision.cages import Cage, load_cage
from rsa_vision.geometry.error_formulas import model_sd
from rsa_vision.kinematics.growth import Growth, compare_lengths
from rsa_vision.kinematics.kinema import motions
from rsa_vision.kinematics.series import MarkerTable, make_series
from rsa_vision.motion_tables import precision_table
from rsa_vision.settings import Limits, Motion
from rsa_vision.types import ImagePoints, Reconstruction
from rsa_vision.xray import reconstruct

Float = NDArray[np.float64]
Errors = dict[str, tuple[float, float]]  # of an image along x and y, um, by role

ALPHA = 0.01  # of each comparison
WIDE = Limits(fiducial_um=1e6, line_mm=1e6, e_rb_mm=1, condition_number=1000, stable_mm=1)  # nothing is left out
ROUNDING = 0.05  # of what is printed with one decimal

# cage 1A: pins lie along x, so that x is the worse; the pins of a tee lie along both
PIN: Errors = {"object": (11.0, 4.6)}
TEES: Errors = {"fiducial": (4.6, 4.6), "control": (4.6, 4.6)}
FOCI_1A = {1: np.array([-240.0, 100, 1110]), 2: np.array([240.0, 100, 1110])}  # c = 1120 with the plate 10 mm over the film
SETTING_UM = 5.0 / np.sqrt(5)  # the standard: the mean of five settings, one of which is known to less than 5 um
EXPANSION = 75e-6  # of Plexiglas, per degree

# cage 1B: c = 1210, b = 660; the lower plane of the test object is 980 mm below the foci
FOCI_1B = {1: np.array([-330.0, 200, 1202]), 2: np.array([330.0, 200, 1202])}
LOWER, UPPER = (26.1, 30.1), (23.9, 28.1)
Z_LOWER, Z_UPPER = 222.0, 302.0


def unlikely(printed: float, simulated: float, n_printed: int, n_simulated: int) -> float:
    """Return the two-sided probability of two estimates of one standard error, by their degrees of freedom."""
    below = float(fisher.cdf((printed / simulated) ** 2, n_printed, n_simulated))
    return 2 * min(below, 1 - below)


def rms(values: Float, axis: int | tuple[int, ...] | None = None) -> Float:
    return np.sqrt(np.mean(np.square(values), axis=axis))


class SetUp(NamedTuple):
    """A cage and the true images of one exposure."""

    cage: Cage
    foci: dict[int, Float]
    films: dict[int, Float]
    images: ImagePoints


def set_up(cage: Cage, foci: dict[int, Float], objects: Float, rng: np.random.Generator, marks: Float | None = None) -> SetUp:
    films = {focus: film_from_plane(rng) for focus in foci}
    return SetUp(cage, foci, films, expose(cage, foci, objects, films, marks))


def measured(true: SetUp, errors: Errors, rng: np.random.Generator, sag: Callable[[Float], Float] | None = None) -> Reconstruction:
    """Measure the images with errors, and reconstruct; `sag` is how far (mm) the film lies below its plane, by the place in it."""
    position = true.images.position_px.copy()
    for focus, film in true.films.items():
        rows = np.flatnonzero(true.images.focus == focus)
        sd = np.array([errors.get(role, (0.0, 0.0)) for role in true.images.role[rows]])
        shift = sd * rng.normal(size=sd.shape) / 1000
        if sag is not None:
            place = np.column_stack([position[rows], np.ones(len(rows))]) @ np.linalg.inv(film).T
            place = place[:, :2] / place[:, 2:]
            shift += sag(place)[:, None] * (place - true.foci[focus][:2]) / true.foci[focus][2]
        position[rows] += shift @ film[:2, :2].T
    return reconstruct(replace(true.images, position_px=position), true.cage, WIDE)


def row_of_marks(x: float, y: float, z: float) -> Float:
    return np.column_stack([np.full(11, x), y + 20.0 * np.arange(11), np.full(11, z)])


ROD = np.vstack([row_of_marks(x, 0, 5) for x in (-10, 10)])  # 15 mm over the film; its two sides
BARS = {z: np.vstack([row_of_marks(x, 100, z) for x in (-45, 45)]) for z in (Z_LOWER, Z_UPPER)}


@pytest.mark.parametrize(
    ("cage", "foci", "points", "errors", "heights", "printed"),
    [
        ("1A", FOCI_1A, ROD, PIN["object"], (1120, 480, 1105), (8.5, 3.7, 30.7)),
        ("1B", FOCI_1B, BARS[Z_LOWER], LOWER, (1210, 660, 980), (14.2, 17.0, 41.5)),
        ("1B", FOCI_1B, BARS[Z_UPPER], UPPER, (1210, 660, 900), (13.2, 16.0, 36.2)),
    ],
)
def test_double_settings_have_the_model_errors_of_tables_7_and_9(
    cage: str,
    foci: dict[int, Float],
    points: Float,
    errors: tuple[float, float],
    heights: tuple[float, float, float],
    printed: Sequence[float],
) -> None:
    rng = np.random.default_rng(7)
    true = set_up(load_cage(cage), foci, points, rng)
    twice = np.array([[measured(true, {"object": errors}, rng).markers.position_mm for _ in range(2)] for _ in range(40)])
    single = 1000 * rms(twice[:, 1] - twice[:, 0], (0, 1)) / np.sqrt(2)
    lengths = dict(zip(("c_mm", "b_mm", "h_mm"), heights, strict=True))
    away = points[:, 1] - foci[1][1]
    formula = rms(np.array([model_sd(*errors, **lengths, y_mm=y) for y in away]), 0)
    for axis in range(3):
        assert unlikely(printed[axis], single[axis], 22, 40 * 22) > ALPHA, (axis, single)
        # (5:2) places the point half-way between the foci and the errors in one plane: 2 %
        assert single[axis] == pytest.approx(formula[axis], rel=0.02 + 2.6 / np.sqrt(2 * 40 * 22)), (axis, single, formula)


def lengths_of(found: Reconstruction, rng: np.random.Generator, setting_um: float) -> list[Growth]:
    """Compare both sides of the test rod with its standard."""
    standard = ROD + np.array([0, setting_um / 1000, 0]) * rng.normal(size=ROD.shape)
    unknown = np.full((11, 3, 3), np.nan)
    return [compare_lengths(standard[side], found.markers.position_mm[side], unknown, unknown) for side in (slice(0, 11), slice(11, 22))]


def rods(errors: Errors, n: int, seed: int, warmer_c: float = 0.0, corrected: bool = False) -> tuple[Float, Float, Float]:
    """Return RMSV and s0, um, and scale, ppm, of n films with both sides of the rod, shape (n, 2), in a cage that has become warmer."""
    rng = np.random.default_rng(seed)
    cage = load_cage("1A")
    assert cage.calibrated_at_c is not None
    marks = np.array([mark.xyz for mark in cage.mark]) * (1 + EXPANSION * warmer_c)
    given = cage.at_temperature(cage.calibrated_at_c + warmer_c) if corrected else cage
    true = set_up(given, FOCI_1A, ROD, rng, marks)
    found = [lengths_of(measured(true, errors, rng), rng, SETTING_UM) for _ in range(n)]
    values = np.array([[(one.rmsv_um, one.s0_um, one.scale_ppm) for one in sides] for sides in found])
    return values[..., 0], values[..., 1], values[..., 2]


MEAN_SQUARE_LENGTH_MM2 = 8800.0  # of the 55 lengths of a rod
TABLE_13 = [[(7.5, 4.4), (14.9, 4.4)], [(12.8, 9.0), (12.8, 4.6)]]  # RMSV and s0 of films, of sides
TABLE_14 = [(5.4, 4.1), (5.2, 3.9), (5.8, 4.2), (6.5, 3.6)]
# RMSV^2 / s0^2 = 9/5 + t^2/5, where t is the scale over its standard error with 9 degrees of freedom
NO_SCALE = (np.sqrt(1.8), np.sqrt(1.8 + 0.2 * fisher.isf(ALPHA, 1, 9)))


def shows_no_scale(rmsv: float, s0: float) -> bool:
    low, high = (rmsv - ROUNDING) / (s0 + ROUNDING), (rmsv + ROUNDING) / (s0 - ROUNDING)
    return bool(high >= NO_SCALE[0] and low <= NO_SCALE[1])


def test_the_rods_s0_is_that_of_his_images_and_of_the_standard_save_for_one_side_of_table_13() -> None:
    _, s0, _ = rods(PIN | TEES, 60, 13)
    chance = {printed: unlikely(printed[1], float(rms(s0)), 9, 9 * s0.size) for film in TABLE_13 for printed in film}
    assert {printed for printed, p in chance.items() if p < ALPHA} == {(12.8, 9.0)}
    assert chance[12.8, 9.0] < 1e-3  # a gross error, or a misprint: twice what the three others say


def test_two_calibrations_of_the_rod_differ_as_table_14_says() -> None:
    # no films: two means of five settings of less than 5 um; all four comparisons share the first, so each is judged by itself
    for _, s0 in TABLE_14:
        assert unlikely(s0, np.sqrt(2) * SETTING_UM, 9, 10**6) > ALPHA


def test_without_systematic_errors_rmsv_is_the_root_of_two_times_s0() -> None:
    rmsv, s0, _ = rods(PIN, 60, 14)
    assert rms(rmsv) / rms(s0) == pytest.approx(
        np.sqrt(2), rel=0.03
    )  # three standard errors: its square is 9/5 and a fifth of mean F(1, 9)
    assert (rmsv / s0).min() > 0.99 * NO_SCALE[0]  # errors across the rod, of 35 um on 20 mm, are in the shortest lengths to second order
    assert (rmsv / s0 > NO_SCALE[1]).sum() <= 5  # 120 rods, of which 1 in 100 is expected: probability 0.002
    assert all(shows_no_scale(*printed) for printed in TABLE_14)
    assert [[shows_no_scale(*side) for side in film] for film in TABLE_13] == [[True, False], [True, False]]


@pytest.mark.parametrize(("printed_rmsv", "warmer_c"), [(7.5, 0.6), (14.9, 1.92), (12.8, 1.6)])
def test_a_cage_warmer_than_calibrated_shortens_the_rod_until_its_temperature_is_told(printed_rmsv: float, warmer_c: float) -> None:
    rmsv, s0, scale = rods(PIN | TEES, 25, 15, warmer_c)
    # the temperatures are those that give the printed figures: what is tested is that expansion shows in full, and in nothing else
    assert unlikely(float(rms(s0)), float(rms(rods(PIN | TEES, 25, 16)[1])), 9 * 50, 9 * 50) > ALPHA
    error = scale.mean(axis=1).std(ddof=1) / np.sqrt(25)
    assert abs(scale.mean() + 1e6 * EXPANSION * warmer_c) < 2.6 * error
    assert rms(rmsv) == pytest.approx(np.sqrt(2 * rms(s0) ** 2 + (EXPANSION * 1000 * warmer_c) ** 2 * MEAN_SQUARE_LENGTH_MM2), rel=0.1)
    assert rmsv.min() < printed_rmsv < rmsv.max()
    again, _, scale = rods(PIN | TEES, 25, 15, warmer_c, corrected=True)
    assert abs(scale.mean()) < 2.6 * error
    assert rms(again) < 1.6 * rms(s0)


def test_fiducial_errors_of_the_printed_size_give_table_13_without_any_temperature() -> None:
    # of one film both sides are as warm, but the printed scales of its sides differ by 100 ppm: no temperature explains that
    scales = [[1e3 * np.sqrt(max(0.0, rmsv**2 - 2 * s0**2) / MEAN_SQUARE_LENGTH_MM2) for rmsv, s0 in film] for film in TABLE_13]
    between_sides = np.abs(np.diff(scales, axis=1))[:, 0]  # at least: a sign is not printed
    _, _, scale = rods(PIN | TEES, 60, 13)
    assert (between_sides > 2.6 * np.diff(scale, axis=1).std()).all()
    # nine marks have 18 coordinates, eight of which make the transformation: RMSE 27 and 21 um
    one = float(rms(np.array([27.0, 21.0]))) * np.sqrt(9 / 10)
    rmsv, _, _ = rods(PIN | {"fiducial": (one, one), "control": (one, one)}, 60, 17)
    low, high = np.quantile(rmsv, [ALPHA / 2, 1 - ALPHA / 2])
    assert all(low < side[0] < high for film in TABLE_13 for side in film)


SEGMENTS = ("1", "2", "3", "4")
PLATE = np.array([[-20.0, -30, 0], [20, -30, 0], [20, 30, 0], [-20, 30, 0], [0, 0, 0]])
PAIRS = (("2", "3"), ("1", "4"))  # 80 and 240 mm apart
PARAMETERS = ("rx_deg", "ry_deg", "rz_deg", "tx_mm", "ty_mm", "tz_mm")
TABLE_17 = {("2", "3"): (3.1, 2.9, 1.0, 10, 9, 41), ("1", "4"): (3.2, 5.3, 1.1, 29, 10, 107)}  # hundredths of a degree, um
TABLE_18 = {("2", "3"): (19, 4, 2, 69, 17, 196), ("1", "4"): (14, 6, 2, 157, 24, 435)}
SCALE = np.array([100.0] * 3 + [1000.0] * 3)
E_RB_UM = 24.0  # the mean of 32 fits
FIT_FREEDOM = 4  # of one e_rb^2, by Satterthwaite: 7 degrees of freedom in the plate, 2 across it with 8 times their variance
POSITIONS = (Rotation.identity(), *(Rotation.from_euler(axis, 180, degrees=True) for axis in "zyx"))  # A to D


def plates(poses: Sequence[Rotation], errors: Errors, n: int, seed: int, sag: Callable[[Float], Float] | None = None) -> MarkerTable:
    """Measure n times a glass plate with four segments of five markers, 80 mm apart along y, in poses about its middle."""
    rng = np.random.default_rng(seed)
    flat = np.vstack([PLATE + np.array([0, 80 * k - 120, 0]) for k in range(4)])
    exposures = [set_up(load_cage("1B"), FOCI_1B, pose.apply(flat) + np.array([0, 200, Z_LOWER]), rng) for pose in poses]
    names = ("1", "1b") if len(poses) == 2 else tuple(str(k) for k in range(len(poses)))
    rows, places = [], []
    for number in range(n):
        for exam, true in zip(names, exposures, strict=True):
            places.append(measured(true, errors, rng, sag).markers.position_mm)
            rows += [(f"{number}", exam, name, str(m + 1)) for name in SEGMENTS for m in range(5)]
    own = np.full((len(rows), 3, 3), np.nan)
    return MarkerTable(*np.array(rows).T, np.concatenate(places), own, np.zeros(len(rows), np.int64))


def of_all(errors: tuple[float, float]) -> Errors:
    return dict.fromkeys(("fiducial", "control", "object"), errors)


def mean_fit_um(table: MarkerTable) -> float:
    return float(1000 * np.mean(motions(make_series(table), Motion(), WIDE, lambda _: ((0, 1),))["e_rb_mm"].astype(float)))


def test_double_evaluations_have_the_standard_errors_of_table_17_with_images_twice_as_good_as_in_table_8() -> None:
    same = (POSITIONS[0], POSITIONS[0])
    n = 60
    table_8 = mean_fit_um(plates(same, of_all(LOWER), 20, 16))
    assert unlikely(E_RB_UM, table_8, 32 * FIT_FREEDOM, 80 * FIT_FREEDOM) < 1e-6
    better = E_RB_UM / table_8
    assert 0.45 < better < 0.6  # balls of tantalum instead of steel of half their size
    table = plates(same, of_all((better * LOWER[0], better * LOWER[1])), n, 17)
    # with the size of the image errors from e_rb alone, all twelve figures follow
    for (reference, segment), printed in TABLE_17.items():
        found = {row["parameter"]: row for row in precision_table(make_series(table), Motion(reference=reference), WIDE, None).to_dicts()
                 if (row["kind"], row["segment"], row["reference"]) == ("motion", segment, reference)}  # fmt: skip
        for name, value, factor in zip(PARAMETERS, printed, SCALE, strict=True):
            ours = found[name]["single"] * factor
            assert found[name]["n"] == n
            assert unlikely(value, ours, 8, n) > ALPHA, (reference, segment, name, ours, value)


def largest(table: MarkerTable, pair: tuple[str, str], n: int) -> Float:
    """Return the largest relative motions from position A to B, C and D, shape (n, 6), in the units of table 18."""
    found = motions(make_series(table), Motion(reference=pair[0]), WIDE, lambda _: ((0, 1), (0, 2), (0, 3)))
    at = (found["segment"] == pair[1]) & (found["reference"] == pair[0])
    values = np.stack([found[name][at].astype(float) for name in PARAMETERS], axis=1) * SCALE
    return np.abs(values).reshape(n, 3, 6).max(axis=1)


def test_a_plate_turned_by_180_degrees_has_no_relative_motion_on_exact_films() -> None:
    table = plates(POSITIONS, {}, 1, 18)
    turned = motions(make_series(table), Motion(reference="1"), WIDE, lambda _: ((0, 1), (0, 2), (0, 3)))
    assert np.allclose(turned["screw_angle_deg"][turned["reference"] == ""].astype(float), 180, rtol=0, atol=1e-6)
    assert max(largest(table, pair, 1).max() for pair in PAIRS) < 1e-3


def hanging(place_mm: Float) -> Float:
    """A film that hangs through by 0.4 mm along its length."""
    depth: Float = 0.4 * (1 - ((place_mm[:, 1] - 200) / 350) ** 2)
    return depth


def test_table_18_has_more_than_image_errors_and_a_film_that_hangs_through_gives_as_much() -> None:
    n = 100
    table = plates(POSITIONS, of_all((E_RB_UM / 46 * LOWER[0], E_RB_UM / 46 * LOWER[1])), n, 19)  # 46 um: e_rb with the errors of table 8
    limit = {pair: np.quantile(largest(table, pair, n), 1 - ALPHA, axis=0) for pair in PAIRS}
    beyond = {
        (pair, name)
        for pair in PAIRS
        for name, printed, most in zip(PARAMETERS, TABLE_18[pair], limit[pair], strict=True)
        if printed > most
    }
    assert beyond == {(pair, name) for pair in PAIRS for name in ("rx_deg", "tx_mm", "tz_mm")}
    # his own explanation; the depth is chosen. It reaches rx and tz between the ends, not between the middle segments, and gives no tx
    bent = largest(plates(POSITIONS, {}, 1, 20, hanging), ("1", "4"), 1)[0]
    assert bent[0] > TABLE_18["1", "4"][0]
    assert bent[5] > TABLE_18["1", "4"][5]
    assert bent[[1, 2, 3, 4]].max() < 1
    # and neither fiducial marks nor control points nor parallaxes tell of it
    rng = np.random.default_rng(21)
    found = measured(set_up(load_cage("1B"), FOCI_1B, BARS[Z_LOWER], rng), {}, rng, hanging)
    assert max(focus.fiducial_max_um for focus in found.foci) < 1
    assert max(focus.line_max_um for focus in found.foci) < 10
    assert np.abs(found.markers.parallax_um).max() < 1
