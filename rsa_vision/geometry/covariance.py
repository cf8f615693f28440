"""First-order propagation of errors through X-RAY's first two steps, and the test of stated covariances by residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc

from rsa_vision.geometry.homography import homography_jacobians, parameter_gain
from rsa_vision.geometry.rays import intersection_jacobians
from rsa_vision.types import Float, ImagePoints, Int

SIGNIFICANCE: Final = 0.01  # of residuals that are larger than the stated covariances predict
ROUNDING: Final = 1e-9  # least standard deviation of an image coordinate, as a fraction of the film: keeps exact input from dividing 0 by 0


def residual_ratio(residuals: Float, covariance: Float) -> tuple[float, float]:
    """Return the sum of squares of residuals over its expectation, and its degrees of freedom; 1 and 0 where nothing is redundant.

    Parameters
    ----------
    residuals : ndarray of shape (n,)
    covariance : ndarray of shape (n, n)
        Of these residuals, by propagation; of any rank.

    Returns
    -------
    ratio, freedom : float
        The distribution is taken as chi-squared with the degrees of freedom that give it the right variance (Satterthwaite).
    """
    expected = float(np.trace(covariance))
    spread = float((covariance**2).sum())
    if not (expected > 0 and spread > 0):
        return 1.0, 0.0
    return float(residuals @ residuals) / expected, expected**2 / spread


def pooled_factor(ratios: Sequence[tuple[float, float]]) -> float:
    """Return the factor by which stated standard deviations are too small (Birge ratio), 1 unless it is significant.

    Parameters
    ----------
    ratios : sequence of (ratio, freedom)
        As of :func:`residual_ratio`, of one set of residuals or of several together.

    Returns
    -------
    float
    """
    freedom = sum(f for _, f in ratios)
    if freedom == 0:
        return 1.0
    ratio = sum(r * f for r, f in ratios) / freedom
    return float(np.sqrt(ratio)) if ratio > 1 and chdtrc(freedom, ratio * freedom) < SIGNIFICANCE else 1.0


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
    return ResectionErrors(parameter[0], image[0], mark[0], *(part[1:].reshape(3 * n, -1) for part in (parameter, image, mark)))


@dataclass(frozen=True, slots=True, eq=False)
class FocusErrors:
    """Errors of the eleven parameters of a focus, fields as in :class:`rsa_vision.types.FocusSolution`."""

    parameter_covariance: Float
    cage_effect: Float
    fiducial_birge: float
    control_birge: float
    image_sd_px: float
    ratios: tuple[tuple[float, float], tuple[float, float]]


def propagate(
    points: ImagePoints,
    rows: tuple[Int, Int],
    steps: tuple[HomographyErrors, ResectionErrors],
    cage_mm: tuple[Float, Float],
    residuals_mm: tuple[Float, Float],
) -> FocusErrors:
    """Propagate image and cage errors to the parameters of a focus, and test the image errors by both steps' residuals.

    Parameters
    ----------
    points : ImagePoints
    rows : pair of ndarray of int, shape (n,) and (k,)
        The fiducial marks and the control points used.
    steps : HomographyErrors, ResectionErrors
    cage_mm : pair of ndarray, shape (2 n, m) and (3 k, m)
        Shifts of the fiducial marks in the plane, and of the control points, for one standard deviation of each cage coordinate.
    residuals_mm : pair of ndarray, shape (2 n,) and (3 k,)
        Of both steps.

    Returns
    -------
    FocusErrors
    """
    (fiducials, controls), (first, second) = rows, steps
    (fiducial_shift, control_shift), (radial_mm, line_mm) = cage_mm, residuals_mm
    px, given = points.position_px, points.covariance_px2
    residual_by_image = first.residual_gain @ first.plane_by_image
    parameter_by_image = -first.gain @ first.plane_by_image
    line_by_fiducial = second.residual_by_parameter @ parameter_by_image
    image_sd = np.nan
    if not np.isfinite(given).all():
        unit = (residual_by_image**2).sum()
        if unit > 0:
            image_sd = float(np.sqrt((radial_mm**2).sum() / unit))
        else:  # four fiducial marks fit exactly: only the lines are redundant
            unit = (line_by_fiducial**2).sum() + (second.residual_by_image**2).sum()
            image_sd = float(np.sqrt((line_mm**2).sum() / unit))
    of_fiducials = blocks(filled_covariance(px[fiducials], given[fiducials], image_sd))
    of_controls = blocks(filled_covariance(px[controls], given[controls], image_sd))

    by_cage = first.residual_gain @ fiducial_shift
    of_plane = residual_ratio(radial_mm, residual_by_image @ of_fiducials @ residual_by_image.T + by_cage @ by_cage.T)
    fiducial_birge = pooled_factor([of_plane])
    of_fiducials, of_controls = of_fiducials * fiducial_birge**2, of_controls * fiducial_birge**2
    parameters_by_cage = first.gain @ fiducial_shift
    by_cage = second.residual_by_parameter @ parameters_by_cage + second.residual_by_mark @ control_shift
    ratio, freedom = residual_ratio(
        line_mm,
        line_by_fiducial @ of_fiducials @ line_by_fiducial.T
        + second.residual_by_image @ of_controls @ second.residual_by_image.T
        + by_cage @ by_cage.T,
    )
    control_birge = pooled_factor([(ratio, freedom)])

    all_by_parameter = np.vstack([np.eye(8), control_birge * second.focus_by_parameter])
    all_by_fiducial = all_by_parameter @ parameter_by_image
    covariance = all_by_fiducial @ of_fiducials @ all_by_fiducial.T
    covariance[8:, 8:] += control_birge**2 * second.focus_by_image @ of_controls @ second.focus_by_image.T
    effect = all_by_parameter @ parameters_by_cage
    effect[8:] += control_birge * second.focus_by_mark @ control_shift
    return FocusErrors(covariance, effect, fiducial_birge, control_birge, image_sd, (of_plane, (ratio * fiducial_birge**2, freedom)))


def filled_covariance(px: Float, covariance_px2: Float, image_sd_px: float) -> Float:
    """Fill in covariances that were not given, and keep exact coordinates from having less error than their own rounding.

    Parameters
    ----------
    px : ndarray of shape (n, 2)
    covariance_px2 : ndarray of shape (n, 2, 2)
        NaN where not given.
    image_sd_px : float

    Returns
    -------
    ndarray of shape (n, 2, 2)
    """
    known = np.isfinite(covariance_px2).all(axis=(1, 2), keepdims=True)
    filled = np.where(known, covariance_px2, image_sd_px**2 * np.eye(2))
    floor = ROUNDING * np.nanmax(np.abs(px), initial=0.0)
    result: Float = filled + floor**2 * np.eye(2)
    return result
