"""Films that were compressed with losses: no noise where they are even, blocks and waves around all that is on them."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.compression import noise_of_compression
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, misses, stored

REACH = 5
# ITU-T T.81 (1992), table K.1: steps of the lowest frequencies at quality 50
LOWEST = np.array([[16, 11, 10, 16], [12, 12, 14, 19], [14, 13, 16, 24], [14, 17, 22, 29]])


def compressed(film: Float, quality: int) -> NDArray[np.uint8]:
    """Return the film as it comes back from a JPEG file."""
    done, code = cv2.imencode(".jpg", stored(film, 8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)


def anatomy(rng: np.random.Generator, side: int, shadows: int) -> Float:
    """Shadows with soft and with sharp edges, about 1."""
    row, col = np.mgrid[0:side, 0:side]
    out = np.ones((side, side))
    for blur in (1.0, 3.0, 12.0):
        for _ in range(shadows):
            (x, y), (a, b) = rng.uniform(0, side, 2), rng.uniform(0.1, 0.3, 2) * side
            out *= 1 - 0.2 * gaussian_filter((((col - x) / a) ** 2 + ((row - y) / b) ** 2 < 1).astype(np.float64), blur)
    return out


@pytest.mark.parametrize("quality", [60, 75, 85])
def test_the_steps_and_what_they_leave_are_told_by_the_film(quality: int) -> None:
    rng = np.random.default_rng(quality)
    film = 128 + 60 * gaussian_filter(rng.standard_normal((640, 640)), 1.0)
    back = compressed(film, quality)
    lossy = noise_of_compression(back, REACH)
    assert lossy is not None
    steps = np.floor((LOWEST * (200 - 2 * quality) + 50) / 100)
    assert lossy.pattern == pytest.approx(steps.max() / 4, rel=0.03)
    error = back - film
    print(f"error {error.std():.2f}, said {np.sqrt(lossy.variance):.2f}, neighbours {lossy.correlation[REACH, REACH + 1]:.2f}")
    assert 0.7 < np.sqrt(lossy.variance) / error.std() < 1.05  # nothing tells of frequencies that all blocks have lost
    spectrum = np.fft.fft2(np.fft.ifftshift(np.pad(lossy.correlation, 8)))
    assert spectrum.real.min() > -1e-9  # no negative variance of anything


@pytest.mark.parametrize("noise_sd", [0.0, 0.1, 0.3, 0.6, 1.0])
def test_other_films_are_not_taken_for_compressed(noise_sd: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        film = 180 * anatomy(rng, 512, 4) + noise_sd * gaussian_filter(rng.standard_normal((512, 512)), 0.3 * seed)
        sharpened = film + 2 * (film - gaussian_filter(film, 2.0))
        resampled = cv2.resize(film[::2, ::2], None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
        coarse = 3 * np.rint(film / 3)
        for other in (film, sharpened, resampled, coarse):
            assert noise_of_compression(np.asarray(stored(np.asarray(other, np.float64), 8)), REACH) is None


def test_a_few_balls_are_found_and_nothing_else() -> None:
    """Waves and blocks around edges were marks by the dozen, of the wrong polarity on some films, and errors ten times those stated."""
    z: list[float] = []
    found = wrong = 0
    for quality, sign in product((60, 75, 90), (-1, 1)):
        rng = np.random.default_rng(quality)
        balls, radii = grid_of_balls(rng, 3, 180.0, (3.0, 3.4))
        film = film_of_balls((620, 620), balls, radii, background=1.0, depth=0.35, sigma_px=1.0, noise_sd=0.002, rng=rng)
        film *= anatomy(rng, 620, 1)
        film += film - gaussian_filter(film, 3.0)  # sharpened, as exported films are
        detection = detect_markers(compressed(150 * film if sign < 0 else 30 + 150 * (1 - film), quality), bits=8)
        assert detection.dark_markers == (sign < 0)
        clean = detection.images.rows(detection.images.flags == 0)
        away, sds = misses(clean, balls)
        found += int(np.count_nonzero(away < 1))
        wrong += len(clean) - int(np.count_nonzero(away < 1))
        z += sds[away < 1].tolist()
    rms = np.sqrt(np.mean(np.square(z)))
    print(f"{found} of 54 balls, {wrong} others, error / sd {rms:.2f}, largest {np.sqrt(2) * max(z):.1f}")
    assert found > 0.9 * 54
    assert wrong == 0
    assert 0.6 < rms < 1.3
    assert max(z) < 5 / np.sqrt(2)
