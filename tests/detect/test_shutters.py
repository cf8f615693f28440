"""Shutters: what lies behind them has values and a noise of its own, which says nothing of the noise under marks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, misses, stored


def density_behind_shutters(rng: np.random.Generator) -> tuple[np.ndarray, Float]:
    """Film of density, with toe and shoulder, of 36 balls in a field with shutters around; the noise is of quanta."""
    side = 800
    position, radius = grid_of_balls(rng, 6, 90.0, (2.8, 6.5))
    position += 90.0
    exposure = 0.8 * film_of_balls((side, side), position, radius, background=1.0, depth=0.9)
    slow = gaussian_filter(rng.standard_normal((side, side)), 120, mode="wrap")
    exposure *= np.exp(0.25 * slow / slow.std())
    field = np.full((side, side), 0.02)
    field[90:-90, 100:-80] = 1.0
    exposure *= gaussian_filter(field, 1.5)
    exposure = np.maximum(exposure + 0.08 * np.sqrt(exposure) * rng.standard_normal((side, side)), 1e-3)
    return stored(4095 * (0.08 + 0.84 / (1 + (0.35 / exposure) ** 2)), 12), position


@pytest.mark.parametrize("seed", [0, 1])
def test_no_ball_is_lost_in_the_field(seed: int) -> None:
    film, position = density_behind_shutters(np.random.default_rng(seed))
    found = detect_markers(film, bits=12).images
    gap = np.hypot(*(position[:, None] - found.position_px).transpose(2, 0, 1))
    nearest = gap.argmin(axis=1)
    nearby = zip(position - found.position_px[nearest], found.covariance_px2[nearest], strict=True)
    z2 = np.array([e @ np.linalg.solve(c, e) for e, c in nearby])
    there = gap.min(axis=1) < 1.5
    print(f"{np.count_nonzero(there)} of {len(there)}, error / sd {np.sqrt(z2[there].mean() / 2):.2f}")
    assert there.all()
    assert len(found) == len(position)


def test_values_beyond_a_gap_are_left_out() -> None:
    film, _ = density_behind_shutters(np.random.default_rng(0))
    noise = estimate_noise(film, 12)
    assert noise.level[0] < 400
    field = noise.before_gap(3000.0, -1.0, 2500.0)
    assert field.level[0] > 1500
    assert np.isin(field.level, noise.level).all()
    assert noise.before_gap(3000.0, -1.0, 1e4) is noise
    assert noise.before_gap(3000.0, 1.0, 2500.0) is noise


def limb(rng: np.random.Generator, n: int = 12) -> tuple[np.ndarray, np.ndarray, Float]:
    """Film of the logarithm of the exposure, a limb across it, and balls in that: values, the noise's standard deviation, places."""
    side = 1000
    cols = np.arange(side) + np.zeros((side, 1))
    deep = np.exp(-(((cols - side / 2) / 160.0) ** 4)) * (1.3 + 0.5 * np.exp(-(((cols - 520.0) / 40.0) ** 2)))
    position = np.column_stack([rng.uniform(400, 620, n), 60 + 880 / (n - 1) * np.arange(n)])
    balls = film_of_balls((side, side), position, np.full(n, 4.0), background=1.0, depth=0.5)
    exposure = np.exp(-deep) * balls
    sd = 25.0 / np.sqrt(exposure)
    return stored(4000 + 900 * np.log(exposure) + sd * rng.standard_normal((side, side)), 12), sd, position


def test_noise_where_a_limb_is_darkest() -> None:
    """The quietest tiles of the darkest class are the least dark: beyond them nothing was known of the noise, 0.7 of it."""
    film, sd, _ = limb(np.random.default_rng(3))
    values = np.quantile(film.astype(float), [0.02, 0.05, 0.2])
    told = np.sqrt(estimate_noise(film, 12).variance_at(values))
    true = [np.median(sd[np.abs(film - value) < 15]) for value in values]
    print(values.round(), (told / true).round(2))
    assert told == pytest.approx(true, rel=0.12)


def test_what_lies_beyond_a_gap_is_known_all_the_same() -> None:
    """Tees on bright film, balls in a limb: the limb is no shutter, and its noise that of the balls."""
    film, _ = density_behind_shutters(np.random.default_rng(0))
    noise = estimate_noise(film, 12)
    field = noise.before_gap(3000.0, -1.0, 2500.0)
    whole = field.and_beyond(800.0, -1.0, noise)
    assert whole.variance_at(noise.level[0]) == noise.variance_at(noise.level[0])
    assert whole.variance_at(np.array([801.0, field.level[0]])) == pytest.approx(field.variance[0])
    assert (np.diff(whole.level) > 0).all()
    assert field.and_beyond(5000.0, 1.0, noise) is field


def test_edges_of_a_round_collimator_are_no_noise() -> None:
    """Of tiles on its rim there were classes of their own: 40 times the variance of the film, and errors 25 times as large."""
    rng = np.random.default_rng(2)
    side = 500
    axis = 190.0 + 40.0 * np.arange(4)
    position = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.uniform(-2, 2, (16, 2))
    film = film_of_balls((side, side), position, np.full(16, 4.0), background=20000.0)
    rows, cols = np.mgrid[0:side, 0:side] - side / 2
    film *= gaussian_filter(np.where(np.hypot(rows, cols) < 165, 1.0, 0.02), 0.7)
    film += np.sqrt(8 * film) * rng.standard_normal(film.shape)
    noise = estimate_noise(stored(film), 16)
    assert noise.is_white
    assert 0.7 < noise.variance_at(np.array(20000.0)) / (8 * 20000.0) < 1.4
    found = detect_markers(stored(film), bits=16).images
    gap = np.hypot(*(position[:, None] - found.position_px).transpose(2, 0, 1)).min(axis=1)
    print(f"RMS {np.sqrt((gap**2).mean() / 2):.4f} px")
    assert np.sqrt((gap**2).mean() / 2) < 0.02


@pytest.mark.parametrize("blur_px", [0.0, 2.0])
def test_a_frame_of_one_value_has_no_say_in_the_noise(blur_px: float) -> None:
    """Of a value between those of the film: of 25 balls 8 and 9 were found, all of no form that so little noise allows."""
    rng = np.random.default_rng(4)
    balls, radii = grid_of_balls(rng, 5, 90.0, (3.5, 3.5))
    balls = balls + 90.0
    film = film_of_balls((660, 660), balls, radii, depth=0.4, noise_sd=450.0, noise_blur_px=0.6, gradient=(0.5, 0.4), rng=rng)
    frame = np.ones((660, 660))
    frame[60:600, 60:600] = 0.0
    frame = gaussian_filter(frame, blur_px) if blur_px else frame
    images = detect_markers(stored(frame * 40000 + (1 - frame) * film), bits=16).images
    assert len(images.flags) == len(balls)
    assert (images.flags == 0).all()
    away, z = misses(images, balls)
    print(f"error / sd {np.sqrt((z**2).mean()):.2f}, largest {np.sqrt(2) * z.max():.1f}")
    assert (away < 1).all()
    assert 0.7 < np.sqrt((z**2).mean()) < 1.3
    assert z.max() < 4 / np.sqrt(2)
