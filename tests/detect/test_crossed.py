"""Scratches, dead pixels and dust over balls: what is left of the ball is measured, and its error stated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored

SIDE, SIGMA_PX, RADIUS_PX = 610, 1.4, 4.0
BACKGROUND, DEPTH, CNR = 30000.0, 0.45, 30.0
FILMS = 2
FAR, MOST_FAR = 4.0, 0.03


def scratch(at: Float, rng: np.random.Generator) -> Float:
    """Return a line through a ball, sharper than its image, from a third of its contrast to all of it, brighter or darker."""
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    angle, off = rng.uniform(0, np.pi), rng.uniform(-1.0, 1.0) * RADIUS_PX
    along = (col - at[0]) * np.cos(angle) + (row - at[1]) * np.sin(angle)
    across = (row - at[1]) * np.cos(angle) - (col - at[0]) * np.sin(angle) - off
    height = rng.choice([-1, 1]) * rng.uniform(0.3, 1.0) * DEPTH * BACKGROUND
    return np.where(np.abs(along) < 40, height * np.exp(-0.5 * (across / rng.uniform(0.3, 0.9)) ** 2), 0.0)


def dead_pixels(at: Float, rng: np.random.Generator) -> Float:
    """Return three pixels of a ball that are half the background off."""
    out = np.zeros((SIDE, SIDE))
    for col, row in np.rint(at + rng.uniform(-1.2, 1.2, (3, 2)) * RADIUS_PX).astype(int):
        out[row, col] = rng.choice([-1, 1]) * 0.5 * BACKGROUND
    return out


@pytest.mark.parametrize("fault", [scratch, dead_pixels], ids=["scratches", "dead pixels"])
def test_balls_under_faults_are_found_and_their_errors_stated(fault: Callable[[Float, np.random.Generator], Float]) -> None:
    found, ratios = 0, []
    count = 0
    for seed in range(FILMS):
        rng = np.random.default_rng(70 + seed)
        truth, radius = grid_of_balls(rng, 6, 90.0, (RADIUS_PX, RADIUS_PX))
        noise_sd = BACKGROUND * DEPTH / CNR
        film = film_of_balls((SIDE, SIDE), truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=SIGMA_PX, noise_sd=noise_sd, rng=rng)
        hit = truth[np.arange(len(truth)) % 3 > 0]
        film = film + sum(fault(at, rng) for at in hit)
        images = detect_markers(stored(film), bits=16).images
        gap = np.hypot(*(hit[:, None] - images.position_px[None]).transpose(2, 0, 1))
        index, near = gap.argmin(axis=1), gap.min(axis=1) < 2.0
        count, found = count + len(hit), found + int(near.sum())
        assert np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1)).min(axis=0).max() < 2.0  # none is false
        clear = near & ((images.flags[index] & MarkerFlag.POOR_FIT) == 0)
        error = images.position_px[index[clear]] - hit[clear]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[index[clear]], error[:, :, None])[:, :, 0])
        ratios += np.sqrt(square).tolist()
    far = float(np.mean(np.array(ratios) > FAR))
    print(f"{found} of {count}, {len(ratios)} not flagged, error / sd {np.sqrt(np.mean(np.square(ratios)) / 2):.2f}, {far:.1%} far")
    assert found >= 0.95 * count
    assert far <= MOST_FAR
