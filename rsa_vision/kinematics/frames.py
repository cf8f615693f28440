"""The frame in which motion is told: that of the cage, an anatomical one, and left limbs as mirrored right ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rsa_vision.kinematics.series import Segment, Series
from rsa_vision.settings import Motion
from rsa_vision.types import Float

MIRROR: Final = np.diag([-1.0, 1.0, 1.0])


def frame_name(settings: Motion) -> str:
    """Return which frame the results are in, for the column ``frame``."""
    frame = "rotated" if settings.rotation else "axes through markers" if settings.axes else "cage"
    return frame if settings.side == "right" else f"{frame}, x mirrored"


def frame_matrix(series: Series, settings: Motion) -> Float:
    """Return the matrix that takes coordinates of the cage's frame to the frame of the results.

    Parameters
    ----------
    series : Series
        Its first examination with all the markers needed defines axes through markers.
    settings : Motion

    Returns
    -------
    ndarray of shape (3, 3)
        Orthonormal; with determinant -1 for a left limb, whose x axis is mirrored. NaN where the axes' markers are not found.
    """
    if settings.rotation:
        left, _, right = np.linalg.svd(np.array(settings.rotation))
        axes = left @ right
    elif settings.axes:
        axes = _marker_axes(series, settings.axes.x, settings.axes.y)
    else:
        axes = np.eye(3)
    result: Float = MIRROR @ axes if settings.side == "left" else axes
    return result


def _marker_axes(series: Series, x: tuple[str, str], y: tuple[str, str]) -> Float:
    places = {
        f"{segment.name}/{marker}": segment.position_mm[0, column]
        for segment in series.segments
        for column, marker in enumerate(segment.markers)
    }
    missing = np.full(3, np.nan)
    across, up = (places.get(pair[1], missing) - places.get(pair[0], missing) for pair in (x, y))
    with np.errstate(invalid="ignore", divide="ignore"):
        second = up / np.linalg.norm(up)
        first = across - (across @ second) * second
        first = first / np.linalg.norm(first)
    axes: Float = np.stack([first, second, np.cross(first, second)])
    return axes if np.isfinite(axes).all() else np.full((3, 3), np.nan)


def in_frame(series: Series, matrix: Float) -> Series:
    """Return a series with its coordinates and covariances in another frame.

    Parameters
    ----------
    series : Series
    matrix : ndarray of shape (3, 3)
        As of :func:`frame_matrix`.
    """
    if np.array_equal(matrix, np.eye(3)):
        return series
    return replace(series, segments=tuple(_turned(segment, matrix) for segment in series.segments))


def _turned(segment: Segment, matrix: Float) -> Segment:
    return replace(segment, position_mm=segment.position_mm @ matrix.T, covariance_mm2=matrix @ segment.covariance_mm2 @ matrix.T)
