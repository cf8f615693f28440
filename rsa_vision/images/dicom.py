"""DICOM: CR, DX, XA, digitised film, with or without file header."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.errors import FilmError, FilmFormatError
from rsa_vision.images.codestream import decoded, ends, jpeg2000_stream, jpeg_stream
from rsa_vision.images.grey import Pixels, to_grey
from rsa_vision.images.header import MIN_BITS, Header
from rsa_vision.images.pitch import Pitch, judge_pitch

IMPLICIT: Final = "1.2.840.10008.1.2"
DEFLATED: Final = "1.2.840.10008.1.2.1.99"
_NATIVE: Final = (IMPLICIT, "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.2")
_JPEG: Final = tuple(f"1.2.840.10008.1.2.4.{number}" for number in (50, 51, 57, 70, 80, 81))
_JPEG_LS: Final = _JPEG[-2:]
_JPEG2000: Final = tuple(f"1.2.840.10008.1.2.4.{number}" for number in (90, 91))
_RLE: Final = "1.2.840.10008.1.2.5"
_PIXEL_DATA: Final = b"\xe0\x7f\x10\x00"  # its tag; what is encapsulated is little-endian
_END_PADDING: Final = 16  # fragments are padded to even length; some writers pad to words
_MONOCHROME: Final = ("MONOCHROME1", "MONOCHROME2")
_PITCH_TAGS: Final = ("ImagerPixelSpacing", "NominalScannedPixelSpacing", "PixelSpacing")  # at the detector first
_META: Final = {
    "patient_id": ("PatientID",),
    "acquisition_date": ("AcquisitionDate", "ContentDate", "StudyDate"),
    "acquisition_time": ("AcquisitionTime", "ContentTime", "StudyTime"),
    "acquisition_datetime": ("AcquisitionDateTime",),
    "view": ("ViewPosition",),
    "detector_id": ("DetectorID",),
    "modality": ("Modality",),
    "photometric": ("PhotometricInterpretation",),
}

logging.getLogger("pydicom").addHandler(logging.NullHandler())  # oddities of tags that are not used here are no news to the user


def may_be_headerless(head: bytes) -> bool:
    """Tell whether bytes begin like a DICOM data set without preamble: a low element of group 0002 or 0008, in either byte order."""
    for order in "<>":
        group, element = struct.unpack(f"{order}HH", head[:4].ljust(4, b"\xff"))
        if group in (0x0002, 0x0008) and element <= 0x0070:
            return True
    return False


def header(path: Path) -> Header:
    """Read the header of a DICOM file."""
    import pydicom

    with path.open("rb") as file:
        if DEFLATED.encode() in file.read(4096):  # a few bytes may inflate to anything
            raise FilmFormatError(f"{path}: the data set is deflated as a whole; export it again without that")
    ds = pydicom.dcmread(path, force=True, stop_before_pixels=True)
    rows, cols, allocated = (ds.get(name) for name in ("Rows", "Columns", "BitsAllocated"))
    if not (isinstance(rows, int) and isinstance(cols, int) and isinstance(allocated, int)):
        raise FilmError(f"{path}: no DICOM image (Rows, Columns or BitsAllocated is missing); export the film itself")
    frames = int(ds.get("NumberOfFrames") or 1)
    if frames != 1:
        raise FilmFormatError(f"{path}: a stack of {frames} frames; export one film a file")
    stored = int(ds.get("BitsStored", allocated))
    if allocated not in (8, 16) or not 0 < stored <= allocated:
        raise FilmFormatError(f"{path}: {stored} bits stored in {allocated}; films have 8 to 16 bits: export it again as 16-bit grey")
    meta = {name: text for name, keywords in _META.items() if (text := _text(ds, keywords))}
    meta["transfer_syntax"] = _transfer_syntax(ds)
    if meta.get("photometric") == "PALETTE COLOR":  # its values are places in a table
        raise FilmFormatError(f"{path}: a colour image (PALETTE COLOR); export it again as MONOCHROME2")
    return Header(path, "DICOM", rows, cols, stored, int(ds.get("SamplesPerPixel") or 1), *_pitch(ds), meta)


def pixels(path: Path, header: Header) -> tuple[Pixels, int]:
    """Decode a DICOM file: stored values, no rescale, no VOI LUT; bits outside of BitsStored (overlays) masked."""
    import pydicom

    ds = pydicom.dcmread(path, force=True)
    if "PixelData" not in ds:
        if _has_begun(path):
            raise FilmError(f"{path}: the coded image has no end; the file is truncated, copy it again")
        raise FilmFormatError(f"{path}: no integer pixel data; export the film itself, as 16-bit grey")
    raw = _native(ds, header) if header.meta["transfer_syntax"] in _NATIVE else _decoded(ds, header)
    photometric = header.meta.get("photometric", "MONOCHROME2")
    shift = int(ds.get("HighBit", header.bits - 1)) + 1 - header.bits
    signed = bool(ds.get("PixelRepresentation"))
    falling = float(ds.get("RescaleSlope") or 1) < 0  # bright is then what has low stored values
    del ds  # and with it the coded bytes
    if photometric not in _MONOCHROME:
        return to_grey(raw, header.bits, path)
    values, bits = _significant(raw, header.bits, shift, signed, path)
    return to_grey(values, bits, path, inverted=(photometric == "MONOCHROME1") != falling)


def _has_begun(path: Path) -> bool:
    """Tell whether PixelData begins in a file: pydicom drops, without a word, what is encapsulated and has no end."""
    import pydicom

    with path.open("rb") as file:
        pydicom.dcmread(file, force=True, stop_before_pixels=True)
        return file.read(4) == _PIXEL_DATA


def _native(ds: Any, header: Header) -> NDArray[Any]:
    """Return uncompressed pixel data as unsigned integers, without copying where they can be used as they are."""
    data = ds.PixelData
    order = "<" if ds.original_encoding[1] else ">"
    kind = np.dtype(f"{order}u{int(ds.BitsAllocated) // 8}")
    count = header.rows * header.cols * header.samples
    expected = count * kind.itemsize
    if len(data) < expected:
        raise FilmError(f"{header.path}: {len(data)} bytes of pixel data, {expected} expected; the file is truncated, copy it again")
    if len(data) >= 2 * expected:
        raise FilmFormatError(f"{header.path}: pixel data of several frames; export one film a file")
    if kind.itemsize == 1 and order == ">" and ds["PixelData"].VR == "OW":
        data = np.frombuffer(data, "u2").byteswap().tobytes()  # the words of OW are swapped, whatever they hold
    values = np.frombuffer(data, kind, count)
    if header.samples == 1:
        return values.reshape(header.rows, header.cols)
    if header.meta.get("photometric") != "RGB":
        raise FilmFormatError(f"{header.path}: a colour image ({header.meta.get('photometric')}); export it again as MONOCHROME2")
    if ds.get("PlanarConfiguration"):
        return values.reshape(header.samples, header.rows, header.cols).transpose(1, 2, 0)
    return values.reshape(header.rows, header.cols, header.samples)


def _decoded(ds: Any, header: Header) -> NDArray[Any]:
    """Return compressed pixel data, after a look at the code stream: decoders fill what is missing and trust what is announced."""
    from pydicom.encaps import get_frame
    from pydicom.pixels import get_decoder  # type: ignore[attr-defined]  # documented, but not in its __all__

    syntax, path = header.meta["transfer_syntax"], header.path
    if syntax not in (*_JPEG, *_JPEG2000, _RLE):
        raise FilmFormatError(f"{path}: transfer syntax {syntax} is not supported; export it again uncompressed")
    if syntax != _RLE:
        coded = get_frame(ds.PixelData, 0, number_of_frames=1)
        stream = jpeg_stream(coded) if syntax in _JPEG else jpeg2000_stream(coded)
        if (stream.rows, stream.cols, stream.samples) != (header.rows, header.cols, header.samples) or stream.bits > int(ds.BitsAllocated):
            raise FilmError(f"{path}: the coded image is not of the size that the header tells; the file is damaged, export it again")
        if not ends(coded, stream.scan, _END_PADDING):
            raise FilmError(f"{path}: the coded image has no end; the file is truncated, copy it again")
        if header.samples == 1:
            import imagecodecs  # GDCM takes three times its memory, and has no JPEG of 12 bits

            if syntax in _JPEG and syntax not in _JPEG_LS:
                return decoded(coded, stream, imagecodecs.jpeg_decode)
            grey: NDArray[Any] = (imagecodecs.jpegls_decode if syntax in _JPEG_LS else imagecodecs.jpeg2k_decode)(coded)
            return grey
    try:
        values: NDArray[Any] = get_decoder(syntax).as_array(ds, index=0)[0]
    except RuntimeError as error:  # it names the plugins that were tried
        raise FilmError(f"{path}: the coded image cannot be decoded; the file is damaged or truncated, copy or export it again") from error
    return values


def _significant(raw: NDArray[Any], bits: int, shift: int, signed: bool, path: Path) -> tuple[NDArray[Any], int]:
    """Return the BitsStored bits below HighBit as unsigned integers; signed values are treated as by :func:`to_grey`."""
    allocated = raw.dtype.itemsize * 8
    if shift < 0 or bits + shift > allocated:
        raise FilmError(f"{path}: HighBit does not fit BitsStored and BitsAllocated; export it again")
    values = raw if raw.dtype.kind == "u" else raw.view(f"u{raw.dtype.itemsize}")
    kind = values.dtype.type
    if bits < allocated:
        values = np.right_shift(values, kind(shift))
        values &= kind(2**bits - 1)
    if not signed:
        return values, bits
    sign = kind(2 ** (bits - 1))
    if int(values.max()) < int(sign):
        return values, max(bits - 1, MIN_BITS)
    return np.bitwise_xor(values, sign, out=values if values.flags.writeable else None), bits  # two's complement plus 2**(bits - 1)


def _text(ds: Any, keywords: tuple[str, ...]) -> str:
    for keyword in keywords:
        try:
            value = ds.get(keyword)
        except ValueError:  # what is said of a patient must not cost the film
            continue
        if value is not None and str(value).strip():
            return str(value).strip()
    return ""


def _transfer_syntax(ds: Any) -> str:
    meta = getattr(ds, "file_meta", None)
    named = meta.get("TransferSyntaxUID") if meta is not None else None
    return str(named or IMPLICIT)


def _pitch(ds: Any) -> tuple[Pitch | None, str]:
    """Return the first pitch that is stated (zeros are not): PixelSpacing last, and not if it is corrected for magnification."""
    for keyword in _PITCH_TAGS:
        try:
            values = [float(value) for value in ds.get(keyword) or ()]
        except (TypeError, ValueError):
            return None, f"DICOM {keyword} is no number"
        if len(values) != 2 or not any(values):
            continue
        calibration = str(ds.get("PixelSpacingCalibrationType") or "")
        if keyword == "PixelSpacing" and calibration:
            return None, f"DICOM PixelSpacing is calibrated ({calibration}), not that of the detector"
        return judge_pitch(values[0], values[1], f"DICOM {keyword}")
    return None, "no DICOM ImagerPixelSpacing, NominalScannedPixelSpacing or PixelSpacing"
