"""Holes of plates, larger and clearer than the balls of a film, are no marks of the other polarity."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.neighbours.holes import are_holes
from rsa_vision.types import Float

from .films import film_of_balls, stored
from .test_balls import nearest

SIDE, RADIUS_PX = 620, 9.0
BALLS = np.array(
    [[60.0, 70.3], [540.2, 90.0], [120.6, 520.1], [420.4, 480.9], [560.0, 300.5], [70.1, 300.8], [330.7, 80.2], [250.3, 560.7]]
)
ALONG = np.array([0.26, 0.97])


def plated(film: Float, passes: float = 0.6) -> tuple[Float, Float]:
    """Lay a plate with seven holes over a film; return where these are, too."""
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    apart = np.stack([col, row], axis=2) - [300.0, 300.0]
    along, across = apart @ ALONG, apart @ [ALONG[1], -ALONG[0]]
    holes = np.array([300.0, 300.0]) + np.arange(-3, 4)[:, None] * 50.0 * ALONG
    plate = (np.abs(along) < 190) & (np.abs(across) < 20)
    for hole in holes:
        plate &= np.hypot(col - hole[0], row - hole[1]) > RADIUS_PX
    return film * gaussian_filter(np.where(plate, passes, 1.0), 1.0), holes


@pytest.mark.parametrize("balls", [BALLS, BALLS[:0]])
@pytest.mark.parametrize("bright", [False, True])
def test_balls_are_found_beside_a_plate_and_its_holes_are_none(balls: Float, bright: bool) -> None:
    rng = np.random.default_rng(2)
    light = film_of_balls((SIDE, SIDE), balls, np.full(len(balls), 2.7), background=1.0, depth=0.35)
    light, holes = plated(light)
    film = stored(30000 + 12000 * np.log(light) + 600 * rng.standard_normal(light.shape))
    found = detect_markers(65535 - film if bright else film, bits=16)
    images = found.images.rows(found.images.flags == 0)
    if len(balls):
        assert found.dark_markers != bright
        assert nearest(balls, found)[1].max() < 1.0
    if len(images):
        assert nearest(holes, found)[1].min() > RADIUS_PX
    assert len(images) <= len(balls)


def seen(places: Float, depth: float) -> BallFits:
    """Return as much of fits as is asked for."""
    some = SimpleNamespace(position_px=places, radius_px=np.full(len(places), RADIUS_PX), depth=np.full(len(places), depth))
    return cast(BallFits, some)


def test_balls_beside_the_edge_of_something_denser_are_no_holes() -> None:
    """As many as a plate has holes, of one size: one side of them only is as dark."""
    rng = np.random.default_rng(3)
    places = np.array([[300.0, 120.0], [300.0, 300.0], [300.0, 480.0]])
    light = film_of_balls((SIDE, SIDE), places, np.full(3, RADIUS_PX), background=1.0, depth=0.3)
    for gap in (1.2, 2.0, 3.0):
        beside = light.copy()
        beside[:, : round(300 - gap * RADIUS_PX)] *= 0.3
        assert not are_holes(beside + 0.01 * rng.standard_normal(light.shape), seen(places, -1.0), 1.0).any()


def test_a_plate_has_several_holes_and_a_small_field_may_have_one_ball() -> None:
    film, holes = plated(np.ones((SIDE, SIDE)))
    assert are_holes(film, seen(holes, 1.0), 1.0).all()
    assert not are_holes(film, seen(holes[:2], 1.0), 1.0).any()
