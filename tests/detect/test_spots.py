"""Focal spots that are no Gaussians: marks far above the film are drawn by them, those near it are not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers

from .films import film_of_balls, grid_of_balls, stored

BAND = (0.85, 1.15)
LINE = (np.arange(8) + 0.5) / 8 - 0.5
SPOTS = {  # points in widths of the spot, and weights
    "two peaks": ([(side, part) for side in (-0.42, 0.42) for part in LINE], [1.0] * 16),
    "uneven peaks": ([(side, part) for side in (-0.56, 0.28) for part in LINE], [1.0] * 8 + [2.0] * 8),
    "square": ([(col, row) for col in LINE[::2] + 1 / 16 for row in LINE[::2] + 1 / 16], [1.0] * 16),
}
WIDTH_PX = 5.5  # 1.6 mm, magnified as a control point of cage 2 is


def film_of_spot(name: str, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return a film, the places of its balls, and which of them are drawn by the spot, which is turned by 0.4."""
    truth, _ = grid_of_balls(rng, 7, 80.0, (4.0, 5.0))
    high = np.arange(49) % 2 == 1
    clear = film_of_balls((600, 600), truth[~high], np.full(25, 3.8), sigma_px=0.9, background=1.0, depth=0.5)
    points, weights = SPOTS[name]
    turned = WIDTH_PX * np.array(points) @ np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    for point, weight in zip(turned, weights, strict=True):
        lost = film_of_balls((600, 600), truth[high] + point, np.full(24, 5.0), sigma_px=0.9, background=1.0, depth=0.5) - 1
        clear += weight / sum(weights) * lost
    return 30000 * clear + 750 * rng.standard_normal(clear.shape), truth, high


@pytest.mark.parametrize("name", SPOTS)
def test_balls_drawn_by_a_spot_are_found_and_their_stated_errors_are_true(name: str) -> None:
    square = []
    for seed in (1, 2):
        film, truth, high = film_of_spot(name, np.random.default_rng(seed))
        found = detect_markers(stored(film), bits=16).images
        gap = np.hypot(*(truth[:, None] - found.position_px[None]).transpose(2, 0, 1))
        assert (gap.min(1) < 1.0).all(), "a ball was missed"
        assert len(found) == len(truth), "a ball was invented"
        index = gap.argmin(1)[high]
        error, covariance = found.position_px[index] - truth[high], found.covariance_px2[index]
        assert (found.flags[index] == 0).all()
        square.append(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]))
    ratio = float(np.sqrt(np.concatenate(square).mean() / 2))
    print(f"{name}: error / sd {ratio:.2f}")
    assert BAND[0] < ratio < BAND[1]


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_odd_things_that_no_spot_explains_together_are_no_balls(seed: int) -> None:
    """The end of one such rod may look pointed: among balls a pin or two are flagged."""
    rng = np.random.default_rng(seed)
    truth, _ = grid_of_balls(rng, 6, 80.0, (4.0, 5.0))
    odd = np.arange(36) % 3 == 0
    film = film_of_balls((520, 520), truth[~odd], np.full(24, 4.0), background=1.0, depth=0.5)
    for place in truth[odd]:  # rods of any direction and length
        turn, reach = rng.uniform(0, np.pi), rng.uniform(6.0, 10.0)
        along = np.linspace(-reach, reach, 9)[:, None] * np.array([np.cos(turn), np.sin(turn)])
        film += sum(film_of_balls((520, 520), (place + step)[None], np.array([3.0]), background=1.0, depth=0.15) - 1 for step in along)
    found = detect_markers(stored(30000 * film + 400 * rng.standard_normal(film.shape)), bits=16).images
    gap = np.hypot(*(truth[odd][:, None] - found.position_px).transpose(2, 0, 1))
    assert (gap.min(axis=0) > 12.0)[found.shape == "ball"].all()
    assert (gap.min(axis=0) > 12.0)[found.flags == 0].all(), "nor are they surely pins"
