"""A rigid body among points: which of its markers are which points, at which pose, and how likely that is.

The likelihood of an assignment is integrated over all poses (Laplace's approximation about the best one), so that what a pose can be made
to fit by chance is counted against it, and over how far the stated errors may be too small. Mirror images are no poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import logsumexp

from rsa_vision.geometry.rigid import COLLINEAR, LEAST_POINTS, fit_rigid_many
from rsa_vision.types import Float, Int, Table

TOLERANCE_MM: Final = 0.05  # sd of a coordinate beyond the stated errors: bone is alive, markers are not exactly where they were
STILL_MM: Final = 0.01  # and of markers that have not moved at all
SCALES: Final = (1.0, 1.0, 2.0, 4.0)  # stated errors may be that much too small,
BEYOND_MM: Final = (STILL_MM, TOLERANCE_MM, TOLERANCE_MM, TOLERANCE_MM)  # with as much beyond them,
ERROR_PRIOR: Final = (0.5, 0.45, 0.045, 0.005)  # and so likely before the residuals are seen
USUAL: Final = 1  # the errors to which residuals are compared; poses are told with these or larger ones, never with those of the still
GATE: Final = 4.5  # sd within which a distance, or a marker from its predicted place, may belong
GATE_SCALE: Final = 2.0  # with the errors so much larger than stated
ROTATION_RAD: Final = 1.0  # sd to which an undetermined rotation is known

Pairs = tuple[tuple[int, int], ...]
"""Marker and point, by rising marker; every marker and every point once at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud(Table):
    """Points with their errors: positions of shape (n, 3), mm, and covariances of shape (n, 3, 3), mm²."""

    position_mm: Float
    covariance_mm2: Float

    @classmethod
    def exact(cls, position_mm: Float) -> Cloud:
        """Return points without errors of their own."""
        return cls.independent(position_mm, None)

    @classmethod
    def independent(cls, position_mm: Float, sd_mm: Float | None) -> Cloud:
        """Return points whose coordinates, shape (n, 3), have independent errors of these standard deviations, or none."""
        points = np.asarray(position_mm, np.float64).reshape(-1, 3)
        sd = np.zeros_like(points) if sd_mm is None else np.asarray(sd_mm, np.float64).reshape(-1, 3)
        return cls(points, sd[:, :, None] ** 2 * np.eye(3))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The pose of a body by some of its markers: ``point = rotation @ marker + translation``.

    Attributes
    ----------
    rotation : ndarray of shape (3, 3)
    translation : ndarray of shape (3,)
    centre_mm : ndarray of shape (3,)
        Mean of the body's markers used, after the motion.
    covariance : ndarray of shape (6, 6)
        Of a small rotation vector about `centre_mm` (rad) and of the shift (mm).
    log_likelihood : float
        Logarithm of the density of the points, 1/mm³ each, times mm³ rad³ of pose: integrated over poses that are all equally likely.
    sigmas : ndarray of shape (k,)
        Residual of every marker in units of its sd by the stated errors and the tolerance (root of a third of the squared length).
    """

    rotation: Float
    translation: Float
    centre_mm: Float
    covariance: Float
    log_likelihood: float
    sigmas: Float

    def predict(self, marker_mm: Float) -> tuple[Float, Float]:
        """Return where markers, shape (n, 3), are at this pose, and the covariance that the pose gives them, shape (n, 3, 3)."""
        moved = marker_mm @ self.rotation.T + self.translation
        jacobian = pose_jacobian(moved - self.centre_mm)
        return moved, jacobian @ self.covariance @ jacobian.swapaxes(-1, -2)


def pose_jacobian(arm_mm: Float) -> Float:
    """Return the derivative, shape (n, 3, 6), of moved points by rotation vector and shift; `arm_mm` (n, 3) from the centre of rotation."""
    x, y, z = np.moveaxis(arm_mm, -1, 0)
    zero = np.zeros_like(x)
    turn = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1), np.stack([y, -x, zero], -1)], -2)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=-1)


def place(body: Cloud, points: Cloud, pairs: Pairs) -> Placement | None:
    """Fit the pose of a body to the points of some of its markers.

    Parameters
    ----------
    body, points : Cloud
    pairs : tuple of (marker, point)
        Three or more.

    Returns
    -------
    Placement or None
        None where the markers lie in line.

    Notes
    -----
    Least squares weighted by the covariances of both sides and :data:`TOLERANCE_MM`, linearised about the unweighted solution. With
    residuals r, covariances S and derivatives J by the pose, ``log ∫ ∏ N(r; S) dθ = Σ log N(r̂; S) + 3 log 2π − ½ log |JᵀS⁻¹J|``, summed
    over what errors may be (:data:`SCALES`, :data:`BEYOND_MM`): three markers that agree to their errors are more than four that agree to
    the tolerance.
    """
    marks, hits = np.array(pairs).T
    return place_many(body, points, marks[None], hits[None])[0]


def place_many(body: Cloud, points: Cloud, marks: Int, hits: Int) -> list[Placement | None]:
    """Fit many poses at once, as :func:`place` does: that of markers ``marks[t]`` at points ``hits[t]``, both of shape (t, k)."""
    source, target = body.position_mm[marks], points.position_mm[hits]  # (t, k, 3)
    fixed = np.minimum(_breadth(source), _breadth(target)) > COLLINEAR
    start = fit_rigid_many(source, target)
    rotation, residual, centre = start.rotation, start.residual_mm, start.target_cog_mm
    jacobian = pose_jacobian(start.turned_mm)
    stated = points.covariance_mm2[hits] + rotation[:, None] @ body.covariance_mm2[marks] @ rotation[:, None].swapaxes(-1, -2)
    scales, beyond_mm = np.array(SCALES)[:, None, None], np.array(BEYOND_MM)[:, None, None]
    every = scales**2 * stated[:, :, None] + beyond_mm**2 * np.eye(3)  # (t, k, s, 3, 3)
    weight = np.linalg.inv(every)
    by_pose = weight @ jacobian[:, :, None]  # (t, k, s, 3, 6)
    normal = (jacobian[:, :, None].swapaxes(-1, -2) @ by_pose).sum(axis=1) + np.diag([ROTATION_RAD**-2] * 3 + [0.0] * 3)  # (t, s, 6, 6)
    covariance = np.linalg.inv(normal)
    slope = (by_pose.swapaxes(-1, -2) @ residual[:, :, None, :, None]).sum(axis=1)  # (t, s, 6, 1)
    step = (covariance @ slope)[..., 0]
    left = residual[:, :, None] - (jacobian[:, :, None] @ step[:, None, ..., None])[..., 0]  # (t, k, s, 3)
    squares = (left[..., None, :] @ weight @ left[..., None])[..., 0, 0]
    density = -0.5 * squares - 1.5 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(every)[1]
    log_likelihood = density.sum(axis=1) + 3 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(normal)[1]  # (t, s)
    total = logsumexp(log_likelihood, axis=1, b=ERROR_PRIOR)
    best = USUAL + np.argmax((log_likelihood + np.log(ERROR_PRIOR))[:, USUAL:], axis=1)
    leverage = np.trace(by_pose[:, :, USUAL] @ covariance[:, None, USUAL] @ jacobian.swapaxes(-1, -2), axis1=-2, axis2=-1) / 3
    sigmas = np.sqrt(squares[:, :, USUAL] / 3 / np.maximum(1 - leverage, 1 / marks.shape[1]))
    one = np.arange(len(marks))
    step, covariance = step[one, best], covariance[one, best]
    turn = rotation_by(step[:, :3])
    rotation, moved = turn @ rotation, centre + step[:, 3:]
    translation = moved - (rotation @ start.source_cog_mm[..., None])[..., 0]
    values = zip(rotation, translation, moved, covariance, total.tolist(), sigmas, strict=True)
    return [Placement(*value) if is_fixed else None for value, is_fixed in zip(values, fixed.tolist(), strict=True)]


def _breadth(points_mm: Float) -> Float:
    """Return how broad sets of points are for their length; 0 where they lie in line."""
    spread = np.linalg.svd(points_mm - points_mm.mean(axis=1, keepdims=True), compute_uv=False)
    result: Float = spread[:, 1] / np.maximum(spread[:, 0], 1e-300)
    return result


def volume_mm3(points: Cloud) -> float:
    """Return the volume that points fill: of the ellipsoid with their second moments, no axis much shorter than the others."""
    if len(points) < LEAST_POINTS:
        return 1.0
    axes = np.linalg.eigvalsh(np.cov(points.position_mm.T))
    return float(4 / 3 * np.pi * np.prod(np.sqrt(5 * np.maximum(axes, axes.mean() / 2) + 1.0)))


def rotation_by(vector: Float) -> Float:
    """Return the matrices, shape (..., 3, 3), of rotation vectors, shape (..., 3) (Rodrigues)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    k = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    result: Float = np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * k @ k
    return result


def distances(cloud: Cloud) -> tuple[Float, Float]:
    """Return the distances between all points, shape (n, n), and their variances by the points' own errors."""
    difference = cloud.position_mm[:, None] - cloud.position_mm[None]
    length = np.linalg.norm(difference, axis=-1)
    unit = difference / np.maximum(length, 1e-9)[..., None]
    both = cloud.covariance_mm2[:, None] + cloud.covariance_mm2[None]
    return length, np.einsum("abi,abij,abj->ab", unit, both, unit)


def nearness(body: Cloud, points: Cloud, placement: Placement) -> Float:
    """Return how far points are from where a pose puts markers, shape (n, m), in units of their sd (errors as in :data:`GATE_SCALE`)."""
    moved, by_pose = placement.predict(body.position_mm)
    own = placement.rotation @ body.covariance_mm2 @ placement.rotation.T
    covariance = GATE_SCALE**2 * (own[:, None] + points.covariance_mm2) + by_pose[:, None] + TOLERANCE_MM**2 * np.eye(3)
    difference = points.position_mm - moved[:, None]
    squares = (difference * np.linalg.solve(covariance, difference[..., None])[..., 0]).sum(-1)
    result: Float = np.sqrt(squares)
    return result
