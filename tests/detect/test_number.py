"""Three faint balls in a row over each other may be two: their errors say so."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.marks.resolve import doubt_of_number

from .films import ball_fits


def balls(cols: list[float], significance: list[float]) -> BallFits:
    """Return balls of radius 4 px in a row."""
    return ball_fits(np.column_stack([cols, np.zeros(len(cols))]), 4.0, significance=np.array(significance))


@pytest.mark.parametrize(
    ("cols", "significance", "doubted"),
    [
        ([0.0, 5.0, 10.0], [20.0, 7.0, 15.0], True),
        ([0.0, 5.0, 10.0], [20.0, 30.0, 15.0], False),  # beyond doubt
        ([0.0, 5.0], [5.0, 5.0], False),  # a pair
        ([0.0, 9.0, 18.0], [5.0, 5.0, 5.0], False),  # beside each other
        ([], [], False),
    ],
)
def test_rows_of_three(cols: list[float], significance: list[float], doubted: bool) -> None:
    variance = doubt_of_number(balls(cols, significance))
    assert variance.shape == (len(cols), 2, 2)
    assert (variance[:, 0, 0] == (6.25 if doubted else 0.0)).all()  # half of five pixels
    assert (variance[:, 1, 1] == 0).all()
