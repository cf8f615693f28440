"""Headers of JPEG, JPEG-LS and JPEG 2000 code streams, read without a decoder: sizes before memory is spent, and whether the end is there.

The marker layout is that of ISO 10918-1 annex B (JPEG), ISO 14495-1 annex C (JPEG-LS) and ISO 15444-1 annex A (JPEG 2000).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

END: Final = b"\xff\xd9"  # EOI of JPEG and JPEG-LS, EOC of JPEG 2000
JPEG_LS: Final = 0xF7  # its SOF
_FRAMES: Final = frozenset({*range(0xC0, 0xD0), JPEG_LS}) - {0xC4, 0xC8, 0xCC}  # SOF0..15 without DHT, JPG, DAC; JPEG-LS
_BARE: Final = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_PROGRESSIVE: Final = 0xC2
_HUFFMAN: Final = (0xC0, 0xC1, _PROGRESSIVE, 0xC3)
_RUN_END: Final = re.compile(rb"\xff+[\xd0-\xd7]")  # RST0..7
_MORE: Final = bytes(range(1, 65))
_LAST: Final = 4  # bytes; what fewer of them say may be lost in rounding
_OTHERS: Final = (0x55, 0xAA, 0x36, 0xC9, 0x0F, 0xF0)  # many: a saturated corner may look the same with some of them


class Stream(NamedTuple):
    """Size of a coded image, the offset of its first entropy-coded scan, and the JFIF density (unit, horizontal, vertical) if any."""

    rows: int
    cols: int
    bits: int
    samples: int
    kind: int
    scan: int
    density: tuple[int, int, int] | None


def jpeg_stream(data: bytes) -> Stream:
    """Read the markers of a JPEG or JPEG-LS stream up to its first scan; ValueError if they are not there."""
    if data[:2] != b"\xff\xd8":
        raise ValueError("no JPEG stream")
    position, frame, density = 2, None, None
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            raise ValueError("JPEG marker expected")
        marker = data[position + 1]
        if marker == 0xFF or marker in _BARE:
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        body = data[position + 4 : position + 2 + length]
        if length < 2 or len(body) != length - 2:
            break
        if marker in _FRAMES:
            frame = (*struct.unpack_from(">BHHB", body), marker)
        elif marker == 0xE0 and body[:5] == b"JFIF\0":
            density = struct.unpack_from(">BHH", body, 7)
        elif marker == 0xDA:
            if frame is None:
                raise ValueError("JPEG scan without a frame")
            bits, rows, cols, samples, kind = frame
            return Stream(rows, cols, bits, samples, kind, position + 2 + length, density)
        position += 2 + length
    raise ValueError("JPEG stream ends in its header")


def jpeg2000_stream(data: bytes) -> Stream:
    """Read the SIZ marker of a JPEG 2000 code stream; ValueError if it is not there."""
    if data[:4] != b"\xff\x4f\xff\x51" or len(data) < 42:
        raise ValueError("no JPEG 2000 code stream")
    cols, rows, left, top = struct.unpack_from(">4I", data, 8)
    (samples,) = struct.unpack_from(">H", data, 40)
    if samples == 0 or len(data) < 42 + 3 * samples:
        raise ValueError("JPEG 2000 stream ends in its header")
    parts = [struct.unpack_from(">3B", data, 42 + 3 * i) for i in range(samples)]
    if len(set(parts)) > 1 or parts[0][1:] != (1, 1):
        raise ValueError("JPEG 2000 components of unequal size")
    depth = parts[0][0]
    return Stream(rows - top, cols - left, (depth & 0x7F) + 1, samples, 0, 42 + 3 * samples, None)


def ends(data: bytes, scan: int, padding: int | None = None) -> bool:
    """Tell whether the end marker stands after the first scan.

    Decoders fill up what is missing with grey and say nothing, so a truncated JPEG must be told by its lost end.

    Parameters
    ----------
    data : bytes
    scan : int
        Where the first scan begins.
    padding : int, optional
        How many bytes may follow the marker; any number by default (files carry previews behind it).
    """
    last = data.rfind(END, scan)
    return last >= 0 and (padding is None or len(data) - last - len(END) <= padding)


def decoded(data: bytes, stream: Stream, decode: Callable[[bytes], NDArray[Any]]) -> NDArray[Any]:
    """Decode a JPEG stream that has its end; ValueError if it holds fewer or more coded bits than its image takes.

    Damage puts a decoder out of step, and it says nothing: it fills up what is missing with grey, or passes over what is left. Then more
    bits before an end change the image, or other last bits do not. Damage after which the count is right by chance is not found.

    Parameters
    ----------
    data : bytes
    stream : Stream
        Its header.
    decode : callable
        Returns the image of a stream.

    Returns
    -------
    ndarray
        The image of ``data``.
    """
    image = decode(data)
    if stream.kind not in _HUFFMAN:  # arithmetic decoders read on, and what they read counts
        return image

    def same(coded: bytes) -> bool:
        try:
            return np.array_equal(decode(data[: stream.scan] + coded + data[stop:]), image)
        except Exception:  # decoders do not say what they may throw
            return False

    stop = data.find(END, stream.scan) % (len(data) + 1)  # at the end of the data, where there is none
    coded = data[stream.scan : stop]
    if not same(_RUN_END.sub(lambda end: _MORE + end[0], coded) + _MORE):
        raise ValueError("coded bits are missing")
    # where the last bits are of what rounding or the margin may hide, this cannot be asked
    if stream.kind != _PROGRESSIVE and stream.samples == 1 and not _RUN_END.search(coded):
        last = _LAST - coded.startswith(b"\xff\0", len(coded) - _LAST - 1)  # a zero is stuffed behind it
        unused = all(same(coded[:-last] + bytes([other]) * last) for other in _OTHERS)
        if unused and not same(bytes(_OTHERS) * (len(coded) // len(_OTHERS))):  # of an even film all bits may be changed
            raise ValueError("coded bits are left over")
    return image
