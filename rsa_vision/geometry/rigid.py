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
    rotation, _, _ = best_rotation(moved.T @ (w[:, None] * centred))
    translation = onto - rotation @ middle
    return RigidFit(rotation, translation, target_mm - (source_mm @ rotation.T + translation))


def best_rotation(cross: Float) -> tuple[Float, Float, Float]:
    """Return the proper rotations that maximise ``trace(rotation.T @ cross)``.

    Parameters
    ----------
    cross : ndarray of shape (..., 3, 3)
        Sum of ``target @ source.T`` of the centred points.

    Returns
    -------
    rotation : ndarray of shape (..., 3, 3)
    singular : ndarray of shape (..., 3)
        Singular values of `cross`, falling.
    handedness : ndarray of shape (...,)
        -1 where a mirror image would fit better, else 1.
    """
    left, singular, right = np.linalg.svd(cross)
    handedness = np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)
    turned = left.copy()
    turned[..., :, 2] *= handedness[..., None]
    return turned @ right, singular, handedness


@dataclass(frozen=True, slots=True, eq=False)
class RigidFits:
    """Rigid motions of k bodies of n points each.

    Attributes
    ----------
    rotation : ndarray of shape (k, 3, 3)
    source_cog_mm, target_cog_mm : ndarray of shape (k, 3)
        Centres of gravity of the points before and after the motion.
    centred_mm : ndarray of shape (k, n, 3)
        The source about its centre of gravity.
    residual_mm : ndarray of shape (k, n, 3)
        Target minus moved source.
    mirror_gain_mm2 : ndarray of shape (k,)
        By how much the sum of squared residuals would fall for a mirror image; 0 where it would not.
    """

    rotation: Float
    source_cog_mm: Float
    target_cog_mm: Float
    centred_mm: Float
    residual_mm: Float
    mirror_gain_mm2: Float

    @property
    def turned_mm(self) -> Float:
        """The centred source after the rotation, shape (k, n, 3)."""
        result: Float = self.centred_mm @ self.rotation.transpose(0, 2, 1)
        return result


def fit_rigid_many(source_mm: Float, target_mm: Float) -> RigidFits:
    """Fit many rigid motions at once: each minimises ``sum |target - (M source + d)|^2``.

    Parameters
    ----------
    source_mm, target_mm : ndarray of shape (k, n, 3)
        Finite; whether the points determine a motion is told by :func:`line_spread`.

    Returns
    -------
    RigidFits
    """
    source_cog, target_cog = source_mm.mean(axis=1), target_mm.mean(axis=1)
    centred, onto = source_mm - source_cog[:, None], target_mm - target_cog[:, None]
    rotation, singular, handedness = best_rotation(onto.transpose(0, 2, 1) @ centred)
    residual = onto - centred @ rotation.transpose(0, 2, 1)
    return RigidFits(rotation, source_cog, target_cog, centred, residual, np.where(handedness < 0, 4 * singular[:, 2], 0.0))


def line_spread(points_mm: Float) -> tuple[Float, Float]:
    """Return how far points spread along, and about, the line that fits them best.

    Parameters
    ----------
    points_mm : ndarray of shape (k, n, 3)

    Returns
    -------
    along_mm, about_mm : ndarray of shape (k,)
        Roots of the sums of squared distances from the centre of gravity along the line, and from the line. The *condition number* of a
        segment is ``1 / about`` (Soderkvist and Wedin 1993), usually in 1/m.
    """
    centred = points_mm - points_mm.mean(axis=1, keepdims=True)
    singular = np.linalg.svd(centred, compute_uv=False)
    return singular[:, 0], np.hypot(singular[:, 1], singular[:, 2])
