"""Position of a focus from the lines through control points and their transformed images (Selvik 1989, ch. 2, step 2)."""

from __future__ import annotations

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.rays import intersect_lines
from rsa_vision.types import Float


def locate_focus(through_mm: Float, control_mm: Float) -> tuple[Float, Float]:
    """Find the focus with the least sum of squared distances to the lines (2:4), in closed form.

    Parameters
    ----------
    through_mm : ndarray of shape (n, 3)
        Images of the control points, transformed to the fiducial plane (r0v).
    control_mm : ndarray of shape (n, 3)
        The control points (rCv).

    Returns
    -------
    focus_mm : ndarray of shape (3,)
    residuals_mm : ndarray of shape (n, 3)
        From the focus perpendicularly to every line; their lengths are the line-to-focus distances.

    Raises
    ------
    GeometryError
        For fewer than two lines, control points that coincide with their images, or parallel lines.
    """
    if len(through_mm) < 2:
        raise GeometryError(f"{len(through_mm)} control points, at least 2 are needed: measure more of them")
    direction = control_mm - through_mm
    if not (np.linalg.norm(direction, axis=1) > 0).all():
        raise GeometryError("a control point lies in the fiducial plane and gives no direction: look at the cage's coordinates")
    focus, residuals = intersect_lines(through_mm, direction)
    if not np.isfinite(focus).all():
        raise GeometryError("the lines through the control points are parallel and fix no focus: look at the numbers of the control points")
    return focus, residuals
