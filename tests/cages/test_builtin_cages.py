"""The built-in cages are those of the printed table (docs/cages.md)."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.cages import Cage, builtin_cages, load_cage
from rsa_vision.errors import CageError


def test_names() -> None:
    assert builtin_cages() == ("1A", "1B", "1B-420", "2")


def positions(cage: Cage, focus: int, role: str) -> dict[int, tuple[float, ...]]:
    return {mark.number: mark.xyz for mark in cage.marks_of(focus, role)}


def numbered(first: int, points: list[tuple[float, float, float]]) -> dict[int, tuple[float, ...]]:
    return {first + index: point for index, point in enumerate(points)}


@pytest.mark.parametrize("focus", [1, 2])
def test_1a(focus: int) -> None:
    cage = load_cage("1A")
    grid = [(x, y) for y in (0, 100, 200) for x in (-65, 0, 65)]
    assert positions(cage, focus, "fiducial") == numbered(1, [(x, y, 0) for x, y in grid])
    assert positions(cage, focus, "control") == numbered(11, [(x, y, 140) for x, y in grid])
    assert (cage.film, cage.material, cage.calibrated_at_c) == ("shared", "plexiglas", 23.5)
    assert cage.foci == {1: (-240, 100, 1120), 2: (240, 100, 1120)}
    for mark in cage.mark:
        assert (mark.shape, mark.diameter, mark.length) == ("tee", 0.5, 2.0)
        assert mark.arms == ((1, 0, 0), (-1, 0, 0), (0, 1, 0))
    assert cage.plane_of(focus).film_gap_mm == 10


@pytest.mark.parametrize(("name", "distal"), [("1B", 400), ("1B-420", 420)])
def test_1b(name: str, distal: float) -> None:
    cage = load_cage(name)
    row = (-135, -90, -45, 0, 45, 90, 135)
    controls = numbered(11, [(x, y, 150) for y in (30, 370) for x in row])
    for focus, sign in ((1, -1), (2, 1)):
        assert positions(cage, focus, "fiducial") == numbered(1, [(x, y, 0) for y in (0, distal) for x in (-100, -50, 0, 50, 100)])
        assert positions(cage, focus, "control") == {n: p for n, p in controls.items() if p[0] * sign >= 0}
    assert (cage.film, cage.material) == ("shared", "mirror glass")
    assert cage.foci == {1: (-330, 200, 1000), 2: (330, 200, 1000)}
    assert {(mark.shape, mark.diameter) for mark in cage.mark} == {("ball", 0.8)}
    assert cage.plane[0].film_gap_mm == 8
    assert cage.plane[0].film_size_mm == (400, 700)


def test_2() -> None:
    cage = load_cage("2")
    assert positions(cage, 1, "fiducial") == numbered(1, [(x, y, 0) for y in (0, 100, 200) for x in (-65, 0, 65)])
    assert positions(cage, 1, "control") == numbered(11, [(x, y, 250) for y in (40, 110, 180) for x in (-50, 0, 50)])
    assert positions(cage, 2, "fiducial") == numbered(1, [(125, y, z) for y in (0, 100, 200) for z in (60, 125, 190)])
    assert positions(cage, 2, "control") == numbered(11, [(-125, y, z) for y in (40, 110, 180) for z in (75, 125, 175)])
    assert (cage.film, cage.material) == ("separate", "plexiglas")
    assert cage.foci == {1: (0, 100, 1000), 2: (-875, 100, 125)}
    origin, basis = cage.plane_of(2).lab_from_plane()
    np.testing.assert_array_equal(origin, (125, 0, 0))
    np.testing.assert_array_equal(basis, ((0, 0, 1), (0, 1, 0)))
    np.testing.assert_array_equal(cage.plane_of(2).normal(), (-1, 0, 0))


@pytest.mark.parametrize(("name", "per_c"), [("1A", 75e-6), ("1B", 8e-6)])
def test_temperature(name: str, per_c: float) -> None:
    cage = load_cage(name)
    warm = cage.at_temperature(33.5)
    for mark, warmer in zip(cage.mark, warm.mark, strict=True):
        np.testing.assert_allclose(warmer.xyz, np.array(mark.xyz) * (1 + 10 * per_c), rtol=1e-15)
    assert warm.foci == cage.foci
    assert cage.at_temperature(None) is cage
    assert warm.at_temperature(33.5).mark == warm.mark
    assert warm.sha256 != cage.sha256


def test_plexiglas_grows_15_um_on_200_mm() -> None:
    """The example that the source gives."""
    cage = load_cage("1A").at_temperature(24.5)
    assert 1000 * (cage.marks_of(1, "fiducial")[-1].xyz[1] - 200) == pytest.approx(15)


def test_second_plane_moves_with_temperature() -> None:
    cage = load_cage("2").at_temperature(24.5)
    plane = cage.plane_of(2)
    assert plane.origin == pytest.approx((125 * (1 + 75e-6), 0, 0))
    assert all(mark.xyz[0] == plane.origin[0] for mark in cage.marks_of(2, "fiducial"))


def test_unknown_focus_and_cage() -> None:
    with pytest.raises(CageError, match="no focus 3"):
        load_cage("1A").plane_of(3)
    with pytest.raises(CageError, match="1A, 1B, 1B-420, 2"):
        load_cage("1C")
