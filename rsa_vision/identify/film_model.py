"""How the marks of a cage fall on one film: a physical model with priors, its best fit, and the evidence for it.

One film lies behind a fiducial plane, at a small unknown distance and nearly parallel to it; the scanner maps it by an affine
transformation that is nearly a similarity of known scale. All foci of the film share these nine unknowns and add three each, far fewer
than one homography for each focus: what a wrong naming would need, the model cannot give.

Coordinates: plane frame (u, v, w), mm, w towards the foci; film frame (x, y), mm, x right and y up as displayed.
Parameters: A00, A01, A10, A11, bx, by (film from plane), gap, tilt about v and u, and (u, v, w) of every focus.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.cages import Cage, Mark
from rsa_vision.types import Bool, Float, Int, Str

FILM: Final = 9  # parameters of the film; three of every focus follow
SCALE_SD: Final = 0.025  # pixel pitch wrong by up to 3 %
SHEAR_SD: Final = 0.010  # half the anisotropy and shear of a scanner, up to 2 %
GAP_MM: Final = 12.0  # film to plane: 0..40 mm; a wide prior around Selvik's 8 and 10 mm
GAP_SD_MM: Final = 12.0
TILT_SD: Final = 0.02  # of the film to the plane, rad
USUAL: Final = 0.8  # part of all set-ups whose foci lie within a few centimetres of their nominal places
USUAL_SD_MM: Final = 25.0
FOCUS_SD_MM: Final = 100.0  # of each coordinate about the nominal focus; the limit is 150 mm


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Every image that the marks of a cage may have on one film: one row for each focus and mark.

    Attributes
    ----------
    foci : tuple of int
    nominal_mm : ndarray of shape (k, 3)
        Nominal foci in the plane frame.
    origin_mm : ndarray of shape (2,)
        Middle of the fiducial marks in the plane: the pivot of the film's tilt.
    focus : ndarray of int, shape (m,)
        Index into ``foci``.
    xyz_mm : ndarray of shape (m, 3)
        The mark in the plane frame.
    stem : ndarray of shape (m, 3)
        Direction of a tee's stem or of a pin; NaN for balls.
    own : ndarray of bool, shape (m,)
        False for marks that this focus is not meant to see.
    fiducial : ndarray of bool, shape (m,)
    shape : ndarray of str, shape (m,)
    size_mm : ndarray of shape (m,)
        Diameter of a ball or of the pins.
    arms_mm : ndarray of shape (m, a, 3)
        Pins of the mark, from its reference point to their thick ends; NaN where it has fewer.
    mark : ndarray of int, shape (m,)
        Index into ``cage.mark``.
    """

    foci: tuple[int, ...]
    nominal_mm: Float
    origin_mm: Float
    lab_origin_mm: Float
    frame: Float
    focus: Int
    xyz_mm: Float
    stem: Float
    own: Bool
    fiducial: Bool
    shape: Str
    size_mm: Float
    arms_mm: Float
    mark: Int

    def lab_mm(self, uvw: Float) -> Float:
        """Return points of the plane frame in the laboratory frame."""
        lab: Float = self.lab_origin_mm + uvw @ self.frame
        return lab


def build_scene(cage: Cage, foci: tuple[int, ...], foci_mm: Mapping[int, Float]) -> Scene:
    """List what may be seen on a film that the given foci share.

    Parameters
    ----------
    cage : Cage
    foci : tuple of int
        The foci of this film; all have the same plane.
    foci_mm : mapping
        Nominal foci in the laboratory frame.

    Returns
    -------
    Scene
    """
    plane = cage.plane_of(foci[0])
    origin, basis = plane.lab_from_plane()
    frame = np.vstack([basis, np.cross(basis[0], basis[1])])
    placed = (np.array([m.xyz for m in cage.mark]) - origin) @ frame.T
    count = len(cage.mark)
    stems = np.array([_stem(m) for m in cage.mark]) @ frame.T
    nominal = (np.array([foci_mm[f] for f in foci]) - origin) @ frame.T
    own = np.concatenate([[f in m.foci for m in cage.mark] for f in foci])
    fiducial = np.tile([m.role == "fiducial" for m in cage.mark], len(foci))
    xyz = np.tile(placed, (len(foci), 1))
    focus = np.repeat(np.arange(len(foci)), count)
    keep = xyz[:, 2] < 0.9 * nominal[focus, 2]  # what lies beside or above a focus has no image
    keep &= own | (xyz[:, 2] > -1.0)  # nor has what lies behind the film
    middle = xyz[own & fiducial, :2].mean(axis=0)
    return Scene(
        foci,
        nominal,
        middle,
        origin,
        frame,
        focus[keep],
        xyz[keep],
        np.tile(stems, (len(foci), 1))[keep],
        own[keep],
        (fiducial & own)[keep],
        np.tile([m.shape for m in cage.mark], len(foci))[keep],
        np.tile([m.diameter for m in cage.mark], len(foci))[keep],
        np.tile(_arms(cage), (len(foci), 1, 1))[keep] @ frame.T,
        np.tile(np.arange(count), len(foci))[keep],
    )


def _arms(cage: Cage) -> Float:
    arms = np.full((len(cage.mark), max(1, *(len(m.arms) for m in cage.mark)), 3), np.nan)
    for row, mark in zip(arms, cage.mark, strict=True):
        for place, arm in zip(row, mark.arms, strict=False):
            place[:] = np.array(arm) * (mark.length or mark.diameter) / np.linalg.norm(arm)
    return arms


def _stem(mark: Mark) -> tuple[float, float, float]:
    """Return the arm without an opposite (a pin's only arm)."""
    for arm in mark.arms:
        if not any(np.allclose(arm, np.negative(other), atol=1e-3) for other in mark.arms):
            return arm
    return (np.nan, np.nan, np.nan)


def project(scene: Scene, parameters: Float, rows: Int | slice = slice(None), *, xyz_mm: Float | None = None) -> Float:
    """Return the film coordinates of marks, shape (n, 2), mm."""
    position, *_ = _on_film(scene, parameters, rows, xyz_mm)
    return (position - scene.origin_mm) @ parameters[:4].reshape(2, 2).T + parameters[4:6]


def _on_film(
    scene: Scene, parameters: Float, rows: Int | slice, xyz_mm: Float | None = None
) -> tuple[Float, Float, Float, Float, Float, Float]:
    """Meet rays with the film: (u, v) there, offsets mark - focus, foci, fraction t of the ray, its denominator, tilt."""
    mark = scene.xyz_mm[rows] if xyz_mm is None else xyz_mm
    focus = parameters[FILM:].reshape(-1, 3)[scene.focus[rows]]
    gap, tilt = parameters[6], parameters[7:9]
    offset = mark - focus
    numerator = focus[:, 2] + gap - (focus[:, :2] - scene.origin_mm) @ tilt
    denominator = -offset[:, 2] + offset[:, :2] @ tilt
    fraction = numerator / denominator
    return focus[:, :2] + fraction[:, None] * offset[:, :2], offset, focus, fraction, denominator, tilt


def jacobian(scene: Scene, parameters: Float, rows: Int) -> tuple[Float, Float]:
    """Return film coordinates, shape (n, 2), and their derivatives by all parameters, shape (n, 2, p)."""
    position, offset, focus, t, denominator, tilt = _on_film(scene, parameters, rows)
    A = parameters[:4].reshape(2, 2)
    relative = position - scene.origin_mm
    n = len(relative)
    of_film = np.zeros((n, 2, 4))  # du, dv by gap, tilt u, tilt v are columns 0..2
    of_film[:, :, 0] = offset[:, :2] / denominator[:, None]
    for axis in range(2):
        dt = (-(focus[:, axis] - scene.origin_mm[axis]) - t * offset[:, axis]) / denominator
        of_film[:, :, 1 + axis] = dt[:, None] * offset[:, :2]
    of_focus = np.zeros((n, 2, 3))
    for axis in range(2):
        of_focus[:, :, axis] = (tilt[axis] * (t - 1) / denominator)[:, None] * offset[:, :2]
        of_focus[:, axis, axis] += 1 - t
    of_focus[:, :, 2] = ((1 - t) / denominator)[:, None] * offset[:, :2]
    result = np.zeros((n, 2, len(parameters)))
    result[:, 0, 0:2] = relative
    result[:, 1, 2:4] = relative
    result[:, 0, 4] = result[:, 1, 5] = 1
    result[:, :, 6:9] = A @ of_film[:, :, :3]
    columns = FILM + 3 * scene.focus[rows][:, None] + np.arange(3)
    result[np.arange(n)[:, None, None], np.arange(2)[None, :, None], columns[:, None, :]] = A @ of_focus
    return relative @ A.T + parameters[4:6], result


def _prior(scene: Scene, parameters: Float) -> tuple[Float, Float]:
    """Return residuals of the priors in units of their standard deviations, and their derivatives."""
    a, b, c, d = parameters[:4]
    cos, sin = (a + d) / 2, (c - b) / 2
    size = np.hypot(cos, sin)
    count = len(parameters)
    values = np.concatenate(
        [
            [(size - 1) / SCALE_SD, (a - d) / 2 / SHEAR_SD, (b + c) / 2 / SHEAR_SD, (parameters[6] - GAP_MM) / GAP_SD_MM],
            parameters[7:9] / TILT_SD,
            (parameters[FILM:] - scene.nominal_mm.ravel()) / FOCUS_SD_MM,
        ]
    )
    slopes = np.zeros((len(values), count))
    slopes[0, :4] = np.array([cos, -sin, sin, cos]) / (2 * size * SCALE_SD)
    slopes[1, [0, 3]] = np.array([1, -1]) / (2 * SHEAR_SD)
    slopes[2, [1, 2]] = 1 / (2 * SHEAR_SD)
    slopes[3, 6] = 1 / GAP_SD_MM
    slopes[[4, 5], [7, 8]] = 1 / TILT_SD
    slopes[np.arange(6, len(values)), np.arange(FILM, count)] = 1 / FOCUS_SD_MM
    return values, slopes


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Most probable parameters for given images of given marks.

    Attributes
    ----------
    parameters : ndarray of shape (p,)
    covariance : ndarray of shape (p, p)
    residual_mm : ndarray of shape (n, 2)
        Observed - fitted.
    jacobian : ndarray of shape (n, 2, p)
    log_prior : float
        Of the parameters, integrated over their uncertainty (Laplace), without the part that is common to all hypotheses on this film:
        position and rotation of the film.
    """

    parameters: Float
    covariance: Float
    residual_mm: Float
    jacobian: Float
    log_prior: float


def fit(scene: Scene, start: Float, rows: Int, observed_mm: Float, covariance_mm2: Float, *, steps: int = 3) -> Fit:
    """Fit the film model to named images by Gauss-Newton steps on the sum of squares with priors.

    Parameters
    ----------
    scene : Scene
    start : ndarray of shape (p,)
    rows : ndarray of int, shape (n,)
        Rows of the scene that were observed.
    observed_mm : ndarray of shape (n, 2)
    covariance_mm2 : ndarray of shape (n, 2, 2)
    steps : int

    Returns
    -------
    Fit

    Raises
    ------
    numpy.linalg.LinAlgError
        If the normal equations are singular or a number is not finite.
    """
    weight = np.linalg.inv(covariance_mm2)
    parameters = start
    for _ in range(steps):
        predicted, slopes = jacobian(scene, parameters, rows)
        prior, prior_slopes = _prior(scene, parameters)
        weighted = (weight @ slopes).reshape(-1, len(start))
        flat = slopes.reshape(-1, len(start))
        hessian = flat.T @ weighted + prior_slopes.T @ prior_slopes
        gradient = weighted.T @ (observed_mm - predicted).ravel() - prior_slopes.T @ prior
        if not np.isfinite(hessian).all():
            raise np.linalg.LinAlgError("not finite")
        parameters = parameters + np.linalg.solve(hessian, gradient)
    predicted, slopes = jacobian(scene, parameters, rows)
    prior, _ = _prior(scene, parameters)
    normalisers = np.log([SCALE_SD, SHEAR_SD, SHEAR_SD, GAP_SD_MM, TILT_SD, TILT_SD, *[FOCUS_SD_MM] * (len(start) - FILM)]).sum()
    # six dimensions of the prior stand against p - 3 Gaussian ones and three uniform ones (position and rotation of the film)
    sign, log_determinant = np.linalg.slogdet(hessian)
    if sign <= 0:
        raise np.linalg.LinAlgError("not a minimum")
    log_prior = -0.5 * float(prior @ prior) - float(normalisers) - 0.5 * float(log_determinant) + 1.5 * np.log(2 * np.pi) - np.log(4)
    log_prior += _usual_foci(scene, parameters)
    return Fit(parameters, np.asarray(np.linalg.inv(hessian), float), observed_mm - predicted, slopes, float(log_prior))


def _usual_foci(scene: Scene, parameters: Float) -> float:
    """Log of how much likelier foci so near to nominal are than the wide prior has it: most set-ups repeat within centimetres."""
    square = ((parameters[FILM:].reshape(-1, 3) - scene.nominal_mm) ** 2).sum(axis=1)
    near = np.log(USUAL) - 1.5 * np.log(2 * np.pi * USUAL_SD_MM**2) - square / (2 * USUAL_SD_MM**2)
    far = np.log(1 - USUAL) - 1.5 * np.log(2 * np.pi * FOCUS_SD_MM**2) - square / (2 * FOCUS_SD_MM**2)
    wide = -1.5 * np.log(2 * np.pi * FOCUS_SD_MM**2) - square / (2 * FOCUS_SD_MM**2)
    return float((np.logaddexp(near, far) - wide).sum())


def plane_from_film(scene: Scene, parameters: Float, focus: int) -> Float:
    """Return the projective transformation of one focus (index into ``scene.foci``), shape (3, 3): film mm to plane mm.

    The film point is moved along its ray to the plane: with e the height of the film above the plane there, x = f + (q - f) h / (h - e).
    """
    A = parameters[:4].reshape(2, 2)
    back = np.eye(3)
    back[:2, :2] = np.linalg.inv(A)
    back[:2, 2] = scene.origin_mm - back[:2, :2] @ parameters[4:6]
    f = parameters[FILM + 3 * focus : FILM + 3 * focus + 3]
    tilt = parameters[7:9]
    elevation = np.array([tilt[0], tilt[1], -parameters[6] - tilt @ scene.origin_mm])  # of the film, linear in (u, v, 1)
    below = np.array([0, 0, f[2]]) - elevation
    to_plane = np.vstack([f[2] * np.eye(3)[axis] - f[axis] * elevation for axis in range(2)] + [below])
    H = to_plane @ back
    result: Float = H / H[2, 2]
    return result
