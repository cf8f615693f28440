"""Pins and tees in two planes have two penumbras: tips are where they are said to be, and a blurred tee is no two tees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.needles.differing import MOST_BLURRIER, differing
from rsa_vision.types import Float

from .test_covered import CELLS, exposed, light_past_tees, tips_of
from .test_pins import film_of_pins

COUNT = CELLS**2
SURE = 3.0  # logarithm of odds


def stated_errors(film: np.ndarray, tips: Float, shape: str) -> tuple[float, float, float]:
    """Return RMS of the errors (pixels), error over standard deviation, and the largest of these."""
    found = detect_markers(film, bits=16).images
    assert found.shape.tolist() == [shape] * COUNT
    assert not found.flags.any()
    nearest = np.hypot(*(found.position_px - tips[:, None]).transpose(2, 0, 1)).argmin(axis=1)
    error = found.position_px[nearest] - tips
    z = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[nearest]), error))
    return float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean(z**2) / 2)), float(z.max())


@pytest.mark.parametrize(("penumbra_px", "most_px"), [(0.8, 0.1), (1.5, 0.15)])
def test_pins_in_two_planes(penumbra_px: float, most_px: float) -> None:
    """Up to a pixel off along the pin, with no flag, all blurs being taken as equal."""
    film, tips, _ = film_of_pins(np.random.default_rng(4), penumbra_px=penumbra_px)
    rms, ratio, largest = stated_errors(film, tips, "pin")
    print(f"penumbra {penumbra_px} px: RMS {rms:.3f} px, error / sd {ratio:.2f}, largest {largest:.1f}")
    assert rms < most_px
    assert 0.6 < ratio < 1.4
    assert largest < 4.5


def test_tees_of_every_penumbra_are_one_each() -> None:
    """One in twelve passed for two, with no flag."""
    rng = np.random.default_rng(7)
    tips, seen = tips_of(rng), 1.0
    for tip, penumbra_px in zip(tips, np.linspace(0.0, 1.6, COUNT), strict=True):
        seen = seen * gaussian_filter(light_past_tees(tip[None], np.ones(1)), penumbra_px)
    rms, ratio, largest = stated_errors(exposed(seen, rng), tips, "tee")
    print(f"RMS {rms:.3f} px, error / sd {ratio:.2f}, largest {largest:.1f}")
    assert rms < 0.03
    assert 0.6 < ratio < 1.4
    assert largest < 4.5


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_only_what_is_more_than_chance_is_a_difference(spread: float) -> None:
    told = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        blurs = [rng.normal(0.3, np.hypot(spread, 0.03), 1) for _ in range(16)]
        if (found := differing(blurs, [np.full(1, 0.03**2)] * 16, MOST_BLURRIER, SURE)) is not None:
            told += 1
            assert not spread or (0.4 * spread < np.median(found.spread) < 2 * spread and abs(found.typical - 0.3) < spread)
    assert (told < 3) if spread == 0 else (told == 50)


def test_few_needles_tell_nothing_of_blurs() -> None:
    assert differing([np.array([-0.3]), np.array([0.3])], [np.array([1e-4])] * 2, MOST_BLURRIER, SURE) is None
