"""PNG, JPEG, JPEG 2000 and BMP."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.errors import FilmError, FilmFormatError
from rsa_vision.images.codestream import JPEG_LS, Stream, decoded, ends, jpeg2000_stream, jpeg_stream
from rsa_vision.images.grey import Pixels, to_grey
from rsa_vision.images.header import Header
from rsa_vision.images.pitch import MM_PER_INCH, Pitch, judge_pitch

HEAD_BYTES: Final = 4 << 20  # previews and colour profiles may stand before the size
MM_PER_M: Final = 1000.0
_PNG_SAMPLES: Final = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_J2K_START: Final = b"\xff\x4f\xff\x51"

Claim = tuple[Pitch | None, str]


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(HEAD_BYTES)


def _per_metre(rows: float, cols: float, tag: str) -> Claim:
    if rows <= 0 or cols <= 0:
        return None, f"{tag} is zero"
    return judge_pitch(MM_PER_M / rows, MM_PER_M / cols, tag, default_suspected=True)


def png_header(path: Path) -> Header:
    """Read the header of a PNG file (ISO 15948)."""
    data = _head(path)
    cols, rows, bits, colour = struct.unpack_from(">IIBB", data, 16)
    claim: Claim = (None, "no pHYs chunk")
    position = 8
    while position + 12 <= len(data) and data[position + 4 : position + 8] != b"IDAT":
        length, kind = struct.unpack_from(">I4s", data, position)
        if kind == b"pHYs":
            per_col, per_row, unit = struct.unpack_from(">IIB", data, position + 8)
            claim = _per_metre(per_row, per_col, "PNG pHYs") if unit == 1 else (None, "PNG pHYs has no unit")
        position += 12 + length
    return Header(path, "PNG", rows, cols, bits, _PNG_SAMPLES.get(colour, 4), *claim)


def png_pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode a PNG file."""
    import imagecodecs

    return to_grey(imagecodecs.png_decode(path.read_bytes()), header.bits, path)


def jpeg_header(path: Path) -> Header:
    """Read the header of a JPEG or JPEG-LS file."""
    stream = jpeg_stream(_head(path))
    return Header(path, "JPEG", stream.rows, stream.cols, stream.bits, stream.samples, *_jfif_pitch(stream))


def _jfif_pitch(stream: Stream) -> Claim:
    unit, per_col, per_row = stream.density or (0, 0, 0)
    if unit not in (1, 2):
        return None, "no JFIF density with a unit"
    to_metre = MM_PER_M / MM_PER_INCH if unit == 1 else 100.0
    return _per_metre(per_row * to_metre, per_col * to_metre, "JFIF density")


def jpeg_pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode a JPEG or JPEG-LS file."""
    import imagecodecs

    data = path.read_bytes()
    stream = jpeg_stream(data)
    if not ends(data, stream.scan):
        raise FilmError(f"{path}: the JPEG stream has no end; the file is truncated, copy it again")
    if stream.samples == 4:
        raise FilmFormatError(f"{path}: a colour image (CMYK); export it again as grey")
    values = imagecodecs.jpegls_decode(data) if stream.kind == JPEG_LS else decoded(data, stream, imagecodecs.jpeg_decode)
    return to_grey(values, header.bits, path)


def _boxes(data: bytes, start: int, stop: int) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type, start, stop) of the contents of the boxes of a JP2 file (ISO 15444-1 annex I)."""
    while start + 8 <= stop:
        length, kind = struct.unpack_from(">I4s", data, start)
        body = start + 8
        if length == 1 and start + 16 <= stop:
            (length,) = struct.unpack_from(">Q", data, start + 8)
            body = start + 16
        after = stop if length == 0 else start + length
        if after < body:
            raise ValueError("JPEG 2000 box without length")
        yield kind, body, min(after, stop)
        start = after


def jpeg2000_header(path: Path) -> Header:
    """Read the header of a JPEG 2000 file or code stream; only the capture resolution is one of the detector."""
    data = _head(path)
    claim: Claim = (None, "no capture resolution box")
    start = 0
    if data[:4] != _J2K_START:
        boxes = {kind: (body, stop) for kind, body, stop in _boxes(data, 0, len(data))}
        start = boxes[b"jp2c"][0]
        nested = {kind: (body, stop) for kind, body, stop in _boxes(data, *boxes.get(b"jp2h", (0, 0)))}
        for kind, body, _ in _boxes(data, *nested.get(b"res ", (0, 0))):
            if kind == b"resc":
                row_n, row_d, col_n, col_d, row_e, col_e = struct.unpack_from(">4H2b", data, body)
                if row_d and col_d:
                    claim = _per_metre(row_n / row_d * 10.0**row_e, col_n / col_d * 10.0**col_e, "JPEG 2000 capture resolution")
    stream = jpeg2000_stream(data[start:])
    return Header(path, "JPEG 2000", stream.rows, stream.cols, stream.bits, stream.samples, *claim)


def jpeg2000_pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode a JPEG 2000 file or code stream."""
    import imagecodecs

    return to_grey(imagecodecs.jpeg2k_decode(path.read_bytes()), header.bits, path)


def bmp_header(path: Path) -> Header:
    """Read the header of a BMP file."""
    data = _head(path)
    size, cols, rows, _, bits, coding = struct.unpack_from("<IiiHHI", data, 14)
    if size < 40 or cols <= 0 or rows == 0:
        raise FilmFormatError(f"{path}: a BMP file of an old or unknown kind; export it again as TIFF or PNG")
    if coding != 0 or bits in (4, 16):
        raise FilmFormatError(f"{path}: a compressed BMP file or one of {bits} bits; export it again as TIFF or PNG")
    per_col, per_row = struct.unpack_from("<ii", data, 38)
    return Header(path, "BMP", abs(rows), cols, min(bits, 8), max(bits // 8, 1), *_per_metre(per_row, per_col, "BMP resolution"))


def bmp_pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode an uncompressed BMP file of 8 bits with a palette, 24 or 32 bits."""
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 10)
    size, _, rows, _, bits = struct.unpack_from("<IiiHH", data, 14)
    (n_colours,) = struct.unpack_from("<I", data, 46)
    line = (header.cols * bits + 31) // 32 * 4
    if len(data) < start + line * header.rows:
        raise FilmError(f"{path}: {len(data)} bytes, {start + line * header.rows} expected; the file is truncated, copy it again")
    lines = np.frombuffer(data, np.uint8, line * header.rows, start).reshape(header.rows, line)
    stored = lines[:: -1 if rows > 0 else 1, : header.cols * bits // 8].reshape(header.rows, header.cols, -1)
    if bits == 8:
        table = np.frombuffer(data, np.uint8, 4 * min(n_colours or 256, 256), 14 + size).reshape(-1, 4)
        return to_grey(through_palette(stored[..., 0], table[:, :3], path), 8, path)
    return to_grey(stored[..., :3], 8, path)


def through_palette(index: NDArray[Any], table: NDArray[Any], path: Path) -> NDArray[Any]:
    """Return the grey values, shape of ``index``, that a palette of shape (n, 3) gives the indices."""
    if int(index.max()) >= len(table):
        raise FilmError(f"{path}: values beyond its palette; the file is damaged, copy it again")
    used = table[np.unique(index)]
    if np.any(used != used[:, :1]):
        raise FilmFormatError(f"{path}: a colour image; export it again as grey")
    grey: NDArray[Any] = np.ascontiguousarray(table[:, 0])[index]
    return grey
