"""Films that were compressed in blocks of 8 x 8 pixels: noise is rounded away where it is quiet, and errors stand where marks are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers
from rsa_vision.detect.noise import block_variance

from .films import film_of_balls, grid_of_balls, stored


def compressed(film: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", film, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED), np.uint8)


@pytest.mark.parametrize("quality", [75, 85, 95])
def test_stated_errors_hold_and_no_ball_is_invented(quality: int) -> None:
    rng = np.random.default_rng(quality)
    truth, radius = grid_of_balls(rng, 8, 80.0, (3.5, 4.5))
    options = {"background": 190.0, "depth": 0.08, "sigma_px": 1.0, "noise_sd": 1.4, "noise_blur_px": 0.8, "gradient": (-0.4, 0.1)}
    raw = stored(film_of_balls((680, 680), truth, radius, rng=rng, **options), 8)  # type: ignore[arg-type]  # options of mixed types
    film = compressed(np.asarray(raw, np.uint8), quality)
    assert block_variance(raw) == 0.0
    assert 0.3 < block_variance(film) / np.square(film - raw.astype(float)).mean() < 3.0
    found = detect_markers(film, bits=8).images
    gap = np.hypot(*(truth[:, None] - found.position_px[None]).transpose(2, 0, 1))
    assert (gap.min(0) < 2.0).all(), "a ball was invented"
    near = (gap.min(1) < 2.0) & (found.flags[gap.argmin(1)] == 0)
    assert near.mean() > 0.8
    index = gap[near].argmin(1)
    error = found.position_px[index] - truth[near]
    square = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2[index], error[:, :, None])[:, :, 0])
    print(f"quality {quality}: {near.sum()} balls, error / sd {np.sqrt(square.mean() / 2):.2f}, largest {np.sqrt(square.max()):.1f}")
    assert square.mean() < 2 * 1.15**2
    assert square.max() < 4.0**2
