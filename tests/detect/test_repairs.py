"""Lines that a flat panel's driver made up hold no film: they are told, and move no tip."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.repairs import repaired_lines
from rsa_vision.types import Float

from .films import stored
from .test_covered import CELLS, check, exposed, light_past_tees, tips_of


def noisy(seed: int, blur_px: float = 0.0, sd: float = 40.0) -> Float:
    """Return a film that is brighter to one side, with a dark bone."""
    rng = np.random.default_rng(seed)
    noise = gaussian_filter(rng.normal(size=(300, 420)), blur_px)
    film = 20000 + 20.0 * np.arange(420) + noise * (sd / noise.std())
    film[:, 200:260] -= 6000
    return np.asarray(film)


def interpolated(film: Float, first: int, last: int) -> None:
    part = (np.arange(first, last + 1) - first + 1) / (last - first + 2)
    film[:, first : last + 1] = film[:, [first - 1]] * (1 - part) + film[:, [last + 1]] * part


@pytest.mark.parametrize("blur_px", [0.0, 0.7])
@pytest.mark.parametrize("sd", [3.0, 40.0])
def test_interpolated_and_copied_lines_are_told(blur_px: float, sd: float) -> None:
    for seed in range(5):
        film = noisy(seed, blur_px, sd)
        interpolated(film, 40, 40)
        interpolated(film, 90, 91)
        film[:, 150] = film[:, 149]
        interpolated(film.T, 77, 77)
        cols, rows = repaired_lines(stored(film))
        assert cols.tolist() == [40, 90, 91, 149, 150]
        assert rows.tolist() == [77]


@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("sd", [0.2, 1.0, 40.0])
def test_films_without_them_have_none(blur_px: float, sd: float) -> None:
    for seed in range(5):
        film = noisy(seed, blur_px, sd)
        film[:, 350:] = 65535  # saturated beside a shutter
        assert [len(lines) for lines in repaired_lines(stored(film))] == [0, 0]


@pytest.mark.parametrize("order", [0, 1])
def test_a_film_that_was_resampled_is_no_row_of_repairs(order: int) -> None:
    assert [len(lines) for lines in repaired_lines(stored(zoom(noisy(0), 2, order=order)))] == [0, 0]


@pytest.mark.parametrize("copied", [False, True])
def test_tips_beside_them_are_where_they_are_said_to_be(copied: bool) -> None:
    """A column goes beside nearly every tip: they were moved by a tenth of a pixel, many stated errors."""
    rng = np.random.default_rng(5)
    tips = tips_of(rng)
    film = exposed(light_past_tees(tips, np.ones(len(tips))), rng).astype(np.float64)
    last = 0
    for col in sorted(np.rint(tips[:, 0]).astype(int) + 1):
        if col > last + 3:
            if copied:
                film[:, col] = film[:, col - 1]
            else:
                interpolated(film, col, col + 1)
            last = col + 1
    check(detect_markers(stored(film), bits=16).images, tips, list(range(CELLS**2)))
