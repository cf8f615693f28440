"""TIFF."""

from __future__ import annotations

import logging
import math
from functools import partial
from pathlib import Path
from typing import Any, Final

from rsa_vision.errors import FilmError, FilmFormatError
from rsa_vision.images.codestream import decoded, jpeg_stream
from rsa_vision.images.grey import Pixels, to_grey
from rsa_vision.images.header import Header
from rsa_vision.images.pitch import MM_PER_INCH, Pitch, judge_pitch
from rsa_vision.images.raster import through_palette

_MM_OF_UNIT: Final = {2: MM_PER_INCH, 3: 10.0}
_INTEGER: Final = (1, 2, 4)  # SampleFormat: unsigned, signed, undefined
_JPEG: Final = 7  # Compression
_MINISWHITE, _MINISBLACK, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_REDUCED: Final = 1 | 4  # NewSubfileType: thumbnail or mask

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # oddities of tags that are not used here are no news to the user


def header(path: Path) -> Header:
    """Read the header of a TIFF file."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = _film_page(file, path)
        bits = page.bitspersample
        if not isinstance(bits, int):
            raise FilmFormatError(f"{path}: a colour image of unequal depths; export it again as grey")
        return Header(path, "TIFF", page.imagelength, page.imagewidth, bits, page.samplesperpixel, *_pitch(page))


def pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode a TIFF file."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = _film_page(file, path)
        _check_segments(page, path)
        values = page.asarray()
        if page.samplesperpixel > 1 and page.planarconfig == 2:
            values = values.transpose(1, 2, 0)
        if page.photometric == _PALETTE:
            table = page.colormap.T
            values, bits = through_palette(values, table if int(table.max()) > 255 else table.astype("uint8"), path), 16
            return to_grey(values, bits if values.dtype.itemsize == 2 else 8, path)
        return to_grey(values, header.bits, path, inverted=page.tags.valueof("PhotometricInterpretation") == _MINISWHITE)


def _film_page(file: Any, path: Path) -> Any:
    """Return the only full page of a file, or refuse it."""
    full = [page for page in (file.pages[index] for index in range(len(file.pages))) if not int(page.subfiletype) & _REDUCED]
    layers = max((int((file.imagej_metadata or {}).get("images", 1)), *(page.imagedepth for page in full)), default=0)
    if not full:
        raise FilmError(f"{path}: no image in it; the file is truncated, copy it again")
    if len(full) != 1 or layers != 1:
        raise FilmFormatError(f"{path}: a stack of {max(len(full), layers)} images; export one film a file")
    page = full[0]
    if int(page.sampleformat) not in _INTEGER or page.dtype is None:
        what = "floating-point or complex values" if int(page.sampleformat) in (3, 5, 6) else "samples of an unknown kind"
        raise FilmFormatError(f"{path}: {what}; export it again as 16-bit (or 8-bit) unsigned integers without rescaling its grey values")
    if page.photometric not in (_MINISWHITE, _MINISBLACK, _RGB, _PALETTE, _YCBCR):
        raise FilmFormatError(f"{path}: photometric interpretation {page.photometric}; export it again as grey")
    return page


def _check_segments(page: Any, path: Path) -> None:
    """Refuse a file that lacks some of its strips or tiles, which tifffile fills with zeros, or of whose JPEG some bits are missing."""
    import imagecodecs

    size = path.stat().st_size
    segments = list(zip(page.dataoffsets, page.databytecounts, strict=False))
    complete = len(segments) >= math.prod(page.chunked) and all(
        offset > 0 and count > 0 and offset + count <= size for offset, count in segments
    )
    if not complete:
        raise FilmError(f"{path}: strips or tiles are missing; the file is truncated, copy it again")
    if int(page.compression) == _JPEG:
        decode = partial(imagecodecs.jpeg_decode, tables=page.jpegtables)
        with path.open("rb") as file:
            for offset, count in segments:
                file.seek(offset)
                coded = file.read(count)
                decoded(coded, jpeg_stream(coded), decode)


def _pitch(page: Any) -> tuple[Pitch | None, str]:
    unit = page.tags.valueof("ResolutionUnit", 2)  # inch is the default of the format
    across, down = page.tags.valueof("XResolution"), page.tags.valueof("YResolution")
    if across is None or down is None or int(unit) not in _MM_OF_UNIT:
        return None, "no TIFF resolution with a unit"
    mm = _MM_OF_UNIT[int(unit)]
    if 0 in (across[0], across[1], down[0], down[1]):
        return None, "TIFF resolution is zero"
    return judge_pitch(mm * down[1] / down[0], mm * across[1] / across[0], "TIFF resolution", default_suspected=True)
