"""Reading a film of any format: the format is told by content, never by the name."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from rsa_vision.errors import FilmError
from rsa_vision.images import dicom, raster, tiff
from rsa_vision.images.grey import Pixels
from rsa_vision.images.header import Header, check_header
from rsa_vision.types import Film

HEAD_BYTES = 132
Result = TypeVar("Result")
Reader = tuple[Callable[[Path], Header], Callable[[Path, Header], tuple[Pixels, int]]]

_DICOM: Reader = (dicom.header, dicom.pixels)
_SIGNATURES: tuple[tuple[int, bytes, Reader], ...] = (
    (128, b"DICM", _DICOM),
    (0, b"II*\0", (tiff.header, tiff.pixels)),
    (0, b"MM\0*", (tiff.header, tiff.pixels)),
    (0, b"II+\0", (tiff.header, tiff.pixels)),
    (0, b"MM\0+", (tiff.header, tiff.pixels)),
    (0, b"\x89PNG\r\n\x1a\n", (raster.png_header, raster.png_pixels)),
    (0, b"\xff\xd8\xff", (raster.jpeg_header, raster.jpeg_pixels)),
    (0, b"\0\0\0\x0cjP  \r\n\x87\n", (raster.jpeg2000_header, raster.jpeg2000_pixels)),
    (0, b"\xff\x4f\xff\x51", (raster.jpeg2000_header, raster.jpeg2000_pixels)),
    (0, b"BM", (raster.bmp_header, raster.bmp_pixels)),
)


def open_header(path: Path) -> Header:
    """Read the header of a film, without its pixels.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Header

    Raises
    ------
    FilmError
        As :func:`read_film`, as far as the header tells.
    """
    path = Path(path)
    return _guarded(path, lambda: check_header(_reader(path)[0](path)))


def read_film(path: Path) -> Film:
    """Read a film: values as stored, larger ones brighter as the file declares.

    Parameters
    ----------
    path : Path
        TIFF, PNG, JPEG, JPEG 2000, BMP or DICOM (with or without file header), whatever its name.

    Returns
    -------
    Film
        Stored values: no window, no VOI LUT, no rescale; MONOCHROME1 and MINISWHITE inverted.

    Raises
    ------
    FilmError
        If the file is missing, empty, truncated, damaged, or of none of these formats.
    FilmFormatError
        If it is no single grey radiograph of 8 to 16 bits (one bit, floating point, colour, stack, absurd size).
    """
    path = Path(path)

    def read() -> Film:
        header, pixels = _reader(path)
        checked = check_header(header(path))
        values, bits = pixels(path, checked)
        if values.shape != (checked.rows, checked.cols):
            raise FilmError(f"{path}: {values.shape} pixels, {(checked.rows, checked.cols)} announced; the file is damaged, copy it again")
        return Film(path, values, bits, checked.pitch_mm, checked.pitch_source, {"format": checked.format, **checked.meta})

    return _guarded(path, read)


def check_file(path: Path) -> None:
    """Raise :class:`FilmError` for what is there and is no file: reading a pipe may never end."""
    if path.is_dir():
        raise FilmError(f"{path}: a folder; name the films in it")
    if path.exists() and not path.is_file():
        raise FilmError(f"{path}: a pipe or a device, whose reading may never end; give a copy of the film as a regular file")


def _reader(path: Path) -> Reader:
    check_file(path)
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if not head:
        raise FilmError(f"{path}: the file is empty; copy it again")
    for offset, signature, reader in _SIGNATURES:
        if head[offset : offset + len(signature)] == signature:
            return reader
    if dicom.may_be_headerless(head):
        return _DICOM
    raise FilmError(f"{path}: not a TIFF, PNG, JPEG, JPEG 2000, BMP or DICOM file; export the film as one of these")


def _guarded(path: Path, read: Callable[[], Result]) -> Result:
    """Run a reader; decoders do not say what they may throw at damaged input, so all of it becomes :class:`FilmError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of decoders about tags that are not used here
            return read()
    except FilmError:
        raise
    except OSError as error:
        raise FilmError(f"{path}: cannot be read ({error.strerror or error}); look at its path and permissions") from error
    except MemoryError as error:
        raise FilmError(f"{path}: not enough memory to read it; run fewer --jobs") from error
    except struct.error as error:
        raise FilmError(f"{path}: ends within its header; the file is truncated, copy it again") from error
    except Exception as error:
        detail = "".join(str(error).splitlines()[:1])[:200]
        raise FilmError(f"{path}: damaged or truncated ({detail}); copy or export it again") from error
