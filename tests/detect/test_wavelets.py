"""Films that JPEG 2000 has compressed with losses: even film has no noise, but single waves as round as marks."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.wavelets import height_of_waves

from .films import film_of_balls, grid_of_balls, stored


def compressed(film: NDArray[np.uint8], thousandths: int) -> NDArray[np.uint8]:
    """Return a film as it comes back from JPEG 2000 of that part of its size."""
    done, code = cv2.imencode(".jp2", film, [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, thousandths])
    assert done
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), np.uint8)


def film_with_balls(seed: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Noise by quanta: most where the film is bright."""
    rng = np.random.default_rng(seed)
    balls, radii = grid_of_balls(rng, 4, 180.0, (4.0, 4.0))
    light = film_of_balls((800, 800), balls, radii, background=1.0, depth=0.6, sigma_px=1.2) * np.geomspace(1.0, 0.25, 800)
    noise = gaussian_filter(rng.standard_normal(light.shape), 0.6, mode="wrap")
    return stored(10 + 200 * (light + 0.05 * np.sqrt(light) * noise / noise.std()), 8), balls


def test_waves_are_no_marks_without_a_flag() -> None:
    """They were six on these films, and 38 on one by another program."""
    waves = marks = 0
    for seed in range(3):
        film, balls = film_with_balls(seed)
        back = compressed(film, 30)
        assert height_of_waves(back) > 3.0
        images = detect_markers(back, bits=8).images
        away = np.hypot(*(images.position_px[:, None] - balls).transpose(2, 0, 1))
        of_none = away.min(axis=1) > 3
        assert (images.flags[of_none] > 0).all()
        waves += np.count_nonzero(of_none)
        marks += np.count_nonzero(images.flags[~of_none] == 0)
    print(f"{waves} waves, {marks} marks without a flag")
    assert waves > 5  # or nothing was shown
    assert marks > 0.7 * 3 * 16


def test_other_films_are_not_taken_for_compressed() -> None:
    for seed in range(3):
        film, _ = film_with_balls(seed)
        smooth = gaussian_filter(film.astype(np.float64), 2.0)
        once = cv2.imencode(".jpg", film, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        resampled = cv2.resize(film[::2, ::2], None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
        for other in (film, np.rint(smooth), 3 * np.rint(film / 3), cv2.imdecode(once, cv2.IMREAD_GRAYSCALE), resampled):
            assert height_of_waves(np.asarray(other, np.uint8)) == 0.0
        assert height_of_waves(film[:100]) == 0.0  # no tile
