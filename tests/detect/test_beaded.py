"""Pins with balls beside them and on them, in one beam: both are found, within their stated errors, and nothing besides."""

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.fits import BallFits, ball_image
from rsa_vision.detect.models.needles import NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.balls_beside import BallsBeside, lapped
from rsa_vision.detect.needles.fits import unfit
from rsa_vision.detect.neighbours.beside import images_beside
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float
from synthetic.chords import chord_pin

from .films import ball_fits
from .test_covered import CELLS, FINE, MU_PER_MM, PITCH_MM, SIDE, exposed, tips_of
from .test_laid_on import RADIUS_PX, light_past_balls

OPTICS = Optics(1.0, 0.5)


def light_past_pins(tips: Float, turns: Float) -> Float:
    """Light that comes past pointed pins of 0.5 x 2 mm, exact chords, those of pixels already averaged."""
    clear, half = np.ones((SIDE, SIDE)), 24
    line = PITCH_MM * ((np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5)
    for tip, turn in zip(tips, turns, strict=True):
        corner = np.rint(tip).astype(int) - half
        x, y = np.meshgrid(*(line + PITCH_MM * (first - at) for first, at in zip(corner, tip, strict=True)))
        way = np.array([np.cos(turn), -np.sin(turn), 0.0])
        chord = chord_pin(np.array([x, y, 0 * x]), np.array([0 * x, 0 * x, 0 * x + 1]), np.zeros(3), way, 2.0, 0.25)
        light = np.exp(-MU_PER_MM * chord).reshape(2 * half + 1, FINE, 2 * half + 1, FINE).mean((1, 3))
        clear[corner[1] : corner[1] + 2 * half + 1, corner[0] : corner[0] + 2 * half + 1] *= light
    return clear


@pytest.mark.parametrize("nearest", [4.0, 9.0])
def test_pins_with_balls(nearest: float) -> None:
    """Seven of sixteen, each with a ball at up to 6 px more than ``nearest`` from its tip, in any direction from there."""
    rng = np.random.default_rng(round(nearest))
    tips, turns = tips_of(rng), rng.uniform(0, 2 * np.pi, CELLS**2)
    beaded, away, aside = np.arange(1, CELLS**2, 2)[:7], nearest + np.arange(7.0), rng.uniform(0, 2 * np.pi, 7)
    balls = tips[beaded] + away[:, None] * np.stack([np.cos(aside), -np.sin(aside)], axis=1)
    found = detect_markers(exposed(light_past_pins(tips, turns) * light_past_balls(balls), rng), bits=16).images
    for shape, places in (("pin", tips), ("ball", balls)):
        of = found.rows(found.shape == shape)
        gap = np.hypot(*(of.position_px[:, None] - places).transpose(2, 0, 1))
        print(shape, len(of.shape), "of", len(places), "errors", gap.min(axis=0).round(3))
        assert sorted(gap.argmin(axis=1)) == list(range(len(places)))
        apart = of.position_px - places[gap.argmin(axis=1)]
        z2 = np.einsum("ni,ni->n", apart, np.linalg.solve(of.covariance_px2, apart[:, :, None])[:, :, 0])
        print("sd", np.sqrt(z2).round(1), of.flags)
        assert (z2 < 13.8).all()  # of chi2 with two degrees of freedom one in a thousand is more
        if shape == "pin":
            along = np.einsum("ni,ni->n", balls - tips[beaded], np.stack([np.cos(turns), -np.sin(turns)], axis=1)[beaded]).clip(0, 20)
            way = np.stack([np.cos(turns[beaded]), -np.sin(turns[beaded])], axis=1)
            on = np.hypot(*(balls - tips[beaded] - along[:, None] * way).T) < RADIUS_PX
            flagged = np.isin(np.arange(len(places)), gap.argmin(axis=1)[of.flags & MarkerFlag.OVERLAP > 0])
            assert flagged[beaded[on]].all()
            assert not np.delete(flagged, beaded).any()


def ball_at(col: float, row: float, depth: float = -1000.0) -> BallFits:
    return ball_fits(np.array([[col, row]]), 4.0, depth=np.array([depth]))


def test_what_lies_over_a_pin() -> None:
    """The image of a ball reaches a blur beyond its rim; the point of a pin is thin."""
    pin = unfit(np.array([50.0, 50.0]), np.array([0.0]), NeedleShape(2.5, 20.0))
    places = {(42.0, 50.0): False, (46.0, 50.0): True, (50.0, 56.0): False, (68.0, 57.0): True, (68.0, 59.0): False}
    assert {at: bool(lapped([pin], ball_at(*at), OPTICS)[0]) for at in places} == places
    beside = BallsBeside(lambda cols, _: np.zeros(cols.shape), ball_at(42.0, 50.0), OPTICS)
    assert beside.over(np.array([42.0, 46.0, 49.0]), np.full(3, 50.0)).tolist() == [True, True, False]


def test_images_are_seen_at_pixels_in_any_order() -> None:
    """Those of a window around a pin begin and end anywhere on its outline."""
    ball = ball_at(30.0, 30.0)
    cols, rows = np.array([20.0, 30.0, 20.0]), np.array([20.0, 30.0, 21.0])
    shown, _ = images_beside(ball, np.arange(0), OPTICS, None, cols, rows)
    assert shown[1] == -1000 * ball_image(np.zeros((1, 1)), np.zeros((1, 1)), np.array([4.0]), OPTICS)[0, 0]
