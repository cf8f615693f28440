"""Wires over balls: their ends, kinks and middles pull less, and the stated errors know of it."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.detect.neighbours.foreign import foreign, in_line
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored, strip

SIDE, SIGMA_PX, DEPTH = 760, 1.2, 0.35
FILMS = 3
BAND = (0.4, 1.5)  # of 100 balls; what lies under a ball may have any profile: statements are cautious
FLAGGED = 1 / 3  # of them, at most
FAR, MOST_FAR = 4.0, 0.06
NOISY, FAINT = 300.0, (0.008, 0.03)


def film_with_wires(rng: np.random.Generator, ends: int) -> tuple[Float, Float]:
    """Return a film of balls over each of which lies a wire, its end or kink, and the centres of the balls."""
    truth, _ = grid_of_balls(rng, 6, 115.0, (4.5, 4.5))
    film = film_of_balls((SIDE, SIDE), truth, np.full(len(truth), 4.5), depth=DEPTH, sigma_px=SIGMA_PX, noise_sd=150.0, rng=rng)
    for place in truth:
        at, angle = place + rng.uniform(-4, 4, 2), rng.uniform(0, 2 * np.pi)
        turns = {1: (0.0,), 2: (0.0, np.pi), 3: (0.0, rng.uniform(0.7, 2.4))}[ends]
        width, depth = rng.uniform(1.5, 4), np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
        wires = [strip((SIDE, SIDE), at, at + 40 * np.array([np.cos(angle + t), np.sin(angle + t)]), width, SIGMA_PX) for t in turns]
        film = film * (1 - depth * np.max(wires, axis=0))
    return film, truth


@pytest.mark.parametrize("ends", [1, 2, 3], ids=["ends", "middles", "kinks"])
def test_errors_under_wires_are_stated(ends: int) -> None:
    ratios, errors, found_of_all = [], [], 0
    for seed in range(FILMS):
        film, truth = film_with_wires(np.random.default_rng(100 * ends + seed), ends)
        images = detect_markers(stored(film), bits=16).images
        gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
        index, near = gap.argmin(axis=1), gap.min(axis=1) < 2.0
        found_of_all += int(near.sum())
        clear = near & ((images.flags[index] & MarkerFlag.POOR_FIT) == 0)
        error = images.position_px[index[clear]] - truth[clear]
        square = np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[index[clear]], error[:, :, None])[:, :, 0])
        ratios += np.sqrt(square).tolist()
        errors += np.hypot(*error.T).tolist()
    ratio, far = np.sqrt(np.mean(np.square(ratios)) / 2), np.mean(np.array(ratios) > FAR)
    print(f"{found_of_all} of {36 * FILMS}, {len(ratios)} not flagged, median error {np.median(errors):.3f} px")
    print(f"error / sd {ratio:.2f}, {far:.0%} far")
    assert found_of_all >= 0.97 * 36 * FILMS
    assert len(ratios) > (1 - FLAGGED) * 36 * FILMS
    assert BAND[0] < ratio < BAND[1]
    assert far <= MOST_FAR


def test_pulls_of_faint_wires_are_stated() -> None:
    """Of one to four standard deviations of the noise in a pixel, half as wide as the balls they touch: masks leave most of them."""
    ratios, flagged = [], []
    for seed in range(FILMS):
        rng = np.random.default_rng(seed)
        truth, _ = grid_of_balls(rng, 6, 115.0, (4.5, 4.5))
        film = film_of_balls((SIDE, SIDE), truth, np.full(len(truth), 4.5), depth=DEPTH, sigma_px=SIGMA_PX, noise_sd=NOISY, rng=rng)
        for place in truth:
            angle = rng.uniform(0, 2 * np.pi)
            along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            at = place + rng.uniform(2, 6) * across
            wire = strip((SIDE, SIDE), at - 50 * along, at + 50 * along, rng.uniform(1.5, 3), SIGMA_PX)
            film = film * (1 - np.exp(rng.uniform(*np.log(FAINT))) * wire)
        images = detect_markers(stored(film), bits=16).images
        gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
        assert (gap.min(axis=1) < 1).all()
        index = gap.argmin(axis=1)
        error = images.position_px[index] - truth
        ratios.append(np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[index], error[:, :, None])[:, :, 0]) / 2)
        flagged.append(images.flags[index] & MarkerFlag.OVERLAP > 0)
    ratio, far = np.sqrt(np.mean(ratios)), np.sqrt(2 * np.max(ratios))
    print(f"error / sd {ratio:.2f}, the largest {far:.1f}, {np.mean(flagged):.0%} flagged")
    assert 0.8 < ratio < 1.25
    assert far < FAR


def windows_with(pixels: Float, side: int = 31) -> tuple[Float, Float, np.ndarray]:
    """Return residuals of one window with something in it, their weights, and what is around a ball in the middle."""
    rng = np.random.default_rng(5)
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1)
    around = (np.hypot(cols - side // 2, rows - side // 2) > 6)[None]
    return rng.standard_normal((1, side * side)) + pixels.reshape(1, -1), np.ones((1, side * side)), around


def test_faint_lines_are_seen_by_their_mean() -> None:
    line = np.zeros((31, 31))
    line[14:17, 20:] = 3.0  # no pixel of it is beyond five standard deviations by itself
    residual, weight, around = windows_with(line)
    found = foreign(residual, weight, around, 1.0).reshape(31, 31)
    assert found[14:17, 23:29].mean() > 0.6
    assert found[line == 0].mean() < 0.03


def test_noise_and_a_background_of_another_kind_are_not_foreign() -> None:
    residual, weight, around = windows_with(np.zeros((31, 31)))
    assert not foreign(residual, weight, around, 1.0).any()
    half = np.zeros((31, 31))
    half[:, 16:] = 30.0
    residual, weight, around = windows_with(half)
    assert not foreign(residual, weight, around, 1.0).any()


def test_lines_go_on_under_the_ball_and_halos_do_not() -> None:
    found = np.zeros((31, 31), bool)
    found[14:17, 21:29] = True
    under = in_line(found.reshape(1, -1), np.array([[15.0, 15.0]]), np.array([6.0])).reshape(31, 31)
    assert under[14:17, 10:20].all()
    assert not under[:12].any()
    rows, cols = np.mgrid[0:31, 0:31]
    distance = np.hypot(cols - 15, rows - 15)
    halo = (distance > 6) & (distance < 8)
    assert not in_line(halo.reshape(1, -1), np.array([[15.0, 15.0]]), np.array([6.0])).any()
    speck = np.hypot(cols - 23, rows - 15) < 2.5
    near = in_line(speck.reshape(1, -1), np.array([[15.0, 15.0]]), np.array([6.0])).reshape(31, 31)
    assert near.sum() < 12
