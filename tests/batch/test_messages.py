"""What messages say of many things at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsa_vision.flags import REASONS
from rsa_vision.readings import FilmReading, Readings, _told, pins_left
from rsa_vision.types import MarkerImages


def test_many_images_without_a_partner_are_one_message() -> None:
    place = np.array([[10.2, 20.7], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    assert _told(place[:1]) == "an image at col 10, row 21 looks like a marker but has no partner"
    assert _told(place[:2]) == "2 images look like markers but have no partner: col 10, row 21; col 30, row 40"
    assert _told(place) == "4 images look like markers but have no partner: col 10, row 21; col 30, row 40; col 50, row 60; ..."


def test_clear_pins_that_are_no_cage_marks_are_told() -> None:
    """They were left without a word in examinations that were ok."""
    shape, flags = np.array(["ball", "pin", "pin", "pin", "tee"]), np.array([0, 0, 0, 16, 0])
    px, look = np.arange(10.0).reshape(5, 2), np.ones((4, 5))
    images = MarkerImages(px, np.tile(np.eye(2), (5, 1, 1)), shape, look[0], np.full(5, np.nan), *look[1:], flags)
    table = Readings.of([FilmReading(Path(f"f{focus}.tif"), focus, (99, 99), None, "auto", images) for focus in (1, 2)])
    every, one = np.ones(10, bool), np.arange(10) == 1
    [(code, told)] = pins_left(table, every)
    assert code in REASONS
    assert told.startswith("4 images of single pins (f1.tif, f2.tif)")
    assert pins_left(table, one) == []
