"""Films on which every ball lies over another, or touches one."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag

from .films import film_of_balls, stored
from .test_balls import nearest

SIDE, BACKGROUND, DEPTH = 260, 30000.0, 0.5


@pytest.mark.parametrize("cnr", [10.0, 30.0])
@pytest.mark.parametrize("apart", [0.5, 0.65, 0.8, 1.0])
@pytest.mark.parametrize("radius_px", [3.0, 6.0])
def test_nothing_but_pairs(radius_px: float, apart: float, cnr: float) -> None:
    z2, lost, flagged = [], 0, 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        middle = np.array([[60.0, 70.0], [190.0, 80.0], [120.0, 190.0]]) + rng.uniform(-15, 15, (3, 2))
        angle = rng.uniform(0, np.pi, 3)
        half = apart * radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        truth = np.concatenate([middle - half, middle + half])
        noise_sd, radius = DEPTH / cnr * BACKGROUND, np.full(6, radius_px)
        film = film_of_balls((SIDE, SIDE), truth, radius, background=BACKGROUND, depth=DEPTH, sigma_px=1.2, noise_sd=noise_sd, rng=rng)
        found = detect_markers(stored(film), bits=16)
        assert len(found.images) <= len(truth)
        index, gap = nearest(truth, found)
        here = gap < 1.0
        lost += np.count_nonzero(~here)
        sure = here & (found.images.flags[index] & ~MarkerFlag.OVERLAP == 0)
        flagged += np.count_nonzero(here & ~sure)
        error, covariance = found.images.position_px[index[sure]] - truth[sure], found.images.covariance_px2[index[sure]]
        z2 += np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).tolist()
    ratio = float(np.sqrt(np.mean(z2) / 2))
    print(f"radius {radius_px}, {apart} diameters, CNR {cnr}: error / sd {ratio:.2f}, {flagged} flagged, {lost} lost of 18")
    assert lost == 0
    assert flagged <= 3
    assert ratio < 1.5
