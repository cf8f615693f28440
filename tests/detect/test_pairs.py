"""Films on which every ball lies over another, or touches one."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float, MarkerImages

from .films import film_of_balls, grid_of_balls, stored

SIDE, BACKGROUND, DEPTH, FILMS = 260, 30000.0, 0.5, 2


def film_of_pairs(seed: int, radius_px: float, apart: float, cnr: float) -> tuple[Float, Float]:
    """Return a film of three pairs whose centres are so many diameters apart, and these."""
    rng = np.random.default_rng(seed)
    middle = np.array([[60.0, 70.0], [190.0, 80.0], [120.0, 190.0]]) + rng.uniform(-15, 15, (3, 2))
    angle = rng.uniform(0, np.pi, 3)
    half = apart * radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    truth, radius = np.concatenate([middle - half, middle + half]), np.full(6, radius_px)
    noise_sd = DEPTH / cnr * BACKGROUND
    return film_of_balls((SIDE, SIDE), truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=1.2, noise_sd=noise_sd, rng=rng), truth


def surely(images: MarkerImages, truth: Float) -> tuple[int, list[float]]:
    """Count the balls with an image nearby; squared standardised errors of images without a flag but that they lap."""
    gap = np.hypot(*(truth[:, None] - images.position_px).transpose(2, 0, 1))
    found = int((gap.min(axis=1, initial=99.0) < 1.0).sum())
    sure = np.flatnonzero(images.flags & ~MarkerFlag.OVERLAP == 0)
    error, covariance = images.position_px[sure] - truth[gap.argmin(axis=0)[sure]], images.covariance_px2[sure]
    return found, np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).tolist()


@pytest.mark.parametrize(
    ("radius_px", "apart", "cnr"),
    [(r, d, c) for r in (3.0, 6.0) for d in (0.5, 0.65, 1.0) for c in (10.0, 30.0) if (r, d, c) != (3.0, 0.5, 10.0)],
)
def test_nothing_but_pairs(radius_px: float, apart: float, cnr: float) -> None:
    z2: list[float] = []
    for seed in range(FILMS):
        film, truth = film_of_pairs(seed, radius_px, apart, cnr)
        images = detect_markers(stored(film), bits=16).images
        assert len(images) == len(truth)
        found, square = surely(images, truth)
        assert found == len(truth)
        z2 += square
    ratio = float(np.sqrt(np.mean(z2) / 2))
    print(f"radius {radius_px}, {apart} diameters, CNR {cnr}: error / sd {ratio:.2f}, {len(z2)} of {6 * FILMS} without a flag")
    assert len(z2) > 0.8 * 6 * FILMS
    assert ratio < 1.4


def test_pairs_that_noise_does_not_let_tell_apart_pass_for_no_single_balls() -> None:
    for seed in range(FILMS):
        film, truth = film_of_pairs(seed, 3.0, 0.5, 10.0)
        _, square = surely(detect_markers(stored(film), bits=16).images, truth)
        assert max(square, default=0.0) < 25.0


@pytest.mark.parametrize("cnr", [10.0, 20.0])
def test_of_many_small_pairs_none_passes_for_a_single_ball(cnr: float) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        middle, _ = grid_of_balls(rng, 7, 110.0, (2.5, 2.5))
        angle = rng.uniform(0, np.pi, len(middle))
        half = 0.5 * 2.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        truth, shape = np.concatenate([middle - half, middle + half]), (840, 840)
        sd, radius = DEPTH / cnr * BACKGROUND, np.full(2 * len(middle), 2.5)
        film = film_of_balls(shape, truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=1.3, noise_sd=sd, rng=rng)
        _, square = surely(detect_markers(stored(film), bits=16).images, truth)
        assert max(square, default=0.0) < 25.0


@pytest.mark.parametrize(("radius_px", "seed"), [(6.0, 7), (6.0, 8), (6.0, 11), (3.0, 4), (3.0, 11)])
def test_pairs_that_hardly_lap_and_look_like_no_ball_are_found_where_there_is_nothing_else(radius_px: float, seed: int) -> None:
    film, truth = film_of_pairs(seed, radius_px, 0.8, 10.0)
    assert surely(detect_markers(stored(film), bits=16).images, truth)[0] == len(truth)


@pytest.mark.parametrize(("radius_px", "apart", "cnr", "seed"), [(6.0, 0.8, 30.0, 5), (6.0, 0.8, 10.0, 2), (9.0, 0.9, 10.0, 2)])
def test_peaks_along_the_rims_of_a_pair_do_not_hide_it(radius_px: float, apart: float, cnr: float, seed: int) -> None:
    """The filter answers between two balls and on their rims as well; nine places, at three of which there are two."""
    rng = np.random.default_rng(1000 * seed + int(10 * radius_px) + int(100 * apart))
    side = int(40 * radius_px) + 160
    place = np.array([[i, j] for i in (1, 2, 3) for j in (1, 2, 3)]) * side / 4 + rng.uniform(-3, 3, (9, 2))
    angle = rng.uniform(0, np.pi, 3)
    half = apart * radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    truth = np.concatenate([place[:6], place[6:] - half, place[6:] + half])
    noise_sd = DEPTH / cnr * BACKGROUND
    film = film_of_balls(
        (side, side), truth, np.full(12, radius_px), background=BACKGROUND, depth=DEPTH, sigma_px=1.2, noise_sd=noise_sd, rng=rng
    )
    images = detect_markers(stored(film), bits=16).images
    assert len(images) == len(truth)
    assert surely(images, truth)[0] == len(truth)


@pytest.mark.parametrize("radii_px", [(3.0, 3.0), (6.0, 3.0), (6.0, 6.0)])
@pytest.mark.parametrize("apart", [0.6, 0.8])
def test_pairs_of_any_two_sizes_of_a_film_are_told(radii_px: tuple[float, float], apart: float) -> None:
    """Two blobs, one of which may be two balls of one size and look like one of the other."""
    found, z2 = 0, list[float]()
    for seed in range(FILMS):
        rng = np.random.default_rng(seed)
        place = np.array([[i, j] for i in (1, 2, 3) for j in (1, 2, 3)]) * 65.0 + rng.uniform(-5, 5, (9, 2))
        angle = rng.uniform(0, 2 * np.pi, 2)
        way = apart * sum(radii_px) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        truth = np.concatenate([place, place[:2] + way])
        radius = np.array([radii_px[0]] * 2 + [6.0, 6.0, 6.0, 6.0, 3.0, 3.0, 3.0] + [radii_px[1]] * 2)
        film = film_of_balls(
            (SIDE, SIDE), truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=1.2, noise_sd=DEPTH / 30 * BACKGROUND, rng=rng
        )
        images = detect_markers(stored(film), bits=16).images
        assert len(images) <= len(truth)
        number, square = surely(images, truth)
        found += number
        z2 += square
    ratio = float(np.sqrt(np.mean(z2) / 2))
    print(f"radii {radii_px}, {apart} of their sum apart: {found} of {FILMS * 11} found, error / sd {ratio:.2f}")
    assert found == FILMS * 11
    assert ratio < 1.4


@pytest.mark.parametrize(("sigma_px", "apart", "cnr"), [(1.3, 1.0, 50.0), (1.5, 1.2, 20.0)])
def test_a_film_of_many_small_pairs_tells_what_balls_are_like(sigma_px: float, apart: float, cnr: float) -> None:
    """Not one of 72 was found: their size was guessed too large."""
    rng = np.random.default_rng(5)
    middle, _ = grid_of_balls(rng, 6, 60.0, (1.0, 1.0))
    angle = rng.uniform(0, np.pi, len(middle))
    half = apart * 2.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    truth, noise_sd = np.concatenate([middle - half, middle + half]), DEPTH / cnr * BACKGROUND
    radius = np.full(len(truth), 2.5)
    film = film_of_balls((390, 390), truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=sigma_px, noise_sd=noise_sd, rng=rng)
    images = detect_markers(stored(film), bits=16).images
    assert len(images) == len(truth)
    found, square = surely(images, truth)
    print(f"{found} of {len(truth)}, error / sd {np.sqrt(np.mean(square) / 2):.2f}")
    assert found == len(truth)
    assert 0.75 < np.sqrt(np.mean(square) / 2) < 1.25
