"""Images that lie over each other are two balls or three of the film's own: neither one ball through a spot, nor nothing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import Detection, detect_markers

from .films import film_of_balls, grid_of_balls, stored, strip

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
@pytest.mark.parametrize("seed", [1, 2])
def test_pairs_are_not_taken_for_balls_drawn_by_a_focal_spot(seed: int, apart: float, contrast: float) -> None:
    film, truth, _ = film_of_pairs(seed, apart, contrast)
    assert_all_are_measured(detect_markers(stored(film), bits=16), truth)


@pytest.mark.parametrize("contrast", [40.0, 12.0])
def test_pairs_that_look_like_no_ball_at_first_sight_do_not_vanish(contrast: float) -> None:
    film, truth, _ = film_of_pairs(1, 0.75, contrast)
    assert_all_are_measured(detect_markers(stored(film), bits=16), truth)


def test_three_in_a_row_and_more_than_forty_pairs_do_not_vanish() -> None:
    rng = np.random.default_rng(1)
    place, _ = grid_of_balls(rng, 9, 60.0, (4.0, 4.0))
    place = rng.permutation(place)
    turn = rng.uniform(0, 2 * np.pi, 60)
    step = 2 * RADIUS_PX * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    threes, pairs, clear = place[:10], place[10:60], place[60:]
    truth = np.concatenate(
        [threes, threes - 0.8 * step[:10], threes + 0.8 * step[:10], pairs - 0.3 * step[10:], pairs + 0.3 * step[10:], clear]
    )
    radius = np.full(len(truth), RADIUS_PX)
    film = film_of_balls((590, 590), truth, radius, depth=DEPTH, sigma_px=1.4, noise_sd=30000 * DEPTH / 30, rng=rng)
    assert_all_are_measured(detect_markers(stored(film), bits=16), truth)


def test_neighbours_of_two_sizes_that_the_film_has_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    place, _ = grid_of_balls(rng, 6, 60.0, (4.0, 4.0))
    turn = rng.uniform(0, 2 * np.pi, 18)
    step = 0.8 * 0.8 * RADIUS_PX * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    truth = np.concatenate([place[:18] - step, place[:18] + step, place[18:]])
    radius = RADIUS_PX * np.concatenate([np.ones(18), np.full(18, 0.6), np.where(np.arange(18) % 2, 1.0, 0.6)])
    film = film_of_balls((420, 420), truth, radius, depth=DEPTH, sigma_px=1.4, noise_sd=30000 * DEPTH / 30, rng=rng)
    assert_all_are_measured(detect_markers(stored(film), bits=16), truth)


@pytest.mark.parametrize("contrast", [40.0, 15.0])
def test_bars_as_wide_as_balls_and_deeper_are_no_rows_of_balls(contrast: float) -> None:
    rng = np.random.default_rng(3)
    place, _ = grid_of_balls(rng, 7, 60.0, (4.0, 4.0))
    place = rng.permutation(place)
    film = film_of_balls((470, 470), place[20:], np.full(29, RADIUS_PX), background=1.0, depth=DEPTH, sigma_px=1.4)
    for middle in place[:20]:
        turn, half, width = rng.uniform(0, np.pi), rng.uniform(5.0, 14.0), rng.uniform(5.0, 9.0)
        along = half * np.array([np.cos(turn), np.sin(turn)])
        film -= 1.3 * DEPTH * strip(film.shape, middle - along, middle + along, width, 1.4)
    found = detect_markers(stored(30000 * (film + DEPTH / contrast * rng.standard_normal(film.shape))), bits=16).images
    gap = np.hypot(*(place[:20, None] - found.position_px[found.shape == "ball"]).transpose(2, 0, 1))
    assert (gap < 20.0).sum(axis=1).max() < 3
