"""Balls that are fitted together."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.detect.neighbours.groups import fit_group

from .films import stored


@pytest.mark.parametrize("seed", [23, 34])
def test_where_there_are_no_balls_none_goes_far(seed: int) -> None:
    rng = np.random.default_rng(seed)
    film = rng.normal(3000, 30, (80, 80))
    film[:, :36] = 4095  # saturated: of most of the window nothing is known
    film = stored(film, 12)
    start = np.array([[40.0, 40], [41, 41.5]]) + rng.uniform(-6, 6, 2)
    fits = fit_group(film, start, np.full(2, 3.1), 1.2, 0.7, estimate_noise(film, 12))
    assert np.abs(fits.position_px - start).max() < 15  # 25 steps of half a pixel and a last one; windows go with what they hold
