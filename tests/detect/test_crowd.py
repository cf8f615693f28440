"""Trabeculae without a mark among them are no marks: what passes for balls is the end of a crowd."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.crowd import lost_in_a_crowd
from rsa_vision.detect.search.candidates import Candidates

from .films import ball_fits, stored


def trabeculae(rng: np.random.Generator) -> NDArray[np.uint16]:
    """Struts of many lengths and depths on a film of nothing else, and as much noise as hides what a mark looks like."""
    fine, strut = np.zeros((2, 1200, 1200), np.float32)
    for _ in range(1800):
        at, turn, length = rng.uniform(100, 1100, 2), rng.normal(0.8, 0.5) * rng.choice([-1, 1]), rng.uniform(8, 45)
        way = length / 2 * np.array([np.cos(turn), np.sin(turn)])
        ends = (tuple(np.rint(16 * (at + sign * way)).astype(int).tolist()) for sign in (-1, 1))
        cv2.line(strut, *ends, float(rng.uniform(0.2, 1.0)), int(rng.integers(1, 5)), cv2.LINE_AA, 4)
        (left, top), reach = np.rint(at).astype(int) - 40, 81
        around = np.s_[top : top + reach, left : left + reach]
        fine[around] += strut[around]
        strut[around] = 0.0
    clear = np.exp(-0.04 * gaussian_filter(fine, 2.2).reshape(600, 2, 600, 2).mean((1, 3)))
    return stored(30000 * clear + 150 * rng.standard_normal(clear.shape), 16)


def test_trabeculae_without_marks_are_none() -> None:
    """Of one film the number is chance: on 34 films it was 0 on 21, three and more on 6, up to 20. Without the rule, six and more."""
    found = [detect_markers(trabeculae(np.random.default_rng(seed)), bits=16).images for seed in (2, 3, 4, 5)]
    print(f"{[len(images) for images in found]} found, {sum(np.count_nonzero(images.flags == 0) for images in found)} unflagged")
    assert sum(len(images) > 2 for images in found) <= 1


def test_faint_marks_are_lost_among_texture_only() -> None:
    """Of what the model explains less closely, those that are no stronger than a crowd beyond noise; in noise there is none."""
    count, rng = 5, np.random.default_rng(0)
    places = rng.uniform(2000, 3000, (400, 2))
    balls = np.stack([np.full(count, 500.0), 100.0 * np.arange(count)], axis=1)
    own, explained = np.array([20.0, 6.5, 6.5, 5.0, 5.0]), np.array([0.9, 0.9, 0.97, 0.9, 0.99])
    fits = ball_fits(balls, 4.0, depth=own, explained=explained, significance=own)
    for texture, lost in (
        (rng.uniform(5.6, 9.0, 400), [1, 3]),
        (rng.uniform(4.0, 5.4, 400), []),
        (np.append(rng.uniform(4, 5.4, 381), [7.0] * 19), []),
    ):
        strength = np.concatenate([own, texture])
        at = np.concatenate([balls, places])
        candidates = Candidates(at, np.full(len(at), 4.4), strength, np.full(len(at), 0.8), np.zeros((0, 5)), np.zeros((0, 6)))
        assert np.flatnonzero(lost_in_a_crowd(fits, candidates)).tolist() == lost
    few = np.arange(1, 4)  # most of these are lost: that the third is explained a little more closely says nothing
    strength = np.concatenate([own[few], rng.uniform(6.6, 9.0, 400)])
    candidates = Candidates(
        np.concatenate([balls[few], places]), np.full(403, 4.4), strength, np.full(403, 0.8), np.zeros((0, 5)), np.zeros((0, 6))
    )
    assert lost_in_a_crowd(fits.rows(few), candidates).all()
