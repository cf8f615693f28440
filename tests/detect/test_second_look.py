"""Balls that only a second look finds: half out of the rim of something as dense as they are."""

import numpy as np
import pytest

from rsa_vision.detect import detect_markers

from .films import film_of_balls, grid_of_balls, stored, strip

SIDE, RADIUS_PX, SIGMA_PX, DEPTH = 400, 4.0, 1.0, 0.9


@pytest.mark.parametrize("beyond", [0.1, 0.3, 0.8])
def test_balls_half_out_of_an_implant(beyond: float) -> None:
    rng = np.random.default_rng(round(10 * beyond))
    alone, _ = grid_of_balls(rng, 3, 50.0, (RADIUS_PX, RADIUS_PX))
    begin, end, width = np.array([280.0, -20.0]), np.array([300.0, SIDE + 20.0]), 60.0
    along = (end - begin) / np.hypot(*(end - begin))
    rims = begin + np.outer([90.0, 170, 250, 330], along) - (width / 2 + beyond * RADIUS_PX) * np.array([along[1], -along[0]])
    places = np.concatenate([alone, rims])
    balls = film_of_balls((SIDE, SIDE), places, np.full(len(places), RADIUS_PX), depth=DEPTH, sigma_px=SIGMA_PX)
    film = balls * (1 - DEPTH * strip((SIDE, SIDE), begin, end, width, SIGMA_PX))
    found = detect_markers(stored(film + rng.normal(0, 600, film.shape)), bits=16).images
    gap = np.hypot(*(found.position_px[:, None] - places).transpose(2, 0, 1))
    assert found.shape.tolist() == ["ball"] * len(places)
    assert sorted(gap.argmin(axis=1)) == list(range(len(places)))
    for k, of in enumerate(gap.argmin(axis=1)):
        error = found.position_px[k] - places[of]
        print(of, error.round(2), np.sqrt(np.diag(found.covariance_px2[k])).round(2))
        assert (
            error @ np.linalg.solve(found.covariance_px2[k], error) < 13.8
        )  # of chi2 with two degrees of freedom one in a thousand is more
