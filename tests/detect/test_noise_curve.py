"""Noise under balls on a film of density: highest where the curve is steepest, at their rims, and told by what all of them leave."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import rsa_vision.detect.marks.found as found
from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored

RELATIVE = 0.04  # noise of the exposure, where that is one


def density(exposure: Float) -> Float:
    return 4095 * (0.08 + 0.84 / (1 + (0.35 / exposure) ** 2))


@pytest.mark.parametrize("blur_px", [0.0, 0.6])
def test_errors_are_as_stated_and_the_noise_as_it_is(blur_px: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blurred noise made white is less than one, which was taken for less noise under balls."""
    rng = np.random.default_rng(4)
    position, radius = grid_of_balls(rng, 8, 70.0, (5.5, 6.5))
    exposure = np.maximum(0.8 * film_of_balls((640, 640), position, radius, background=1.0, depth=0.92), 0.05)
    curves: list[NoiseModel | None] = []
    told = found.noise_by_value

    def listened(*args: Any) -> NoiseModel | None:
        curves.append(told(*args))
        return curves[-1]

    monkeypatch.setattr(found, "noise_by_value", listened)
    z2 = []
    for _ in range(2):
        noise = gaussian_filter(rng.standard_normal(exposure.shape), blur_px)
        film = stored(density(exposure + RELATIVE * np.sqrt(exposure) * noise / noise.std()), 12)
        images = detect_markers(film, bits=12).images
        assert len(images) == len(position)
        assert not images.flags.any()
        nearest = np.hypot(*(position[:, None] - images.position_px).transpose(2, 0, 1)).argmin(axis=1)
        error = position - images.position_px[nearest]
        z2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(images.covariance_px2[nearest]), error))
    ratio = float(np.sqrt(np.mean(z2) / 2))
    levels = np.linspace(0.1, 0.7, 7)
    slope = (density(levels + 1e-4) - density(levels - 1e-4)) / 2e-4
    truth = RELATIVE * np.sqrt(levels) * slope
    assert curves[-1] is not None
    stated = np.sqrt(curves[-1].variance_at(density(levels)))
    print(f"error / sd {ratio:.2f}; noise told over what it is {np.round(stated / truth, 2)}")
    assert 0.85 < ratio < 1.2
    rims = truth > truth[-1]  # middles are taken for no quieter than what is beside
    assert (np.abs(np.log(stated / truth)) < 0.3)[rims].all()
