"""Calibrated cameras instead of a cage: MayaCam text files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rsa_vision.errors import CalibrationError
from rsa_vision.types import Float

ROTATION_TOLERANCE: Final = 1e-5  # text with six decimals; 10 um at a distance of 1 m
_ROWS: Final = {"image size": (1, 2), "camera matrix": (3, 3), "rotation": (3, 3), "translation": (3, 1)}


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV's convention: ``px ~ matrix (rotation X + translation)``, z along the view.

    Attributes
    ----------
    image_size : tuple of int
        (cols, rows), px.
    matrix : ndarray of shape (3, 3)
        Focal lengths and principal point, px; (0, 0) is the centre of the first pixel.
    rotation : ndarray of shape (3, 3)
        Camera from calibration frame.
    translation : ndarray of shape (3,)
        mm.
    """

    image_size: tuple[int, int]
    matrix: Float
    rotation: Float
    translation: Float


def load_camera(path: Path) -> Camera:
    """Read a calibrated camera.

    Parameters
    ----------
    path : Path
        Text with the sections ``image size``, ``camera matrix``, ``rotation`` and ``translation`` (MayaCam, as XMALab writes it).

    Returns
    -------
    Camera

    Raises
    ------
    CalibrationError
        If it cannot be read, lacks a section, or is no calibration; every error is listed.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not a readable text file ({error})") from error
    sections, errors = _sections(text)
    errors = errors or _errors(sections)
    if errors:
        listed = "\n".join(f"  {error}" for error in errors)
        raise CalibrationError(f"{path}: not a camera calibration (MayaCam text); export it again\n{listed}")
    cols, rows = (int(value) for value in sections["image size"][0])
    return Camera((cols, rows), sections["camera matrix"], sections["rotation"], sections["translation"][:, 0])


def _sections(text: str) -> tuple[dict[str, Float], list[str]]:
    """Return the numbers of every section, and what is wrong with their form."""
    lines: dict[str, list[str]] = {}
    errors: list[str] = []
    name = ""
    for line in filter(None, map(str.strip, text.splitlines())):
        if line[0].isalpha() and line.lower() not in ("nan", "inf", "infinity"):
            name = line.lower().rstrip(":")
            if name not in _ROWS or name in lines:
                errors.append(
                    f"{name}: {'stands twice' if name in lines else 'not a section known here; distortion must be removed before'}"
                )
            lines.setdefault(name, [])
        elif name:
            lines[name].append(line)
        else:
            errors.append(f"{line!r}: before the first section")
    arrays: dict[str, Float] = {}
    for name, shape in _ROWS.items():
        try:
            numbers = [[float(value) for value in line.replace(",", " ").split()] for line in lines.get(name, [])]
        except ValueError as error:
            errors.append(f"{name}: {error}")
            continue
        if name not in lines:
            errors.append(f"{name}: missing")
        elif [len(row) for row in numbers] != [shape[1]] * shape[0]:
            errors.append(f"{name}: {shape[0]} rows of {shape[1]} numbers expected")
        elif not np.all(np.isfinite(numbers)):
            errors.append(f"{name}: not finite")
        else:
            arrays[name] = np.array(numbers)
    return arrays, errors


def _errors(sections: dict[str, Float]) -> list[str]:
    size, matrix, rotation = sections["image size"], sections["camera matrix"], sections["rotation"]
    errors = []
    if np.any(size < 1) or np.any(size != np.round(size)):
        errors.append("image size: two whole positive numbers expected")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        errors.append("camera matrix: focal lengths must be positive")
    if np.any(matrix[[1, 2, 2], [0, 0, 1]]) or matrix[2, 2] != 1:
        errors.append("camera matrix: upper triangular with last row 0, 0, 1 expected")
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if deviation > ROTATION_TOLERANCE:
        errors.append(f"rotation: not orthonormal (off by {deviation:.2g})")
    elif np.linalg.det(rotation) < 0:
        errors.append("rotation: a mirror (determinant -1)")
    return errors
