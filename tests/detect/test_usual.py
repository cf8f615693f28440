"""Sizes of balls beside edges, against those that are usual on the film."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.balls.usual import size_unlike
from rsa_vision.types import Float

from .films import ball_fits

ERROR_PX = 0.01


def of_radii(*radius_px: float) -> BallFits:
    n = len(radius_px)
    return ball_fits(np.zeros((n, 2)), np.array(radius_px), covariance=np.tile(ERROR_PX**2 * np.eye(4), (n, 1, 1)))


def differ_px(edged: BallFits, clear: BallFits) -> Float:
    return np.sqrt(size_unlike(edged, clear))


def test_balls_of_a_size_that_no_clear_ones_have_may_differ_by_magnification() -> None:
    """On a sharpened film all larger balls have an edge around them: 0.05 - 0.4 px were stated for errors of 0.006."""
    clear = of_radii(1.76, 1.79, 1.86, 1.91, 1.94)
    larger = of_radii(2.81, 2.85, 2.91, 2.94, 3.02, 3.06, 3.54, 3.60, 3.68, 3.71)
    assert differ_px(larger, clear).max() < 0.05


def test_one_that_a_corner_pulls_is_unlike_those_of_its_kind() -> None:
    clear = of_radii(*np.linspace(2.95, 3.05, 12))
    pulled = of_radii(2.99, 3.01, 3.02, 3.03, 3.3)
    assert (differ_px(pulled, clear)[:4] == 0).all()
    assert abs(differ_px(pulled, clear)[4] - 0.25) < 0.01


def test_few_clear_balls_tell_a_size_as_closely_as_magnification_lets_it_be_known() -> None:
    """Two of 1 mm without a clear one were stated 0.8 and 1 px off, for 0.03 and 0.05."""
    clear = of_radii(2.26, 3.47, 3.56, 3.61, 4.36)
    differ = differ_px(of_radii(4.25, 4.45, 4.8, 5.39, 5.55), clear)
    assert (differ[[0, 1, 3, 4]] == 0).all()
    assert abs(differ[2] - (0.44 - 0.04 * 4.8)) < 0.01


def test_one_of_a_size_of_its_own_is_unlike_all() -> None:
    assert abs(differ_px(of_radii(2.9, 2.95, 3.0, 3.05, 4.5), of_radii(1.8, 1.85, 1.9))[4] - (1.45 - 0.04 * 4.5)) < 0.01


def test_where_hardly_any_ball_is_clear_nothing_is_said() -> None:
    assert (differ_px(of_radii(3.0, 4.0), of_radii(2.0, 2.1)) == 0).all()
