"""Rigid motions: inverted exactly, mirror images never, and what does not determine one is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.rigid import fit_rigid


@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
def test_finds_the_motion_again(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(0, 20, (n, 3))
    motion, shift = Rotation.random(random_state=rng), rng.normal(0, 100, 3)
    fit = fit_rigid(source, motion.apply(source) + shift, rng.uniform(0.5, 2, n))
    assert np.degrees((Rotation.from_matrix(fit.rotation) * motion.inv()).magnitude()) < 1e-6
    assert np.abs(fit.residual_mm).max() < 1e-9
    assert np.allclose(fit.move(source), motion.apply(source) + shift)


def test_a_mirror_image_is_no_motion() -> None:
    source = np.random.default_rng(1).normal(0, 20, (5, 3))
    fit = fit_rigid(source, source * [-1, 1, 1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    assert np.abs(fit.residual_mm).max() > 1


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.eye(3)[:2], "3 points"),
        (np.outer(np.arange(4.0), [1, 2, 3]), "in line"),
        (np.zeros((3, 3)), "in line"),
        (np.full((3, 3), np.nan), "finite"),
    ],
)
def test_refuses_what_determines_no_motion(points: np.ndarray, said: str) -> None:
    with pytest.raises(GeometryError, match=said):
        fit_rigid(points, points)
