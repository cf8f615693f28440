"""Errors of rigid motions: from covariances of the markers to those of the motion, to first order.

The errors of a motion are nine numbers: a small further rotation about the axes of the frame (rad), the translation of the centre of
gravity, and the centre of gravity itself (mm). Every result of a motion is a function of these, so every standard deviation is one product.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from rsa_vision.geometry.rigid import RigidFits
from rsa_vision.geometry.screw import SINGLE, _cross
from rsa_vision.types import Bool, Float, Int

SIGNIFICANCE: Final = 0.01  # residuals that chance exceeds less often make the stated errors larger
LOOSE: Final = 1e-14  # determinant over cubed trace: below it points in line, or half a mirror image, do not hold a rotation at all
TWO_SIDED_95: Final = 1.959964  # normal distribution


@dataclass(frozen=True, slots=True, eq=False)
class FitErrors:
    """Errors of k fits of n markers.

    Attributes
    ----------
    gain : ndarray of shape (k, n, 9, 6)
        Derivative of (rotation, centre of gravity before, centre of gravity after) by each marker before and after.
    marker_mm2 : ndarray of shape (k, n, 6, 6)
        Covariance of each marker before and after, as used.
    birge : ndarray of shape (k,)
        By how much the given standard deviations were multiplied because the residuals are larger than they explain; 1 where they are not.
    """

    gain: Float
    marker_mm2: Float
    birge: Float

    @property
    def covariance(self) -> Float:
        """Covariance of (rotation, centre of gravity before, after), shape (k, 9, 9)."""
        result: Float = (self.gain @ self.marker_mm2 @ self.gain.transpose(0, 1, 3, 2)).sum(axis=1)
        return result


def fit_errors(fits: RigidFits, source_mm2: Float, target_mm2: Float) -> FitErrors:
    """Return the errors of fits.

    Parameters
    ----------
    fits : RigidFits
        k fits of n points.
    source_mm2, target_mm2 : ndarray of shape (k, n, 3, 3)
        Covariances of the points, independent of each other. A fit with NaN in them takes its errors from its residuals instead: the same
        for all coordinates of all its points, with 3 n - 6 degrees of freedom.

    Returns
    -------
    FitErrors
        NaN where the points do not hold a rotation.

    Notes
    -----
    With the turned source p and the target y about their centres of gravity, ``B = sum y p^T``, a change of the points turns the best
    rotation by ``(tr B I - B)^-1 sum (p x dy - y x M dr)``: the derivative of its normal equations, residuals included.
    """
    turned, n = fits.turned_mm, fits.centred_mm.shape[1]
    onto = turned + fits.residual_mm
    moment = onto.transpose(0, 2, 1) @ turned
    moment = (moment + moment.transpose(0, 2, 1)) / 2
    stiffness = np.trace(moment, axis1=1, axis2=2)[:, None, None] * np.eye(3) - moment
    stiff = np.linalg.det(stiffness) > LOOSE * np.trace(stiffness, axis1=1, axis2=2) ** 3
    compliance = np.where(stiff[:, None, None], np.linalg.inv(np.where(stiff[:, None, None], stiffness, np.eye(3))), np.nan)[:, None]
    gain = np.zeros((*fits.centred_mm.shape[:2], SINGLE, 6))
    gain[..., :3, :3] = -compliance @ _cross(onto) @ fits.rotation[:, None]
    gain[..., :3, 3:] = compliance @ _cross(turned)
    gain[..., 3:6, :3] = gain[..., 6:, 3:] = np.eye(3) / n

    known: Bool = np.isfinite(np.concatenate([source_mm2, target_mm2], axis=1)).all(axis=(1, 2, 3))
    squares = (fits.residual_mm**2).sum(axis=(1, 2))
    both = np.zeros((*fits.centred_mm.shape[:2], 6, 6))
    by_residuals = squares / (3 * n - 6) / 2  # half of the variance of a difference
    both[..., :3, :3] = np.where(known[:, None, None, None], source_mm2, by_residuals[:, None, None, None] * np.eye(3))
    both[..., 3:, 3:] = np.where(known[:, None, None, None], target_mm2, by_residuals[:, None, None, None] * np.eye(3))
    birge = np.ones(len(squares))
    if known.any():
        turn = fits.rotation[known][:, None]
        expected = target_mm2[known] + turn @ source_mm2[known] @ turn.transpose(0, 1, 3, 2)
        birge[known] = _birge(turned[known], squares[known], expected)
    return FitErrors(gain, both * (birge**2)[:, None, None, None], birge)


def _birge(turned_mm: Float, squares_mm2: Float, expected_mm2: Float) -> Float:
    """Return Birge factors: residuals against the covariances of the differences, shape (k, n, 3, 3), that should explain them."""
    k, n = turned_mm.shape[:2]
    design = np.concatenate([-_cross(turned_mm), np.broadcast_to(np.eye(3), (k, n, 3, 3))], axis=3).reshape(k, 3 * n, 6)
    left = np.linalg.qr(design)[0]
    spread = np.zeros((k, n, 3, n, 3))
    for i in range(n):
        spread[:, i, :, i, :] = expected_mm2[:, i]
    remaining = spread.reshape(k, 3 * n, 3 * n)
    remaining = remaining - left @ (left.transpose(0, 2, 1) @ remaining)  # of the residuals: (I - P) S
    trace = np.trace(remaining, axis1=1, axis2=2)
    freedom = trace**2 / (remaining * remaining.transpose(0, 2, 1)).sum(axis=(1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = squares_mm2 / trace
    significant = ratio * freedom > chdtri(freedom, SIGNIFICANCE)
    result: Float = np.where(significant, np.sqrt(np.maximum(ratio, 1.0)), 1.0)
    return result


def absolute_transfer(count: int) -> Float:
    """Return the matrices, shape (count, 9, 9), from the errors of a fit to those of its absolute motion."""
    transfer = np.zeros((count, SINGLE, SINGLE))
    transfer[:, :3, :3] = transfer[:, 3:6, 6:] = transfer[:, 6:, 3:6] = np.eye(3)
    transfer[:, 3:6, 3:6] = -np.eye(3)
    return transfer


def relative_transfer(reference: Float, lever_mm: Float) -> tuple[Float, Float]:
    """Return the matrices from the errors of two fits to those of their relative motion ``M1^T M2`` (Selvik 7:9, 7:10).

    Parameters
    ----------
    reference : ndarray of shape (k, 3, 3)
        Rotation M1 of the segment that is returned to its place.
    lever_mm : ndarray of shape (k, 3)
        From its centre of gravity to that of the other segment, after the motion.

    Returns
    -------
    moved, fixed : ndarray of shape (k, 9, 9)
        For the errors of the moving and of the reference segment.
    """
    back = reference.transpose(0, 2, 1)
    moved, fixed = np.zeros((2, len(back), SINGLE, SINGLE))
    moved[:, :3, :3] = moved[:, 3:6, 6:] = back
    moved[:, 3:6, 3:6] = -np.eye(3)
    moved[:, 6:, 3:6] = np.eye(3)
    fixed[:, :3, :3] = fixed[:, 3:6, 6:] = -back
    fixed[:, 3:6, :3] = back @ _cross(lever_mm)
    fixed[:, 3:6, 3:6] = np.eye(3)
    return moved, fixed


@dataclass(frozen=True, slots=True, eq=False)
class TotalMotion:
    """Maximum total point motion (MTPM) of k segments.

    Attributes
    ----------
    marker : ndarray of int, shape (k,)
        Which one moves furthest.
    length_mm, sd_mm, low_mm, high_mm : ndarray of shape (k,)
        Its displacement, the standard deviation to first order, and an interval that holds the true one in 95 of 100 cases.
    """

    marker: Int
    length_mm: Float
    sd_mm: Float
    low_mm: Float
    high_mm: Float


def total_motion(rotation: Float, shift_mm: Float, arm_mm: Float, covariance: Float, joint: Float, marker_mm2: Float) -> TotalMotion:
    """Return which marker the fitted motion moves furthest, how far, and how sure that is.

    Parameters
    ----------
    rotation : ndarray of shape (k, 3, 3)
    shift_mm : ndarray of shape (k, 3)
        Translation of the centre of gravity.
    arm_mm : ndarray of shape (k, n, 3)
        From the centre of gravity to the markers, before the motion.
    covariance : ndarray of shape (k, 9, 9)
        Of the motion.
    joint : ndarray of shape (k, n, 9, 3)
        Covariance of the motion with each marker before it.
    marker_mm2 : ndarray of shape (k, n, 3, 3)
        Covariance of each marker before the motion.

    Returns
    -------
    TotalMotion

    Notes
    -----
    A length is never negative, so noise makes it longer. With the covariance C of the displacement, whose direction is u, its square has
    the expectation ``L^2 + tr C`` and the variance ``2 tr C^2 + 4 L^2 u^T C u``; the interval holds the true lengths L from which the
    observed one is less than 1.96 standard deviations away. It reaches down to 0 for a motion within the noise, where the standard
    deviation to first order means nothing.
    """
    every = np.arange(len(rotation))
    moved = shift_mm[:, None] + arm_mm @ (rotation - np.eye(3)).transpose(0, 2, 1)
    furthest = np.linalg.norm(moved, axis=2).argmax(axis=1)
    way, arm, joint, own = moved[every, furthest], arm_mm[every, furthest], joint[every, furthest], marker_mm2[every, furthest]
    length = np.linalg.norm(way, axis=1)
    swing = rotation - np.eye(3)
    by_motion = np.concatenate([-_cross((rotation @ arm[:, :, None])[..., 0]), np.broadcast_to(np.eye(3), swing.shape), -swing], axis=2)
    mixed = by_motion @ joint @ swing.transpose(0, 2, 1)
    spread = by_motion @ covariance @ by_motion.transpose(0, 2, 1) + mixed + mixed.transpose(0, 2, 1)
    spread = spread + swing @ own @ swing.transpose(0, 2, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = np.where(length[:, None] > 0, way / length[:, None], 0.0)
    along = np.maximum((direction * (spread @ direction[:, :, None])[..., 0]).sum(axis=1), 0.0)
    total, squares = np.trace(spread, axis1=1, axis2=2), (spread**2).sum(axis=(1, 2))
    # |s - L2| <= z sqrt(2 tr C^2 + 4 L2 v), with s = length^2 - tr C, is quadratic in L2
    centre = length**2 - total + 2 * TWO_SIDED_95**2 * along
    root = np.sqrt(np.maximum(centre**2 - ((length**2 - total) ** 2 - 2 * TWO_SIDED_95**2 * squares), 0.0))
    low, high = np.sqrt(np.maximum(centre - root, 0.0)), np.sqrt(np.maximum(centre + root, 0.0))
    return TotalMotion(furthest, length, np.sqrt(along), low, high)
