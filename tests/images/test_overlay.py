"""What a person sees on a drawing of marks: which may be none, what the colours mean, and all of it on films of any size."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from rsa_vision.flags import MarkerFlag
from rsa_vision.overlay import COLOUR, DOUBT, overlay_png
from rsa_vision.types import MarkerImages

PLACE = 0.3  # of the side, away from the legend


def drawn(side: int, flags: int = 0, *, marks: int = 1) -> Any:
    """Draw a film with a ball, or with none."""
    none, whole = np.full(marks, np.nan), np.ones(marks)
    images = MarkerImages(
        np.full((marks, 2), PLACE * side),
        np.zeros((marks, 2, 2)),
        np.full(marks, "ball"),
        3 * whole,
        none,
        whole,
        whole,
        whole,
        np.full(marks, flags),
    )
    return cv2.imdecode(np.frombuffer(overlay_png(np.full((side, side), 1000, np.uint16), images), np.uint8), cv2.IMREAD_COLOR)


def pixels(picture: Any, colour: tuple[int, int, int]) -> int:
    """Count pixels of a colour above the legend."""
    return int((picture[: picture.shape[0] // 2] == colour).all(axis=-1).sum())


@pytest.mark.parametrize("flag", [MarkerFlag.UNLIKE, MarkerFlag.POOR_FIT, MarkerFlag.CLIPPED])
def test_marks_that_may_be_none_have_broken_circles_of_another_colour(flag: MarkerFlag) -> None:
    sure, doubtful = drawn(1000, MarkerFlag.OVERLAP), drawn(1000, flag)
    assert pixels(sure, COLOUR["ball"]) > pixels(doubtful, DOUBT) > 0
    assert pixels(sure, DOUBT) == pixels(doubtful, COLOUR["ball"]) == 0


def test_the_legend_has_every_colour() -> None:
    picture = drawn(1000, marks=0)
    for colour in (*COLOUR.values(), DOUBT):
        assert (picture == colour).all(axis=-1).any()


def test_small_films_are_not_covered_by_the_legend() -> None:
    assert not np.ptp(drawn(200, marks=0), axis=-1).any()


def test_lines_of_large_films_are_seen_on_a_screen() -> None:
    reduced = cv2.resize(drawn(3200), (800, 800), interpolation=cv2.INTER_AREA)
    assert np.ptp(reduced[:400].astype(int), axis=-1).max() > 2 * 255 / 4  # a line of one pixel leaves a quarter
