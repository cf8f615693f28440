"""What speaks against a reconstruction."""

import numpy as np
import pytest

from rsa_vision.flags import MarkerFlag
from rsa_vision.settings import Limits
from rsa_vision.types import ImagePoints, Markers, Reconstruction
from rsa_vision.verdict import _judge_films, _judge_images, _judge_markers


def markers(parallax_um: np.ndarray, sd_um: np.ndarray) -> Markers:
    n = len(sd_um)
    where = np.arange(3.0 * n).reshape(n, 3)
    names = np.array([f"b/{k}" for k in range(n)])
    return Markers(names, where, np.tile(np.eye(3), (n, 1, 1)), np.abs(parallax_um), sd_um, parallax_um, np.full(n, 2), np.zeros(n, int))


@pytest.mark.parametrize(
    ("mean_um", "scatter_um", "sd_um", "bent"),
    [
        (335.0, 7.0, [400.0, 380, 300, 20, 350, 30], True),  # most markers are measured badly, or said to be
        (335.0, 7.0, [400.0] * 6, False),  # an error of the foci, that all have in common, may be as large
        (120.0, 300.0, [20.0] * 6, False),  # as far apart as they are, their mean is no surer
        (120.0, 7.0, [20.0] * 6, True),
        (80.0, 7.0, [20.0] * 6, False),  # below the limit
    ],
)
def test_a_common_parallax_is_excused_by_common_errors_alone(mean_um: float, scatter_um: float, sd_um: list[float], bent: bool) -> None:
    parallax = mean_um + scatter_um * np.array([-1.0, 1, -1, 1, -1, 1])
    codes = [code for code, _ in _judge_markers(markers(parallax, np.array(sd_um)), Limits(parallax_um=100.0))]
    assert ("film-bend" in codes) == bent


@pytest.mark.parametrize(("lapped", "used", "doubled"), [(5, 9, True), (4, 9, False), (5, 4, False), (0, 9, False), (0, 0, False)])
def test_control_points_that_mostly_overlap_others_are_reviewed(lapped: int, used: int, doubled: bool) -> None:
    """Of a double focal spot each control point may be two balls: one shift of all is another focus, and no residual shows it."""
    n = 10  # of which the first of each focus is a fiducial mark
    flags = np.where(np.arange(n) >= n - lapped, int(MarkerFlag.OVERLAP | MarkerFlag.UNLIKE), 0)
    points = ImagePoints(
        focus=np.repeat([1, 2], n),
        role=np.tile(["fiducial", *["control"] * (n - 1)], 2),
        number=np.arange(2 * n).astype(str),
        shape=np.full(2 * n, "ball"),
        position_px=np.zeros((2 * n, 2)),
        covariance_px2=np.tile(np.eye(2), (2 * n, 1, 1)),
        flags=np.append(flags, np.zeros(n, int)),
        film=np.repeat([0, 1], n),
    )
    taken = np.tile(np.arange(n) <= used, 2)
    nothing = markers(np.zeros(0), np.zeros(0))
    reconstruction = Reconstruction(points, np.zeros((2 * n, 3)), np.zeros(2 * n), taken, (), nothing, nothing)
    assert [code for code, _ in _judge_images(reconstruction, 1)] == ["control-doubled"] * doubled
    assert not _judge_images(reconstruction, 2)


@pytest.mark.parametrize(("what", "same"), [("scanned twice", True), ("flat object", False), ("deep object", False)])
def test_one_film_scanned_twice_is_told_from_films_of_two_foci(what: str, same: bool) -> None:
    rng = np.random.default_rng(1)
    marks, objects = rng.uniform(0, 2000, (18, 2)), rng.uniform(600, 1400, (6, 2))
    shift = {"scanned twice": np.zeros((24, 2)), "flat object": np.repeat([[50.0, 0], [0, 0]], [18, 6], axis=0)}
    second = np.concatenate([marks, objects]) + shift.get(what, rng.normal(0, 30, (24, 2)))
    turn = np.exp(0.02j)
    turned = (second @ [1, 1j]) * turn + (30 - 12j)
    px = np.concatenate([marks, objects, np.column_stack([turned.real, turned.imag])]) + rng.normal(0, 0.2, (48, 2))
    roles, numbers = np.repeat(["fiducial", "control", "object"], [9, 9, 6]), np.arange(24).astype(str)
    points = ImagePoints(
        focus=np.repeat([1, 2], 24),
        role=np.tile(roles, 2),
        number=np.concatenate([numbers, np.arange(100, 118).astype(str), numbers[18:]]),
        shape=np.full(48, "ball"),
        position_px=px,
        covariance_px2=np.tile(np.eye(2), (48, 1, 1)),
        flags=np.zeros(48, int),
        film=np.repeat([0, 1], 24),
    )
    assert [code for code, _ in _judge_films(points)] == ["film-duplicate"] * same
