"""Balls at rims of implants, on linear films: they take away their part of what comes through beside the implant and behind it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers

from .films import ATTENUATION, FINE, stored

SIDE, RIM_PX, SIGMA_PX, RADIUS_PX = 620, 130.0, 1.3, 4.0


@pytest.mark.parametrize("density", [0.4, 0.8])
@pytest.mark.parametrize("from_rim", [-1.5, 0.0, 1.0])
def test_balls_at_rims_of_implants(density: float, from_rim: float) -> None:
    rng = np.random.default_rng(int(10 * density + 100 * (from_rim + 2)))
    turn = 2 * np.pi * (np.arange(12) + rng.uniform(-0.2, 0.2, 12)) / 12
    middle = SIDE / 2
    rim = middle + (RIM_PX + from_rim * RADIUS_PX) * np.column_stack([np.cos(turn), np.sin(turn)])
    far = np.array([(x, y) for x in range(40, SIDE, 60) for y in range(40, SIDE, 60) if np.hypot(x - middle, y - middle) > RIM_PX + 50])
    far = far + rng.uniform(-8, 8, far.shape)
    rows, cols = np.mgrid[0 : SIDE * FINE, 0 : SIDE * FINE].astype(np.float32) / FINE - 0.5 + 0.5 / FINE
    path = density * (np.hypot(cols - middle, rows - middle) < RIM_PX).astype(np.float32)
    for x, y in np.concatenate([rim, far]):
        near = np.s_[int((y - 6) * FINE) : int((y + 7) * FINE), int((x - 6) * FINE) : int((x + 7) * FINE)]
        chord = np.sqrt(np.maximum(RADIUS_PX**2 - (cols[near] - x) ** 2 - (rows[near] - y) ** 2, 0))
        path[near] += 0.6 * ATTENUATION * 2 * chord
    image = gaussian_filter(np.exp(-path), SIGMA_PX * FINE).reshape(SIDE, FINE, SIDE, FINE).mean(axis=(1, 3))
    film = 5000 + 40000 * image + 1200 * rng.standard_normal((SIDE, SIDE))
    found = detect_markers(stored(film), bits=16).images
    gap = np.hypot(*(rim[:, None] - found.position_px[None]).transpose(2, 0, 1))
    index = gap.argmin(axis=1)
    assert (gap.min(axis=1) < 2).all()
    error, covariance = found.position_px[index] - rim, found.covariance_px2[index]
    z = np.sqrt(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]) / 2)
    rms = np.sqrt((error**2).mean())
    print(f"RMS {rms:.3f} px, error / sd {np.sqrt((z**2).mean()):.2f}, largest {z.max():.1f}")
    assert rms < 0.4  # behind the denser one little is left of a ball
    assert z.max() < 3.5
    everything = np.hypot(*(found.position_px[:, None] - np.concatenate([rim, far])).transpose(2, 0, 1)).min(axis=1)
    assert (everything < 2).all()
