"""Euler angles about body-fixed axes X, Y, Z in this order: ``M = Mx(phi) My(psi) Mz(theta)`` (Selvik 6:5, 6:6)."""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.types import Float

SINGULAR_COS: Final = 1e-7
"""Cosine of psi below which phi and theta are not told apart: rounding of the matrix (1e-16) would be 1e-9 rad of either."""


def euler_from_matrix(rotation: Float) -> Float:
    """Return the angles of rotations.

    Parameters
    ----------
    rotation : ndarray of shape (..., 3, 3)

    Returns
    -------
    ndarray of shape (..., 3)
        phi, psi, theta in rad; phi and theta in (-pi, pi], psi in [-pi/2, pi/2]. Where psi is +-pi/2 only the sum or difference of phi and
        theta is determined: both are NaN there.
    """
    cosine = np.hypot(rotation[..., 0, 0], rotation[..., 0, 1])  # keeps its digits near +-90 deg, where the arcsine loses half of them
    phi = np.arctan2(-rotation[..., 1, 2], rotation[..., 2, 2])
    psi = np.arctan2(rotation[..., 0, 2], cosine)
    theta = np.arctan2(-rotation[..., 0, 1], rotation[..., 0, 0])
    determined = cosine > SINGULAR_COS
    angles: Float = np.stack([np.where(determined, phi, np.nan), psi, np.where(determined, theta, np.nan)], axis=-1)
    return angles + 0.0  # no "-0"


def euler_jacobian(angles_rad: Float) -> Float:
    """Return the derivative of the angles by a small further rotation about the axes of the fixed frame.

    Parameters
    ----------
    angles_rad : ndarray of shape (..., 3)
        phi, psi, theta.

    Returns
    -------
    ndarray of shape (..., 3, 3)
        Inverse of the matrix of the three axes ``ex``, ``Mx ey``, ``Mx My ez``. Where phi is not determined only the row of psi would be
        finite, and that depends on phi: all NaN.
    """
    phi, psi = angles_rad[..., 0], angles_rad[..., 1]
    sine, cosine, tangent = np.sin(phi), np.cos(phi), np.tan(psi)
    secant = 1 / np.cos(psi)
    one, zero = np.ones_like(phi), np.zeros_like(phi)
    rows = [[one, sine * tangent, -cosine * tangent], [zero, cosine, sine], [zero, -sine * secant, cosine * secant]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
