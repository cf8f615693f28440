"""The last decision on balls of which most are many times as high."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsa_vision.detect.balls.decide import are_balls
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.types import Float

from .films import ball_fits

WHITE = np.zeros((11, 11))
WHITE[5, 5] = 1.0


def clear_balls(depth: Float, background: Float) -> BallFits:
    n = len(depth)
    clear = {"explained": np.full(n, 0.985), "chi2_core": np.ones(n), "chi2_ring": np.ones(n)}
    seen = {"significance": 3 * depth, "valid_fraction": np.ones(n), "n_core": np.full(n, 30)}
    return ball_fits(np.zeros((n, 2)), np.full(n, 2.6), depth=depth, background=background, **clear, **seen)


def test_balls_at_the_end_of_a_film_curve_are_as_high_as_those_on_their_background() -> None:
    """On a film of 8 bits balls through a limb are a tenth as high as those beside it: a clear one was too faint for this."""
    noise = NoiseModel(np.array([0.0, 250.0]), np.full(2, 2.25), WHITE, -1.0, 256.0)
    depth = np.concatenate([np.full(12, 215.0), [29.0, 27.0, 25.0], [18.0, 18.0]])
    background = np.concatenate([np.full(12, 15.0), [206.0, 212.0, 216.0], [221.0, 15.0]])
    assert are_balls(clear_balls(depth, background), 6.0, 0.8, noise).tolist() == [True] * 16 + [False]


def test_those_that_stand_out_of_less_noise_tell_as_well() -> None:
    """Where few quanta come through: of balls in a shoulder the faintest, thirty standard deviations high, was lost."""
    noise = NoiseModel(np.array([0.0, 900.0, 3400.0, 4000.0]), np.array([64.0, 64.0, 5.76, 5.76]), WHITE, -1.0, 4096.0)
    depth = np.array([2976.0, 2943.0, 3020.0, 384.0, 321.0, 202.0, 174.0, 128.0, 115.0, 66.0, 66.0])
    background = np.array([884.0, 886.0, 980.0, 3493.0, 3545.0, 3791.0, 3799.0, 3877.0, 3885.0, 3945.0, 900.0])
    assert are_balls(clear_balls(depth, background), 6.0, 0.8, noise).tolist() == [True] * 10 + [False]


def test_a_letter_on_a_bright_rim_does_not_say_how_high_the_balls_behind_a_limb_are() -> None:
    """On a linear film: three balls that lap were the pattern, 25 times as high as ten behind the limb, of which three were lost."""
    noise = NoiseModel(np.array([0.0, 65535.0]), np.array([2500.0, 60000.0]), WHITE, -1.0, 65536.0)
    depth = np.concatenate([np.full(3, 48000.0), [2000.0, 1800.0, 1900.0, 1700.0, 1600.0, 1500.0, 1300.0, 1200.0, 800.0, 700.0]])
    background = np.concatenate([np.full(3, 60000.0), np.full(10, 4000.0)])
    letter, apart = np.array([[900.0, 1100.0], [905.0, 1100.0], [900.0, 1096.0]]), 60.0 * np.arange(1, 11)
    fits = replace(clear_balls(depth, background), significance=depth / 60.0)
    behind = replace(fits, position_px=np.concatenate([letter, np.column_stack([apart, apart])]))
    assert are_balls(behind, 6.0, 0.8, noise)[3:].all()
    three = replace(fits, position_px=np.concatenate([60.0 * letter, np.column_stack([apart, apart])]))
    assert are_balls(three, 6.0, 0.8, noise)[:3].all()
    assert not are_balls(three, 6.0, 0.8, noise)[-1]
