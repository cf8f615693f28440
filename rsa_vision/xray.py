"""X-RAY: named image points of one examination -> 3-D markers with their covariances (Selvik 1989, ch. 2 and 4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import chdtrc

from rsa_vision.cages import Cage
from rsa_vision.errors import CalibrationError, GeometryError
from rsa_vision.flags import MarkerFlag
from rsa_vision.geometry.camera import Pinhole, camera_centre, camera_rays
from rsa_vision.geometry.covariance import pooled_factor
from rsa_vision.geometry.focus import UM_PER_MM, FocusFit, ray_effects, rays_of, solve_focus
from rsa_vision.geometry.image_excess import image_excess
from rsa_vision.geometry.rays import RayBundle, crossing_errors, intersect_lines, intersection_jacobians
from rsa_vision.settings import Limits
from rsa_vision.types import Float, FocusSolution, ImagePoints, Int, Markers, Reconstruction

__all__ = [
    "ControlCheck",
    "FocusFit",
    "calibration_error",
    "check_controls",
    "intersect",
    "rays_of",
    "reconstruct",
    "reconstruct_calibrated",
    "solve_focus",
]

DERIVED = MarkerFlag.REJECTED | MarkerFlag.LARGE_RESIDUAL | MarkerFlag.ONE_VIEW | MarkerFlag.NO_COVARIANCE  # set anew here

_LEAST_FOR_CROSSINGS = 5  # markers that can tell an error of all
_UNEXPLAINED_P = 0.01  # significance from which crossing errors count as larger than the images explain
_MEDIAN_CHI2 = 0.455  # of one degree of freedom

Groups = dict[str, list[int]]


def reconstruct(points: ImagePoints, cage: Cage, limits: Limits, tip_error: float = 0.0) -> Reconstruction:
    """Reconstruct the markers of one examination with a cage.

    Parameters
    ----------
    points : ImagePoints
        Named points of all foci. Object points with the same number belong together.
    cage : Cage
        At the temperature of the examination (:meth:`Cage.at_temperature`).
    limits : Limits
        ``fiducial_um``, ``line_mm`` and ``crossing_sigma`` are used.
    tip_error : float
        As of :func:`rsa_vision.geometry.focus.solve_focus`.

    Returns
    -------
    Reconstruction
        A row for every object number, in the order of their first images. Markers seen from one focus only, and rays that are parallel or
        meet behind a focus, have NaN and a flag.

    Raises
    ------
    GeometryError
        If the points do not determine the plane or position of a focus, or a number occurs twice at one focus; the message names the
        remedy.
    """
    _require_foci(points, cage)
    fits = {focus: solve_focus(points.rows(points.focus == focus), cage, focus, limits, tip_error) for focus in _foci(points)}
    plane = np.full((len(points), 3), np.nan)
    residual = np.full(len(points), np.nan)
    used = np.zeros(len(points), bool)
    flags = points.flags & ~int(DERIVED)
    mark = np.full(len(points), -1)
    bundles: list[RayBundle] = []
    for focus, fit in fits.items():
        rows = np.flatnonzero(points.focus == focus)
        plane[rows], residual[rows], used[rows], mark[rows] = fit.plane_mm, fit.residual_um, fit.used, fit.mark
        flags[rows] |= fit.flags
        bundles.append(rays_of(points.position_px[rows], points.covariance_px2[rows], fit.solution, cage, rows, fit.focus_by_image))
    bundle = _joined(bundles)
    groups, objects = _object_groups(points, bundle), points.role == "object"
    # crossings are judged by stated errors: wrong pairs must not excuse themselves by widening all of them
    stated, distance, flags = intersect(groups, bundle, flags, limits)
    factor = _image_factors(points, groups, bundle, fits, cage)
    fits = {focus: replace(fit, solution=replace(fit.solution, image_factor=factor[focus])) for focus, fit in fits.items()}
    wider = [
        rays_of(points.position_px[rows], points.covariance_px2[rows], fit.solution, cage, rows)
        for focus, fit in fits.items()
        for rows in [np.flatnonzero((points.focus == focus) & objects)]
    ]
    bundle = _joined([bundle.rows(~objects[bundle.image]), *wider])
    markers = replace(stated, covariance_mm2=intersect(_object_groups(points, bundle), bundle, flags, limits)[0].covariance_mm2)
    residual[objects] = distance[objects]
    used |= objects & np.isfinite(distance)
    common: Groups = {}
    for ray, row in enumerate(bundle.image):
        if used[row] and points.role[row] == "control":
            common.setdefault(str(mark[row]), []).append(ray)
    shared = {str(cage.mark[int(index)].number): rays for index, rays in common.items() if len(rays) > 1}
    controls = intersect(shared, bundle, flags, limits)[0]
    solutions = tuple(fit.solution for fit in fits.values())
    return Reconstruction(_flagged(points, flags), plane, residual, used, solutions, markers, controls)


def _image_factors(points: ImagePoints, groups: Groups, bundle: RayBundle, fits: Mapping[int, FocusFit], cage: Cage) -> dict[int, float]:
    """Return for every focus the factor by which object images are less exact than stated and than its fiducial marks already show.

    What a film, its scanner or its bending do to images they do to those of marks and objects alike: the marks of all foci on a film tell
    it together, and so do the crossings.
    """
    crossings = _factor_by_crossings(points, groups, bundle, [fit.solution for fit in fits.values()], cage)
    film = {focus: int(points.film[points.focus == focus][0]) for focus in fits}
    out = {}
    for focus, fit in fits.items():
        by_marks = pooled_factor([ratio for other in fits if film[other] == film[focus] for ratio in fits[other].ratios])
        out[focus] = max(crossings, by_marks / fit.solution.fiducial_birge, 1.0)
    return out


def _factor_by_crossings(points: ImagePoints, groups: Groups, bundle: RayBundle, solutions: list[FocusSolution], cage: Cage) -> float:
    """Return the factor by which the errors of object images are larger than stated, by the crossings of the first two rays of markers."""
    pairs = np.array([rays[:2] for rays in groups.values() if len(rays) > 1], np.int64).reshape(-1, 2)
    pairs = pairs[np.isfinite(bundle.through_mm[pairs].sum(axis=(1, 2)))]
    if not len(pairs):
        return 1.0
    column = {solution.focus: k for k, solution in enumerate(solutions)}
    cage_errors = solutions[0].cage_effect.shape[1]
    shift = np.zeros((len(pairs), 2, 6, 11 * len(solutions) + cage_errors))
    own = np.zeros((len(pairs), 2, 6, 6))
    for solution in solutions:
        mine = bundle.focus[pairs] == solution.focus
        rows = bundle.image[pairs[mine]]
        own[mine], effect = ray_effects(points.position_px[rows], points.covariance_px2[rows], solution, cage)
        first = 11 * column[solution.focus]
        by_focus = np.zeros((len(rows), *shift.shape[2:]))
        by_focus[:, :, first : first + 11] = effect[:, :, :11]
        by_focus[:, :, 11 * len(solutions) :] = effect[:, :, 11:]
        shift[mine] = by_focus
    return image_excess(*crossing_errors(bundle.through_mm[pairs], bundle.origin_mm[pairs], own, shift))


def reconstruct_calibrated(points: ImagePoints, cameras: Mapping[int, Pinhole], limits: Limits) -> Reconstruction:
    """Reconstruct the markers of one examination with calibrated cameras, in the calibration's frame.

    Parameters
    ----------
    points : ImagePoints
        Object points of all foci, in pixels; points of other roles are left alone.
    cameras : mapping of focus number to camera
        For example :class:`rsa_vision.cameras.Camera`.
    limits : Limits
        ``crossing_sigma`` is used.

    Returns
    -------
    Reconstruction
        As of :func:`reconstruct`, without a fiducial plane and controls; ``parallax_um`` is NaN, since no axis of the calibration's frame
        is that of the foci. The calibration counts as exact, unless the crossings say otherwise: see :func:`calibration_error`.

    Raises
    ------
    CalibrationError
        If a focus has no camera.
    GeometryError
        If a number occurs twice at one focus.
    """
    missing = sorted(set(_foci(points)) - set(cameras))
    if missing:
        raise CalibrationError(f"focus {missing[0]} has no camera: add its file to calibration in the study file")
    unknown = ~np.isfinite(points.covariance_px2).all(axis=(1, 2))
    flags = (points.flags & ~int(DERIVED)) | np.where(unknown, MarkerFlag.NO_COVARIANCE, MarkerFlag.NONE)

    def at_error(calibration_px: float) -> tuple[Markers, Float, Int]:
        bundles = []
        for focus in _foci(points):
            rows = np.flatnonzero(points.focus == focus)
            px, covariance = points.position_px[rows], points.covariance_px2[rows]
            bundles.append(camera_rays(cameras[focus], focus, px, covariance, rows, calibration_px=calibration_px))
        bundle = _joined(bundles)
        return intersect(_object_groups(points, bundle), bundle, flags, limits)

    calibration_px = calibration_error(lambda error_px: at_error(error_px)[0])
    markers, distance, flags = at_error(calibration_px)
    markers.parallax_um[:] = np.nan
    solutions = tuple(_camera_solution(focus, cameras[focus]) for focus in _foci(points))
    controls = markers.rows(np.zeros(len(markers), bool))
    plane = np.full((len(points), 3), np.nan)
    return Reconstruction(_flagged(points, flags), plane, distance, np.isfinite(distance), solutions, markers, controls, calibration_px)


def calibration_error(markers_at: Callable[[float], Markers]) -> float:
    """Return the error of calibrated cameras that the crossing errors show, px.

    Parameters
    ----------
    markers_at : callable
        Markers for an assumed error of the calibration (standard deviation of each image coordinate, px).

    Returns
    -------
    float
        0 where the image errors explain the crossings (chi-square, p > 0.01) or fewer than five markers could tell; else the error with
        which the median of the squared ratios of crossing errors and their standard deviations is that of chi-square.
    """

    def ratios(error_px: float) -> Float:
        markers = markers_at(error_px)
        ratio = (markers.crossing_um / markers.crossing_sd_um) ** 2
        known: Float = ratio[np.isfinite(ratio)]
        return known

    exact = ratios(0.0)
    if len(exact) < _LEAST_FOR_CROSSINGS or chdtrc(len(exact), exact.sum()) > _UNEXPLAINED_P:
        return 0.0
    low, high = 1e-3, 30.0
    for _ in range(30):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if np.median(ratios(middle)) > _MEDIAN_CHI2 else (low, middle)
    return float(np.sqrt(low * high)) if low > 1e-3 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ControlCheck:
    """Control points that more than one focus sees, re-computed as object points (Selvik 1989, ch. 2, step 2).

    Attributes
    ----------
    number : tuple of str
        Cage numbers.
    given_mm, computed_mm : ndarray of shape (n, 3)
    radial_um : ndarray of shape (n,)
        Distances between them.
    radial_rms_um, radial_max_um, crossing_rms_um : float
        NaN for no such points.
    """

    number: tuple[str, ...]
    given_mm: Float
    computed_mm: Float
    radial_um: Float
    radial_rms_um: float
    radial_max_um: float
    crossing_rms_um: float


def check_controls(reconstruction: Reconstruction, cage: Cage) -> ControlCheck:
    """Compare the re-computed control points with the cage.

    Parameters
    ----------
    reconstruction : Reconstruction
    cage : Cage
        The one it was computed with.

    Returns
    -------
    ControlCheck
    """
    controls = reconstruction.controls
    shared = {str(mark.number): mark.xyz for mark in cage.mark if mark.role == "control" and len(mark.foci) > 1}
    given = np.array([shared[str(name)] for name in controls.name]).reshape(-1, 3)
    radial = np.linalg.norm(controls.position_mm - given, axis=1) * UM_PER_MM
    seen = len(radial) > 0
    return ControlCheck(
        tuple(map(str, controls.name)),
        given,
        controls.position_mm,
        radial,
        float(np.sqrt((radial**2).mean())) if seen else np.nan,
        float(radial.max()) if seen else np.nan,
        float(np.sqrt((controls.crossing_um**2).mean())) if seen else np.nan,
    )


def _foci(points: ImagePoints) -> list[int]:
    """Foci that have a named point; unassigned images alone make no focus."""
    named = set(points.focus[points.role != "unassigned"].tolist())
    if not named or 0 in named:
        raise GeometryError("a named point has no focus, or none is named: give every fiducial, control and object point its focus")
    return sorted(named)


def _require_foci(points: ImagePoints, cage: Cage) -> None:
    strange = sorted(set(_foci(points)) - set(cage.foci))
    if strange:
        raise GeometryError(f"cage {cage.name} has no focus {strange[0]}: correct the focus numbers, or choose the right cage")


def _flagged(points: ImagePoints, flags: Int) -> ImagePoints:
    return ImagePoints(
        points.focus, points.role, points.number, points.shape, points.position_px, points.covariance_px2, flags, points.film
    )


def _joined(bundles: list[RayBundle]) -> RayBundle:
    return RayBundle(*(np.concatenate([getattr(b, item.name) for b in bundles]) for item in fields(RayBundle)))


def _object_groups(points: ImagePoints, bundle: RayBundle) -> Groups:
    """Rays of every object number, foci in rising order; numbers in the order of their first images."""
    ray_of = {int(row): ray for ray, row in enumerate(bundle.image)}
    groups: Groups = {}
    for row in np.flatnonzero(points.role == "object"):
        number = str(points.number[row])
        if not number:
            raise GeometryError(f"an object point of focus {points.focus[row]} has no number: name it, or make it unassigned")
        rays = groups.setdefault(number, [])
        if any(bundle.focus[ray] == points.focus[row] for ray in rays):
            raise GeometryError(f"object point {number} occurs twice at focus {points.focus[row]}: give every image its own number")
        rays.append(ray_of[int(row)])
    return {number: sorted(rays, key=lambda ray: int(bundle.focus[ray])) for number, rays in groups.items()}


def intersect(groups: Groups, bundle: RayBundle, flags: Int, limits: Limits) -> tuple[Markers, Float, Int]:
    """Reconstruct markers from groups of rays (step 3).

    Parameters
    ----------
    groups : dict of str to list of int
        Rows of the bundle by the name of the marker, foci in rising order.
    bundle : RayBundle
        ``image`` counts the rows of `flags`.
    flags : ndarray of int, shape (n,)
        Of every image.
    limits : Limits
        ``crossing_sigma`` is used.

    Returns
    -------
    markers : Markers
    distance_um : ndarray of shape (n,)
        Of every image's ray from its marker, NaN for images without one.
    flags : ndarray of int, shape (n,)
        With what was found here.
    """
    names = np.array(list(groups), dtype=np.str_)
    n = len(names)
    position, covariance = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    crossing, crossing_sd, parallax = (np.full(n, np.nan) for _ in range(3))
    distance = np.full(len(flags), np.nan)
    flags = flags.copy()
    finite = np.isfinite(bundle.through_mm.sum(axis=1))
    views = [[ray for ray in rays if finite[ray]] for rays in groups.values()]
    n_views = np.array([len(rays) for rays in views], dtype=np.int64)
    marker_flags = np.array([int(np.bitwise_or.reduce(flags[bundle.image[rays]])) for rays in groups.values()], dtype=np.int64)
    marker_flags[n_views < 2] |= MarkerFlag.ONE_VIEW
    for count in sorted(set(n_views[n_views > 1].tolist())):
        chosen = np.flatnonzero(n_views == count)
        rays = np.array([views[index] for index in chosen])
        through, origin = bundle.through_mm[rays], bundle.origin_mm[rays]
        point, residual = intersect_lines(origin, origin - through)
        towards = ((point[:, None] - through) * (origin - through)).sum(-1) / ((origin - through) ** 2).sum(-1)
        possible = (towards < 1).all(axis=1)  # NaN (parallel rays) is not
        marker_flags[chosen[~possible]] |= MarkerFlag.LARGE_RESIDUAL
        chosen, rays, through, origin = chosen[possible], rays[possible], through[possible], origin[possible]
        point, residual = point[possible], residual[possible]
        of_point, of_residual = intersection_jacobians(through, origin, point)
        of_residual = of_residual.reshape(len(chosen), 3 * count, count, 6)
        by_ray, by_cage = bundle.covariance_mm2[rays], bundle.cage_effect_mm[rays]
        effect = np.einsum("gkij,gkjm->gim", of_point, by_cage)
        position[chosen] = point
        covariance[chosen] = (of_point @ by_ray @ of_point.swapaxes(-1, -2)).sum(axis=1) + effect @ effect.swapaxes(-1, -2)
        effect = np.einsum("gikj,gkjm->gim", of_residual, by_cage)
        variance = np.einsum("gikj,gkjl,gikl->g", of_residual, by_ray, of_residual, optimize=True) + (effect**2).sum(axis=(1, 2))
        squares = (residual**2).sum(-1)
        distance[bundle.image[rays]] = np.sqrt(squares) * UM_PER_MM
        crossing[chosen] = 2 * np.sqrt(squares.mean(axis=1)) * UM_PER_MM
        crossing_sd[chosen] = 2 * np.sqrt(variance / count) * UM_PER_MM
        if count == 2:
            parallax[chosen] = (residual[:, 1] - residual[:, 0])[:, 1] * UM_PER_MM
    marker_flags[crossing > limits.crossing_sigma * crossing_sd] |= MarkerFlag.LARGE_RESIDUAL
    ray_flags = MarkerFlag.ONE_VIEW | MarkerFlag.LARGE_RESIDUAL
    for value, rays_of_marker in zip(marker_flags, groups.values(), strict=True):
        flags[bundle.image[rays_of_marker]] |= value & ray_flags
    return Markers(names, position, covariance, crossing, crossing_sd, parallax, n_views, marker_flags), distance, flags


def _camera_solution(focus: int, camera: Pinhole) -> FocusSolution:
    none = np.full((3, 3), np.nan)
    position = camera_centre(camera)
    figures = (np.nan, np.nan, np.nan, np.nan)
    covariance = np.zeros((11, 11))
    return FocusSolution(focus, none, position, np.zeros((3, 3)), *figures, 0, 0, 1.0, 1.0, np.nan, covariance, np.zeros((11, 0)))
