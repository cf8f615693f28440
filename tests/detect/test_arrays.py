"""What may be given to detection: arrays that are films, in any byte order; all else is refused with the remedy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.errors import FilmFormatError

ROWS, COLS = np.mgrid[:128, :140]
PLACES = (30.2, 40.7), (60.5, 100.1), (95.0, 50.3)
BALLS = [np.exp(-np.maximum((ROWS - row) ** 2 + (COLS - col) ** 2 - 16.0, 0.0) / 8) for row, col in PLACES]
FILM = np.random.default_rng(0).normal(30000 - 15000 * sum(BALLS), 100).astype(np.uint16)


@pytest.mark.parametrize(
    ("values", "bits", "remedy"),
    [
        (FILM / 65535, 16, "as uint8 or uint16"),
        (FILM.astype(np.int32), 16, "as uint8 or uint16"),
        (np.full(FILM.shape, np.nan), 16, "as uint8 or uint16"),
        (FILM > 20000, 8, "as uint8 or uint16"),
        (np.dstack([FILM] * 3), 16, "(rows, cols)"),
        (FILM[:7, :7], 16, "at least 16 a side"),
        (FILM, -1, "8 to 16"),
        (FILM, 17, "8 to 16"),
        (FILM, 12, "number of bits"),
    ],
    ids=["float", "int32", "nan", "bool", "colour", "tiny", "-1 bits", "17 bits", "too few bits"],
)
def test_what_is_no_film_is_refused(values: Any, bits: int, remedy: str) -> None:
    with pytest.raises(FilmFormatError) as caught:
        detect_markers(values, bits=bits)
    assert remedy in str(caught.value)


def test_byte_order_does_not_matter() -> None:
    native, swapped = (detect_markers(FILM.astype(kind), bits=16).images for kind in ("<u2", ">u2"))
    assert len(native) == len(swapped) > 0
    np.testing.assert_array_equal(native.position_px, swapped.position_px)
