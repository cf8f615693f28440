"""What may pass for a tee, and what may not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsa_vision.detect import tees
from rsa_vision.detect.needle_images import NeedleFit, NeedleShape
from rsa_vision.detect.noise import estimate_noise
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.tees import find_tees, is_tee


def test_arms_of_a_few_pixels_are_no_tee() -> None:
    quarter = np.pi / 2
    shape = NeedleShape(2.0, 16.0)
    fit = NeedleFit(
        np.zeros(2), np.array([0.0, quarter, -quarter]), shape, np.full(3, -900.0), -900.0, 4e4, np.eye(2) * 1e-4, 190, 1.0, 1.0, 0.98, 1.0,
        0.0, 80.0, True,
    )  # fmt: skip
    assert is_tee(fit)
    assert not is_tee(replace(fit, n_core=10))  # within a ball three short arms explain all of their ten pixels
    assert not is_tee(replace(fit, shape=NeedleShape(1.6, 5.2)))


def test_nothing_left_of_what_looked_like_tees_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    film = np.full((300, 300), 1000, np.uint16)
    model = NeedleFit(
        np.array([150.0, 150]), np.array([0.0, 1.5, -1.5]), NeedleShape(2.0, 16.0), np.full(3, -90.0), -90.0, 1e3, np.eye(2), 190, 1.0, 1.0,
        0.98, 1.0, 0.0, 80.0, True,
    )  # fmt: skip
    monkeypatch.setattr(tees, "_models", lambda *_: [model])
    monkeypatch.setattr(tees, "_like", lambda *_: [])
    optics = Optics(1.0, 0.5)
    assert find_tees(film, np.zeros((1, 5)), np.zeros((0, 6)), optics, estimate_noise(film, 16)) == ([], [], optics)
