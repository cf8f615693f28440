"""Films of scanners whose lines start early or late."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.fft import irfft, rfft, rfftfreq
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers

from .films import film_of_balls, grid_of_balls, stored

SIDE = 600


def rows_displaced(film: NDArray[np.float64], by_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Band-limited, as all that blur has gone over is."""
    turned = np.exp(-2j * np.pi * rfftfreq(film.shape[1]) * by_px[:, None])
    return np.asarray(irfft(rfft(film, axis=1) * turned, film.shape[1], axis=1))


def errors_over_stated(of_lines_px: float, noise_blur_px: tuple[float, float], *, turned: bool) -> NDArray[np.float64]:
    """Of the column and the row of balls on four films, shape (n, 2)."""
    z = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        balls, radii = grid_of_balls(rng, 6, 85.0, (4.0, 4.0))
        balls += rng.uniform(-12.0, 12.0, balls.shape)  # lest they share lines
        film = film_of_balls((SIDE, SIDE), balls, radii, depth=0.5, sigma_px=1.0)
        noise = gaussian_filter(rng.standard_normal(film.shape), noise_blur_px, mode="wrap")
        film = rows_displaced(film, rng.normal(0.0, of_lines_px, SIDE)) + 300.0 * noise / noise.std()
        balls, film = (balls[:, ::-1], film.T) if turned else (balls, film)
        images = detect_markers(stored(film), bits=16).images
        images = images.rows(images.flags == 0)
        gap = images.position_px[:, None] - balls
        nearest = np.argmin(np.hypot(*gap.transpose(2, 0, 1)), axis=1)
        z.append(gap[np.arange(len(gap)), nearest] / np.sqrt(images.covariance_px2[:, [0, 1], [0, 1]]))
    return np.concatenate(z)


@pytest.mark.parametrize(("displaced_px", "turned"), [(0.15, True), (0.3, False)])
def test_what_lines_do_to_centres_is_stated(displaced_px: float, turned: bool) -> None:
    """Errors along displaced lines were 1.9 times the stated ones, errors across them 0.3 to 0.6 times."""
    z = errors_over_stated(displaced_px, (0.0, 0.0), turned=turned)
    along, across = np.sqrt(np.mean(z**2, axis=0))[:: -1 if turned else 1]
    print(f"{len(z)} balls, error / stated along lines {along:.2f}, across {across:.2f}")
    assert len(z) > 0.95 * 4 * 36
    assert 0.8 < along < 1.2
    assert 0.65 < across < 1.2


@pytest.mark.parametrize("blur_px", [(0.0, 0.0), (0.0, 0.8)])
def test_steady_lines_add_nothing_whether_noise_is_as_smooth_along_them_or_not(blur_px: tuple[float, float]) -> None:
    along, across = np.sqrt(np.mean(errors_over_stated(0.0, blur_px, turned=False) ** 2, axis=0))
    print(f"error / stated along lines {along:.2f}, across {across:.2f}")
    assert 0.85 < along < 1.15
    assert 0.85 < across < 1.15


@pytest.mark.parametrize("seed", [0, 5, 12])
def test_few_lines_of_small_balls_in_white_noise_are_steady(seed: int) -> None:
    """Three or four lines tell of a small ball, most of which its fit takes up: by chance errors were halved along one axis."""
    rng = np.random.default_rng(seed)
    balls, radii = grid_of_balls(rng, 5, 80.0, (2.0, 3.0))
    balls += rng.uniform(-12, 12, balls.shape)
    film = film_of_balls((440, 440), balls, radii, depth=0.5, sigma_px=0.8, noise_sd=1300.0, rng=rng)
    images = detect_markers(stored(film), bits=16).images
    sd = np.sqrt(images.covariance_px2[:, [0, 1], [0, 1]])
    assert len(images) == 25
    assert 0.9 < np.median(sd[:, 0] / sd[:, 1]) < 1.1
