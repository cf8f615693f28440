"""Balls on arms of tees, in one beam with them: both are found, within their stated errors, and nothing besides."""

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Float

from .test_covered import ARMS, CELLS, FINE, MU_PER_MM, PITCH_MM, SIDE, exposed, light_past_tees, tips_of

RADIUS_PX = 4.5


def light_past_balls(centres: Float) -> Float:
    """Light that comes past balls, exact chords, those of pixels already averaged."""
    clear, half = np.ones((SIDE, SIDE)), int(RADIUS_PX) + 2
    line = (np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5
    for centre in centres:
        corner = np.rint(centre).astype(int) - half
        x, y = (line + first - at for first, at in zip(corner, centre, strict=True))
        chord = 2 * PITCH_MM * np.sqrt(np.maximum(RADIUS_PX**2 - x**2 - y[:, None] ** 2, 0))
        light = np.exp(-MU_PER_MM * chord).reshape(2 * half + 1, FINE, 2 * half + 1, FINE).mean((1, 3))
        clear[corner[1] : corner[1] + 2 * half + 1, corner[0] : corner[0] + 2 * half + 1] *= light
    return clear


@pytest.mark.parametrize("across", [0.0, -5.0])
def test_on_arms(across: float) -> None:
    """At 8 to 18 px from the tip, so many pixels beside the middle of the arm."""
    rng = np.random.default_rng(round(10 * across) + 100)
    tips = tips_of(rng)
    covered, along, turn = np.array([1, 4, 6, 9, 11, 14]), np.array([8.0, 10, 12, 14, 16, 18]), np.tile(ARMS[:2], 3)
    way, beside = np.stack([np.cos(turn), -np.sin(turn)], axis=1), np.stack([np.sin(turn), np.cos(turn)], axis=1)
    on_arms = tips[covered] + along[:, None] * way + across * beside
    between = np.stack(np.meshgrid(*[(np.arange(CELLS - 1) + 1) * SIDE / CELLS] * 2), axis=-1).reshape(-1, 2) + rng.uniform(-2, 2, (9, 2))
    balls = np.concatenate([between, on_arms])
    film = exposed(light_past_tees(tips, np.ones(len(tips))) * light_past_balls(balls), rng)
    found = detect_markers(film, bits=16).images
    for shape, places in (("tee", tips), ("ball", balls)):
        of = found.rows(found.shape == shape)
        gap = np.hypot(*(of.position_px[:, None] - places).transpose(2, 0, 1))
        nearest = gap.argmin(axis=1)
        print(shape, len(of.shape), "of", len(places), "errors", gap.min(axis=0).round(3))
        assert len(set(nearest)) == len(of.shape)
        assert len(of.shape) >= len(places) - (shape == "ball")
        apart = of.position_px - places[nearest]
        z2 = np.einsum("ni,ni->n", apart, np.linalg.solve(of.covariance_px2, apart[:, :, None])[:, :, 0])
        assert (z2 < 13.8).all()  # of chi2 with two degrees of freedom one in a thousand is more
        clear = of.flags & ~(MarkerFlag.OVERLAP | MarkerFlag.SATURATED) == 0
        assert np.hypot(*apart[clear].T).max() < 0.3
        if shape == "ball":
            assert (of.flags[nearest >= len(between)] & MarkerFlag.OVERLAP).all()
