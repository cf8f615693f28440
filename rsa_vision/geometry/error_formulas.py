"""Selvik's error formulas for two foci at the same height over the fiducial plane (Selvik 1989, ch. 5).

They hold for an object half-way between the foci and errors in one plane; the propagation in :mod:`rsa_vision.xray` holds everywhere.
Errors keep the unit they are given in; all lengths of the set-up are mm.
"""

from __future__ import annotations

import numpy as np

from rsa_vision.types import Float


def model_error(parallax_error: float, mean_error: float, *, c_mm: float, b_mm: float, h_mm: float, y_mm: float) -> Float:
    """Error of a model point by errors of its image coordinates (5:1).

    Parameters
    ----------
    parallax_error : float
        dx', error of the difference of the two x' (of the first image minus the second).
    mean_error : float
        dy', error of the mean of the two y'.
    c_mm : float
        Distance of the foci from the film plane.
    b_mm : float
        Base: distance between the foci.
    h_mm : float
        Height from the foci down to the point.
    y_mm : float
        Distance of the point from the vertical plane of the foci.

    Returns
    -------
    ndarray of shape (3,)
        dx of a point whose parallax error is in one image only, dy, dz.
    """
    across = parallax_error * h_mm / (b_mm * c_mm)
    return np.array([parallax_error * h_mm / (2 * c_mm), across * y_mm + mean_error * h_mm / c_mm, across * h_mm])


def model_sd(sx: float, sy: float, *, c_mm: float, b_mm: float, h_mm: float, y_mm: float = 0.0) -> Float:
    """Standard deviations of a model point by those of one image coordinate along and across the base (5:2).

    Parameters
    ----------
    sx, sy : float
        Standard deviation of one image coordinate x' and y'.
    c_mm, b_mm, h_mm, y_mm : float
        As of :func:`model_error`.

    Returns
    -------
    ndarray of shape (3,)
    """
    along = model_error(np.sqrt(2) * sx, 0.0, c_mm=c_mm, b_mm=b_mm, h_mm=h_mm, y_mm=y_mm)
    across = model_error(0.0, sy / np.sqrt(2), c_mm=c_mm, b_mm=b_mm, h_mm=h_mm, y_mm=y_mm)
    result: Float = np.hypot(along, across)
    return result


def common_shift_effect(shift: Float, *, z_focus_mm: float, z_mm: float) -> Float:
    """Shift of a model point by a common shift of both foci (5:4).

    Parameters
    ----------
    shift : ndarray of shape (3,)
        Of both foci.
    z_focus_mm, z_mm : float
        Heights of the foci and of the point over the fiducial plane.

    Returns
    -------
    ndarray of shape (3,)
    """
    return shift * (z_mm / z_focus_mm)


def base_effect(base_error: float, *, b_mm: float, z_focus_mm: float, z_mm: float, h_mm: float, y_mm: float) -> Float:
    """Shift of a model point by an error of the base, one focus being moved along it (5:5).

    Parameters
    ----------
    base_error : float
        db.
    b_mm, z_focus_mm, z_mm : float
        Base, heights of the foci and of the point over the fiducial plane.
    h_mm, y_mm : float
        As of :func:`model_error`.

    Returns
    -------
    ndarray of shape (3,)
    """
    across = base_error * z_mm / (b_mm * z_focus_mm)
    return np.array([base_error * z_mm / (2 * z_focus_mm), across * y_mm, across * h_mm])


def plate_effect(shift: Float, *, z_plate_mm: float, z_mm: float) -> Float:
    """Shift of a focus (3:4) or of a model point (3:5) by a shift of the whole plate of control points.

    Parameters
    ----------
    shift : ndarray of shape (3,)
    z_plate_mm, z_mm : float
        Heights over the fiducial plane of the plate, and of the focus or the point.

    Returns
    -------
    ndarray of shape (3,)
    """
    return shift * (z_mm / z_plate_mm)
