"""Calibrated cameras instead of a cage: from image points of two views to markers in the calibration's frame."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import tifffile
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import rsa_vision
from rsa_vision.cli import run_app
from rsa_vision.types import Float, MarkerImages

SIZE, FOCAL_PX, DISTANCE_MM, SD_PX, ALONG_PX = 400, 1500.0, 900.0, 0.02, 0.3
SIGMAS = 5.0  # of 27 coordinates
TURNS_DEG = {1: 0.0, 2: 70.0}


def camera_text(turn_deg: float) -> str:
    rotation = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    rows = "\n".join(",".join(f"{v:.12f}" for v in row) for row in rotation)
    matrix = f"{FOCAL_PX},0,199.5\n0,{FOCAL_PX},199.5\n0,0,1"
    return f"image size\n{SIZE},{SIZE}\n\ncamera matrix\n{matrix}\n\nrotation\n{rows}\n\ntranslation\n0\n0\n{DISTANCE_MM}\n"


def seen(points_mm: Float, turn_deg: float) -> Float:
    """Project by hand: turn about y, divide by depth."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    x, y, z = points_mm.T
    u, w = c * x + s * z, -s * x + c * z + DISTANCE_MM
    return np.column_stack([FOCAL_PX * u / w + 199.5, FOCAL_PX * y / w + 199.5])


@pytest.fixture
def biplane(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Float]:
    """Nine balls, or as many of them as are asked for pins that point anywhere."""
    pins = np.arange(9) < getattr(request, "param", 0)
    rng = np.random.default_rng(11)
    points = rng.uniform(-40, 40, (9, 3))
    folder = tmp_path / "study"
    folder.mkdir()
    lines = []
    known = {}
    for focus, turn in TURNS_DEG.items():
        film = rng.integers(0, 60000, (SIZE, SIZE)).astype(np.uint16)
        tifffile.imwrite(folder / f"H_1_f{focus}.tif", film)
        angle = np.where(pins, rng.uniform(-np.pi, np.pi, 9), np.nan)
        along = ALONG_PX * np.nan_to_num(np.column_stack([np.cos(angle), -np.sin(angle)]))
        px = seen(points, turn) + rng.normal(0, SD_PX, (9, 2)) + rng.normal(0, 1, (9, 1)) * along
        n = len(px)
        cov = np.eye(2) * SD_PX**2 + along[:, :, None] * along[:, None]
        look = (
            np.where(pins, "pin", "ball"),
            np.full(n, 2.5),
            np.rad2deg(angle),
            *np.full((2, n), 0.5),
            np.full(n, 40.0),
            np.zeros(n, np.int64),
        )
        known[int(film[0, 0]), int(film[0, 1])] = MarkerImages(px, cov, *look)
        (folder / f"calib_f{focus}.txt").write_text(camera_text(turn))
        lines.append(f'{focus} = "calib_f{focus}.txt"')
    (folder / "study.toml").write_text(f"calibration = {{ {', '.join(lines)} }}\n")

    def detect(values: Any, **_: Any) -> Any:
        return SimpleNamespace(images=known[int(values[0, 0]), int(values[0, 1])])

    monkeypatch.setattr("rsa_vision.examination.detect_markers", detect)
    return folder, points


def test_markers_without_cage_and_without_pitch(biplane: tuple[Path, Float], tmp_path: Path) -> None:
    folder, truth = biplane
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out)]) == 0
    markers = pl.read_csv(out / "markers.csv")
    place = markers.select("x_mm", "y_mm", "z_mm").to_numpy()
    sd = markers.select("sd_x_mm", "sd_y_mm", "sd_z_mm").to_numpy()
    nearest = cKDTree(truth).query(place)[1]
    assert sorted(nearest.tolist()) == list(range(9))
    assert np.abs((place - truth[nearest]) / sd).max() < SIGMAS
    assert sd.max() < 0.05
    assert len(pl.read_csv(out / "foci.csv")) == 2
    assert "calibrated cameras" in (out / "report.html").read_text()


@pytest.mark.parametrize("biplane", [5, 6], indirect=True)
def test_pins_are_markers_whose_errors_are_long_along_them(biplane: tuple[Path, Float], tmp_path: Path) -> None:
    folder, truth = biplane
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out)]) == 0
    markers = pl.read_csv(out / "markers.csv")
    place, sd = (markers.select(*(f"{prefix}{axis}_mm" for axis in "xyz")).to_numpy() for prefix in ("", "sd_"))
    nearest = cKDTree(truth).query(place)[1]
    assert sorted(nearest.tolist()) == list(range(9))
    assert np.abs((place - truth[nearest]) / sd).max() < SIGMAS
    assert sd.max() > 0.5 * ALONG_PX * DISTANCE_MM / FOCAL_PX


def test_films_that_are_not_of_these_cameras_fail(biplane: tuple[Path, Float], tmp_path: Path) -> None:
    folder, _ = biplane
    text = camera_text(0.0).replace(f"{SIZE},{SIZE}", "800,800")
    (folder / "calib_f1.txt").write_text(text)
    summary = rsa_vision.measure(folder, tmp_path / "out")
    assert [(o.status, o.reasons) for o in summary.outcomes] == [("failed", "calibration-invalid")]


def test_a_wrong_calibration_is_never_ok(biplane: tuple[Path, Float], tmp_path: Path) -> None:
    folder, _ = biplane
    (folder / "calib_f2.txt").write_text(camera_text(TURNS_DEG[2] + 8.0).replace("0\n0\n900", "0\n12\n900"))
    summary = rsa_vision.measure(folder, tmp_path / "out")
    assert summary.outcomes[0].status != "ok"


def test_cage_and_calibration_exclude_each_other(biplane: tuple[Path, Float], tmp_path: Path) -> None:
    with pytest.raises(rsa_vision.RsaError, match="exclude each other"):
        rsa_vision.measure(biplane[0], tmp_path / "out", cage="1A")
