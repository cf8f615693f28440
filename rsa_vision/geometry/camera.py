"""Rays of calibrated pinhole cameras (OpenCV's convention; the centre of the first pixel is (0, 0))."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from rsa_vision.errors import CalibrationError
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.types import Float, Int


class Pinhole(Protocol):
    """What is needed of a camera: ``px ~ matrix (rotation X + translation)``."""

    @property
    def matrix(self) -> Float:
        """Shape (3, 3), px."""

    @property
    def rotation(self) -> Float:
        """Shape (3, 3), camera from calibration frame."""

    @property
    def translation(self) -> Float:
        """Shape (3,), mm."""


def camera_centre(camera: Pinhole) -> Float:
    """Return the focus of a camera in the calibration's frame.

    Parameters
    ----------
    camera : Pinhole

    Returns
    -------
    ndarray of shape (3,)
    """
    return np.asarray(-np.linalg.solve(camera.rotation, camera.translation), dtype=np.float64)


def project(camera: Pinhole, points_mm: Float) -> Float:
    """Project points.

    Parameters
    ----------
    camera : Pinhole
    points_mm : ndarray of shape (n, 3)

    Returns
    -------
    ndarray of shape (n, 2)
        (col, row) in px.
    """
    homogeneous = (points_mm @ camera.rotation.T + camera.translation) @ camera.matrix.T
    result: Float = homogeneous[:, :2] / homogeneous[:, 2:]
    return result


def pixel_rays(camera: Pinhole, px: Float) -> tuple[Float, Float, Float]:
    """Return the rays of pixels and their derivatives.

    Parameters
    ----------
    camera : Pinhole
    px : ndarray of shape (n, 2)
        (col, row).

    Returns
    -------
    origin_mm : ndarray of shape (3,)
        The focus.
    through_mm : ndarray of shape (n, 3)
        A point of every ray at the depth of the calibration frame's origin, so that its error is about that of an object there.
    by_pixel : ndarray of shape (n, 3, 2)
        Derivative of that point by (col, row).

    Raises
    ------
    CalibrationError
        If the camera matrix or rotation is singular.
    """
    try:
        origin = camera_centre(camera)
        inverse = np.linalg.inv(camera.matrix @ camera.rotation)
    except np.linalg.LinAlgError as error:
        raise CalibrationError("the camera matrix or rotation is singular: calibrate again") from error
    depth = float(np.linalg.norm(camera.translation)) or 1.0
    # matrix has the last row (0, 0, 1), so the ray is linear in the pixel at fixed depth
    through = origin + depth * (np.column_stack([px, np.ones(len(px))]) @ inverse.T)
    return origin, through, np.broadcast_to(depth * inverse[:, :2], (len(px), 3, 2))


def camera_rays(camera: Pinhole, focus: int, px: Float, covariance_px2: Float, image: Int, *, calibration_px: float = 0.0) -> RayBundle:
    """Return a bundle of rays whose errors are those of the images and, if given, of the calibration.

    Parameters
    ----------
    camera : Pinhole
    focus : int
    px : ndarray of shape (n, 2)
    covariance_px2 : ndarray of shape (n, 2, 2)
    image : ndarray of int, shape (n,)
        Rows of the table of images.
    calibration_px : float
        Error of the calibration, as a standard deviation of each image coordinate.

    Returns
    -------
    RayBundle
    """
    origin, through, by_pixel = pixel_rays(camera, px)
    covariance = np.zeros((len(px), 6, 6))
    covariance[:, :3, :3] = by_pixel @ (covariance_px2 + calibration_px**2 * np.eye(2)) @ by_pixel.swapaxes(1, 2)
    focuses = np.full(len(px), focus, np.int64)
    return RayBundle(image, focuses, np.tile(origin, (len(px), 1)), through, covariance, np.zeros((len(px), 6, 0)))
