"""Correlated noise is made white, and balls in it are measured as well as the noise lets them be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.noise import LAGS, NoiseModel
from rsa_vision.detect.film.whitening import Filter, variance_left, whiten
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored

SIDE = 25


def _model(sigma_px: float, part: float) -> NoiseModel:
    lag = np.arange(-LAGS, LAGS + 1)
    square = lag[:, None] ** 2 + lag**2
    correlation = part * np.exp(-square / (4 * sigma_px**2)) + (1 - part) * (square == 0)
    return NoiseModel(np.zeros(1), np.ones(1), correlation, -np.inf, np.inf)


def _noise(sigma_px: float, part: float, shape: tuple[int, int, int], rng: np.random.Generator) -> Float:
    """Noise of variance one with just the correlation of the model."""
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape[1:])
    square = (rows[:, None] ** 2 + cols**2).astype(float)
    correlation = part * np.exp(-square / (4 * sigma_px**2)) + (1 - part) * (square == 0)
    power = np.maximum(np.fft.rfft2(correlation).real, 0.0)
    return np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * np.sqrt(power), s=shape[1:])


@pytest.mark.parametrize(("sigma_px", "part"), [(0.7, 0.5), (0.6, 1.0), (1.0, 1.0)])
def test_what_is_left_of_noise_made_white_is_foretold(sigma_px: float, part: float) -> None:
    white = whiten(_noise(sigma_px, part, (60, 64, 64), np.random.default_rng(1)), _model(sigma_px, part))[:, 8:-8, 8:-8]
    print(f"variance {white.var():.3f}, foretold {variance_left(_model(sigma_px, part)):.3f}")
    assert abs(np.log(white.var() / variance_left(_model(sigma_px, part)))) < 0.03


@settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 1.2), st.floats(0.3, 0.7), st.integers(0, 100))
def test_blurred_noise_comes_out_white(sigma_px: float, part: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    white = whiten(_noise(sigma_px, part, (60, 64, 64), rng), _model(sigma_px, part))[:, 8:-8, 8:-8]
    assert 0.9 < white.var() < 1.03  # less where the model's correlations, cut off, would have a frequency of too little power
    for lag in (1, 2, 3):
        assert abs((white[:, lag:] * white[:, :-lag]).mean()) < 0.05
        assert abs((white[:, lag:, lag:] * white[:, :-lag, :-lag]).mean()) < 0.05


@settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 2.0), st.floats(0.3, 1.0), st.integers(0, 100))
def test_the_filter_is_its_own_transpose(sigma_px: float, part: float, seed: int) -> None:
    one, two = np.random.default_rng(seed).standard_normal((2, 3, SIDE, SIDE))
    noise = _model(sigma_px, part)
    assert (whiten(one, noise) * two).sum() == pytest.approx((one * whiten(two, noise)).sum(), rel=1e-9, abs=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 2.0), st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0, 5, 17]), st.integers(0, 100))
def test_so_is_that_which_takes_out_what_is_slow(sigma_px: float, part: float, side_px: int, seed: int) -> None:
    one, two = np.random.default_rng(seed).standard_normal((2, 3, SIDE, SIDE + 4)).astype(np.float32)
    through = Filter(_model(sigma_px, part), side_px)
    assert (through(one) * two).sum() == pytest.approx((one * through(two)).sum(), rel=1e-3, abs=1e-3)
    alone = through(one[1:2])
    assert np.allclose(through(one)[1:2], alone, atol=1e-4)


def test_what_is_slow_is_taken_out() -> None:
    slow = np.add.outer(np.arange(60.0), np.arange(80.0)).astype(np.float32)[None]
    left = Filter(_model(1.0, 0.0), 17)(slow)[0, 8:-8, 8:-8]
    assert np.abs(left).max() < 1e-3 * slow.max()


def test_white_noise_is_left_alone() -> None:
    images = np.random.default_rng(1).standard_normal((2, 5, SIDE, SIDE))
    assert np.array_equal(whiten(images, _model(1.0, 0.0)), images)


def test_windows_of_a_batch_do_not_mix() -> None:
    images = np.random.default_rng(2).standard_normal((2, 3, SIDE, SIDE))
    noise = _model(1.0, 0.9)
    apart = np.array([[whiten(image[None], noise)[0] for image in row] for row in images])
    assert np.allclose(whiten(images, noise), apart, atol=1e-12)


@pytest.mark.parametrize(("blur_px", "part"), [(0.8, 0.8), (1.2, 0.95)])
def test_balls_in_correlated_noise_come_near_the_bound(blur_px: float, part: float) -> None:
    rng = np.random.default_rng(41)
    sigma_px, radius_px, sd = 1.1, 4.0, 700.0
    truth, radius = grid_of_balls(rng, 10, 60.0, (radius_px, radius_px))
    clear = film_of_balls((640, 640), truth, radius, sigma_px=sigma_px)
    found = detect_markers(stored(clear + sd * _noise(blur_px, part, (1, 640, 640), rng)[0]), bits=16).images
    gap = np.hypot(*(truth[:, None] - found.position_px[None]).transpose(2, 0, 1))
    assert (gap.min(axis=1) < 1).all()
    index = gap.argmin(axis=1)
    error, sds = found.position_px[index] - truth, np.sqrt(np.einsum("nii->ni", found.covariance_px2[index]))

    half, size = 14, 29

    def image(dx: float = 0.0, dy: float = 0.0, larger: float = 0.0) -> Float:
        return film_of_balls((size, size), np.array([[half + dx, half + dy]]), np.array([radius_px + larger]), sigma_px=sigma_px).ravel()

    steps = [(0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)]
    by = [(image(*step) - image(*(-s for s in step))) / 0.2 for step in steps]
    v, u = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j].reshape(2, -1)
    jac = np.stack([*by, image() - 30000.0, np.ones_like(u), u, v, u * u, u * v, v * v])
    place = np.stack(np.mgrid[:size, :size], -1).reshape(-1, 2)
    square = ((place[:, None] - place) ** 2).sum(-1)
    covariance = part * np.exp(-square / (4 * blur_px**2)) + (1 - part) * (square == 0)
    scale = np.linalg.norm(jac, axis=1)
    jac /= scale[:, None]
    best = np.linalg.inv(jac @ np.linalg.solve(covariance, jac.T))
    bound = sd * np.sqrt(best[0, 0]) / scale[0]
    weights_alone = np.linalg.pinv(jac.T)
    without = sd * np.sqrt((weights_alone @ covariance @ weights_alone.T)[0, 0]) / scale[0]

    rms, ratio = np.sqrt((error**2).mean()), np.sqrt(((error / sds) ** 2).mean())
    print(f"RMS {rms:.4f} px, bound {bound:.4f}, least squares {without:.4f}; error / sd {ratio:.2f}")
    assert rms < 1.15 * bound
    assert 0.85 < ratio < 1.15
