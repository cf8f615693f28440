"""What messages say of many things at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsa_vision.flags import REASONS
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.pairs import Pairing
from rsa_vision.readings import FilmReading, Readings, _told, pins_left
from rsa_vision.types import MarkerImages


def test_many_images_without_a_partner_are_one_message() -> None:
    place = np.array([[10.2, 20.7], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    assert _told(place[:1]) == "an image at col 10, row 21 looks like a marker but has no partner"
    assert _told(place[:2]) == "2 images look like markers but have no partner: col 10, row 21; col 30, row 40"
    assert _told(place) == "4 images look like markers but have no partner: col 10, row 21; col 30, row 40; col 50, row 60; ..."


def pins_seen(places_px: list[list[float]], paired: int) -> list[tuple[str, str]]:
    """What is told of two films with equal images, a ball and pins, the first ones of which are paired."""
    px = np.array([[5.0, 5.0], *places_px])
    n = len(px)
    shape, flags, look = np.array(["ball", *["pin"] * (n - 1)]), np.where(np.arange(n) == 3, 16, 0), np.ones((4, n))
    images = MarkerImages(px, np.tile(np.eye(2), (n, 1, 1)), shape, look[0], np.full(n, np.nan), *look[1:], flags)
    table = Readings.of([FilmReading(Path(f"f{focus}.tif"), focus, (99, 99), None, "auto", images) for focus in (1, 2)])
    rays = np.arange(2 * n)
    foci = np.array([[-240.0, 100.0, 1120.0], [240.0, 100.0, 1120.0]])
    through = np.column_stack([np.tile(px, (2, 1)), np.zeros(2 * n)])  # equal images meet on the film
    bundle = RayBundle(rays, 1 + rays // n, foci[rays // n], through, np.tile(1e-4 * np.eye(6), (2 * n, 1, 1)), np.zeros((2 * n, 6, 0)))
    groups, none = tuple((k, k + n) for k in range(paired + 1)), np.zeros(paired + 1)
    left = np.setdiff1d(rays, np.array(groups))
    return pins_left(table, Pairing(groups, none, none > 0, none, left, 0.0, ()), bundle, None)


def test_clear_pins_without_partners_are_told_where_no_pins_are_paired() -> None:
    """They were left without a word in examinations that were ok."""
    places = [[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]]
    [(code, told)] = pins_seen(places, 0)
    assert code in REASONS
    assert told.startswith("4 images of single pins (f1.tif, f2.tif) have no partner")
    assert pins_seen(places, 1) == []  # which of the others look like these is asked
    assert pins_seen([], 0) == []
