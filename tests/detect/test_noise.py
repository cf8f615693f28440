"""The noise of a film, told by its tiles."""

import numpy as np
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.film.noise import estimate_noise

from .films import stored

SD = 1000.0


def test_marks_make_no_noise_of_an_even_film() -> None:
    """The darkest of its tiles are those with marks; their values lie within the noise of all others."""
    rng = np.random.default_rng(1)
    image = np.zeros((900, 900))
    for x, y in rng.uniform(50, 850, (60, 2)):
        turn, along = rng.uniform(0, 2 * np.pi), np.linspace(0, 40, 160)
        stroke = np.zeros_like(image)
        stroke[(y + along * np.sin(turn)).astype(int), (x + along * np.cos(turn)).astype(int)] = 1.0
        image += gaussian_filter(stroke, 2.0)
    noise = estimate_noise(stored(38000.0 - 40 * SD * image + rng.normal(0, SD, image.shape), 16), 16)
    assert np.abs(np.sqrt(noise.variance) / SD - 1).max() < 0.01
