"""The last decision on balls of which most are many times as high."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.decide import are_balls
from rsa_vision.detect.film.noise import NoiseModel

from .films import ball_fits

WHITE = np.zeros((11, 11))
WHITE[5, 5] = 1.0
NOISE = NoiseModel(np.array([0.0, 250.0]), np.full(2, 2.25), WHITE, -1.0, 256.0)


def test_balls_at_the_end_of_a_film_curve_are_as_high_as_those_on_their_background() -> None:
    """On a film of 8 bits balls through a limb are a tenth as high as those beside it: a clear one was too faint for this."""
    depth = np.concatenate([np.full(12, 215.0), [29.0, 27.0, 25.0], [18.0, 18.0]])
    background = np.concatenate([np.full(12, 15.0), [206.0, 212.0, 216.0], [221.0, 15.0]])
    n = len(depth)
    strong = {"explained": np.full(n, 0.985), "significance": 4 * depth / 1.5, "valid_fraction": np.ones(n), "n_core": np.full(n, 30)}
    fits = ball_fits(
        np.zeros((n, 2)), np.full(n, 2.6), depth=depth, background=background, chi2_core=np.ones(n), chi2_ring=np.ones(n), **strong
    )
    assert are_balls(fits, 6.0, 0.8, NOISE).tolist() == [True] * 16 + [False]
