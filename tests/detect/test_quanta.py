"""Quanta that a screen spreads, seen through a logarithmic film with grain: errors of balls are as stated, in noise as stated none grow."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.quanta import shared_more

from .films import film_of_balls, grid_of_balls, stored


@pytest.mark.parametrize("spread_px", [0.8, 1.2])
def test_quanta_shared_by_neighbours_are_told(spread_px: float) -> None:
    """Error over stated error 1.55 and 1.93, up to 7.9, with no flag: on the film beside marks grain hides what neighbours share."""
    rng = np.random.default_rng(3)
    position, radius = grid_of_balls(rng, 8, 70.0, (5.5, 6.5))
    exposure = np.maximum(3000 * film_of_balls((640, 640), position, radius, background=1.0, depth=0.993), 5.0)
    z2 = []
    for _ in range(2):
        shared = gaussian_filter(rng.standard_normal(exposure.shape), spread_px)
        quanta = np.maximum(exposure + np.sqrt(exposure) * shared / shared.std(), 1.0)
        film = stored(1365 * (np.log10(quanta) - 0.8) + 0.7 * rng.standard_normal(exposure.shape), 12)
        images = detect_markers(film, bits=12).images
        assert len(images) == len(position)
        nearest = np.hypot(*(position[:, None] - images.position_px).transpose(2, 0, 1)).argmin(axis=1)
        error = position - images.position_px[nearest]
        z2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance_px2[nearest]), error))
    print(f"spread {spread_px} px: error / sd {np.sqrt(np.mean(z2) / 2):.2f}, largest {np.sqrt(np.max(z2)):.1f}")
    assert 0.75 < np.sqrt(np.mean(z2) / 2) < 1.3
    assert np.sqrt(np.max(z2)) < 5.0


@pytest.mark.parametrize(("times", "told"), [(1.0, 1.0), (2.5, 2.5)])
def test_chance_is_told_from_more(times: float, told: float) -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        of_size = rng.uniform(0.5, 2.0, 30)
        left, expected = times * of_size * rng.gamma(8.0, 1 / 8, 30), of_size * rng.gamma(8.0, 1 / 8, (2, 30))
        assert shared_more([(left[:8], expected[:, :8]), (left[8:], expected[:, 8:])]) == pytest.approx(told, rel=0.4 if told > 1 else 0)


def test_few_balls_tell_nothing() -> None:
    assert shared_more([]) == 1.0
    assert shared_more([(np.full(4, 9.0), np.ones((2, 4)))]) == 1.0
