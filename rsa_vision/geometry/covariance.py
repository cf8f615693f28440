"""First-order propagation of errors through X-RAY's first two steps, and the test of stated covariances by residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2

from rsa_vision.geometry.homography import homography_jacobians, parameter_gain
from rsa_vision.geometry.rays import intersection_jacobians
from rsa_vision.types import Float

SIGNIFICANCE: Final = 0.01  # of residuals that are larger than the stated covariances predict
ROUNDING: Final = 1e-9  # least standard deviation of an image coordinate, as a fraction of the film: keeps exact input from dividing 0 by 0


def birge_factor(residuals: Float, covariance: Float) -> float:
    """Return the factor by which stated standard deviations are too small (Birge ratio), 1 unless it is significant.

    Parameters
    ----------
    residuals : ndarray of shape (n,)
    covariance : ndarray of shape (n, n)
        Of these residuals, by propagation; of any rank.

    Returns
    -------
    float
        Square root of the sum of squares over its expectation, whose distribution is taken as chi-squared with the degrees of freedom
        that give it the right variance (Satterthwaite).
    """
    expected = float(np.trace(covariance))
    spread = float((covariance**2).sum())
    if not (expected > 0 and spread > 0):
        return 1.0
    ratio, freedom = float(residuals @ residuals) / expected, expected**2 / spread
    return float(np.sqrt(ratio)) if ratio > 1 and chi2.sf(ratio * freedom, freedom) < SIGNIFICANCE else 1.0


def blocks(parts: Float) -> Float:
    """Return the block-diagonal matrix, shape (n a, n b), of parts of shape (n, a, b)."""
    n, a, b = parts.shape
    result = np.zeros((n, a, n, b))
    result[np.arange(n), :, np.arange(n), :] = parts
    return result.reshape(n * a, n * b)


@dataclass(frozen=True, slots=True, eq=False)
class HomographyErrors:
    """Linear relations of step 1 at its solution, for n fiducial marks and m cage coordinates.

    Attributes
    ----------
    plane_by_image : ndarray of shape (2 n, 2 n)
        Shift in the plane by shift on the film.
    gain : ndarray of shape (8, 2 n)
        Parameters by shift in the plane (against the given coordinates).
    residual_gain : ndarray of shape (2 n, 2 n)
        Residuals by shift in the plane; 0 without redundancy.
    """

    plane_by_image: Float
    gain: Float
    residual_gain: Float


def homography_errors(plane_from_film: Float, film_px: Float) -> HomographyErrors:
    """Linearise step 1.

    Parameters
    ----------
    plane_from_film : ndarray of shape (3, 3)
    film_px : ndarray of shape (n, 2)
        The fiducial marks used.

    Returns
    -------
    HomographyErrors
    """
    by_point, by_parameter = homography_jacobians(plane_from_film, film_px)
    gain = parameter_gain(by_parameter)
    design = by_parameter.reshape(-1, 8)
    residual_gain = np.eye(len(design)) - design @ gain if len(design) > 8 else np.zeros((len(design), len(design)))
    return HomographyErrors(blocks(by_point), gain, residual_gain)


@dataclass(frozen=True, slots=True, eq=False)
class ResectionErrors:
    """Linear relations of step 2 at its solution, for n control points.

    Attributes
    ----------
    focus_by_parameter, focus_by_image, focus_by_mark : ndarray of shape (3, 8), (3, 2 n), (3, 3 n)
        Change of the focus by the homography, the images of the control points and the control points.
    residual_by_parameter, residual_by_image, residual_by_mark : ndarray of shape (3 n, ...)
        Change of the perpendiculars from the focus to the lines, alike.
    """

    focus_by_parameter: Float
    focus_by_image: Float
    focus_by_mark: Float
    residual_by_parameter: Float
    residual_by_image: Float
    residual_by_mark: Float


def resection_errors(
    plane_from_film: Float, basis: Float, film_px: Float, through_mm: Float, control_mm: Float, focus_mm: Float
) -> ResectionErrors:
    """Linearise step 2.

    Parameters
    ----------
    plane_from_film : ndarray of shape (3, 3)
    basis : ndarray of shape (2, 3)
        Unit vectors u and v of the fiducial plane.
    film_px : ndarray of shape (n, 2)
        Images of the control points used.
    through_mm, control_mm : ndarray of shape (n, 3)
        These transformed to the plane, and the control points.
    focus_mm : ndarray of shape (3,)

    Returns
    -------
    ResectionErrors
    """
    n = len(film_px)
    by_point, by_parameter = homography_jacobians(plane_from_film, film_px)
    of_focus, of_residuals = intersection_jacobians(through_mm, control_mm, focus_mm)
    stacked = np.concatenate([of_focus.transpose(1, 0, 2)[None], of_residuals.transpose(0, 1, 2, 3)])  # (1 + n, 3, n, 6)
    by_plane = stacked[..., :3] @ basis.T  # (1 + n, 3, n, 2)
    parameter = np.einsum("aikp,kpq->aiq", by_plane, by_parameter)
    image = np.einsum("aikp,kpq->aikq", by_plane, by_point).reshape(1 + n, 3, 2 * n)
    mark = stacked[..., 3:].reshape(1 + n, 3, 3 * n)
    return ResectionErrors(
        parameter[0], image[0], mark[0], *(part[1:].reshape(3 * n, -1) for part in (parameter, image, mark))
    )
