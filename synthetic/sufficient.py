"""Whether the images of a cage's marks can tell the foci at all: from the truth, and by nothing that a program makes of them."""

from __future__ import annotations

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.types import Float

FILM: int = 9
"""Unknowns of a film behind its plane: six of an affine map, its distance, two of its tilt; three of every focus are beside them."""


def coordinates_over(marks: int, foci: int) -> int:
    """Return how many coordinates of images are left to test a naming when those of all unknowns of a film are taken away."""
    return 2 * marks - FILM - 3 * foci


def focus_sd_mm(cage: Cage, focus: int, place_mm: Float, numbers: set[tuple[str, int]], error_mm: float) -> float:
    """Return how well marks determine a focus where nothing else is known: no film that is shared, no usual place, no usual scale.

    Parameters
    ----------
    cage : Cage
    focus : int
    place_mm : ndarray of shape (3,)
        The true focus, laboratory frame.
    numbers : set of (role, number)
        Marks that have an image of their own.
    error_mm : float
        Standard deviation of every coordinate of an image, in the plane.

    Returns
    -------
    float
        Standard deviation (mm) along the worst axis; infinite where the fiducial marks fix no projective transformation, or the control
        points no focus.

    Notes
    -----
    Linear propagation at the truth of the two equations that Selvik solves one after the other: an image lies where a projective
    transformation of the plane (eight unknowns, those of the fiducial marks) puts a point, and that of a control point is where the ray
    from the focus through it meets the plane.
    """
    plane = cage.plane_of(focus)
    axes = np.array([plane.u, plane.v, np.cross(plane.u, plane.v)])
    f = axes @ (np.asarray(place_mm) - plane.origin)
    marks = [m for m in cage.mark if focus in m.foci and (m.role, m.number) in numbers]
    if not marks:
        return np.inf
    points = np.array([axes @ (np.array(m.xyz) - plane.origin) for m in marks])
    control = np.array([m.role == "control" for m in marks])
    rise = np.where(control, f[2] - points[:, 2], 1.0)
    t = np.where(control, f[2] / rise, 1.0)
    u, v = (f[:2] + t[:, None] * (points[:, :2] - f[:2])).T if control.any() else points[:, :2].T
    u, v = np.where(control, u, points[:, 0]), np.where(control, v, points[:, 1])
    middle = np.array([u.mean(), v.mean()])
    size = max(float(np.ptp(u)), float(np.ptp(v)), 1.0)
    x, y = (u - middle[0]) / size, (v - middle[1]) / size
    zero, one = np.zeros_like(x), np.ones_like(x)
    slope = np.where(control, -points[:, 2] / rise**2, 0.0)  # of t by the height of the focus
    of_u = np.column_stack([x, y, one, zero, zero, zero, -x * x, -x * y, 1 - t, zero, (points[:, 0] - f[0]) * slope])
    of_v = np.column_stack([zero, zero, zero, x, y, one, -x * y, -y * y, zero, 1 - t, (points[:, 1] - f[1]) * slope])
    slopes = np.vstack([of_u, of_v])
    if np.linalg.matrix_rank(slopes) < slopes.shape[1]:
        return np.inf
    covariance = np.linalg.inv(slopes.T @ slopes)[8:, 8:] * error_mm**2
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
