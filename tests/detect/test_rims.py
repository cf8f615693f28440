"""The ends, kinks and crossings of bars and wires are no balls; balls over them are."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.detect.neighbours.rims import cut_from_outlines
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored, strip

SIDE, SIGMA_PX = 700, 1.2
RADIUS_PX, DEPTH = 4.5, 0.35
CROSS = np.array([350.0, 350.0])


def film_with(strips: Float, depth: float, *, ball: bool) -> tuple[Float, Float]:
    """Return a film of balls with strips over the middle, and the centres of the balls."""
    rng = np.random.default_rng(31)
    truth, _ = grid_of_balls(rng, 4, 150.0, (RADIUS_PX, RADIUS_PX))
    truth = truth[np.hypot(*(truth - CROSS).T) > 100]
    truth = np.concatenate([truth, [CROSS + 0.3]]) if ball else truth
    film = film_of_balls((SIDE, SIDE), truth, np.full(len(truth), RADIUS_PX), depth=DEPTH, sigma_px=SIGMA_PX, noise_sd=150.0, rng=rng)
    return film * (1 - depth * strips), truth


def turned(degrees: float, length: float) -> Float:
    return CROSS + length * np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])


SHAPES = {
    "end of a bar": [(20.0, 9.0)],
    "kink": [(10.0, 6.0), (60.0, 6.0)],
    "crossing": [(0.0, 6.0), (70.0, 6.0), (180.0, 6.0), (250.0, 6.0)],
    "corner of a letter": [(5.0, 9.0), (95.0, 9.0)],
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("depth", [0.2, 0.5])
def test_what_goes_on_beyond_its_rim_is_no_ball(shape: str, depth: float) -> None:
    strips = np.clip(sum(strip((SIDE, SIDE), CROSS, turned(angle, 90.0), width, SIGMA_PX) for angle, width in SHAPES[shape]), 0.0, 1.0)
    film, truth = film_with(strips, depth, ball=False)
    found = detect_markers(stored(film), bits=16).images.position_px
    gap = np.hypot(*(found[:, None] - truth).transpose(2, 0, 1))
    assert (gap.min(axis=0) < 0.5).all()
    assert (gap.min(axis=1) < 2.0).all(), found[gap.min(axis=1) >= 2.0]


@pytest.mark.parametrize("shape", ["end of a bar", "kink", "crossing"])
def test_balls_over_wires_stay(shape: str) -> None:
    strips = np.clip(sum(strip((SIDE, SIDE), CROSS, turned(angle, 90.0), 5.0, SIGMA_PX) for angle, _ in SHAPES[shape]), 0.0, 1.0)
    film, truth = film_with(strips, 0.1, ball=True)
    found = detect_markers(stored(film), bits=16).images
    gap = np.hypot(*(found.position_px - truth[-1]).T)
    assert gap.min() < 1.0
    sd = float(np.sqrt(np.linalg.eigvalsh(found.covariance_px2[gap.argmin()])[-1]))
    assert gap.min() < 3 * sd


def test_where_nothing_stands_alone_and_some_go_on_all_are_pieces_of_outlines() -> None:
    touching, ends = np.ones(6, bool), np.array([True, True, False, False, False, False])
    assert cut_from_outlines(touching, ends).all()
    assert not cut_from_outlines(touching, np.zeros(6, bool)).any()  # crowds
    touching[5] = False
    assert not cut_from_outlines(touching, ends).any()
    assert cut_from_outlines(np.zeros(0, bool), np.zeros(0, bool)).shape == (0,)
