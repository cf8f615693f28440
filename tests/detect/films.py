"""Small films made with numpy alone: chords through balls summed on a fine grid, blurred, binned. Shares no code with the detection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.types import Float, MarkerImages

FINE = 5  # samples of a pixel along either axis
ATTENUATION = 0.6  # per pixel of chord


def film_of_balls(
    shape: tuple[int, int],
    position_px: NDArray[np.float64],
    radius_px: NDArray[np.float64],
    *,
    background: float = 30000.0,
    depth: float | NDArray[np.float64] = 0.6,
    sigma_px: float = 1.0,
    noise_sd: float = 0.0,
    noise_blur_px: float = 0.0,
    gradient: Sequence[float] = (0.0, 0.0),
    rng: np.random.Generator | None = None,
) -> NDArray[np.float64]:
    """Return the expected values plus noise, not yet rounded, shape (rows, cols)."""
    absorbed = np.zeros(shape)
    for centre, radius, part in zip(position_px, radius_px, np.broadcast_to(depth, len(radius_px)), strict=True):
        half = int(np.ceil(radius + 6 * sigma_px + 2))
        corner = np.rint(centre).astype(int) - half
        size = 2 * half + 1
        fine = (np.arange(size * FINE) + 0.5) / FINE - 0.5
        square = (fine[None, :] + corner[0] - centre[0]) ** 2 + (fine[:, None] + corner[1] - centre[1]) ** 2
        opacity = -np.expm1(-2 * ATTENUATION * np.sqrt(np.maximum(radius**2 - square, 0.0)))
        image = gaussian_filter(opacity, sigma_px * FINE, mode="constant").reshape(size, FINE, size, FINE).mean((1, 3))
        rows, cols = np.arange(size) + corner[1], np.arange(size) + corner[0]
        on_r, on_c = (rows >= 0) & (rows < shape[0]), (cols >= 0) & (cols < shape[1])
        absorbed[np.ix_(rows[on_r], cols[on_c])] += part * image[np.ix_(on_r, on_c)]
    row, col = np.mgrid[0 : shape[0], 0 : shape[1]]
    film = background * (1 + gradient[0] * col / shape[1] + gradient[1] * row / shape[0] - absorbed)
    if noise_sd and rng is not None:
        noise = rng.standard_normal(shape)
        if noise_blur_px:
            noise = gaussian_filter(noise, noise_blur_px, mode="wrap")
            noise /= noise.std()
        film = film + noise_sd * noise
    return film


def stored(film: NDArray[np.float64], bits: int = 16) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Round and clip to the values of a scanner."""
    values = np.clip(np.rint(film), 0, 2**bits - 1)
    return values.astype(np.uint8) if bits <= 8 else values.astype(np.uint16)


def grid_of_balls(
    rng: np.random.Generator, n: int, spacing_px: float, radius_px: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return n x n positions, (col, row), at random fractions of a pixel, and radii spread evenly over a range."""
    axis = spacing_px * (np.arange(n) + 0.75)
    position = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.uniform(-2, 2, (n * n, 2))
    return position, np.linspace(*radius_px, n * n)


def strip(
    shape: tuple[int, int], begin: NDArray[np.float64], end: NDArray[np.float64], width_px: float, sigma_px: float
) -> NDArray[np.float64]:
    """Return the image of a strip of depth one between two points (col, row), blurred, shape (rows, cols)."""
    out = np.zeros(shape)
    far = int(np.ceil(width_px + 6 * sigma_px))
    low = np.maximum(np.floor(np.minimum(begin, end)).astype(int) - far, 0)
    high = np.minimum(np.ceil(np.maximum(begin, end)).astype(int) + far + 1, np.array(shape[::-1]))
    cols, rows = ((np.arange((high[k] - low[k]) * FINE) + 0.5) / FINE - 0.5 + low[k] for k in (0, 1))
    length = float(np.hypot(*(end - begin)))
    c, r = (end - begin) / length
    u = (cols - begin[0]) * c + (rows[:, None] - begin[1]) * r
    v = (rows[:, None] - begin[1]) * c - (cols - begin[0]) * r
    inside = ((u > 0) & (u < length) & (np.abs(v) < width_px / 2)).reshape(high[1] - low[1], FINE, high[0] - low[0], FINE)
    out[low[1] : high[1], low[0] : high[0]] = gaussian_filter(inside.mean(axis=(1, 3)), sigma_px, mode="nearest")
    return out


def ball_fits(position_px: Float, radius_px: float | Float, **known: Float) -> BallFits:
    """Return fits of balls of which no more is known, zero otherwise."""
    n = len(position_px)
    nothing = {field.name: np.zeros(n) for field in fields(BallFits)} | {"covariance": np.zeros((n, 4, 4))}
    return BallFits(**{**nothing, "position_px": position_px, "radius_px": np.broadcast_to(radius_px, n), **known})


def misses(found: MarkerImages, balls: Float) -> tuple[Float, Float]:
    """Return distances of balls from the nearest images, in pixels and in units of what is stated."""
    gap = np.hypot(*(balls[:, None] - found.position_px[None]).transpose(2, 0, 1))
    index = gap.argmin(axis=1)
    error, covariance = found.position_px[index] - balls, found.covariance_px2[index]
    return gap.min(axis=1), np.sqrt(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]) / 2)
