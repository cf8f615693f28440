"""Rigid motion between two sets of points that correspond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.types import Float

LEAST_POINTS = 3
COLLINEAR = 1e-6  # second over first singular value of the centred points: below it, the rotation about their line is not determined


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """The motion ``target = rotation @ source + translation`` that fits best.

    Attributes
    ----------
    rotation : ndarray of shape (3, 3)
        Proper (determinant +1).
    translation : ndarray of shape (3,)
        Of the origin, mm.
    residual_mm : ndarray of shape (n, 3)
        Target minus moved source.
    """

    rotation: Float
    translation: Float
    residual_mm: Float

    def move(self, points_mm: Float) -> Float:
        """Return points, shape (..., 3), after the motion."""
        moved: Float = points_mm @ self.rotation.T + self.translation
        return moved


def fit_rigid(source_mm: Float, target_mm: Float, weights: Float | None = None) -> RigidFit:
    """Fit a rigid motion by least squares: minimise ``sum w |target - (M source + d)|^2``.

    Parameters
    ----------
    source_mm, target_mm : ndarray of shape (n, 3)
        At least three points that are not in line.
    weights : ndarray of shape (n,), optional
        Of the squared distances; equal by default.

    Returns
    -------
    RigidFit

    Raises
    ------
    GeometryError
        With fewer than three points, points in line, or coordinates that are not finite.

    Notes
    -----
    Solution by singular values with determinant +1 (Soderkvist and Wedin 1993), so that a mirror image is never a motion.
    """
    w = np.ones(len(source_mm)) if weights is None else np.asarray(weights, np.float64)
    if len(source_mm) < LEAST_POINTS:
        raise GeometryError(f"a rigid motion needs {LEAST_POINTS} points, got {len(source_mm)}")
    if not (np.isfinite(source_mm).all() and np.isfinite(target_mm).all()):
        raise GeometryError("a rigid motion needs finite coordinates")
    middle, onto = w @ source_mm / w.sum(), w @ target_mm / w.sum()
    centred, moved = source_mm - middle, target_mm - onto
    for points in (centred, moved):
        spread = np.linalg.svd(points * np.sqrt(w)[:, None], compute_uv=False)
        if not spread[1] > COLLINEAR * spread[0]:
            raise GeometryError("the points lie in line: the rotation about it is not determined")
    left, _, right = np.linalg.svd(moved.T @ (w[:, None] * centred))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    translation = onto - rotation @ middle
    return RigidFit(rotation, translation, target_mm - (source_mm @ rotation.T + translation))
