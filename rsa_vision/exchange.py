"""Markers of one subject as frames of points, in the file formats of motion analysis: TRC, C3D, and the table of XMALab."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rsa_vision.errors import UsageError
from rsa_vision.kinematics.series import Series
from rsa_vision.types import Float

RATE_HZ: Final = 1.0  # examinations are frames, at no rate; formats of films want one
EXTRA: Final = "C3D files need the package ezc3d: python3 -m pip install 'rsa-vision[c3d]'"


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The n markers of a subject in all E examinations.

    Attributes
    ----------
    exams : tuple of str
        In order of time: the frames.
    names : tuple of str
        ``segment/marker``, or ``marker`` where there is no segment.
    position_mm : ndarray of shape (E, n, 3)
        NaN where a marker was not measured.
    """

    exams: tuple[str, ...]
    names: tuple[str, ...]
    position_mm: Float

    @property
    def n_missing(self) -> int:
        """How many places are not determined."""
        return int(np.isnan(self.position_mm).any(axis=2).sum())


def frames_of(series: Series, unnamed: str) -> Frames:
    """Return the markers of a subject as frames.

    Parameters
    ----------
    series : Series
        Markers that stand twice, were predicted or are doubtful have no place there.
    unnamed : str
        The segment that stands for none.
    """
    names = tuple(
        marker if segment.name == unnamed else f"{segment.name}/{marker}" for segment in series.segments for marker in segment.markers
    )
    places = [segment.position_mm for segment in series.segments]
    return Frames(series.exams, names, np.concatenate([np.zeros((len(series.exams), 0, 3)), *places], axis=1))


def to_xmalab(frames: Frames) -> bytes:
    """Return a CSV table as XMALab exports points: a row for each frame, columns ``NAME_X``, ``NAME_Y``, ``NAME_Z``, NaN where missing."""
    header = ",".join(f"{name}_{axis}" for name in frames.names for axis in "XYZ")
    rows = (",".join(_number(value, "NaN") for value in row) for row in frames.position_mm.reshape(len(frames.exams), -1).tolist())
    return "".join(f"{line}\n" for line in (header, *rows)).encode()


def to_trc(frames: Frames) -> bytes:
    """Return a TRC file (Motion Analysis; OpenSim): mm, one frame for each examination at 1 Hz, empty where missing."""
    n_frames, n_points = frames.position_mm.shape[:2]
    rate = f"{RATE_HZ:g}"
    lines = [
        ["PathFileType", "4", "(X/Y/Z)", "markers.trc"],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"],
        [rate, rate, str(n_frames), str(n_points), "mm", rate, "1", str(n_frames)],
        ["Frame#", "Time", *(text for name in frames.names for text in (name, "", ""))],
        ["", "", *(f"{axis}{k + 1}" for k in range(n_points) for axis in "XYZ")],
        [],
    ]
    for k, row in enumerate(frames.position_mm.reshape(n_frames, -1).tolist()):
        lines.append([str(k + 1), f"{k / RATE_HZ:.6f}", *(_number(value, "") for value in row)])
    return "".join("\t".join(line) + "\n" for line in lines).encode()


def _number(value: float, missing: str) -> str:
    return missing if np.isnan(value) else f"{value:.6f}"


def to_c3d(frames: Frames) -> bytes:
    """Return a C3D file: mm, one frame for each examination, with the names of the examinations in the parameter ``RSA:EXAMS``.

    Coordinates of C3D have single precision: 0.02 um at 300 mm. Missing points have the residual -1.

    Raises
    ------
    UsageError
        If the package ezc3d is not installed.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise UsageError(EXTRA) from error
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [RATE_HZ]
    point["UNITS"]["value"] = ["mm"]
    point["LABELS"]["value"] = list(frames.names)
    file.add_parameter("RSA", "EXAMS", list(frames.exams))
    homogeneous = np.ones((4, len(frames.names), len(frames.exams)))
    homogeneous[:3] = frames.position_mm.transpose(2, 1, 0)
    file["data"]["points"] = homogeneous
    file["data"]["meta_points"]["residuals"] = np.where(np.isnan(homogeneous).any(axis=0), -1.0, 0.0)[None]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "markers.c3d"
        file.write(str(path))
        return path.read_bytes()


FORMATS: Final[Mapping[str, Callable[[Frames], bytes]]] = {"trc": to_trc, "c3d": to_c3d, "xmalab": to_xmalab}
SUFFIXES: Final = {".trc": "trc", ".c3d": "c3d", ".csv": "xmalab"}


def encode(frames: Frames, path: Path, format_name: str | None) -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    frames : Frames
    path : Path
        Its suffix tells the format where none is given.
    format_name : str or None
        ``trc``, ``c3d`` or ``xmalab``.

    Raises
    ------
    UsageError
        If the format is not known, or its package not installed.
    """
    chosen = SUFFIXES.get(path.suffix.lower(), "") if format_name is None else format_name
    if chosen not in FORMATS:
        raise UsageError(f"{format_name or path.name}: not a known format; use --format {'|'.join(FORMATS)}")
    return FORMATS[chosen](frames)
