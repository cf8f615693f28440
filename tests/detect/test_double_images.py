"""Two exposures on one film: images that lie over each other are two balls, and neither one ball through a spot nor nothing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import Detection, detect_markers

from .films import film_of_balls, grid_of_balls, stored

RADIUS_PX, DEPTH = 4.0, 0.3


def film_of_pairs(seed: int, apart: float, contrast: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return a film, the places of its balls, and which are in pairs, ``apart`` diameters of one another; contrast over noise."""
    rng = np.random.default_rng(seed)
    place, _ = grid_of_balls(rng, 7, 60.0, (4.0, 4.0))
    place = rng.permutation(place)
    turn = rng.uniform(0, 2 * np.pi, 10)
    half = apart * RADIUS_PX * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    truth = np.concatenate([place[:10] - half, place[:10] + half, place[10:]])
    radius = np.full(len(truth), RADIUS_PX)
    film = film_of_balls((470, 470), truth, radius, depth=DEPTH, sigma_px=1.4, noise_sd=30000 * DEPTH / contrast, rng=rng)
    return film, truth, np.arange(len(truth)) < 20


def assert_all_are_measured(found: Detection, truth: NDArray[np.float64]) -> None:
    images = found.images
    gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
    assert len(images) == len(truth)
    assert (gap.min(axis=1) < 1.0).all(), "a ball was missed"
    index = gap.argmin(axis=1)
    assert len(set(index)) == len(truth)
    error = images.position_px[index] - truth
    square = np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[index], error[:, :, None])[:, :, 0])
    assert square.max() < 25.0
    assert 0.8 < np.sqrt(square.mean() / 2) < 1.2


@pytest.mark.parametrize(("apart", "contrast"), [(0.5, 40.0), (0.65, 12.0)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pairs_are_not_taken_for_balls_drawn_by_a_focal_spot(seed: int, apart: float, contrast: float) -> None:
    film, truth, _ = film_of_pairs(seed, apart, contrast)
    assert_all_are_measured(detect_markers(stored(film), bits=16), truth)
