"""Pictures of films with what was found on them: previews and overlays as PNG or JPEG."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.flags import MarkerFlag, flag_names
from rsa_vision.types import MarkerImages

PREVIEW_PX: Final = 1300  # longest side: marks of 5 px on a 3000 px film are still seen
DISPLAYED: Final = (0.2, 99.8)  # percentiles of the values that become black and white
JPEG_QUALITY: Final = 72
COLOUR: Final = {"ball": (0, 165, 255), "pin": (0, 210, 0), "tee": (255, 150, 40)}  # BGR; seen on black and on white

DOUBT: Final = (80, 60, 255)
DOUBTFUL: Final = MarkerFlag.CLIPPED | MarkerFlag.POOR_FIT | MarkerFlag.UNLIKE
RING, WIDTH = 5.0, 1.5  # px from a mark to its circle, and of the line, on a film of PREVIEW_PX
DASHES: Final = 6
SHIFT: Final = 4  # sub-pixel bits of OpenCV's drawing

Grey = NDArray[np.uint8]
Colour = tuple[int, int, int]


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
    """Draw every marker image on its film at full size, with a legend; lines grow with the film, which a screen shows reduced.

    Parameters
    ----------
    values : ndarray of shape (rows, cols)
    images : MarkerImages

    Returns
    -------
    bytes
        PNG; circles round balls, the direction of pins and of the stems of tees as lines from tip to thick end. Circles of marks that
        may be none or lie elsewhere, by one of the flags ``DOUBTFUL``, are broken.
    """
    canvas = cv2.cvtColor(preview(values, max(values.shape)), cv2.COLOR_GRAY2BGR)
    unit = max(1.0, max(values.shape) / PREVIEW_PX)
    _legend(canvas, unit)
    doubtful = images.flags & DOUBTFUL != 0
    marks = zip(images.position_px, images.shape, images.radius_px, images.angle_deg, doubtful, strict=True)
    for (col, row), shape, radius, angle, doubt in marks:
        if not np.isfinite([col, row]).all():
            continue
        colour = COLOUR[str(shape)]
        reach = float(np.nan_to_num(radius, nan=4.0)) * (1.0 if shape == "ball" else 2.0) + RING * unit
        _ring(canvas, (col, row), reach, None if doubt else colour, unit)
        if np.isfinite(angle):
            end = col + 3 * reach * np.cos(np.deg2rad(angle)), row - 3 * reach * np.sin(np.deg2rad(angle))
            cv2.line(canvas, _fixed((col, row)), _fixed(end), colour, round(WIDTH * unit), cv2.LINE_AA, SHIFT)
    return bytes(cv2.imencode(".png", canvas)[1])


def _fixed(place: Any) -> tuple[int, int]:
    return round(float(place[0]) * 2**SHIFT), round(float(place[1]) * 2**SHIFT)


def _ring(canvas: NDArray[Any], centre: Any, reach: float, colour: Colour | None, unit: float) -> None:
    """Draw a circle, a broken one where there is no colour."""
    step = 360 // (1 if colour else 2 * DASHES)
    for start in range(0, 360, 2 * step):
        width = round(WIDTH * unit)
        cv2.ellipse(canvas, _fixed(centre), _fixed((reach, reach)), 0, start, start + step, colour or DOUBT, width, cv2.LINE_AA, SHIFT)


def _legend(canvas: NDArray[Any], unit: float) -> None:
    """Say in the lower left corner what the circles mean, if the film is large enough for that."""
    entries: list[tuple[str, Colour | None]] = [*COLOUR.items(), (flag_names(DOUBTFUL).replace(";", ", "), None)]
    font, size, width, line = cv2.FONT_HERSHEY_SIMPLEX, 0.45 * unit, round(unit), 22 * unit
    top, left = round(canvas.shape[0] - (len(entries) + 0.4) * line), round(1.3 * line)
    right = left + round(0.5 * line) + max(cv2.getTextSize(name, font, size, width)[0][0] for name, _ in entries)
    if 2 * right > canvas.shape[1]:
        return
    canvas[max(top, 0) :, :right] //= 3  # dark enough for letters, and the film is still seen
    for k, (name, colour) in enumerate(entries):
        row = top + (k + 0.7) * line
        _ring(canvas, (0.7 * line, row), 0.3 * line, colour, unit)
        cv2.putText(canvas, name, (left, round(row + 0.22 * line)), font, size, colour or DOUBT, width, cv2.LINE_AA)
