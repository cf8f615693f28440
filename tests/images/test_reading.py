"""Films come back as they were written, whatever the format."""

from __future__ import annotations

from pathlib import Path

import film_files as films
import imagecodecs
import numpy as np
import pytest

from rsa_vision.errors import FilmError
from rsa_vision.images import open_header, read_film

REAL = Path(__file__).parents[3] / "shared" / "data" / "real"


@pytest.mark.parametrize("name", films.LOSSLESS)
def test_lossless_formats_are_exact(name: str, tmp_path: Path) -> None:
    bits, write = films.LOSSLESS[name]
    film = read_film(write(tmp_path / "film"))  # no extension: told by content
    np.testing.assert_array_equal(film.values, films.radiograph(bits))
    assert film.bits == bits
    assert film.values.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert film.values.flags.c_contiguous
    assert film.values.dtype.isnative
    if not name.startswith("jp2"):
        assert film.pitch_mm == pytest.approx((0.1, 0.1), rel=1e-4)


@pytest.mark.parametrize("name", films.LOSSLESS)
def test_header_agrees_with_film(name: str, tmp_path: Path) -> None:
    bits, write = films.LOSSLESS[name]
    header = open_header(write(tmp_path / "film"))
    assert (header.rows, header.cols, header.bits) == (*films.SHAPE, bits)


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_packed_tiff(bits: int, tmp_path: Path) -> None:
    """Samples of other than 8 or 16 bits stand bit by bit behind each other, lines filled up to whole bytes."""
    values = films.radiograph(bits)
    lines = np.unpackbits(values.astype(">u2").view(np.uint8).reshape(*values.shape, 2), axis=2)[..., 16 - bits :]
    packed = np.packbits(lines.reshape(len(values), -1), axis=1)
    path = films.tiff(tmp_path / "film.tif", packed, rowsperstrip=len(values))
    data = bytearray(path.read_bytes())
    for tag, value in ((256, values.shape[1]), (258, bits)):  # ImageWidth, BitsPerSample
        at = data.index(tag.to_bytes(2, "little") + b"\x03\x00\x01\x00\x00\x00" if tag == 258 else tag.to_bytes(2, "little") + b"\x04\x00")
        data[at + 8 : at + 12] = value.to_bytes(4, "little")
    path.write_bytes(bytes(data))
    film = read_film(path)
    assert film.bits == bits
    np.testing.assert_array_equal(film.values, values)


def test_signed_tiff(tmp_path: Path) -> None:
    values = films.radiograph(16)
    shifted = (values.astype(np.int32) - 2**15).astype(np.int16)
    film = read_film(films.tiff(tmp_path / "film.tif", shifted))
    np.testing.assert_array_equal(film.values, values)
    assert film.bits == 16
    film = read_film(films.tiff(tmp_path / "film.tif", films.radiograph(12).astype(np.int16)))
    np.testing.assert_array_equal(film.values, films.radiograph(12))
    assert film.bits == 15


def test_thumbnails_are_no_stack(tmp_path: Path) -> None:
    import tifffile

    values = films.radiograph(16)
    with tifffile.TiffWriter(tmp_path / "film.tif") as file:
        file.write(values[::2, ::2], subfiletype=1, metadata=None)
        file.write(values, metadata=None)
    np.testing.assert_array_equal(read_film(tmp_path / "film.tif").values, values)


@pytest.mark.parametrize("compression", ["jpeg", "file"])
def test_jpeg_is_near(compression: str, tmp_path: Path) -> None:
    values = films.radiograph(8)
    path = tmp_path / "film.jpg"
    if compression == "jpeg":
        films.tiff(path, values, compression="jpeg", compressionargs={"level": 95}, rowsperstrip=64)
    else:
        films.jpeg(path, values)
    film = read_film(path)
    assert film.pitch_mm == pytest.approx((0.1, 0.1))
    difference = film.values.astype(int) - values
    assert np.abs(difference[1:]).max() <= 12  # quantisation of quality 95; the extremes in row 0 ring


def test_jpeg_of_equal_colours(tmp_path: Path) -> None:
    path = tmp_path / "film.jpg"
    films.jpeg(path, np.repeat(films.radiograph(8)[..., None], 3, 2))
    assert read_film(path).values.shape == films.SHAPE


def test_jpeg_12_bit_dicom(tmp_path: Path) -> None:
    values = films.radiograph(12)
    coded = bytes(imagecodecs.jpeg_encode(values, level=98, bitspersample=12))
    film = read_film(films.dicom(tmp_path / "film", values, 12, syntax="1.2.840.10008.1.2.4.51", coded=coded))
    assert film.bits == 12
    assert np.abs(film.values.astype(int) - values)[1:].max() <= 60  # lossy, but of the same scale


@pytest.mark.parametrize("predictor", range(1, 8))
@pytest.mark.parametrize("bits", [12, 16])
def test_jpeg_lossless_predictors(predictor: int, bits: int, tmp_path: Path) -> None:
    """All predictors of ISO 10918-1 annex H; another decoder (GDCM) agrees."""
    from pydicom import dcmread
    from pydicom.pixels import get_decoder

    values = films.radiograph(bits)
    coded = bytes(imagecodecs.jpeg8_encode(values, lossless=True, predictor=predictor, bitspersample=bits))
    path = films.dicom(tmp_path / "film", values, bits, syntax="1.2.840.10008.1.2.4.57", coded=coded)
    np.testing.assert_array_equal(read_film(path).values, values)
    other, _ = get_decoder("1.2.840.10008.1.2.4.57").as_array(dcmread(path), index=0)
    np.testing.assert_array_equal(other, values)


def test_signed_jpeg2000_dicom(tmp_path: Path) -> None:
    values = films.radiograph(12).astype(np.int16) - 2048
    coded = bytes(imagecodecs.jpeg2k_encode(values, level=0, codecformat="J2K", bitspersample=12, reversible=True))
    film = read_film(films.dicom(tmp_path / "film", values, 12, syntax="1.2.840.10008.1.2.4.90", coded=coded))
    np.testing.assert_array_equal(film.values, films.radiograph(12))


def test_never_negative_signed_dicom(tmp_path: Path) -> None:
    values = films.radiograph(12)
    film = read_film(films.dicom(tmp_path / "film", values.astype(np.int16), 16))
    np.testing.assert_array_equal(film.values, values)
    assert film.bits == 15


def test_signed_monochrome1(tmp_path: Path) -> None:
    values = films.radiograph(12).astype(np.int16) - 2048
    film = read_film(films.dicom(tmp_path / "film", values, 12, photometric="MONOCHROME1"))
    np.testing.assert_array_equal(film.values, 4095 - films.radiograph(12))


def test_voi_and_rescale_are_not_applied(tmp_path: Path) -> None:
    values = films.radiograph(12)
    film = read_film(films.dicom(tmp_path / "film", values, 12, WindowCenter=100, WindowWidth=10, RescaleSlope=2, RescaleIntercept=-1000))
    np.testing.assert_array_equal(film.values, values)


def test_meta(tmp_path: Path) -> None:
    meta = read_film(films.dicom(tmp_path / "film", films.radiograph(12), 12)).meta
    assert meta["patient_id"] == "S1"
    assert (meta["acquisition_date"], meta["acquisition_time"]) == ("20260101", "090000")
    assert (meta["view"], meta["detector_id"], meta["modality"]) == ("AP", "D1", "CR")
    assert meta["photometric"] == "MONOCHROME2"


def test_wrong_extension_is_read(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_film(films.png(tmp_path / "film.tif", films.radiograph(16))).values, films.radiograph(16))


@pytest.mark.parametrize("name", ["tiff-16", "tiff-white", "tiff-lzw", "dicom-12", "dicom-monochrome1", "bmp"])
def test_memory_is_twice_the_film_at_most(name: str, tmp_path: Path) -> None:
    """Peak of what Python's allocators (numpy's among them) hand out while a larger film is read."""
    import tracemalloc

    values = np.tile(films.radiograph(films.LOSSLESS[name][0]), (12, 12))
    writers = {
        "tiff-16": lambda p: films.tiff(p, values),
        "tiff-white": lambda p: films.tiff(p, values, photometric="miniswhite"),
        "tiff-lzw": lambda p: films.tiff(p, values, compression="lzw", rowsperstrip=64),
        "dicom-12": lambda p: films.dicom(p, values, 12),
        "dicom-monochrome1": lambda p: films.dicom(p, values, 12, photometric="MONOCHROME1"),
        "bmp": lambda p: films.bmp(p, values),
    }
    path = writers[name](tmp_path / "film")
    read_film(path)  # imports
    tracemalloc.start()
    film = read_film(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 2.1 * film.values.nbytes + 2**20


@pytest.mark.skipif(not REAL.exists(), reason="the real films are not here")
def test_real_films() -> None:
    read = {path.name: read_film(path) for path in sorted(REAL.glob("*/*")) if path.suffix in (".tif", ".png", ".dcm")}
    assert read["wrist_0158_f1.tif"].values.shape == (1760, 1760)
    assert read["pig_00_f1.png"].values.shape == (1024, 1024)
    assert (read["RG1_UNCR.dcm"].bits, read["RG1_UNCR.dcm"].values.shape) == (15, (1955, 1841))
    assert read["gantry0.dcm"].values.shape == (384, 512)  # no file header
    # a chest film is bright (little exposed) where it is shown bright: its mediastinum against the lungs beside it
    chest = read["RG1_UNCR.dcm"].values
    assert chest[900:1100, 880:960].mean() > chest[900:1100, 400:480].mean()
    assert all(film.pitch_mm is None for film in read.values())


def test_missing_file_is_a_film_error(tmp_path: Path) -> None:
    with pytest.raises(FilmError, match="path"):
        read_film(tmp_path / "nothing.tif")
