"""Projective transformation from the film to a plane of fiducial marks (Selvik 1989, eq. 2:1), with its derivatives."""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.types import Float

MIN_POINTS: Final = 4
IN_LINE: Final = 1e-6  # distance from a line, as a fraction of the extent, below which a point counts as lying on it
MAX_ITERATIONS: Final = 100
STEP_TOLERANCE: Final = 1e-13  # of the normalised parameters, which are of order 1


def apply_homography(plane_from_film: Float, film_px: Float) -> Float:
    """Transform points projectively (2:1).

    Parameters
    ----------
    plane_from_film : ndarray of shape (3, 3)
    film_px : ndarray of shape (..., 2)

    Returns
    -------
    ndarray of shape (..., 2)
        Infinite or NaN for points on the transformation's horizon.
    """
    homogeneous = film_px @ plane_from_film[:, :2].T + plane_from_film[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        result: Float = homogeneous[..., :2] / homogeneous[..., 2:]
    return result


def homography_jacobians(plane_from_film: Float, film_px: Float) -> tuple[Float, Float]:
    """Derivatives of the transformed points.

    Parameters
    ----------
    plane_from_film : ndarray of shape (3, 3)
        Last element 1.
    film_px : ndarray of shape (n, 2)

    Returns
    -------
    by_point : ndarray of shape (n, 2, 2)
        Derivative by the film coordinates.
    by_parameter : ndarray of shape (n, 2, 8)
        Derivative by the first eight elements of the matrix, row by row.
    """
    film = np.column_stack([film_px, np.ones(len(film_px))])
    denominator = (film @ plane_from_film[2])[:, None]
    plane = film @ plane_from_film[:2].T / denominator
    by_point = (plane_from_film[None, :2, :2] - plane[:, :, None] * plane_from_film[None, None, 2, :2]) / denominator[:, :, None]
    scaled = film / denominator
    by_parameter = np.zeros((len(film), 2, 8))
    by_parameter[:, 0, 0:3] = scaled
    by_parameter[:, 1, 3:6] = scaled
    by_parameter[:, :, 6:8] = -plane[:, :, None] * scaled[:, None, :2]
    return by_point, by_parameter


def fit_homography(film_px: Float, plane_mm: Float) -> Float:
    """Fit the projective transformation with the least sum of squared distances in the plane (Selvik 1989, ch. 2, step 1).

    The given plane coordinates count as exact and all marks weigh the same, as in X-RAY; the start is the normalised direct linear
    transformation, the minimum is found by Levenberg's and Marquardt's method. An affine deformation of the film, its mirror image
    included, is absorbed exactly.

    Parameters
    ----------
    film_px : ndarray of shape (n, 2)
        In any units: they are absorbed.
    plane_mm : ndarray of shape (n, 2)

    Returns
    -------
    ndarray of shape (3, 3)
        Last element 1.

    Raises
    ------
    GeometryError
        For fewer than four points, all but one in line, coincident or not finite, and for points between which the transformation's
        horizon passes (marks named wrongly).
    """
    if len(film_px) < MIN_POINTS:
        raise GeometryError(f"{len(film_px)} fiducial marks, at least {MIN_POINTS} are needed: measure more of them")
    _require_general_position(plane_mm, "in the cage")
    _require_general_position(film_px, "on the film")
    to_film, film = _normalise(film_px)
    to_plane, plane = _normalise(plane_mm)
    matrix = _refine(_direct_linear_transformation(film, plane), film, plane)
    matrix = np.asarray(np.linalg.solve(to_plane, matrix @ to_film), dtype=np.float64)
    denominator = np.column_stack([film_px, np.ones(len(film_px))]) @ matrix[2]
    if not np.all(denominator > 0) and not np.all(denominator < 0):
        raise GeometryError("the fiducial marks do not lie on the film as they do in the cage: look for a mark with a wrong number")
    if abs(matrix[2, 2]) < np.abs(denominator).max() * 1e-9:
        raise GeometryError("the origin of the film coordinates lies on the horizon of the fiducial plane: shift the coordinates")
    result: Float = matrix / matrix[2, 2]
    return result


def parameter_gain(by_parameter: Float) -> Float:
    """Change of the fitted parameters for a change of the given plane coordinates (pseudo-inverse of the design matrix).

    A change of the film coordinates acts through the plane with the opposite sign. Terms of the order of residual over extent of the
    cage are left out.

    Parameters
    ----------
    by_parameter : ndarray of shape (n, 2, 8)
        As of :func:`homography_jacobians` at the marks of the fit.

    Returns
    -------
    ndarray of shape (8, 2 n)
    """
    design = by_parameter.reshape(-1, 8)
    scale = np.linalg.norm(design, axis=0)  # pixels and their products differ by orders of magnitude
    gain: Float = np.linalg.pinv(design / scale) / scale[:, None]
    return gain


def _require_general_position(points: Float, where: str) -> None:
    """Raise unless four of the points have no three in line, i.e. every line through two leaves out two others."""
    if not np.isfinite(points).all():
        raise GeometryError(f"fiducial marks {where} have coordinates that are not finite")
    difference = points[None] - points[:, None]
    distance = np.linalg.norm(difference, axis=2)
    extent = distance.max()
    if (distance + extent * np.eye(len(points)) <= IN_LINE * extent).any():
        raise GeometryError(f"two fiducial marks coincide {where}: look for one that was measured or given twice")
    direction = difference / np.where(distance > 0, distance, 1.0)[:, :, None]
    offset = np.abs(direction[:, :, None, 0] * difference[:, None, :, 1] - direction[:, :, None, 1] * difference[:, None, :, 0])
    off_line = (offset > IN_LINE * extent).sum(axis=2) + 2 * np.eye(len(points), dtype=int)
    if off_line.min() < 2:
        raise GeometryError(f"the fiducial marks {where} lie on one line but for at most one: measure marks of another row too")


def _normalise(points: Float) -> tuple[Float, Float]:
    centre = points.mean(axis=0)
    scale = 1.0 / np.sqrt(((points - centre) ** 2).sum(axis=1).mean())
    transformation = np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
    return transformation, (points - centre) * scale


def _direct_linear_transformation(film: Float, plane: Float) -> Float:
    ones = np.column_stack([film, np.ones(len(film))])
    rows = np.zeros((2 * len(film), 9))
    rows[0::2, 0:3] = ones
    rows[1::2, 3:6] = ones
    rows[0::2, 6:9] = -plane[:, :1] * ones
    rows[1::2, 6:9] = -plane[:, 1:] * ones
    matrix = np.asarray(np.linalg.svd(rows)[2][-1].reshape(3, 3), dtype=np.float64)
    if abs(matrix[2, 2]) < 1e-9:
        raise GeometryError("the fiducial marks do not lie on the film as they do in the cage: look for a mark with a wrong number")
    result: Float = matrix / matrix[2, 2]
    return result


def _refine(matrix: Float, film: Float, plane: Float) -> Float:
    """Minimise the squared distances in the plane; coordinates are normalised, so that steps and damping are of order 1."""
    damping = 0.0
    residual = plane - apply_homography(matrix, film)
    cost = float((residual**2).sum())
    for _ in range(MAX_ITERATIONS):
        design = homography_jacobians(matrix, film)[1].reshape(-1, 8)
        normal = design.T @ design
        try:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), design.T @ residual.ravel())
        except np.linalg.LinAlgError:
            damping = max(10 * damping, 1e-6)
            continue
        trial = (matrix.ravel() + np.append(step, 0.0)).reshape(3, 3)
        trial_residual = plane - apply_homography(trial, film)
        trial_cost = float((trial_residual**2).sum())
        small = np.abs(step).max() < STEP_TOLERANCE * max(1.0, float(np.abs(matrix).max()))
        if trial_cost <= cost:
            matrix, residual, cost, damping = trial, trial_residual, trial_cost, damping / 10 if damping > 1e-9 else 0.0
        elif not small:
            damping = max(10 * damping, 1e-6)
        if small:
            break
    return matrix
