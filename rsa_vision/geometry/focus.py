"""Steps 1 and 2 of X-RAY for one focus, and its rays, both with their errors (Selvik 1989, ch. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.cages import Cage, Mark
from rsa_vision.errors import GeometryError
from rsa_vision.flags import MarkerFlag
from rsa_vision.geometry.covariance import blocks, filled_covariance, homography_errors, propagate, resection_errors
from rsa_vision.geometry.gross_errors import drop_gross_errors
from rsa_vision.geometry.homography import apply_homography, fit_homography, homography_jacobians
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.geometry.resection import locate_focus
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, FocusSolution, ImagePoints, Int

UM_PER_MM = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class FocusFit:
    """Steps 1 and 2 with what they say of every point.

    Attributes
    ----------
    solution : FocusSolution
    plane_mm : ndarray of shape (n, 3)
        Every point in the fiducial plane, laboratory frame.
    residual_um : ndarray of shape (n,)
        Fiducial marks: radial error in the plane; control points: line-to-focus distance; else NaN.
    used : ndarray of bool, shape (n,)
        Fiducial marks and control points that the solution rests on.
    flags : ndarray of int, shape (n,)
        To be added to those of the points.
    mark : ndarray of int, shape (n,)
        Index into ``cage.mark``; -1 for all other points.
    focus_by_image : ndarray of shape (n, 3, 2)
        Change of the focus for a shift of each control point's image on the film, mm/px; 0 for all other points.
    ratios : pair of (ratio, freedom)
        Squares of the residuals of both steps over what stated image errors let expect
        (:func:`rsa_vision.geometry.covariance.residual_ratio`).
    """

    solution: FocusSolution
    plane_mm: Float
    residual_um: Float
    used: Bool
    flags: Int
    mark: Int
    focus_by_image: Float
    ratios: tuple[tuple[float, float], tuple[float, float]]


def solve_focus(points: ImagePoints, cage: Cage, focus: int, limits: Limits, tip_error: float = 0.0) -> FocusFit:
    """Fit the fiducial plane to the film and locate the focus, with the rules for gross errors.

    Parameters
    ----------
    points : ImagePoints
        The points of this focus, at least its fiducial marks and control points; others are only transformed.
    cage : Cage
        At the temperature of the examination.
    focus : int
    limits : Limits
        ``fiducial_um`` and ``line_mm`` are used.
    tip_error : float
        Standard deviation of what all points of the cage have in common (:func:`tip_shift`), as a part of their half width.

    Returns
    -------
    FocusFit

    Raises
    ------
    GeometryError
        If the points do not determine the plane or the focus, a number occurs twice, or is that of no mark of the cage.

    Notes
    -----
    Covariances are propagated to first order through both steps (implicit functions). Points without covariance get the image error that
    the residuals show. Where the residuals are significantly larger than stated covariances predict, these are inflated (Birge ratio).
    """
    try:
        return _solve(points, cage, focus, limits, tip_error)
    except GeometryError as error:
        raise GeometryError(f"focus {focus}: {error}") from error


def rays_of(
    position_px: Float,
    covariance_px2: Float,
    solution: FocusSolution,
    cage: Cage,
    image: Int | None = None,
    focus_by_image: Float | None = None,
) -> RayBundle:
    """Return the rays from a focus to images on its film, with the errors of image, homography and focus.

    Parameters
    ----------
    position_px : ndarray of shape (n, 2)
    covariance_px2 : ndarray of shape (n, 2, 2)
        NaN where not known: then the error that the cage's marks show on this film stands in.
    solution : FocusSolution
    cage : Cage
        The one that was solved with.
    image : ndarray of int, shape (n,), optional
        Names the rays; default 0, 1, 2 ...
    focus_by_image : ndarray of shape (n, 3, 2), optional
        As of :class:`FocusFit`, for images that the focus itself was computed from; without it they are those of objects.

    Returns
    -------
    RayBundle
    """
    n = len(position_px)
    through, own, common = _ray_errors(position_px, covariance_px2, solution, cage, focus_by_image)
    covariance = own * (solution.image_factor**2 if focus_by_image is None else 1.0)
    covariance += common @ solution.parameter_covariance @ common.swapaxes(1, 2)
    return RayBundle(
        np.arange(n) if image is None else image,
        np.full(n, solution.focus, np.int64),
        np.tile(solution.position_mm, (n, 1)),
        through,
        covariance,
        common @ solution.cage_effect,
    )


def ray_effects(position_px: Float, covariance_px2: Float, solution: FocusSolution, cage: Cage) -> tuple[Float, Float]:
    """Return the errors of rays apart: by their own images, and by what they share.

    Parameters
    ----------
    position_px, covariance_px2, solution, cage
        As of :func:`rays_of`.

    Returns
    -------
    own_mm2 : ndarray of shape (n, 6, 6)
        Covariance of (through, origin) by each ray's image.
    effect_mm : ndarray of shape (n, 6, 11 + m)
        Change of (through, origin) for one standard deviation of each independent error of homography and focus, and of the m of the cage.
    """
    _, own, common = _ray_errors(position_px, covariance_px2, solution, cage, None)
    value, vector = np.linalg.eigh(solution.parameter_covariance)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    return own, np.concatenate([common @ root, common @ solution.cage_effect], axis=2)


def _ray_errors(
    position_px: Float, covariance_px2: Float, solution: FocusSolution, cage: Cage, focus_by_image: Float | None
) -> tuple[Float, Float, Float]:
    """Points of rays in the fiducial plane, their covariance by their own images, and their change by the parameters of the focus."""
    n = len(position_px)
    origin, basis = cage.plane_of(solution.focus).lab_from_plane()
    through = origin + apply_homography(solution.plane_from_film, position_px) @ basis
    by_point, by_parameter = homography_jacobians(solution.plane_from_film, position_px)
    by_image = np.zeros((n, 6, 2))
    by_image[:, :3] = basis.T @ by_point
    if focus_by_image is not None:
        by_image[:, 3:] = focus_by_image
    common = np.zeros((n, 6, 11))
    common[:, :3, :8] = basis.T @ by_parameter
    common[:, 3:, 8:] = np.eye(3)
    stated = filled_covariance(position_px, covariance_px2, solution.image_sd_px) * solution.fiducial_birge**2
    # the focus's own covariance has the part of these images already: only their correlation with the ray is new
    own = by_image @ stated @ by_image.swapaxes(1, 2)
    own[:, 3:, 3:] = 0
    return through, own, common


def _solve(points: ImagePoints, cage: Cage, focus: int, limits: Limits, tip_error: float) -> FocusFit:
    px = points.position_px
    flags, mark = _match(points, cage, focus)
    fiducials = np.flatnonzero((mark >= 0) & (points.role == "fiducial"))
    controls = np.flatnonzero((mark >= 0) & (points.role == "control"))
    origin, basis = cage.plane_of(focus).lab_from_plane()
    xyz = np.array([item.xyz for item in cage.mark])
    given_uv = (xyz[mark[fiducials]] - origin) @ basis.T

    def fit_plane(index: Int) -> tuple[Float, Float]:
        matrix = fit_homography(px[fiducials[index]], given_uv[index])
        return matrix, np.linalg.norm(apply_homography(matrix, px[fiducials[index]]) - given_uv[index], axis=1) * UM_PER_MM

    matrix, kept_fiducials = drop_gross_errors(len(fiducials), fit_plane, limits.fiducial_um)
    plane = origin + apply_homography(matrix, px) @ basis

    def fit_focus(index: Int) -> tuple[tuple[Float, Float], Float]:
        found = locate_focus(plane[controls[index]], xyz[mark[controls[index]]])
        return found, np.linalg.norm(found[1], axis=1)

    (position, line_residuals), kept_controls = drop_gross_errors(len(controls), fit_focus, limits.line_mm)

    residual = np.full(len(px), np.nan)
    shift = apply_homography(matrix, px[fiducials]) - given_uv
    residual[fiducials] = np.linalg.norm(shift, axis=1) * UM_PER_MM
    along = xyz[mark[controls]] - plane[controls]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    residual[controls] = np.linalg.norm(np.cross(along, position - plane[controls]), axis=1) * UM_PER_MM
    used = np.zeros(len(px), bool)
    used[fiducials[kept_fiducials]] = True
    used[controls[kept_controls]] = True
    flags[fiducials[~used[fiducials]]] |= MarkerFlag.REJECTED
    flags[controls[~used[controls]]] |= MarkerFlag.REJECTED
    limit_um = np.where(points.role == "fiducial", limits.fiducial_um, limits.line_mm * UM_PER_MM)
    flags[used & (residual > limit_um)] |= MarkerFlag.LARGE_RESIDUAL  # the rule stopped at four marks

    rows, lines = fiducials[kept_fiducials], controls[kept_controls]
    first = homography_errors(matrix, px[rows])
    second = resection_errors(matrix, basis, px[lines], plane[lines], xyz[mark[lines]], position)
    steps = _cage_errors(cage, tip_error)
    by_cage = _cage_steps(steps, mark[rows], mark[lines], given_uv[kept_fiducials], origin, basis, position)
    errors = propagate(points, (rows, lines), (first, second), by_cage, (shift[kept_fiducials].ravel(), line_residuals.ravel()))
    focus_by_image = np.zeros((len(px), 3, 2))
    focus_by_image[lines] = second.focus_by_image.reshape(3, -1, 2).swapaxes(0, 1) * errors.control_birge
    effect = errors.cage_effect[8:]
    radial, distance = residual[rows], residual[lines]
    solution = FocusSolution(
        focus,
        matrix,
        position,
        errors.parameter_covariance[8:, 8:] + effect @ effect.T,
        float(np.sqrt((radial**2).mean())),
        float(radial.max()),
        float(np.sqrt((distance**2).mean())),
        float(distance.max()),
        len(rows),
        len(lines),
        errors.fiducial_birge,
        errors.control_birge,
        errors.image_sd_px,
        errors.parameter_covariance,
        errors.cage_effect,
    )
    return FocusFit(solution, plane, residual, used, flags, mark, focus_by_image, errors.ratios)


def _match(points: ImagePoints, cage: Cage, focus: int) -> tuple[Int, Int]:
    """Return new flags, and the index into ``cage.mark`` of every fiducial mark and control point."""
    flags = np.where(np.isfinite(points.covariance_px2).all(axis=(1, 2)), MarkerFlag.NONE, MarkerFlag.NO_COVARIANCE).astype(np.int64)
    known: dict[tuple[str, str, int], int] = {
        (item.role, str(item.number), seen): index for index, item in enumerate(cage.mark) for seen in item.foci
    }
    mark = np.full(len(points), -1)
    for row in np.flatnonzero((points.role == "fiducial") | (points.role == "control")):
        role, number = str(points.role[row]), str(points.number[row])
        index = known.get((role, number, focus), -1)
        if index >= 0 and (mark == index).any():
            raise GeometryError(f"{role} mark {number} occurs twice: give every image its own number")
        if index < 0 and not any(key[:2] == (role, number) for key in known):
            raise GeometryError(f"there is no {role} mark {number} in cage {cage.name}: correct the number, or choose the right cage")
        if index < 0:
            flags[row] |= MarkerFlag.FOREIGN_MARK
        elif np.isfinite(points.position_px[row]).all():
            mark[row] = index
    return flags, mark


def tip_shift(mark: Mark) -> Float:
    """Return the shift of a tip, or of the point where three tips meet, for points that are longer by one half width, mm.

    Parameters
    ----------
    mark : Mark

    Returns
    -------
    ndarray of shape (3,)
        Along the arms; the two of a tee that are opposite cancel, its stem stays. 0 for balls.
    """
    arms = np.array(mark.arms).reshape(-1, 3)
    shift: Float = -(arms / np.linalg.norm(arms, axis=1, keepdims=True)).sum(axis=0) * mark.diameter / 2
    return shift


def _cage_errors(cage: Cage, tip_error: float) -> Float:
    """Shifts of every mark for one standard deviation of each of the m errors of the cage, shape (marks, 3, m).

    All tips were ground alike and are seen by one method: where they end is one error for all of them, which no residual shows.
    """
    n = len(cage.mark)
    deviations = np.array([item.sd or (0.0, 0.0, 0.0) for item in cage.mark])
    own = blocks(deviations[:, :, None] * np.eye(3)).reshape(n, 3, 3 * n)[..., : 3 * n if deviations.any() else 0]
    common = tip_error * np.array([tip_shift(item) for item in cage.mark])
    return np.concatenate([own, common[:, :, None]], axis=2) if common.any() else own


def _cage_steps(
    errors: Float, fiducials: Int, controls: Int, given_uv: Float, origin: Float, basis: Float, focus_mm: Float
) -> tuple[Float, Float]:
    """Shifts for one standard deviation of each of the m errors of the cage: fiducial marks in the plane (2 n, m), controls (3 n, m)."""
    count = errors.shape[2]
    normal = np.cross(basis[0], basis[1])
    height = (focus_mm - origin) @ normal
    foot = (focus_mm - origin) @ basis.T
    # a mark off the plane is seen along its ray
    seen = basis + (given_uv - foot)[:, :, None] / height * normal
    return (seen @ errors[fiducials]).reshape(2 * len(fiducials), count), errors[controls].reshape(3 * len(controls), count)
