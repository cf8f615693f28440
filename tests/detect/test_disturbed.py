"""Wires over tees: what a fit leaves of them, as smooth as images are, tells how much of them it has taken up."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.types import Float

from .films import strip
from .test_covered import SIDE, exposed, light_past_tees, tips_of

WIRES, WIDTH_PX = 5, 3.0


def error_over_sd(wire_depth: float, seed: int) -> Float:
    """Errors of tees that have no flag, in stated standard deviations (n,); wires beside some tips take so much of the light."""
    rng = np.random.default_rng(seed)
    tips = tips_of(rng)
    light = light_past_tees(tips, np.ones(len(tips)))
    for tip in rng.permutation(tips)[:WIRES]:
        angle, middle = rng.uniform(0, np.pi), tip + rng.uniform(-12, 12, 2)
        way = 45 * np.array([np.cos(angle), np.sin(angle)])
        light *= 1 - wire_depth * strip((SIDE, SIDE), middle - way, middle + way, WIDTH_PX, 0.5)
    found = detect_markers(exposed(light, rng), bits=16).images
    gap = np.hypot(*(found.position_px[:, None] - tips).transpose(2, 0, 1))
    mine = np.flatnonzero((found.shape == "tee") & (found.flags == 0) & (gap.min(axis=1) < 6.0))
    assert len(mine) >= len(tips) - WIRES
    error = found.position_px[mine] - tips[gap[mine].argmin(axis=1)]
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[mine]), error)))


@pytest.mark.parametrize("depth", [0.0, 0.25])
def test_errors_are_stated(depth: float) -> None:
    z = np.concatenate([error_over_sd(depth, seed) for seed in range(2)])
    print(f"wires of {depth}: error / sd {np.sqrt(np.mean(z**2) / 2):.2f}, largest {z.max():.1f} of {len(z)}")
    assert z.max() < 5.0
    assert np.sqrt(np.mean(z**2) / 2) < 1.3
