"""Films without markers, and films that are none: nothing found, no failure."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag

from .films import film_of_balls, misses, stored

RNG = np.random.default_rng(1)
FILMS = {
    "zero": np.zeros((300, 300), np.uint16),
    "constant": np.full((300, 300), 20000, np.uint16),
    "full": np.full((300, 300), 65535, np.uint16),
    "tiny constant": np.full((64, 64), 100, np.uint8),
    "tiny noise": stored(RNG.normal(120, 5, (64, 64)), 8),
    "narrow": stored(RNG.normal(120, 5, (600, 40)), 8),
    "white noise": stored(RNG.normal(20000, 800, (700, 700))),
    "screen noise": stored(20000 + 3000 * gaussian_filter(RNG.standard_normal((700, 700)), 1.2)),
    "noise in 8 bits": stored(RNG.normal(120, 0.4, (500, 500)), 8),
    "mostly saturated": stored(RNG.normal(65000, 3000, (500, 500))),
    "steps": np.kron(RNG.integers(0, 4, (8, 8)), np.full((60, 60), 12000)).astype(np.uint16),
    "gradient": np.tile(np.linspace(0, 60000, 500).astype(np.uint16), (500, 1)),
}


@pytest.mark.parametrize("name", FILMS)
def test_nothing_is_found_where_nothing_is(name: str) -> None:
    film = FILMS[name]
    found = detect_markers(film, bits=8 * film.dtype.itemsize)
    assert len(found.images) == 0, found.images.position_px


def test_noise_makes_no_more_false_detections_than_asked_for() -> None:
    rng = np.random.default_rng(4)
    films = [stored(20000 + 800 * rng.standard_normal((500, 500))) for _ in range(8)]
    assert sum(len(detect_markers(f, bits=16, false_detections=0.1).images) for f in films) <= 3  # 0.8 expected


def test_balls_all_of_which_are_saturated_are_found_and_say_so() -> None:
    """Specks that were whole told blur and polarity: not one of the balls was found."""
    rng = np.random.default_rng(0)
    axis = np.arange(40.0, 600.0, 100.0)
    balls = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.uniform(-8, 8, (36, 2))
    clear = film_of_balls((600, 600), balls, np.full(36, 3.5), background=1.0, depth=0.5, sigma_px=1.1)
    noise = gaussian_filter(rng.standard_normal(clear.shape), 0.7)
    film = 1.3 - clear + 0.012 * noise / noise.std() + 0.05 * np.sin(np.arange(600) / 40)
    images = detect_markers(stored(film / (0.3 + 0.3 * 0.475) * 4095, 12), bits=12).images
    assert len(images.flags) == len(balls)
    assert (images.flags & MarkerFlag.SATURATED).all()
    away, z = misses(images, balls)
    print(f"error / sd {np.sqrt((z**2).mean()):.2f}, largest {np.sqrt(2) * z.max():.1f}")
    assert (away < 1).all()
    assert 0.6 < np.sqrt((z**2).mean()) < 1.2
    assert z.max() < 4 / np.sqrt(2)
