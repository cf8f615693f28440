"""Trabeculae without a mark among them are no marks: what passes for balls is the end of a crowd."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers

from .films import stored


def trabeculae(rng: np.random.Generator) -> NDArray[np.uint16]:
    """Struts of many lengths and depths on a film of nothing else, and as much noise as hides what a mark looks like."""
    fine = np.zeros((1200, 1200), np.float32)
    for _ in range(1800):
        at, turn, length = rng.uniform(100, 1100, 2), rng.normal(0.8, 0.5) * rng.choice([-1, 1]), rng.uniform(8, 45)
        way = length / 2 * np.array([np.cos(turn), np.sin(turn)])
        ends = (tuple(np.rint(16 * (at + sign * way)).astype(int).tolist()) for sign in (-1, 1))
        strut = np.zeros_like(fine)
        cv2.line(strut, *ends, float(rng.uniform(0.2, 1.0)), int(rng.integers(1, 5)), cv2.LINE_AA, 4)
        fine += strut
    clear = np.exp(-0.04 * gaussian_filter(fine, 2.2).reshape(600, 2, 600, 2).mean((1, 3)))
    return stored(30000 * clear + 150 * rng.standard_normal(clear.shape), 16)


def test_trabeculae_without_marks_are_none() -> None:
    """Of one film the number is chance: of seeds 2 and 4 it was seven and nine, later none and one, and eight of all five."""
    found = [detect_markers(trabeculae(np.random.default_rng(seed)), bits=16).images for seed in range(5)]
    print(f"{[len(images) for images in found]} found, {sum(np.count_nonzero(images.flags == 0) for images in found)} unflagged")
    assert sum(map(len, found)) <= 7
    assert sum(np.count_nonzero(images.shape == "pin") for images in found) <= 4
