"""Films without noise, on one background: measured like others. What is cut off is not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.saturation import saturation

from .films import film_of_balls, grid_of_balls, stored

RNG = np.random.default_rng(3)
TRUTH, RADIUS = grid_of_balls(RNG, 5, 90.0, (3.5, 5.0))


def shadows(sigma_px: float) -> NDArray[np.float64]:
    return film_of_balls((480, 480), TRUTH, RADIUS, background=1.0, depth=0.5, sigma_px=sigma_px)


@pytest.mark.parametrize("sigma_px", [0.6, 1.0, 2.5])
@pytest.mark.parametrize(("bits", "inverted"), [(8, False), (16, True)])
@pytest.mark.parametrize("background", [0.7, 1.0])
def test_balls_on_one_value_are_measured(sigma_px: float, bits: int, inverted: bool, background: float) -> None:
    film = background * shadows(sigma_px)
    found = detect_markers(stored((2**bits - 1) * (1 - film if inverted else film), bits), bits=bits)
    gap = np.hypot(*(TRUTH[:, None] - found.images.position_px[None]).transpose(2, 0, 1))
    assert found.dark_markers != inverted
    assert len(found.images) == len(TRUTH)
    assert (gap.min(1) < 0.02).all()
    assert (found.images.flags == 0).all()
    error = found.images.position_px[gap.argmin(1)] - TRUTH
    square = error**2 / np.einsum("nii->ni", found.images.covariance_px2[gap.argmin(1)])
    print(f"RMS {np.sqrt((error**2).mean()):.4f} px, error / sd {np.sqrt(square.mean()):.2f}")
    assert square.mean() < 2.0  # the films themselves are exact to 0.003 px


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("high", [1.0, 0.9])
def test_what_is_cut_off_is_saturated(bits: int, noise: float, high: float) -> None:
    film = 0.8 * shadows(1.0) * np.linspace(1.0, 1.8, 480) + noise * np.random.default_rng(5).standard_normal((480, 480))
    full = 2**bits - 1
    assert saturation(stored(full * np.minimum(film, high), bits), bits) == (-np.inf, np.rint(full * high))
    turned = stored(full * (1 - np.minimum(film, high)), bits)
    assert saturation(turned, bits) == (np.rint(full * (1 - high)), np.inf)


def test_noise_of_a_burnt_film_is_not_that_of_where_rounding_hides_it() -> None:
    rng = np.random.default_rng(3)
    truth, radius = grid_of_balls(rng, 5, 90.0, (3.5, 5.0))
    dose = np.exp(np.linspace(-3, 2.2, 480))  # most of the film has the same value
    light = dose * film_of_balls((480, 480), truth, radius, background=1.0, depth=-2.0)
    found = detect_markers(stored(3 + light * (1 + 0.2 * rng.standard_normal(light.shape)), 8), bits=8)
    gap = np.hypot(*(truth[:, None] - found.images.position_px[None]).transpose(2, 0, 1))
    assert np.count_nonzero(gap.min(1) < 1) >= 12
    assert (gap.min(0) < 2).all()
    assert found.noise.variance.max() > 1.0
