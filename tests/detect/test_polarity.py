"""Round things of the other polarity that outnumber the marks: bubbles are of any size, holes of a plate are not."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float

from .films import film_of_balls, stored
from .test_covered import SIDE as TEES_SIDE
from .test_covered import exposed, light_past_tees, tips_of

SIDE, RADIUS_PX, LEVEL, NOISE = 600, 4.0, 20000.0, 400.0


def apart(rng: np.random.Generator, n: int) -> Float:
    """Return places of which none is near another."""
    cells = np.stack(np.divmod(rng.permutation(64)[:n], 8), axis=1)
    return (cells + 0.5) * SIDE / 8 + rng.uniform(-15, 15, (n, 2))


def bubbles(places: Float, radius_px: Float, deep: float) -> Float:
    """By how much the light is more: as the chord through them goes, or, if ``deep`` is infinite, the same all over."""
    rows, cols = np.mgrid[0:SIDE, 0:SIDE].astype(float)
    more = np.zeros((SIDE, SIDE))
    for (col, row), radius in zip(places, radius_px, strict=True):
        chord = 2 * np.sqrt(np.maximum(radius**2 - (cols - col) ** 2 - (rows - row) ** 2, 0.0))
        more += np.minimum(np.where(chord > 0, deep, 0.0) * np.maximum(chord, 1e-9), 0.8)
    return gaussian_filter(more, 1.0)


@pytest.mark.parametrize("bright", [False, True])
def test_marks_of_one_size_among_more_bubbles_of_many(bright: bool) -> None:
    rng = np.random.default_rng(4)
    places = apart(rng, 36)
    balls = film_of_balls((SIDE, SIDE), places[:10], np.full(10, RADIUS_PX), background=LEVEL, depth=0.6)
    film = balls * (1 + bubbles(places[10:], rng.uniform(4.0, 8.0, 26), 0.03)) + rng.normal(0, NOISE, (SIDE, SIDE))
    found = detect_markers(stored(65535 - film if bright else film), bits=16).images
    gap = np.hypot(*(found.position_px[:, None] - places[:10]).transpose(2, 0, 1))
    assert sorted(gap.argmin(axis=1)) == list(range(10))
    assert gap.min(axis=0).max() < 0.3
    assert (found.flags == 0).all()


def test_holes_of_a_plate_among_marks_are_no_marks_without_a_flag() -> None:
    rng = np.random.default_rng(5)
    places = apart(rng, 60)
    balls = film_of_balls((SIDE, SIDE), places[:12], np.full(12, RADIUS_PX), background=LEVEL, depth=0.6)
    film = balls * (1 + bubbles(places[12:], np.full(48, 6.5), np.inf)) + rng.normal(0, NOISE, (SIDE, SIDE))
    found = detect_markers(stored(film), bits=16).images
    none = np.hypot(*(found.position_px[:, None] - places[:12]).transpose(2, 0, 1)).min(axis=1) > 2
    assert (found.flags[none] & MarkerFlag.UNLIKE).all()


def test_tees_among_many_more_bubbles() -> None:
    rng = np.random.default_rng(6)
    tips, places = tips_of(rng), rng.uniform(10, TEES_SIDE - 10, (2000, 2))
    places = places[np.hypot(*(places[:, None] - tips).transpose(2, 0, 1)).min(axis=1) > 40]
    places = places[[all(np.hypot(*(places[:k] - at).T) > 24) for k, at in enumerate(places)]]
    film = exposed(light_past_tees(tips, np.ones(len(tips))) * (1 + bubbles(places, rng.uniform(4.0, 8.0, len(places)), 0.05)), rng)
    found = detect_markers(film, bits=16).images
    assert found.shape.tolist() == ["tee"] * len(tips)
    assert np.hypot(*(found.position_px[:, None] - tips).transpose(2, 0, 1)).min(axis=0).max() < 0.3
