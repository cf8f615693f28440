"""Balls of two and a half pixels on sharp films, told from faulty pixels and dust, which are no larger."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, misses, stored

SIDE, SMALL_PX, LARGE_PX = 360, 1.3, 2.2


def faults(rng: np.random.Generator, balls: Float) -> Float:
    """Thirty pixels, squares of four and crosses of five, none near a ball."""
    out = np.zeros((SIDE, SIDE))
    places = rng.uniform(20, SIDE - 20, (30, 2))
    places = places[np.hypot(*(balls[:, None] - places).transpose(2, 0, 1)).min(axis=0) > 12]
    for k, (col, row) in enumerate(places.astype(int)):
        for right, down in (((0, 0),), ((0, 0), (1, 0), (0, 1), (1, 1)), ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)))[k % 3]:
            out[row + down, col + right] = 1.0
    return out


@pytest.mark.parametrize("cnr", [15.0, 50.0, 150.0])
@pytest.mark.parametrize(("sigma_px", "sharpened"), [(0.6, 1.2), (0.45, 0.0)], ids=["sharpened", "sharp"])
def test_small_balls_are_no_faulty_pixels(sigma_px: float, sharpened: float, cnr: float) -> None:
    """Of twelve ten and more were lost beside larger ones, however clear they were."""
    rng = np.random.default_rng(2)
    truth, _ = grid_of_balls(rng, 6, 60.0, (1.0, 1.0))
    radius = np.where(np.arange(len(truth)) % 3 == 0, SMALL_PX, LARGE_PX)
    light = film_of_balls((SIDE, SIDE), truth, radius, background=1.0, depth=0.4, sigma_px=sigma_px)
    seen = np.log(light) + 0.4 / cnr / (1 + sharpened) * rng.standard_normal(light.shape)
    seen = seen + sharpened * (seen - gaussian_filter(seen, 1.25))
    images = detect_markers(stored(30000 + 16000 * seen - 6000 * faults(rng, truth)), bits=16).images
    away, z = misses(images, truth)
    ratio = np.sqrt(np.mean(z**2))
    print(f"{np.count_nonzero(away > 1)} of {len(truth)} lost, {len(images) - len(truth)} more, error / stated {ratio:.2f}")
    assert (away < 0.5).all()
    assert np.count_nonzero(images.flags == 0) <= len(truth)
    assert 0.6 < ratio < 1.3


@pytest.mark.parametrize("scattered", [0.0, 0.3])
@pytest.mark.parametrize("sigma_px", [1.3, 1.6])
def test_small_balls_on_logarithmic_plates_have_their_size(sigma_px: float, scattered: float) -> None:
    """As high in the middle as the logarithm makes them, they passed for specks of 1.2 px in a wider blur, whose place was not believed."""
    rng = np.random.default_rng(4)
    truth, _ = grid_of_balls(rng, 6, 60.0, (1.0, 1.0))
    light = film_of_balls(
        (SIDE, SIDE), truth, np.full(len(truth), LARGE_PX), background=1.0, depth=0.9 * (1 - scattered), sigma_px=sigma_px
    )
    film = 50000 + 12000 * np.log(light) + 80 * rng.standard_normal(light.shape)
    images = detect_markers(stored(film), bits=16).images
    away, z = misses(images, truth)
    ratio, size = np.sqrt(np.mean(z**2)), np.median(images.radius_px) / LARGE_PX
    print(f"error / stated {ratio:.2f}, radius / true {size:.2f}, {np.count_nonzero(images.flags)} flagged")
    assert (away < 0.5).all()
    assert not images.flags.any()
    assert 0.75 < size < 1.25
    assert 0.7 < ratio < 1.3
