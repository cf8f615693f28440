"""Lines in space: the point nearest to several lines, closest approach of two, and the errors of both.

Every line is given by two points: `through`, where it meets the fiducial plane, and `origin`, the focus. With u the unit vector from
the first to the second, L their distance and M = I - u u^T, the point P with the least sum of squared distances to the lines solves
sum(M) P = sum(M through) (Selvik 1989, eq. 2:4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.types import Float, Int, Table

PARALLEL: Final = 1e-10  # smallest eigenvalue of the mean of M: lines within 1e-5 rad of each other do not fix a point


@dataclass(frozen=True, slots=True, eq=False)
class RayBundle(Table):
    """Rays with their errors, of one focus or of several.

    Attributes
    ----------
    image : ndarray of int, shape (n,)
        Row of the table of image points that the ray belongs to.
    focus : ndarray of int, shape (n,)
    origin_mm : ndarray of shape (n, 3)
        The focus.
    through_mm : ndarray of shape (n, 3)
        Another point of the ray: its point in the fiducial plane, or with calibrated cameras one about as far away as the object.
    covariance_mm2 : ndarray of shape (n, 6, 6)
        Joint covariance of (through, origin) by the errors of images, rays of different foci being independent in it.
    cage_effect_mm : ndarray of shape (n, 6, m)
        Change of (through, origin) for one standard deviation of each cage coordinate; common to all rays. m = 0 for an exact cage.
    """

    image: Int
    focus: Int
    origin_mm: Float
    through_mm: Float
    covariance_mm2: Float
    cage_effect_mm: Float

    @property
    def direction(self) -> Float:
        """Unit vectors from the focus towards the film, shape (n, 3)."""
        difference = self.through_mm - self.origin_mm
        result: Float = difference / np.linalg.norm(difference, axis=1, keepdims=True)
        return result


def intersect_lines(origins: Float, directions: Float) -> tuple[Float, Float]:
    """Find the point with the least sum of squared distances to lines (2:4).

    Parameters
    ----------
    origins : ndarray of shape (..., k, 3)
        A point of each of the k lines.
    directions : ndarray of shape (..., k, 3)
        Of any length but zero.

    Returns
    -------
    points : ndarray of shape (..., 3)
        NaN where the lines are parallel.
    residuals : ndarray of shape (..., k, 3)
        From the point perpendicularly to every line.
    """
    projector = _projectors(directions)
    normal = projector.sum(axis=-3)
    centre = origins.mean(axis=-2, keepdims=True)  # keeps digits when the frame's origin is far away
    right = (projector @ (origins - centre)[..., None]).sum(axis=-3)
    with np.errstate(invalid="ignore"):
        determined = np.isfinite(normal).all(axis=(-1, -2))
    safe = np.where(determined[..., None, None], normal, np.eye(3))
    determined &= np.linalg.eigvalsh(safe)[..., 0] > PARALLEL * origins.shape[-2]
    safe = np.where(determined[..., None, None], safe, np.eye(3))
    points = np.where(determined[..., None], np.linalg.solve(safe, right)[..., 0] + centre[..., 0, :], np.nan)
    residuals = (projector @ (origins - points[..., None, :])[..., None])[..., 0]
    return points, residuals


def intersection_jacobians(through: Float, origins: Float, points: Float) -> tuple[Float, Float]:
    """Derivatives of the intersection of :func:`intersect_lines` and of its residuals by both points of every line.

    Parameters
    ----------
    through, origins : ndarray of shape (..., k, 3)
    points : ndarray of shape (..., 3)
        Their intersection.

    Returns
    -------
    of_point : ndarray of shape (..., k, 3, 6)
        Derivative of the point by (through, origin) of each line.
    of_residuals : ndarray of shape (..., k, 3, k, 6)
        Derivative of the residual of the first index's line by (through, origin) of the other's. Both are exact, at any residual.
    """
    difference = origins - through
    length = np.linalg.norm(difference, axis=-1)[..., None, None]
    unit = difference / length[..., 0]
    projector = _projectors(difference)
    offset = through - points[..., None, :]
    along = (unit * offset).sum(axis=-1)[..., None, None]
    residual = offset - along[..., 0] * unit
    # d(M (through - P)) at fixed P, from du = M (d origin - d through) / L
    turn = (along * projector + unit[..., :, None] * residual[..., None, :]) / length
    own = np.concatenate([projector + turn, -turn], axis=-1)
    of_point = np.linalg.inv(projector.sum(axis=-3))[..., None, :, :] @ own
    lines = range(through.shape[-2])
    of_residuals = -np.einsum("...aij,...bjk->...aibk", projector, of_point)
    of_residuals[..., lines, :, lines, :] += np.moveaxis(own, -3, 0)
    return of_point, of_residuals


def closest_approach(through_a: Float, origin_a: Float, through_b: Float, origin_b: Float) -> tuple[Float, Float, Float, Float]:
    """Find where two lines come nearest to each other.

    Parameters
    ----------
    through_a, origin_a, through_b, origin_b : ndarray of shape (..., 3)
        Two points of each line; the shapes are broadcast.

    Returns
    -------
    point_a, point_b : ndarray of shape (..., 3)
        The nearest points; NaN for parallel lines. The error vector is ``point_b - point_a``.
    fraction_a, fraction_b : ndarray of shape (...)
        Where they lie on the way from `through` (0) to `origin` (1).
    """
    difference_a, difference_b = origin_a - through_a, origin_b - through_b
    offset = through_b - through_a
    aa, bb, ab = _dot(difference_a, difference_a), _dot(difference_b, difference_b), _dot(difference_a, difference_b)
    a_offset, b_offset = _dot(difference_a, offset), _dot(difference_b, offset)
    # |a x b|^2 by the cross product: aa bb - ab^2 loses the digits of a small angle
    perpendicular = np.cross(difference_a, difference_b)
    determinant = _dot(perpendicular, perpendicular)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = np.where(determinant > PARALLEL * aa * bb, determinant, np.nan)
        fraction_a = (a_offset * bb - ab * b_offset) / determinant
        fraction_b = (ab * a_offset - aa * b_offset) / determinant
    point_a = through_a + fraction_a[..., None] * difference_a
    point_b = through_b + fraction_b[..., None] * difference_b
    return point_a, point_b, fraction_a, fraction_b


def cross(a: RayBundle, b: RayBundle) -> tuple[Float, Float, Float]:
    """Cross every ray of one bundle with every ray of another.

    Parameters
    ----------
    a, b : RayBundle
        Of different foci.

    Returns
    -------
    points_mm : ndarray of shape (na, nb, 3)
        Midpoints of the shortest connections (the intersection of step 3); NaN for parallel rays.
    crossing_mm : ndarray of shape (na, nb)
        Crossing distances, not negative.
    sigma_mm : ndarray of shape (na, nb)
        Standard deviation of the *signed* distance along the common perpendicular, by the errors of images, homographies and foci.

    Notes
    -----
    To first order the distance changes by n . (dq_b - dq_a), where n is the common perpendicular and dq the shift of a line at its
    nearest point, (1 - t) d(through) + t d(origin); that the nearest point itself wanders along the line does not matter.
    """
    through_a, origin_a = a.through_mm[:, None], a.origin_mm[:, None]
    through_b, origin_b = b.through_mm[None], b.origin_mm[None]
    middle, signed, leverage_a, leverage_b = _crossing(through_a, origin_a, through_b, origin_b)
    variance = ((leverage_a @ a.covariance_mm2) * leverage_a).sum(-1)  # (na, nb, 6) @ (na, 6, 6)
    over_b = leverage_b.swapaxes(0, 1)
    variance += ((over_b @ b.covariance_mm2) * over_b).sum(-1).T
    if a.cage_effect_mm.shape[-1]:
        common = (over_b @ b.cage_effect_mm).swapaxes(0, 1) - leverage_a @ a.cage_effect_mm
        variance += (common**2).sum(-1)
    return middle, np.abs(signed), np.sqrt(variance)


def crossing_errors(through_mm: Float, origin_mm: Float, own_mm2: Float, effect_mm: Float) -> tuple[Float, Float, Float]:
    """Return the signed crossing errors of pairs of rays, and what they have from each ray alone and in common.

    Parameters
    ----------
    through_mm, origin_mm : ndarray of shape (n, 2, 3)
    own_mm2 : ndarray of shape (n, 2, 6, 6)
        Covariance of (through, origin) by the ray's own image.
    effect_mm : ndarray of shape (n, 2, 6, m)
        Change for one standard deviation of each error that rays share.

    Returns
    -------
    crossing_mm, own_variance_mm2 : ndarray of shape (n,)
    effect_mm : ndarray of shape (n, m)
        As :func:`cross` has them; pairs of parallel rays are left out.
    """
    _, signed, *leverages = _crossing(through_mm[:, 0], origin_mm[:, 0], through_mm[:, 1], origin_mm[:, 1])
    leverage = np.stack([-leverages[0], leverages[1]], axis=1)
    variance = np.einsum("nki,nkij,nkj->n", leverage, own_mm2, leverage)
    effect = np.einsum("nki,nkim->nm", leverage, effect_mm)
    known = np.isfinite(signed)
    return signed[known], variance[known], effect[known]


def _crossing(through_a: Float, origin_a: Float, through_b: Float, origin_b: Float) -> tuple[Float, Float, Float, Float]:
    """Midpoints of shortest connections, their signed lengths, and how much (through, origin) of either line moves its end of them."""
    point_a, point_b, fraction_a, fraction_b = closest_approach(through_a, origin_a, through_b, origin_b)
    perpendicular = np.cross(origin_a - through_a, origin_b - through_b)
    with np.errstate(divide="ignore", invalid="ignore"):
        perpendicular /= np.linalg.norm(perpendicular, axis=-1, keepdims=True)
    signed = (perpendicular * (point_b - point_a)).sum(-1)
    return (point_a + point_b) / 2, signed, _leverage(perpendicular, fraction_a), _leverage(perpendicular, fraction_b)


def _dot(a: Float, b: Float) -> Float:
    product: Float = np.einsum("...i,...i->...", a, b)  # sums over a short last axis take several times as long
    return product


def _leverage(perpendicular: Float, fraction: Float) -> Float:
    return np.concatenate([(1 - fraction)[..., None] * perpendicular, fraction[..., None] * perpendicular], axis=-1)


def _projectors(directions: Float) -> Float:
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    result: Float = np.eye(3) - unit[..., :, None] * unit[..., None, :]
    return result
