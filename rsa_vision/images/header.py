"""What a film file says of itself before its pixels are read, and the limits that keep a hostile or broken file from being decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from rsa_vision.errors import FilmError, FilmFormatError

MAX_PIXELS: Final = 1_000_000_000  # a film of 400 x 700 mm at 25 um has 448 million
MIN_SIDE_PX: Final = 64  # no cage fits on less
MAX_COMPRESSION: Final = 2000  # a blank film in deflate reaches 1030; beyond, a few bytes claim gigabytes
MIN_BITS, MAX_BITS = 8, 16


@dataclass(frozen=True, slots=True)
class Header:
    """The header of a film file.

    Attributes
    ----------
    path : Path
    format : str
        ``TIFF``, ``PNG``, ``JPEG``, ``JPEG 2000``, ``BMP`` or ``DICOM``, by content.
    rows, cols : int
    bits : int
        Significant bits of a sample, 8 to 16.
    samples : int
        Samples a pixel; more than one is accepted if they are equal.
    pitch_mm : tuple of two floats, or None
        (row, column) pitch, None where missing or implausible; ``pitch_source`` says which.
    pitch_source : str
    meta : mapping
        Lower-case names; DICOM: patient_id, date, time, view, detector_id, modality, photometric, transfer_syntax.
    """

    path: Path
    format: str
    rows: int
    cols: int
    bits: int
    samples: int
    pitch_mm: tuple[float, float] | None
    pitch_source: str
    meta: Mapping[str, str] = field(default_factory=dict)


def check_header(header: Header) -> Header:
    """Return the header, or raise :class:`FilmError` or :class:`FilmFormatError` if its pixels must not or need not be read."""
    path, rows, cols = header.path, header.rows, header.cols
    if not MIN_BITS <= header.bits <= MAX_BITS:
        what = "a one-bit image" if header.bits == 1 else f"{header.bits} bits a sample"
        raise FilmFormatError(f"{path}: {what}; films have {MIN_BITS} to {MAX_BITS} bits: export it again as 16-bit (or 8-bit) grey")
    if min(rows, cols) < MIN_SIDE_PX:
        raise FilmFormatError(f"{path}: {rows} x {cols} pixels are no radiograph (at least {MIN_SIDE_PX} a side); look for the full film")
    if rows * cols > MAX_PIXELS:
        raise FilmFormatError(
            f"{path}: {rows} x {cols} pixels are absurd (at most {MAX_PIXELS:.0e}); scan or export it at a lower resolution"
        )
    size = path.stat().st_size
    if rows * cols * header.samples * (header.bits / 8) > MAX_COMPRESSION * size:
        raise FilmError(f"{path}: {size} bytes cannot hold {rows} x {cols} pixels; the file is truncated, copy it again")
    return header
