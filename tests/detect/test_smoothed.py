"""Films whose noise was taken away where they are even, and not at the rims of marks, as by filters that keep edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers

from .films import film_of_balls, grid_of_balls, stored

Film = NDArray[np.float32]


def bilateral(film: Film) -> Film:
    return np.asarray(cv2.bilateralFilter(film / 65535, 7, 0.04, 2.0) * 65535)


def median(film: Film) -> NDArray[Any]:
    return np.asarray(cv2.medianBlur(np.rint(film).astype(np.uint16), 5))


@pytest.mark.parametrize("smoothed", [bilateral, median])
def test_errors_are_those_by_the_noise_at_marks(smoothed: Callable[[Film], NDArray[Any]]) -> None:
    """They were up to five times too small: what is left beside marks is far less, and smoother."""
    ratios, n = [], 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        balls, radii = grid_of_balls(rng, 6, 85.0, (4.0, 4.0))
        film = film_of_balls(
            (600, 600), balls, radii, depth=0.5, sigma_px=0.9, noise_sd=450.0, noise_blur_px=0.5, gradient=(0.3, 0.2), rng=rng
        )
        images = detect_markers(stored(smoothed(film.astype(np.float32))), bits=16).images
        nearest = np.hypot(*(images.position_px[:, None] - balls).transpose(2, 0, 1)).argmin(axis=1)
        error = images.position_px - balls[nearest]
        ours = (np.hypot(*error.T) < 1) & (images.flags == 0)
        n += np.count_nonzero(ours)
        ratios += np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance_px2), error)[ours].tolist()
    print(f"{n} balls, error / sd {np.sqrt(np.mean(ratios) / 2):.2f}, largest {np.sqrt(max(ratios)):.1f}")
    assert n > 0.95 * 3 * 36
    assert 0.7 < np.sqrt(np.mean(ratios) / 2) < 1.3
    assert max(ratios) < 5**2
