"""Contrasts that go with the background, as each film shows it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsa_vision.identify.contrasts import contrasts_alike

SPREAD = 0.03


def film(rng: np.random.Generator, n: int, scatter: float) -> tuple[np.ndarray, np.ndarray]:
    """Backgrounds of balls behind bone on a linear film, and their contrasts."""
    primary = rng.uniform(0.05, 0.6, n)
    return primary + scatter, 0.7 * primary * np.exp(rng.normal(0, SPREAD, n))


@pytest.mark.parametrize("scatter", [0.0, 0.2])
def test_linear_films(scatter: float) -> None:
    rng = np.random.default_rng(1)
    background, contrast = film(rng, 15, scatter)
    alike = contrasts_alike(contrast, background, np.ones(15, bool))
    assert np.log(contrast).std() > 0.4
    assert np.log(alike).std() < 2 * SPREAD


def test_things_that_are_no_balls_do_not_count_much() -> None:
    rng = np.random.default_rng(2)
    background, contrast = film(rng, 15, 0.1)
    strays = rng.uniform(0.02, 0.6, 5)
    alike = contrasts_alike(np.append(contrast, strays), np.append(background, rng.uniform(0.1, 0.7, 5)), np.ones(20, bool))
    assert np.log(alike[:15]).std() < 3 * SPREAD


def test_two_sizes_keep_their_ratio() -> None:
    rng = np.random.default_rng(3)
    background, contrast = film(rng, 18, 0.1)
    small = np.arange(18) % 3 == 0
    alike = np.log(contrasts_alike(np.where(small, 0.6, 1.0) * contrast, background, np.ones(18, bool)))
    assert alike[~small].std() < 2 * SPREAD
    assert alike[small].mean() - alike[~small].mean() == pytest.approx(np.log(0.6), abs=0.1)


@given(seed=st.integers(0, 10_000), n=st.integers(0, 60))
def test_films_that_show_no_dependence_are_left_alone(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    contrast, background = 0.4 * np.exp(rng.normal(0, 0.2, n)), rng.uniform(0.1, 0.9, n)
    changed = contrasts_alike(contrast, background, np.ones(n, bool)) / contrast
    # one film in a hundred or so shows one by chance, and then a small one
    assert (changed == 1).all() or np.abs(np.log(changed)).max() < 1.5


def test_chance_shows_a_dependence_seldom() -> None:
    rng = np.random.default_rng(4)
    changed = 0
    for _ in range(300):
        n = int(rng.integers(6, 40))
        contrast = 0.4 * np.exp(rng.normal(0, 0.3, n))
        changed += bool((contrasts_alike(contrast, rng.uniform(0.1, 0.9, n), np.ones(n, bool)) != contrast).any())
    assert changed <= 6


@given(seed=st.integers(0, 1000), scale=st.floats(0.1, 10.0))
def test_the_film_s_scale_does_not_matter(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    background, contrast = film(rng, 12, 0.1)
    every = np.ones(12, bool)
    np.testing.assert_allclose(scale * contrasts_alike(contrast, background, every), contrasts_alike(scale * contrast, background, every))


def test_unknown_backgrounds() -> None:
    contrast = np.linspace(0.1, 0.9, 10)
    np.testing.assert_array_equal(contrasts_alike(contrast, np.full(10, np.nan), np.ones(10, bool)), contrast)
