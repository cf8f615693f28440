"""Rendered films and their truth as files."""

from __future__ import annotations

import datetime
import struct
import zlib
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import polars as pl
import tifffile
from numpy.typing import NDArray
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import ComputedRadiographyImageStorage, ExplicitVRLittleEndian, generate_uid

Values = NDArray[np.uint8] | NDArray[np.uint16]


def write_film(path: Path, values: Values, *, bits: int, pitch_mm: tuple[float, float] | None, white_is_zero: bool = False) -> None:
    """Write a film in the format of the path's extension: tif, png or dcm.

    Parameters
    ----------
    path : Path
    values : ndarray of uint8 or uint16, shape (rows, cols)
        Larger values brighter.
    bits : int
        Significant bits; TIFF packs 9 to 15 of them.
    pitch_mm : tuple of two floats, or None
        (row, col), for the resolution tags; None: no tags.
    white_is_zero : bool
        Store the values inverted and declare so (MINISWHITE, MONOCHROME1); not in PNG.

    Raises
    ------
    ValueError
        For another extension.
    """
    stored = np.asarray((2**bits - 1 - values).astype(values.dtype)) if white_is_zero else values
    kind = path.suffix.lower()
    if kind in (".tif", ".tiff"):
        options: dict[str, Any] = {} if bits in (8, 16) else {"bitspersample": bits}
        if pitch_mm is not None:
            options |= {"resolution": (10 / pitch_mm[1], 10 / pitch_mm[0]), "resolutionunit": "CENTIMETER"}
        tifffile.imwrite(path, stored, photometric="miniswhite" if white_is_zero else "minisblack", metadata=None, **options)
    elif kind == ".png" and not white_is_zero:
        path.write_bytes(_png(stored, pitch_mm))
    elif kind == ".dcm":
        _dicom(path, stored, bits, pitch_mm, white_is_zero).save_as(path, enforce_file_format=True)
    else:
        raise ValueError(f"{path}: films are written as tif, png (no white_is_zero) or dcm")


def _png(values: Values, pitch_mm: tuple[float, float] | None) -> bytes:
    encoded = bytes(imagecodecs.png_encode(values))
    if pitch_mm is None:
        return encoded
    chunk = b"pHYs" + struct.pack(">IIB", round(1000 / pitch_mm[1]), round(1000 / pitch_mm[0]), 1)  # pixels a metre: x, y
    after_header = 8 + 25  # signature, IHDR
    return encoded[:after_header] + struct.pack(">I", 9) + chunk + struct.pack(">I", zlib.crc32(chunk)) + encoded[after_header:]


def _dicom(path: Path, values: Values, bits: int, pitch_mm: tuple[float, float] | None, white_is_zero: bool) -> Dataset:
    subject, _, rest = path.stem.partition("_")
    exam, _, focus = rest.partition("_")
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = ComputedRadiographyImageStorage
    seed = [path.name, str(zlib.crc32(values.tobytes()))]  # the same film gets the same identifiers
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = generate_uid(entropy_srcs=seed)
    data.StudyInstanceUID, data.SeriesInstanceUID = (generate_uid(entropy_srcs=[*seed, level]) for level in ("study", "series"))
    data.Modality, data.PatientID, data.PatientName = "CR", subject, subject
    try:
        when = datetime.datetime.strptime(exam[:12], "%Y%m%d%H%M")
        data.AcquisitionDate, data.AcquisitionTime = when.strftime("%Y%m%d"), when.strftime("%H%M%S")
    except ValueError:
        data.StudyID = exam[:16]
    data.SeriesDescription = focus
    data.Rows, data.Columns = values.shape
    data.SamplesPerPixel = 1
    data.PhotometricInterpretation = "MONOCHROME1" if white_is_zero else "MONOCHROME2"
    data.PixelRepresentation = 0
    data.BitsAllocated = 8 * values.dtype.itemsize
    data.BitsStored, data.HighBit = bits, bits - 1
    if pitch_mm is not None:
        data.ImagerPixelSpacing = [f"{pitch_mm[0]:.10g}", f"{pitch_mm[1]:.10g}"]
    data.PixelData = values.tobytes()
    data["PixelData"].VR = "OB" if values.dtype.itemsize == 1 else "OW"
    return data


def write_truth(folder: Path, tables: dict[str, pl.DataFrame]) -> list[Path]:
    """Write truth tables as ``NAME.csv`` into a folder.

    Parameters
    ----------
    folder : Path
    tables : dict of str to polars.DataFrame

    Returns
    -------
    list of Path
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, table in tables.items():
        path = folder / f"{name}.csv"
        table.write_csv(path)
        paths.append(path)
    return paths
