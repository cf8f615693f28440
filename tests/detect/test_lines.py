"""Wires in correlated noise are no rows of faint balls, and balls that lie on them keep their places."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect import detect_markers
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored, strip

SIDE, SIGMA_PX, RADIUS_PX = 560, 1.4, 4.0
DEPTH, CNR, NOISE_BLUR_PX = 0.45, 15.0, 0.8
BACKGROUND = 30000.0
FILMS = 2
MOST_FALSE, LEAST_FOUND = 1, 0.95  # of a film with 16 wires; of 32 there were 9 to 13
FAR = 4.5


def film_with_wires(rng: np.random.Generator, faint: float = 0.0) -> tuple[Float, Float]:
    """Return a film of balls, most of them on or beside a wire as wide as they are, and the centres of the balls.

    ``faint``: every third ball lies on no wire and has so much of the contrast.
    """
    truth, radius = grid_of_balls(rng, 5, 100.0, (RADIUS_PX, RADIUS_PX))
    bare = np.arange(len(truth)) % 3 == 0
    depth = np.where(bare & (faint > 0), faint * DEPTH, DEPTH)
    film = film_of_balls((SIDE, SIDE), truth, radius, background=BACKGROUND, depth=depth, sigma_px=SIGMA_PX)
    for place in truth[~bare]:
        angle, off = rng.uniform(0, np.pi), rng.uniform(-1.5, 1.5) * RADIUS_PX
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        middle = place + off * across
        wire = strip((SIDE, SIDE), middle - 45 * along, middle + 45 * along, 1.4 * RADIUS_PX, SIGMA_PX)
        film = film * (1 - rng.uniform(0.1, 0.4) * wire)
    flat = np.zeros((0, 2)), np.zeros(0)
    noise = film_of_balls((SIDE, SIDE), *flat, background=0.0, noise_sd=BACKGROUND * DEPTH / CNR, noise_blur_px=NOISE_BLUR_PX, rng=rng)
    return film + noise, truth


def test_wires_are_no_rows_of_balls() -> None:
    found = count = wrong = 0
    for seed in range(FILMS):
        film, truth = film_with_wires(np.random.default_rng(40 + seed))
        images = detect_markers(stored(film), bits=16).images
        gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
        index, near = gap.argmin(axis=1), gap.min(axis=1) < 2.0
        false = images.position_px[gap.min(axis=0) >= 2.0]
        error = images.position_px[index[near]] - truth[near]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[index[near]], error[:, :, None])[:, :, 0])
        print(f"{near.sum()} of {len(truth)}, {len(false)} false, farthest {np.sqrt(square.max()):.1f} sd")
        assert np.sqrt(square.max()) < FAR
        found, count, wrong = found + int(near.sum()), count + len(truth), wrong + len(false)
    # of all films: of one, a ball more or less is chance
    assert found >= LEAST_FOUND * count
    assert wrong <= MOST_FALSE * FILMS


def test_faint_balls_beside_them_stay() -> None:
    film, truth = film_with_wires(np.random.default_rng(50), faint=0.4)
    found = detect_markers(stored(film), bits=16).images.position_px
    gap = np.hypot(*(truth[::3, None] - found[None]).transpose(2, 0, 1)).min(axis=1)
    assert (gap < 1.5).all(), truth[::3][gap >= 1.5]


def test_wires_alone_are_no_balls() -> None:
    """None is clear, then, beside which others could be faint: there were 30 on the films of 24 wires, and no place free of 40."""
    rng = np.random.default_rng(60)
    film = np.full((SIDE, SIDE), BACKGROUND)
    for middle, angle in zip(rng.uniform(60, SIDE - 60, (40, 2)), rng.uniform(0, np.pi, 40), strict=True):
        along = 45 * np.array([np.cos(angle), np.sin(angle)])
        film = film * (1 - rng.uniform(0.1, 0.25) * strip((SIDE, SIDE), middle - along, middle + along, 1.4 * RADIUS_PX, SIGMA_PX))
    flat = np.zeros((0, 2)), np.zeros(0)
    film = film + film_of_balls(
        (SIDE, SIDE), *flat, background=0.0, noise_sd=BACKGROUND * DEPTH / CNR, noise_blur_px=NOISE_BLUR_PX, rng=rng
    )
    images = detect_markers(stored(film), bits=16).images
    assert len(images) <= MOST_FALSE
