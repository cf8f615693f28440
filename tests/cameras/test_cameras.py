"""Camera calibrations: read exactly, or refused with every error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rsa_vision.cameras import load_camera
from rsa_vision.errors import CalibrationError

REAL = Path(__file__).parents[3] / "shared" / "data" / "real" / "wrist"
GOOD = """image size
1760,1024

camera matrix
6000.5,0,803.25
0,6001,865
0,0,1

rotation
0.6,0,0.8
0,1,0
-0.8,0,0.6

translation
-16.5
-77
901
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "calib_f1.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("change", [lambda t: t, lambda t: t.replace("\n", "\r\n"), lambda t: "\ufeff" + t, lambda t: t.replace(",", ", ")])
def test_reads(change: Callable[[str], str], tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_bytes(change(GOOD).encode())
    camera = load_camera(path)
    assert camera.image_size == (1760, 1024)
    np.testing.assert_array_equal(camera.matrix, [[6000.5, 0, 803.25], [0, 6001, 865], [0, 0, 1]])
    np.testing.assert_array_equal(camera.rotation, [[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]])
    np.testing.assert_array_equal(camera.translation, [-16.5, -77, 901])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD.replace("0.6,0,0.8", "0.6,0,0.81"), "not orthonormal"),
        (GOOD.replace("0,1,0", "0,-1,0"), "determinant -1"),
        (GOOD.replace("6000.5", "-6000.5"), "focal lengths"),
        (GOOD.replace("0,6001,865", "3,6001,865"), "upper triangular"),
        (GOOD.replace("0,0,1\n", "0,0,2\n"), "upper triangular"),
        (GOOD.replace("1760,1024", "1760.5,1024"), "whole positive"),
        (GOOD.replace("1760,1024", "0,1024"), "whole positive"),
        (GOOD.replace("901", "nan"), "translation: not finite"),
        (GOOD.replace("901\n", ""), "translation: 3 rows of 1 numbers"),
        (GOOD.replace("-0.8,0,0.6", "-0.8,0"), "rotation: 3 rows of 3 numbers"),
        (GOOD.replace("901", "9o1"), "translation: could not convert"),
        (GOOD.replace("rotation", "rotatoin"), "rotation: missing"),
        (GOOD + "distortion\n0.1,0,0,0\n", "distortion"),
        (GOOD + "rotation\n1,0,0\n", "twice"),
        ("1,2,3\n" + GOOD, "before the first section"),
        ("", "image size: missing"),
    ],
)
def test_refused(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"calib_f1\.txt") as caught:
        load_camera(write(tmp_path, text))
    assert says in str(caught.value)


def test_all_errors_at_once(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError) as caught:
        load_camera(write(tmp_path, GOOD.replace("0.6,0,0.8", "0.6,0,0.81").replace("6000.5", "-1").replace("1760", "0")))
    for part in ("image size", "focal lengths", "orthonormal"):
        assert part in str(caught.value)


def test_unreadable(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="not a readable"):
        load_camera(tmp_path / "none.txt")
    (tmp_path / "film.tif").write_bytes(b"II*\0\xff\xfe")
    with pytest.raises(CalibrationError, match="not a readable"):
        load_camera(tmp_path / "film.tif")


@pytest.mark.skipif(not REAL.exists(), reason="the real films are not here")
@pytest.mark.parametrize("focus", [1, 2])
def test_real_calibrations(focus: int) -> None:
    camera = load_camera(REAL / f"calib_f{focus}.txt")
    assert camera.image_size == (1760, 1760)
    assert camera.matrix[0, 0] == pytest.approx(6250, abs=200)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
