"""Balls that are fitted together."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.neighbours.groups import fit_group

from .films import film_of_balls, grid_of_balls, stored


@pytest.mark.parametrize("seed", [23, 34])
def test_where_there_are_no_balls_none_goes_far(seed: int) -> None:
    rng = np.random.default_rng(seed)
    film = rng.normal(3000, 30, (80, 80))
    film[:, :36] = 4095  # saturated: of most of the window nothing is known
    film = stored(film, 12)
    start = np.array([[40.0, 40], [41, 41.5]]) + rng.uniform(-6, 6, 2)
    fits = fit_group(film, start, np.full(2, 3.1), Optics(1.2, 0.7), estimate_noise(film, 12))
    assert np.abs(fits.position_px - start).max() < 15  # 25 steps of half a pixel and a last one; windows go with what they hold


@pytest.mark.parametrize("n", [3, 4])
@pytest.mark.parametrize("apart", [0.95, 1.0])
def test_balls_in_a_row_that_touch_are_all_found(n: int, apart: float) -> None:
    """Each was fitted beside the one next to it while the third disturbed both: of sixty such rows thirty-two gave nothing."""
    rng = np.random.default_rng(12)
    single, _ = grid_of_balls(rng, 4, 110.0, (4.4, 4.4))
    film_side, rows = 700, []
    for k in range(4):
        way = rng.uniform(0, np.pi)
        step = 2 * 4.4 * apart * np.array([np.cos(way), np.sin(way)])
        rows.append(np.array([560.0 + rng.uniform(-5, 5), 90.0 + 150 * k]) + (np.arange(n) - (n - 1) / 2)[:, None] * step)
    truth = np.concatenate([single, *rows])
    film = film_of_balls((film_side, film_side), truth, np.full(len(truth), 4.4), depth=0.35, sigma_px=1.4, noise_sd=300.0, rng=rng)
    found = detect_markers(stored(film), bits=16).images
    assert len(found) == len(truth)
    index = np.hypot(*(truth[:, None] - found.position_px).transpose(2, 0, 1)).argmin(axis=1)
    error = found.position_px[index] - truth
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2[index], error[:, :, None])[:, :, 0]) / 2
    print(
        f"{n} at {apart}: RMS {np.sqrt((error**2).mean()):.3f} px, error / sd {np.sqrt(chi2.mean()):.2f}, largest {np.sqrt(chi2.max()):.1f}"
    )
    assert np.sqrt(chi2.max()) < 4.5


@pytest.mark.parametrize("noise_blur_px", [0.0, 1.2])
def test_small_balls_that_nearly_touch_are_not_lost(noise_blur_px: float) -> None:
    """Their peaks melt into one that no ball explains, as long as a short pin: six of sixteen such pairs had no row at all."""
    rng = np.random.default_rng(5)
    middles, _ = grid_of_balls(rng, 5, 90.0, (2.2, 2.2))
    single, pairs = middles[:9], middles[9:]
    way, apart = rng.uniform(0, np.pi, len(pairs)), 4.4 * np.linspace(1.05, 1.35, len(pairs))
    half = 0.5 * apart[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    truth = np.concatenate([single, pairs - half, pairs + half])
    film = film_of_balls(
        (500, 500), truth, np.full(len(truth), 2.2), depth=0.3, sigma_px=1.45, noise_sd=50.0, noise_blur_px=noise_blur_px, rng=rng
    )
    found = detect_markers(stored(film), bits=16).images
    apart_px = np.hypot(*(truth[:, None] - found.position_px).transpose(2, 0, 1))
    index = apart_px.argmin(axis=1)
    assert len(np.unique(index[apart_px.min(axis=1) < 1.0])) >= len(truth) - 1
    error = found.position_px[index] - truth
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2[index], error[:, :, None])[:, :, 0]) / 2
    assert np.sqrt(np.median(chi2)) < 1.5
