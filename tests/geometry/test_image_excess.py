"""By how much image errors are larger than stated, from the crossings of all markers."""

import numpy as np
import pytest

from rsa_vision.geometry.image_excess import image_excess

N = 13
OWN = np.full(N, 4.0**2)
SHARED = 15.0 * np.stack([np.ones(N), np.linspace(-1, 1, N), np.cos(np.arange(N))], axis=1)  # larger than a single image's errors


def crossings(rng: np.random.Generator, factor: float) -> np.ndarray:
    """Draw crossing errors whose own part is larger than stated by a factor."""
    return SHARED @ rng.standard_normal(SHARED.shape[1]) + factor * np.sqrt(OWN) * rng.standard_normal(N)


def test_honest_errors_are_left_alone_but_for_chance() -> None:
    rng = np.random.default_rng(1)
    found = [image_excess(crossings(rng, 1.0), OWN, SHARED) > 1 for _ in range(1000)]
    assert np.mean(found) < 0.02


def test_errors_that_each_crossing_alone_would_hide_are_found_in_their_size() -> None:
    rng = np.random.default_rng(2)
    drawn = [crossings(rng, 3.0) for _ in range(300)]
    alone = [((d**2) / (OWN + (SHARED**2).sum(1))).mean() for d in drawn]
    assert np.mean(alone) < 1.5
    found = np.array([image_excess(d, OWN, SHARED) for d in drawn])
    assert np.mean(found > 1) > 0.9
    assert np.median(found) == pytest.approx(3.0, rel=0.15)


def test_one_wrong_pair_says_nothing_of_the_others() -> None:
    rng = np.random.default_rng(3)
    found = []
    for _ in range(300):
        drawn = crossings(rng, 1.0)
        drawn[rng.integers(N)] += 500.0
        found.append(image_excess(drawn, OWN, SHARED) > 1)
    assert np.mean(found) < 0.02


def test_few_markers_tell_nothing() -> None:
    assert image_excess(np.full(4, 1e3), np.ones(4), np.zeros((4, 0))) == 1
