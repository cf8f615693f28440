"""Which places are near which others, told by a tree as by all distances."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.film.places import are_within, gaps, pairs_within


def test_those_within_reach_are_those_of_all_distances() -> None:
    """Places on whole pixels, of which many are just as far from each other as they reach."""
    rng = np.random.default_rng(7)
    for count, others in ((0, 5), (5, 0), (40, 60)):
        places, at = (rng.integers(0, 20, (n, 2)).astype(float) for n in (count, others))
        own, reach = (rng.integers(0, 4, n).astype(float) for n in (count, others))
        near = gaps(places, at) < own[:, None] + reach
        found = np.zeros_like(near)
        found[pairs_within(places, at, reach, own)] = True
        assert np.array_equal(found, near)
        assert np.array_equal(are_within(places, at, reach, own), near.any(axis=1))
