"""The screw axis of a rigid motion: every motion is a rotation about a line and a translation along it (Selvik 7:4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from rsa_vision.types import Float

NO_ROTATION_RAD: Final = 1e-9  # the axis of a smaller rotation is rounding
PARALLEL: Final = 1e-12  # component of the axis below which it does not meet a coordinate plane
SINGLE: Final = 9  # errors of a motion: rotation vector, translation of the centre of gravity, centre of gravity


@dataclass(frozen=True, slots=True, eq=False)
class Screws:
    """Screw axes of k motions.

    Attributes
    ----------
    angle_rad : ndarray of shape (k,)
        In [0, pi]. At pi the sense of the axis is a matter of choice.
    axis : ndarray of shape (k, 3)
        Unit vector, about which the rotation is right-handed; NaN where there is no rotation.
    shift_mm : ndarray of shape (k,)
        Translation along the axis. Without a rotation: length of the translation.
    foot_mm : ndarray of shape (k, 3)
        Point of the axis next to the origin; NaN where there is no rotation.
    planes_mm : ndarray of shape (k, 3, 3)
        Where the axis meets the planes x = 0, y = 0 and z = 0; NaN where it is parallel to one.
    """

    angle_rad: Float
    axis: Float
    shift_mm: Float
    foot_mm: Float
    planes_mm: Float


def find_screws(rotation: Float, shift_mm: Float, point_mm: Float) -> Screws:
    """Return the screw axes of motions that turn by `rotation` and move the point `point_mm` by `shift_mm`.

    Parameters
    ----------
    rotation : ndarray of shape (k, 3, 3)
    shift_mm, point_mm : ndarray of shape (k, 3)

    Returns
    -------
    Screws

    Notes
    -----
    The axis is the eigenvector of the rotation for the eigenvalue 1; the point of the axis next to P is
    ``P + (D + cot(angle / 2) e x D) / 2`` with the part D of P's translation across the axis e.
    """
    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = np.linalg.norm(vector, axis=1)
    turns = angle > NO_ROTATION_RAD
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(turns[:, None], vector / angle[:, None], np.nan)
        along = (axis * shift_mm).sum(axis=1)
        across = shift_mm - along[:, None] * axis
        near = point_mm + (across + np.cross(axis, across) / np.tan(angle / 2)[:, None]) / 2
        foot = near - (near * axis).sum(axis=1)[:, None] * axis
        reach = np.where(np.abs(axis) > PARALLEL, -foot / axis, np.nan)  # along the axis, to the planes
    planes = foot[:, None, :] + reach[:, :, None] * axis[:, None, :]
    on_plane = np.eye(3, dtype=bool) & np.isfinite(planes)
    return Screws(
        angle, axis + 0.0, np.where(turns, along, np.linalg.norm(shift_mm, axis=1)), foot + 0.0, np.where(on_plane, 0.0, planes) + 0.0
    )


def screw_jacobians(screws: Screws, shift_mm: Float, point_mm: Float) -> tuple[Float, Float, Float, Float]:
    """Return the derivatives of screws by the motion and its point.

    Parameters
    ----------
    screws : Screws
    shift_mm, point_mm : ndarray of shape (k, 3)
        As of :func:`find_screws`.

    Returns
    -------
    angle : ndarray of shape (k, 9)
        By a small further rotation about the axes of the frame (rad), by the translation and by the point (mm).
    axis : ndarray of shape (k, 3, 9)
    shift_mm : ndarray of shape (k, 9)
    foot_mm : ndarray of shape (k, 3, 9)
    """
    axis, k = screws.axis, len(screws.axis)
    half = screws.angle_rad[:, None, None] / 2
    outer = axis[:, :, None] * axis[:, None, :]
    across = np.eye(3) - outer
    turn, shift, point = (np.broadcast_to(part, (k, 3, SINGLE)) for part in np.split(np.eye(SINGLE), 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        cotangent = 1 / np.tan(half)
        by_angle = (axis[:, None, :] @ turn)[:, 0]
        # of the rotation vector: inverse left Jacobian of SO(3)
        by_axis = (cotangent * across - _cross(axis)) @ turn / 2
        by_shift = (axis[:, None, :] @ shift + shift_mm[:, None, :] @ by_axis)[:, 0]
        along = (axis * shift_mm).sum(axis=1)[:, None, None]
        offset = shift_mm - along[:, :, 0] * axis
        by_offset = shift - axis[:, :, None] * by_shift[:, None, :] - along * by_axis
        lever = np.cross(axis, offset)
        near = point_mm + (offset + lever * cotangent[:, :, 0]) / 2
        by_lever = _cross(axis) @ by_offset - _cross(offset) @ by_axis
        by_near = point + (by_offset + cotangent * by_lever - lever[:, :, None] * by_angle[:, None, :] / (2 * np.sin(half) ** 2)) / 2
        height = (near * axis).sum(axis=1)[:, None, None]
        by_foot = across @ by_near - axis[:, :, None] * (near[:, None, :] @ by_axis) - height * by_axis
    return by_angle, by_axis, by_shift, by_foot


def _cross(vector: Float) -> Float:
    """Return the matrices that multiply from the left with a vector: shape (k, 3) to (k, 3, 3)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack(row, axis=-1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], axis=-2)
