"""What depths say of pairs, and how large errors of crossings are by the other pairs."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.identify.crossings import Crossings
from rsa_vision.identify.depths import log_chance_of_depths, log_odds_of_depths


def test_chance_is_a_density_of_where_images_without_a_partner_cross() -> None:
    rng = np.random.default_rng(0)
    met = rng.uniform(-0.8, 0.0, 3000)
    grid = np.linspace(-1.2, 0.4, 8001)
    alike = log_chance_of_depths(grid, met, np.zeros(len(met)))
    assert abs(np.trapezoid(np.exp(alike), grid) - 1) < 0.01
    assert np.abs(alike[(grid > -0.7) & (grid < -0.1)] - np.log(1 / 0.8)).max() < 0.3
    few = log_chance_of_depths(np.array([-0.7, -0.1]), met, np.where(met < -0.6, 1.0, 0.0))
    assert few[0] > few[1] + 3


@pytest.mark.parametrize("apart", [0.0, 0.001, 0.002, 0.003])
def test_crossings_at_one_depth_are_likeliest_there(apart: float) -> None:
    """The kernel was longer than the histogram of two crossings that lie about as deep, and the examination failed."""
    met = -0.3 + apart * np.array([-0.5, 0.5])
    there = log_chance_of_depths(met, met, np.ones(2))
    assert np.exp(there) == pytest.approx(1 / (0.01 * np.sqrt(2 * np.pi)), rel=0.1)
    assert (log_chance_of_depths(met + 0.03, met, np.ones(2)) < there - 2).all()


def test_a_depth_among_the_markers_speaks_for_a_pair_and_one_elsewhere_against_it() -> None:
    rng = np.random.default_rng(1)
    depth = np.append(rng.normal(-0.2, 0.02, 14), [-0.2, -0.7])
    chance = np.full(16, np.log(1 / 0.8))
    pair = np.append(np.ones(14), [0.0, 0.0])
    odds = log_odds_of_depths(depth, chance, np.arange(16), np.arange(16), pair)
    assert odds[14] > 1.5
    assert -np.log(16) < odds[15] < -1.5
    assert not log_odds_of_depths(depth, chance, np.arange(16), np.arange(16), np.where(pair > 0, 0.1, 0)).any()  # too few to tell


def test_the_errors_of_the_other_crossings_tell_how_large_the_next_one_is() -> None:
    rng = np.random.default_rng(2)
    rows, none = np.arange(13), np.zeros(13)
    for true in (0.1, 1.0, 2.0):
        distance = np.abs(rng.normal(0, 0.02 * true, 13))
        distance[0] = 0.02  # the one that is judged does not excuse itself
        crossings = Crossings(rows, rows, distance, np.full(13, 0.02), none, none, none, none)
        scale, freedom = crossings.scale_of_errors(np.ones(13), 0.02)
        others = np.sqrt((2 + ((distance[1:] / 0.02) ** 2).sum()) / 14)
        assert 0.8 * others < scale[0] < 1.05 * others
        assert freedom[0] == 14
        told = crossings.log_ratio(0.02, scale, freedom)[0] - crossings.log_ratio(0.02)[0]
        assert (told < -1) == (true < 0.5)
