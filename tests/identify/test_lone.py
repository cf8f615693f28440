"""Images without a partner: a marker that the other focus does not show is told from clutter."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.identify.lone import chance_of_marker

SHAPE = (4000, 3000)


def chances(radius: float, contrast: float, place: tuple[float, float], *, quality: int = 0, others: int = 0) -> float:
    """Return what is said of one image on a film with twenty images of markers and other clutter."""
    rng = np.random.default_rng(0)
    look = np.column_stack([rng.normal(np.log(4.3), 0.03, 20), rng.normal(np.log(0.1), 0.4, 20)])
    clutter = np.column_stack([rng.uniform(np.log(2), np.log(10), others), rng.uniform(np.log(0.03), np.log(0.6), others)])
    places = np.vstack([rng.normal([1500, 2000], [300, 400], (20, 2)), rng.uniform([0, 0], [3000, 4000], (others, 2))])
    look = np.vstack([look, clutter, np.log([[radius, contrast]])])
    qualities = np.append(np.zeros(20 + others, int), quality)
    result = chance_of_marker(look, np.vstack([places, place]), qualities, np.arange(21 + others) < 20, SHAPE)
    assert (result[:20] == 1).all()
    return float(result[-1])


def test_image_like_a_marker_among_markers_is_one_for_a_person() -> None:
    assert chances(4.3, 0.1, (1600, 2100)) > 0.9
    assert chances(4.3, 0.1, (1600, 2100), others=30) > 0.3


@pytest.mark.parametrize(
    ("radius", "contrast", "place", "quality"),
    [(6.5, 0.1, (1600, 2100), 0), (4.3, 2.0, (1600, 2100), 0), (4.9, 0.1, (200, 100), 0), (4.5, 0.1, (200, 100), 2)],
    ids=["too large", "too dense", "larger, in a corner", "poor, in a corner"],
)
def test_image_unlike_markers_or_far_from_them_is_clutter(radius: float, contrast: float, place: tuple[float, float], quality: int) -> None:
    assert chances(radius, contrast, place, quality=quality) < 0.1


def test_the_worse_an_image_is_described_the_less_it_is_a_marker() -> None:
    clear, disturbed, poor = (chances(4.3, 0.1, (1600, 2100), quality=quality) for quality in (0, 1, 2))
    assert clear > 0.9
    assert poor < 0.5 * disturbed < 0.5 * clear


def test_chances_are_true() -> None:
    """Of images said to be markers with a probability of p, a part of about p is."""
    said, true = [], []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        hidden, clutter = rng.poisson(1.5), rng.poisson(6)
        n = 20 + hidden
        look = np.column_stack([rng.normal(np.log(4.3), 0.04, n), rng.normal(np.log(0.1), 0.3, n)])
        look = np.vstack([look, np.column_stack([rng.normal(np.log(4.3), 0.7, clutter), rng.normal(np.log(0.1), 0.7, clutter)])])
        places = np.vstack([rng.normal([1500, 2000], 350, (n, 2)), rng.uniform([0, 0], [3000, 4000], (clutter, 2))])
        above = rng.random(n + clutter)[:, None] > np.where(np.arange(n + clutter)[:, None] < n, [0.94, 0.99], [1 / 3, 2 / 3])
        result = chance_of_marker(look, places, above.sum(axis=1), np.arange(n + clutter) < 20, SHAPE)
        said += result[20:].tolist()
        true += (np.arange(n + clutter) < n)[20:].tolist()
    chance, marker = np.array(said), np.array(true)
    assert marker[chance > 0.9].mean() > 0.85
    assert marker[chance < 0.1].mean() < 0.1
    assert chance.sum() == pytest.approx(marker.sum(), rel=0.25)


def test_nothing_is_said_without_pairs() -> None:
    assert chance_of_marker(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2, int), np.zeros(2, bool), SHAPE).tolist() == [0.0, 0.0]
