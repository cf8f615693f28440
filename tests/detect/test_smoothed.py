"""Films whose noise was taken away where they are even, and not at the rims of marks, as by filters that keep edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers

from .films import film_of_balls, grid_of_balls, misses, stored

Film = NDArray[np.float32]


def bilateral(film: Film) -> Film:
    return np.asarray(cv2.bilateralFilter(film / 65535, 7, 0.04, 2.0) * 65535)


def median(film: Film) -> NDArray[Any]:
    return np.asarray(cv2.medianBlur(np.rint(film).astype(np.uint16), 5))


# noise goes with the slope after a median filter, not with the value: of 431 balls of 12 films 8 are beyond five, the largest 8.4
@pytest.mark.parametrize(("smoothed", "beyond"), [(bilateral, 0.0), (median, 0.05)])
def test_errors_are_those_by_the_noise_at_marks(smoothed: Callable[[Film], NDArray[Any]], beyond: float) -> None:
    """They were 4.7 and 1.9 times too small: what is left beside marks is far less, and smoother."""
    z: list[float] = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        balls, radii = grid_of_balls(rng, 6, 85.0, (4.0, 4.0))
        film = film_of_balls(
            (600, 600), balls, radii, depth=0.5, sigma_px=0.9, noise_sd=450.0, noise_blur_px=0.5, gradient=(0.3, 0.2), rng=rng
        )
        images = detect_markers(stored(smoothed(film.astype(np.float32))), bits=16).images
        away, sds = misses(images.rows(images.flags == 0), balls)
        z += sds[away < 1].tolist()
    print(f"{len(z)} balls, error / sd {np.sqrt(np.mean(np.square(z))):.2f}, largest {np.sqrt(2) * max(z):.1f}")
    assert len(z) > 0.95 * 3 * len(balls)
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.mean(np.array(z) > 5 / np.sqrt(2)) <= beyond
