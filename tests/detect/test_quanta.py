"""Quanta that a screen spreads, seen through a logarithmic film with grain: errors of balls are as stated, in noise as stated none grow."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.quanta import Left, shared_more
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored

Rng = np.random.Generator


@pytest.mark.parametrize("spread_px", [0.8, 1.2])
def test_quanta_shared_by_neighbours_are_told(spread_px: float) -> None:
    """Error over stated error 1.55 and 1.93, up to 7.9, with no flag: on the film beside marks grain hides what neighbours share."""
    rng = np.random.default_rng(3)
    z2 = np.concatenate([_error(rng, 8, 1.2, partial(_logarithmic, spread_px=spread_px))[1] for _ in range(2)])
    print(f"spread {spread_px} px: error / sd {np.sqrt(np.mean(z2) / 2):.2f}, largest {np.sqrt(np.max(z2)):.1f}")
    assert 0.75 < np.sqrt(np.mean(z2) / 2) < 1.3
    assert np.sqrt(np.max(z2)) < 5.0


def test_few_balls_on_transmission_film() -> None:
    """Balls have six times the noise of what is beside them: it made specks on seven in nine, up to 8.7 stated errors off, unflagged."""
    rng = np.random.default_rng(2)
    error, z2 = (np.concatenate(of) for of in zip(*(_error(rng, 3, 1.4, _transmission) for _ in range(6)), strict=True))
    rms, ratio, largest = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(z2) / 2), np.sqrt(np.max(z2))
    print(f"RMS {rms:.3f} px, error / sd {ratio:.2f}, largest {largest:.1f}")
    assert rms < 0.14
    assert ratio < 1.75  # one of six films may have no more by chance
    assert largest < 6.0


def _error(rng: Rng, side: int, sigma_px: float, film: Callable[[Rng, Float], NDArray[np.uint16]]) -> tuple[Float, Float]:
    """Errors of so many by so many balls in px, shape (n, 2), and their squares over those stated, shape (n,)."""
    pixels = 70 * side + 80
    position, radius = grid_of_balls(rng, side, 70.0, (5.5, 6.5))
    light = film_of_balls((pixels, pixels), position, radius, sigma_px=sigma_px, background=1.0, depth=1.0)
    images = detect_markers(film(rng, light), bits=16).images
    assert len(images) == len(position)
    nearest = np.hypot(*(position[:, None] - images.position_px).transpose(2, 0, 1)).argmin(axis=1)
    error = position - images.position_px[nearest]
    return error, np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance_px2[nearest]), error))


def _quanta(rng: Rng, exposure: Float, spread_px: float) -> Float:
    shared = gaussian_filter(rng.standard_normal(exposure.shape), spread_px)
    return np.asarray(exposure + np.sqrt(exposure) * shared / shared.std())


def _logarithmic(rng: Rng, light: Float, spread_px: float) -> NDArray[np.uint16]:
    exposure = np.maximum(3000 * (0.993 * light + 0.007), 5.0)
    quanta = np.maximum(_quanta(rng, exposure, spread_px), 1.0)
    return stored(1365 * (np.log10(quanta) - 0.8) + 0.7 * rng.standard_normal(exposure.shape), 12)


def _transmission(rng: Rng, light: Float) -> NDArray[np.uint16]:
    exposure = np.maximum(_quanta(rng, 278 * (0.85 * light + 0.15), 1.2) / 278, 1e-3)
    through = 10 ** -(0.15 + 2.6 / (1 + 0.6 / exposure**2))
    return stored(3000 + 40000 * (through + 0.02 * rng.standard_normal(exposure.shape)), 16)


@pytest.mark.parametrize("times", [1.0, 2.5])
def test_chance_is_told_from_more(times: float) -> None:
    told = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        of_size = rng.uniform(0.5, 2.0, 30)
        found, *drawn = of_size * rng.gamma(8.0, 1 / 8, (5, 30)) * np.array([times, 1.0, 1.0, 3.0, 3.0])[:, None]
        expected, shared = np.array(drawn).reshape(2, 2, 30)
        plain = np.zeros(30, bool)
        left = [Left(found[of], expected[:, of], shared[:, of], plain[of]) for of in (slice(8), slice(8, None))]
        told.append(shared_more(left))
    print(f"{times}: told {np.mean(told):.3f}")
    assert np.mean(told) == pytest.approx((times - 1) / 3, rel=0.1, abs=0.02)


def test_few_balls_tell_nothing() -> None:
    assert shared_more([]) == 0.0
    assert shared_more([Left(np.full(3, 9.0), np.ones((2, 3)), np.ones((2, 3)), np.zeros(3, bool))]) == 0.0
