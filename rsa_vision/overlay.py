"""Pictures of films with what was found on them: previews and overlays as PNG or JPEG."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import MarkerImages

PREVIEW_PX: Final = 1300  # longest side: marks of 5 px on a 3000 px film are still seen
DISPLAYED: Final = (0.2, 99.8)  # percentiles of the values that become black and white
JPEG_QUALITY: Final = 72
COLOUR: Final = {"ball": (80, 200, 255), "pin": (120, 255, 120), "tee": (255, 170, 60)}  # BGR

Grey = NDArray[np.uint8]


def preview(values: NDArray[Any], longest_px: int = PREVIEW_PX) -> Grey:
    """Return a film reduced in size and windowed to 8 bits.

    Parameters
    ----------
    values : ndarray of shape (rows, cols)
    longest_px : int
        Longest side of the result; smaller films are not enlarged.

    Returns
    -------
    ndarray of uint8
    """
    rows, cols = values.shape
    scale = min(1.0, longest_px / max(rows, cols))
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    small = cv2.resize(values, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    low, high = np.percentile(small, DISPLAYED)
    scaled: Grey = np.clip((small - low) * (255 / max(high - low, 1e-6)), 0, 255).astype(np.uint8)
    return scaled


def jpeg(picture: Grey) -> bytes:
    """Return a picture as JPEG."""
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def overlay_png(values: NDArray[Any], images: MarkerImages) -> bytes:
    """Draw every marker image on its film at full size.

    Parameters
    ----------
    values : ndarray of shape (rows, cols)
    images : MarkerImages

    Returns
    -------
    bytes
        PNG; circles round balls, the direction of pins and of the stems of tees as lines from tip to thick end.
    """
    canvas = cv2.cvtColor(preview(values, max(values.shape)), cv2.COLOR_GRAY2BGR)
    shift = 4  # sub-pixel bits of OpenCV's drawing
    for (col, row), shape, radius, angle in zip(images.position_px, images.shape, images.radius_px, images.angle_deg, strict=True):
        if not np.isfinite([col, row]).all():
            continue
        colour = COLOUR.get(str(shape), (255, 255, 255))
        reach = float(np.nan_to_num(radius, nan=4.0)) * (1.0 if shape == "ball" else 2.0) + 4.0
        centre = round(float(col) * 2**shift), round(float(row) * 2**shift)
        cv2.circle(canvas, centre, round(reach * 2**shift), colour, 1, cv2.LINE_AA, shift)
        if np.isfinite(angle):
            end = col + 3 * reach * np.cos(np.deg2rad(angle)), row - 3 * reach * np.sin(np.deg2rad(angle))
            cv2.line(canvas, centre, (round(end[0] * 2**shift), round(end[1] * 2**shift)), colour, 1, cv2.LINE_AA, shift)
    return bytes(cv2.imencode(".png", canvas)[1])
