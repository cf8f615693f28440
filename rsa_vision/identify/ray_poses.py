"""A rigid body's pose by points and by single rays of its markers, and how far rays pass markers at a pose."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import logsumexp

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.poses import (
    BEYOND_MM,
    ERROR_PRIOR,
    GATE_SCALE,
    ROTATION_RAD,
    SCALES,
    TOLERANCE_MM,
    USUAL,
    Cloud,
    Pairs,
    Placement,
    pose_jacobian,
    rotation_by,
)
from rsa_vision.types import Float

STEPS: Final = 6


def place_with_rays(
    body: Cloud, points: Cloud, pairs: Pairs, rays: RayBundle, sights: Pairs, rotation: Float, translation: Float
) -> Placement | None:
    """Fit the pose of a body to points and rays of its markers.

    Parameters
    ----------
    body, points : Cloud
    pairs : tuple of (marker, point)
    rays : RayBundle
    sights : tuple of (marker, ray)
    rotation, translation : ndarray of shape (3, 3) and (3,)
        To begin with.

    Returns
    -------
    Placement or None
        Its ``sigmas`` are of `pairs`, then of `sights`. None where the iteration does not settle.

    Notes
    -----
    Gauss and Newton's method on ``Σ rᵀ S⁻¹ r``: r the difference of point and marker, or its two components across the ray.
    """
    mine = np.array([i for i, _ in (*pairs, *sights)])
    theirs, seen = [a for _, a in pairs], [r for _, r in sights]
    across = _across(rays.direction[seen])
    length = np.linalg.norm(rays.origin_mm - rays.through_mm, axis=1)[seen]
    for _ in range(STEPS):
        moved = body.position_mm[mine] @ rotation.T + translation
        centre = np.asarray(moved.mean(axis=0), np.float64)
        jacobian = pose_jacobian(moved - centre)
        own = rotation @ body.covariance_mm2[mine] @ rotation.T
        k = len(pairs)
        target = rays.through_mm[seen]
        up = ((moved[k:] - target) * -rays.direction[seen]).sum(-1) / length
        at_ray = _ray_covariance(rays.covariance_mm2[seen], up)
        residual = [*(points.position_mm[theirs] - moved[:k]), *np.einsum("nij,nj->ni", across, target - moved[k:])]
        design = [*jacobian[:k], *(across @ jacobian[k:])]
        stated = [*(points.covariance_mm2[theirs] + own[:k]), *(across @ (at_ray + own[k:]) @ across.swapaxes(1, 2))]
        step, _, _, _ = _solved(residual, design, stated, 1.0, TOLERANCE_MM)
        turn = rotation_by(step[:3])
        rotation, translation = turn @ rotation, np.asarray(turn @ (translation - centre) + centre + step[3:], np.float64)
        if np.linalg.norm(step) < 1e-6:
            break
        if not np.linalg.norm(step[:3]) < 1.0:
            return None
    solved = [_solved(residual, design, stated, *errors) for errors in zip(SCALES, BEYOND_MM, strict=True)]
    log_likelihood = np.array([density + 3 * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(normal)[1] for _, normal, density, _ in solved])
    best = USUAL + int(np.argmax((log_likelihood + np.log(ERROR_PRIOR))[USUAL:]))
    total = float(logsumexp(log_likelihood, b=ERROR_PRIOR))
    covariance = np.asarray(np.linalg.inv(solved[best][1]), np.float64)
    return Placement(rotation, translation, centre, covariance, total, solved[USUAL][3])


def off_rays(body: Cloud, rays: RayBundle, placement: Placement) -> tuple[Float, Float]:
    """Return how far rays pass markers at a pose, shape (n, r), in units of sd, and the log density (1/mm²) of passing like that."""
    moved, by_pose = placement.predict(body.position_mm)
    own = placement.rotation @ body.covariance_mm2 @ placement.rotation.T
    across = _across(rays.direction)  # (r, 2, 3)
    offset = np.einsum("rij,nrj->nri", across, rays.through_mm - moved[:, None])
    length = np.linalg.norm(rays.origin_mm - rays.through_mm, axis=1)
    up = ((moved[:, None] - rays.through_mm) * -rays.direction).sum(-1) / length
    at_ray = np.stack([_ray_covariance(rays.covariance_mm2, row) for row in up])
    stated = GATE_SCALE**2 * (at_ray + own[:, None]) + by_pose[:, None] + TOLERANCE_MM**2 * np.eye(3)
    covariance = across @ stated @ across.swapaxes(-1, -2)
    squares = (offset * np.linalg.solve(covariance, offset[..., None])[..., 0]).sum(-1)
    away: Float = np.sqrt(squares)
    return away, -0.5 * squares - np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(covariance)[1]


def _ray_covariance(covariance: Float, up: Float) -> Float:
    """Return the covariance of places on rays, a fraction of the way up from the plane to the focus; shapes (n, 6, 6), (n,)."""
    lever = np.concatenate([(1 - up)[:, None, None] * np.eye(3), up[:, None, None] * np.eye(3)], axis=2)
    result: Float = lever @ covariance @ lever.swapaxes(1, 2)
    return result


def _across(direction: Float) -> Float:
    """Return two unit vectors perpendicular to each direction, shape (n, 2, 3)."""
    helper = np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]) if len(direction) else np.zeros((0, 3))
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=1)


def _solved(
    residual: list[Float], design: list[Float], stated: list[Float], scale: float, beyond_mm: float
) -> tuple[Float, Float, float, Float]:
    """Return the step, the normal matrix, the log density after it, and the residuals in units of their sd."""
    normal = np.diag([ROTATION_RAD**-2 * 1e-3] * 3 + [0.0] * 3)
    right = np.zeros(6)
    weights = [np.linalg.inv(scale**2 * s + beyond_mm**2 * np.eye(len(s))) for s in stated]
    for r, d, w in zip(residual, design, weights, strict=True):
        normal += d.T @ w @ d
        right += d.T @ w @ r
    step = np.asarray(np.linalg.solve(normal, right), np.float64)
    left = [r - d @ step for r, d in zip(residual, design, strict=True)]
    squares = np.array([r @ w @ r for r, w in zip(left, weights, strict=True)])
    density = sum(
        -0.5 * q - 0.5 * len(r) * np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(w)[1] for q, r, w in zip(squares, left, weights, strict=True)
    )
    size = np.array([len(r) for r in left], np.float64)
    return step, normal, float(density), np.asarray(np.sqrt(squares / size), np.float64)
