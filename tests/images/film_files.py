"""Films in every format, written by the encoders of other libraries or byte by byte, for the reader's tests."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import pydicom
import tifffile
from numpy.typing import NDArray
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.uid import UID, ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless

Array = NDArray[np.unsignedinteger]  # type: ignore[type-arg]
SHAPE = (150, 212)


def radiograph(bits: int, seed: int = 1) -> Array:
    """Return a noisy gradient with its extremes at the ends of the scale."""
    rng = np.random.default_rng(seed)
    full = 2**bits - 1
    ramp = np.linspace(0.2, 0.8, SHAPE[1]) * full
    values = np.clip(ramp + rng.normal(0, 0.01 * full, SHAPE), 0, full).round()
    values[0, 0], values[0, 1] = 0, full
    return values.astype(np.uint8 if bits == 8 else np.uint16)


def tiff(path: Path, values: Array, **options: object) -> Path:
    """Write a TIFF file of 254 dpi."""
    given = {"photometric": "minisblack", "resolution": (254, 254), "resolutionunit": "INCH", "metadata": None, **options}
    tifffile.imwrite(path, values, **given)
    return path


def dicom(
    path: Path,
    values: Array,
    bits: int,
    *,
    syntax: str = ExplicitVRLittleEndian,
    photometric: str = "MONOCHROME2",
    header: bool = True,
    coded: bytes | None = None,
    **tags: object,
) -> Path:
    """Write a DICOM file; ``coded`` is the frame of a compressed transfer syntax."""
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = UID(syntax)
    meta.MediaStorageSOPClassUID = UID("1.2.840.10008.5.1.4.1.1.1")
    meta.MediaStorageSOPInstanceUID = UID("1.2.3.4")
    ds = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    ds.SOPClassUID, ds.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    ds.PatientID, ds.Modality, ds.AcquisitionDate, ds.AcquisitionTime = "S1", "CR", "20260101", "090000"
    ds.ViewPosition, ds.DetectorID = "AP", "D1"
    ds.Rows, ds.Columns = values.shape[:2]
    ds.SamplesPerPixel = 1 if values.ndim == 2 else 3
    if values.ndim == 3:
        ds.PlanarConfiguration = 0
    ds.PhotometricInterpretation = photometric
    ds.BitsAllocated = values.dtype.itemsize * 8
    ds.BitsStored, ds.HighBit = bits, bits - 1
    ds.PixelRepresentation = int(values.dtype.kind == "i")
    ds.ImagerPixelSpacing = [0.1, 0.1]
    for keyword, value in tags.items():
        setattr(ds, keyword, value)
    if coded is None:
        big = syntax == ExplicitVRBigEndian
        data = values.astype(values.dtype.newbyteorder(">" if big else "<")).tobytes()
        ds.PixelData = data + b"\0" * (len(data) % 2)
    else:
        ds.PixelData = encapsulate([coded])
        ds["PixelData"].is_undefined_length = True
    ds["PixelData"].VR = "OW" if ds.BitsAllocated == 16 else "OB"
    if header:
        pydicom.dcmwrite(path, ds, enforce_file_format=True)
    else:
        del ds.file_meta
        pydicom.dcmwrite(path, ds, implicit_vr=syntax == ImplicitVRLittleEndian, little_endian=True)
    return path


def dicom_rle(path: Path, values: Array, bits: int, **tags: object) -> Path:
    """Write a DICOM file with run-length coding."""
    plain = pydicom.dcmread(dicom(path, values, bits, **tags))
    plain.compress(RLELossless)
    plain.save_as(path)
    return path


def bmp(path: Path, values: Array, *, palette: Array | None = None, bits: int = 8, top_down: bool = False, per_metre: int = 10000) -> Path:
    """Write a BMP file byte by byte."""
    rows, cols = values.shape[:2]
    line = (cols * bits + 31) // 32 * 4
    table = b""
    if bits == 8:
        table = np.repeat((np.arange(256) if palette is None else palette).astype(np.uint8)[:, None], 4, axis=1).tobytes()
    start = 54 + len(table)
    lines = np.zeros((rows, line), np.uint8)
    lines[:, : cols * bits // 8] = values.reshape(rows, -1)
    body = (lines if top_down else lines[::-1]).tobytes()
    head = struct.pack("<2sIHHI", b"BM", start + len(body), 0, 0, start)
    info = struct.pack("<IiiHHIIiiII", 40, cols, -rows if top_down else rows, 1, bits, 0, len(body), per_metre, per_metre, 0, 0)
    path.write_bytes(head + info + table + body)
    return path


def png(path: Path, values: Array, per_metre: int | None = 10000) -> Path:
    """Write a PNG file with a pHYs chunk."""
    data = imagecodecs.png_encode(values)
    if per_metre is not None:
        chunk = b"pHYs" + struct.pack(">IIB", per_metre, per_metre, 1)
        data = data[:33] + struct.pack(">I", 9) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    path.write_bytes(data)
    return path


def jp2(path: Path, values: Array, bits: int, resolution: bytes = b"") -> Path:
    """Write a JPEG 2000 file; ``resolution`` goes behind the image header box."""
    data = imagecodecs.jpeg2k_encode(values, level=0, bitspersample=bits, reversible=True)
    if resolution:
        at = data.index(b"jp2h") - 4
        (length,) = struct.unpack_from(">I", data, at)
        data = data[:at] + struct.pack(">I", length + len(resolution)) + data[at + 4 : at + length] + resolution + data[at + length :]
    path.write_bytes(data)
    return path


def jpeg(path: Path, values: Array, density: tuple[int, int, int] = (1, 254, 254)) -> Path:
    """Write a JPEG file with a JFIF density."""
    data = bytearray(imagecodecs.jpeg8_encode(values, level=95))
    at = data.index(b"JFIF\0")
    data[at + 7 : at + 12] = struct.pack(">BHH", *density)
    path.write_bytes(bytes(data))
    return path


def _coded(codec: str, bits: int) -> bytes:
    values = radiograph(bits)
    if codec == "j2k":
        return bytes(imagecodecs.jpeg2k_encode(values, level=0, codecformat="J2K", bitspersample=bits, reversible=True))
    if codec == "jls":
        return bytes(imagecodecs.jpegls_encode(values))
    return bytes(imagecodecs.ljpeg_encode(values, bitspersample=bits))


LOSSLESS: dict[str, tuple[int, Callable[[Path], Path]]] = {
    "tiff-8": (8, lambda p: tiff(p, radiograph(8))),
    "tiff-16": (16, lambda p: tiff(p, radiograph(16))),
    "tiff-big-endian": (16, lambda p: tiff(p, radiograph(16), byteorder=">")),
    "tiff-big": (16, lambda p: tiff(p, radiograph(16), bigtiff=True)),
    "tiff-strips": (16, lambda p: tiff(p, radiograph(16), rowsperstrip=7)),
    "tiff-tiles": (16, lambda p: tiff(p, radiograph(16), tile=(64, 64))),
    "tiff-lzw": (16, lambda p: tiff(p, radiograph(16), compression="lzw", rowsperstrip=16)),
    "tiff-lzw-predictor": (16, lambda p: tiff(p, radiograph(16), compression="lzw", predictor=True, rowsperstrip=16)),
    "tiff-lzw-tiles": (8, lambda p: tiff(p, radiograph(8), compression="lzw", tile=(64, 64))),
    "tiff-deflate": (16, lambda p: tiff(p, radiograph(16), compression="zlib", rowsperstrip=16)),
    "tiff-packbits": (8, lambda p: tiff(p, radiograph(8), compression="packbits")),
    "tiff-white": (16, lambda p: tiff(p, 65535 - radiograph(16), photometric="miniswhite")),
    "tiff-white-8": (8, lambda p: tiff(p, 255 - radiograph(8), photometric="miniswhite", compression="lzw")),
    "tiff-rgb": (8, lambda p: tiff(p, np.repeat(radiograph(8)[..., None], 3, 2), photometric="rgb")),
    "tiff-rgb-planes": (16, lambda p: tiff(p, np.repeat(radiograph(16)[None], 3, 0), photometric="rgb", planarconfig="separate")),
    "png-8": (8, lambda p: png(p, radiograph(8))),
    "png-16": (16, lambda p: png(p, radiograph(16))),
    "png-rgb": (16, lambda p: png(p, np.repeat(radiograph(16)[..., None], 3, 2))),
    "png-rgba": (8, lambda p: png(p, np.dstack([radiograph(8)] * 3 + [np.full(SHAPE, 255, np.uint8)]))),
    "jp2-16": (16, lambda p: jp2(p, radiograph(16), 16)),
    "jp2-12": (12, lambda p: jp2(p, radiograph(12), 12)),
    "jp2-8": (8, lambda p: jp2(p, radiograph(8), 8)),
    "bmp": (8, lambda p: bmp(p, radiograph(8))),
    "bmp-top-down": (8, lambda p: bmp(p, radiograph(8), top_down=True)),
    "bmp-inverse-palette": (8, lambda p: bmp(p, 255 - radiograph(8), palette=np.arange(255, -1, -1))),
    "bmp-24": (8, lambda p: bmp(p, np.repeat(radiograph(8)[..., None], 3, 2), bits=24)),
    "dicom-16": (16, lambda p: dicom(p, radiograph(16), 16)),
    "dicom-12": (12, lambda p: dicom(p, radiograph(12), 12)),
    "dicom-8": (8, lambda p: dicom(p, radiograph(8), 8)),
    "dicom-implicit": (12, lambda p: dicom(p, radiograph(12), 12, syntax=ImplicitVRLittleEndian)),
    "dicom-big-endian": (12, lambda p: dicom(p, radiograph(12), 12, syntax=ExplicitVRBigEndian)),
    "dicom-no-header": (12, lambda p: dicom(p, radiograph(12), 12, syntax=ImplicitVRLittleEndian, header=False)),
    "dicom-no-header-explicit": (12, lambda p: dicom(p, radiograph(12), 12, header=False)),
    "dicom-monochrome1": (12, lambda p: dicom(p, 4095 - radiograph(12), 12, photometric="MONOCHROME1")),
    "dicom-falling": (12, lambda p: dicom(p, 4095 - radiograph(12), 12, RescaleSlope=-1, RescaleIntercept=4095)),
    "dicom-signed": (12, lambda p: dicom(p, (radiograph(12).astype(np.int16) - 2048), 12)),
    "dicom-overlay-bits": (12, lambda p: dicom(p, radiograph(12) | np.uint16(0x4000), 12)),
    "dicom-high-bit": (12, lambda p: dicom(p, radiograph(12) << np.uint16(4), 12, HighBit=15)),
    "dicom-rgb": (8, lambda p: dicom(p, np.repeat(radiograph(8)[..., None], 3, 2), 8, photometric="RGB")),
    "dicom-rle": (12, lambda p: dicom_rle(p, radiograph(12), 12)),
    "dicom-j2k": (12, lambda p: dicom(p, radiograph(12), 12, syntax="1.2.840.10008.1.2.4.90", coded=_coded("j2k", 12))),
    "dicom-jls": (16, lambda p: dicom(p, radiograph(16), 16, syntax="1.2.840.10008.1.2.4.80", coded=_coded("jls", 16))),
    "dicom-jpeg-lossless": (12, lambda p: dicom(p, radiograph(12), 12, syntax="1.2.840.10008.1.2.4.70", coded=_coded("ljpeg", 12))),
    "dicom-jpeg-lossless-8": (8, lambda p: dicom(p, radiograph(8), 8, syntax="1.2.840.10008.1.2.4.57", coded=_coded("ljpeg", 8))),
}
"""Name -> (bits, writer) of files that must read back as ``radiograph(bits)`` exactly."""
