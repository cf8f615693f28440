"""What is no whole grey radiograph is refused with the remedy; damage never gives another exception than :class:`FilmError`."""

from __future__ import annotations

import os
import re
import struct
import time
from pathlib import Path

import cv2
import film_files as films
import imagecodecs
import numpy as np
import pydicom
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rsa_vision.errors import FilmError, FilmFormatError, PitchError
from rsa_vision.images import open_header, read_film, require_pitch

COMPRESSED = [
    name for name in films.LOSSLESS if any(word in name for word in ("lzw", "deflate", "png", "jp2", "rle", "j2k", "jls", "jpeg"))
]


def refused(path: Path, error: type[FilmError], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        read_film(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


# ---- truncation


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.7, 0.97, "-1", "-40"])
@pytest.mark.parametrize("name", [*films.LOSSLESS, "jpeg", "jpeg-strips", "jpeg-dicom"])
def test_truncated(name: str, fraction: float | str, tmp_path: Path) -> None:
    path = tmp_path / "film"
    if name == "jpeg":
        films.jpeg(path, films.radiograph(8))
    elif name == "jpeg-strips":
        films.tiff(path, films.radiograph(8), compression="jpeg", rowsperstrip=64)
    elif name == "jpeg-dicom":
        coded = bytes(imagecodecs.jpeg8_encode(films.radiograph(8), level=95))
        films.dicom(path, films.radiograph(8), 8, syntax="1.2.840.10008.1.2.4.50", coded=coded)
    else:
        films.LOSSLESS[name][1](path)
    whole = read_film(path).values
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction) if isinstance(fraction, float) else int(fraction)])
    try:
        film = read_film(path)
    except FilmError as error:
        assert str(path) in str(error)
    else:  # the cut took what is not part of the picture: padding, a closing delimiter
        np.testing.assert_array_equal(film.values, whole)
        assert isinstance(fraction, str)


def test_missing_strips(tmp_path: Path) -> None:
    """A strip of length 0 is a hole that tifffile fills with zeros."""
    import tifffile

    path = films.tiff(tmp_path / "film", films.radiograph(16), compression="lzw", rowsperstrip=16)
    with tifffile.TiffFile(path, mode="r+b") as file:
        counts = list(file.pages[0].databytecounts)
        counts[3] = 0
        file.pages[0].tags["StripByteCounts"].overwrite(counts)
    refused(path, FilmError, "truncated")


def overwritten(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite 64 bytes in the middle, as a bad sector would."""
    middle = len(data) // 2
    return data[:middle] + rng.integers(0, 255, 64, np.uint8).tobytes() + data[middle + 64 :]  # and no marker


@pytest.mark.parametrize("name", ["jpeg", "jpeg-strips", "dicom-jpeg-lossless"])
def test_decoders_that_are_out_of_step_are_asked(name: str, tmp_path: Path) -> None:
    path, rng = tmp_path / "film", np.random.default_rng(3)
    if name == "jpeg":
        films.jpeg(path, films.radiograph(8))
    elif name == "jpeg-strips":
        films.tiff(path, films.radiograph(8), compression="jpeg")
    else:
        films.LOSSLESS[name][1](path)
    data, told = path.read_bytes(), 0
    third = len(data) // 3
    path.write_bytes(data[:third] + bytes(third) + data[2 * third :])
    refused(path, FilmError, "coded bits are")
    for _ in range(20):
        path.write_bytes(overwritten(data, rng))
        try:
            read_film(path)
        except FilmError:
            told += 1
    assert told >= 10  # the count of bits may be right by chance


@pytest.mark.parametrize("blank", [0, 128, 255])
@pytest.mark.parametrize("options", [{}, {"optimize": True}, {"progressive": True}, {"restart": 7}], ids=str)
def test_even_films_and_margins_in_jpeg_are_whole(blank: int, options: dict[str, int], tmp_path: Path) -> None:
    names = {"optimize": cv2.IMWRITE_JPEG_OPTIMIZE, "progressive": cv2.IMWRITE_JPEG_PROGRESSIVE, "restart": cv2.IMWRITE_JPEG_RST_INTERVAL}
    path, values = tmp_path / "film.jpg", films.radiograph(8)
    for first in (70, 0):
        values[first:] = blank
        for quality in (30, 75, 100):
            written = [cv2.IMWRITE_JPEG_QUALITY, quality, *(x for name, on in options.items() for x in (names[name], int(on)))]
            cv2.imwrite(str(path), values, written)
            assert read_film(path).values.shape == values.shape


@pytest.mark.parametrize("name", ["dicom-rle", "dicom-j2k", "dicom-jls", "dicom-jpeg-lossless"])
def test_compressed_dicom_without_its_end_is_truncated(name: str, tmp_path: Path) -> None:
    path = films.LOSSLESS[name][1](tmp_path / "film")
    path.write_bytes(path.read_bytes()[:-100])
    refused(path, FilmError, "truncated")


def test_run_length_coding_that_cannot_be_decoded_names_no_plugins(tmp_path: Path) -> None:
    path = films.LOSSLESS["dicom-rle"][1](tmp_path / "film")
    data = path.read_bytes()
    third = len(data) // 3
    path.write_bytes(data[:third] + bytes(third) + data[2 * third :])
    refused(path, FilmError, "cannot be decoded; the file is damaged")


# ---- kinds of files that are no films


def test_empty_and_garbage(tmp_path: Path) -> None:
    path = tmp_path / "film.tif"
    path.write_bytes(b"")
    refused(path, FilmError, "empty")
    path.write_bytes(b"subject,exam\n" * 100)
    refused(path, FilmError, "not a TIFF, PNG, JPEG")
    path.write_bytes(b"%PDF-1.4" + bytes(500))
    refused(path, FilmError, "not a TIFF")
    refused(tmp_path, FilmError, "a folder; name the films in it")
    refused(tmp_path / "none", FilmError, "cannot be read")
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    refused(path, FilmError, "ends within its header")


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tif")
    refused(tmp_path / "pipe.tif", FilmError, "regular file")


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.complex64])
def test_floating_point(dtype: type, tmp_path: Path) -> None:
    path = films.tiff(tmp_path / "film.tif", films.radiograph(12).astype(dtype))
    refused(path, FilmFormatError, "unsigned integers")


def test_nan(tmp_path: Path) -> None:
    refused(films.tiff(tmp_path / "film.tif", np.full(films.SHAPE, np.nan, np.float32)), FilmFormatError, "unsigned integers")


def test_32_bits(tmp_path: Path) -> None:
    refused(films.tiff(tmp_path / "film.tif", films.radiograph(16).astype(np.uint32)), FilmFormatError, "16-bit")


def test_one_bit(tmp_path: Path) -> None:
    bits = films.radiograph(8) > 128
    refused(films.tiff(tmp_path / "film.tif", bits), FilmFormatError, "one-bit")
    data = bytearray(films.png(tmp_path / "film.png", films.radiograph(8)).read_bytes())
    data[24] = 1
    (tmp_path / "film.png").write_bytes(bytes(data))
    refused(tmp_path / "film.png", FilmFormatError, "one-bit")
    path = films.dicom(tmp_path / "film.dcm", films.radiograph(8), 1)
    refused(path, FilmFormatError, "one-bit")


def test_colour(tmp_path: Path) -> None:
    colour = np.repeat(films.radiograph(8)[..., None], 3, 2)
    colour[50, 60, 1] ^= 1  # one unequal pixel is enough
    refused(films.png(tmp_path / "film", colour), FilmFormatError, "colour")
    refused(films.tiff(tmp_path / "film", colour, photometric="rgb"), FilmFormatError, "colour")
    refused(films.bmp(tmp_path / "film", colour, bits=24), FilmFormatError, "colour")
    refused(films.dicom(tmp_path / "film", colour, 8, photometric="RGB"), FilmFormatError, "colour")
    colour[..., 1] //= 2
    refused(films.jpeg(tmp_path / "film", colour), FilmFormatError, "colour")


def test_transparency(tmp_path: Path) -> None:
    values = films.radiograph(8)
    refused(films.png(tmp_path / "film", np.dstack([values, values])), FilmFormatError, "transparent")


def test_stacks(tmp_path: Path) -> None:
    values = films.radiograph(16)
    stack = np.stack([values, values])
    refused(films.tiff(tmp_path / "film", stack), FilmFormatError, "stack of 2")
    import tifffile

    tifffile.imwrite(tmp_path / "film", stack, imagej=True)
    refused(tmp_path / "film", FilmFormatError, "stack of 2")
    refused(films.dicom(tmp_path / "film", values, 16, NumberOfFrames=2), FilmFormatError, "stack of 2")
    path = films.dicom(tmp_path / "film", np.vstack([values, values]), 16, Rows=values.shape[0])
    refused(path, FilmFormatError, "several frames")


def test_too_small(tmp_path: Path) -> None:
    refused(films.png(tmp_path / "film", films.radiograph(8)[:40]), FilmFormatError, "no radiograph")


# ---- hostile sizes


def test_announced_size_is_checked_before_memory_is_spent(tmp_path: Path) -> None:
    import tracemalloc

    path = films.png(tmp_path / "a", films.radiograph(8))
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 30000, 30000)
    path.write_bytes(bytes(data))
    tracemalloc.start()
    refused(path, FilmError, "truncated")
    data[16:24] = struct.pack(">II", 200000, 200000)
    path.write_bytes(bytes(data))
    refused(path, FilmFormatError, "absurd")
    refused(films.dicom(tmp_path / "b", films.radiograph(12), 12, Rows=60000, Columns=16000), FilmError, "truncated")
    refused(films.dicom(tmp_path / "b", films.radiograph(12), 12, Rows=65535, Columns=65535), FilmFormatError, "absurd")
    refused(films.dicom(tmp_path / "b", films.radiograph(12), 12, Rows=300), FilmError, "truncated")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


@pytest.mark.parametrize("name", ["dicom-j2k", "dicom-jls", "dicom-jpeg-lossless"])
def test_coded_size_must_be_the_announced_one(name: str, tmp_path: Path) -> None:
    path = films.LOSSLESS[name][1](tmp_path / "film")
    ds = pydicom.dcmread(path)
    ds.Rows = 200
    ds.save_as(path)
    refused(path, FilmError, "not of the size")


def test_dicom_without_pixels(tmp_path: Path) -> None:
    path = films.dicom(tmp_path / "film", films.radiograph(12), 12)
    ds = pydicom.dcmread(path)
    del ds.PixelData
    ds.save_as(path)
    refused(path, FilmFormatError, "no integer pixel data")
    del ds.Rows
    ds.save_as(path)
    refused(path, FilmError, "no DICOM image")


def test_deep_sequences(tmp_path: Path) -> None:
    """Nested items, thousands deep: no overflow, no hang."""
    deep = b"".join(struct.pack("<HHIHHI", 0x0008, 0x1140, 0xFFFFFFFF, 0xFFFE, 0xE000, 0xFFFFFFFF) for _ in range(20000))
    path = tmp_path / "film"
    path.write_bytes(struct.pack("<HHI", 0x0008, 0x0008, 2) + b"A " + deep)
    start = time.monotonic()
    refused(path, FilmError, "damaged|no DICOM")
    assert time.monotonic() - start < 10


def test_unsupported_transfer_syntaxes(tmp_path: Path) -> None:
    path = films.dicom(tmp_path / "film", films.radiograph(12), 12, syntax="1.2.840.10008.1.2.1.99")
    refused(path, FilmFormatError, "deflated")
    path = films.dicom(tmp_path / "film", films.radiograph(12), 12, syntax="1.2.840.10008.1.2.4.100", coded=b"\0" * 3000)
    refused(path, FilmFormatError, "export it again uncompressed")


# ---- corruption


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("samples")
    made = {name: write(folder / "film").read_bytes() for name, (_, write) in films.LOSSLESS.items()}
    made["jpeg"] = films.jpeg(folder / "film", films.radiograph(8)).read_bytes()
    return made


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_corruption_gives_an_image_or_a_film_error(samples: dict[str, bytes], tmp_path: Path, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(samples)))
    damaged = bytearray(samples[name])
    # headers are short: half of the damage goes to the first 600 bytes, or the last (TIFF's directory may stand there)
    place = st.one_of(st.integers(0, 600), st.integers(0, len(damaged) - 1), st.integers(len(damaged) - 400, len(damaged) - 1))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(place)
        run = data.draw(st.binary(min_size=1, max_size=4))
        damaged[at : at + len(run)] = run
    path = tmp_path / "film"
    path.write_bytes(bytes(damaged))
    start = time.monotonic()
    try:
        film = read_film(path)
    except FilmError as error:
        assert str(path) in str(error)
    else:
        assert film.values.ndim == 2
        assert film.values.dtype in (np.uint8, np.uint16)
        assert 8 <= film.bits <= 16
        assert int(film.values.max()) < 2**film.bits
    assert time.monotonic() - start < 5


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    tail=st.binary(max_size=300),
    head=st.sampled_from(
        [
            b"II*\0",
            b"MM\0*",
            b"II+\0",
            b"\x89PNG\r\n\x1a\n",
            b"\xff\xd8\xff",
            b"BM",
            b"\x08\0\x05\0",
            b"\0" * 128 + b"DICM",
            b"\xff\x4f\xff\x51",
            b"\0\0\0\x0cjP  \r\n\x87\n",
        ]
    ),
)
def test_garbage_behind_a_signature(tmp_path: Path, head: bytes, tail: bytes) -> None:
    path = tmp_path / "film"
    path.write_bytes(head + tail)
    with pytest.raises(FilmError):
        read_film(path)


# ---- pixel pitch


def pitch_source(path: Path) -> str:
    header = open_header(path)
    assert header.pitch_mm is None
    with pytest.raises(PitchError, match=re.escape("pixel_pitch_mm in study.toml")) as caught:
        require_pitch(read_film(path))
    assert "--pixel-pitch-mm" in str(caught.value)
    assert header.pitch_source in str(caught.value)
    return header.pitch_source


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"resolution": (72, 72)}, "72 dpi"),
        ({"resolution": (96, 96)}, "96 dpi"),
        ({"resolution": (1, 1)}, "implausible"),
        ({"resolution": (10000, 10000)}, "implausible"),
        ({"resolution": (254, 300)}, "differ"),
        ({"resolution": (254, 254), "resolutionunit": "NONE"}, "no TIFF resolution"),
    ],
)
def test_implausible_tiff_pitch(options: dict[str, object], says: str, tmp_path: Path) -> None:
    assert says in pitch_source(films.tiff(tmp_path / "film", films.radiograph(8), **options))


def test_tiff_pitch(tmp_path: Path) -> None:
    film = read_film(films.tiff(tmp_path / "film", films.radiograph(8), resolution=(100, 102), resolutionunit="CENTIMETER"))
    assert film.pitch_mm == pytest.approx((10 / 102, 0.1))  # (row, column): YResolution, XResolution


def test_raster_pitch(tmp_path: Path) -> None:
    values = films.radiograph(8)
    assert "72 dpi" in pitch_source(films.png(tmp_path / "a", values, per_metre=2835))
    assert "96 dpi" in pitch_source(films.bmp(tmp_path / "a", values, per_metre=3780))
    assert "zero" in pitch_source(films.bmp(tmp_path / "a", values, per_metre=0))
    assert "no pHYs" in pitch_source(films.png(tmp_path / "a", values, per_metre=None))
    assert "72 dpi" in pitch_source(films.jpeg(tmp_path / "a", values, (1, 72, 72)))
    assert "no JFIF" in pitch_source(films.jpeg(tmp_path / "a", values, (0, 1, 1)))
    assert read_film(films.jpeg(tmp_path / "a", values, (2, 100, 100))).pitch_mm == pytest.approx((0.1, 0.1))


def test_jpeg2000_capture_resolution(tmp_path: Path) -> None:
    values = films.radiograph(16)
    assert "no capture" in pitch_source(films.jp2(tmp_path / "a", values, 16))
    capture = struct.pack(">I4s4H2b", 18, b"resc", 100, 1, 125, 1, 2, 2)  # 10,000 rows and 12,500 columns a metre
    display = struct.pack(">I4s4H2b", 18, b"resd", 50, 1, 50, 1, 2, 2)
    box = struct.pack(">I4s", 44, b"res ") + display + capture
    film = read_film(films.jp2(tmp_path / "a", values, 16, box.replace(struct.pack(">H", 125), struct.pack(">H", 104))))
    assert film.pitch_mm == pytest.approx((0.1, 1 / 10.4))
    np.testing.assert_array_equal(film.values, values)
    assert "differ" in pitch_source(films.jp2(tmp_path / "a", values, 16, box))


@pytest.mark.parametrize(
    ("tags", "pitch"),
    [
        ({"ImagerPixelSpacing": [0.1, 0.102], "PixelSpacing": [0.08, 0.08]}, (0.1, 0.102)),
        ({"ImagerPixelSpacing": None, "PixelSpacing": [0.08, 0.08]}, (0.08, 0.08)),
        ({"ImagerPixelSpacing": [0, 0], "PixelSpacing": [0.08, 0.08]}, (0.08, 0.08)),
        ({"ImagerPixelSpacing": None, "NominalScannedPixelSpacing": [0.05, 0.05], "PixelSpacing": [0.08, 0.08]}, (0.05, 0.05)),
        ({"ImagerPixelSpacing": [3, 3], "PixelSpacing": [0.08, 0.08]}, None),
        ({"ImagerPixelSpacing": None}, None),
        ({"ImagerPixelSpacing": None, "PixelSpacing": [0.08, 0.08], "PixelSpacingCalibrationType": "GEOMETRY"}, None),
    ],
)
def test_dicom_pitch(tags: dict[str, object], pitch: tuple[float, float] | None, tmp_path: Path) -> None:
    assert read_film(films.dicom(tmp_path / "film", films.radiograph(12), 12, **tags)).pitch_mm == pitch


def test_require_pitch(tmp_path: Path) -> None:
    film = read_film(films.tiff(tmp_path / "film", films.radiograph(8)))
    assert require_pitch(film) == pytest.approx((0.1, 0.1))
    assert require_pitch(film, 0.2) == (0.2, 0.2)
    with pytest.raises(PitchError, match="implausible"):
        require_pitch(film, 2.0)


def test_dicom_of_a_palette_or_of_no_bits(tmp_path: Path) -> None:
    values = films.radiograph(12)
    refused(films.dicom(tmp_path / "palette.dcm", values, 12, photometric="PALETTE COLOR"), FilmFormatError, "PALETTE COLOR")
    path = films.dicom(tmp_path / "none.dcm", values, 12)
    ds = pydicom.dcmread(path)
    ds.BitsStored = 0
    ds.save_as(path)
    refused(path, FilmFormatError, "0 bits")
