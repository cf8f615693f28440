"""`export`: what it writes is read back the same, by the rules of each format."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import rsa_vision
from rsa_vision.cli import run_app
from rsa_vision.kinematics.series import make_series
from rsa_vision.marker_files import read_markers

PRINTED_MM = 0.5e-6
SINGLE_MM = 2e-5  # of coordinates below 300 mm


@pytest.fixture
def markers(tmp_path: Path) -> Path:
    """One subject, three examinations, bone and stem; stem/2 is missing in the second, stem/3 loose in the third."""
    rng = np.random.default_rng(8)
    rows = []
    for exam in ("202601010900", "202602010900", "202701010900"):
        for segment, count in (("bone", 4), ("stem", 3), ("", 1)):
            for k in range(1, count + 1):
                x, y, z = rng.uniform(-150, 150, 3)
                row = {"subject": "S01", "exam": exam, "segment": segment, "marker": str(k), "x_mm": x, "y_mm": y, "z_mm": z, "flags": ""}
                rows.append(row)
    rows[8 + 5] |= {"x_mm": None, "y_mm": None, "z_mm": None}
    rows[16 + 6] |= {"flags": "loose"}
    pl.DataFrame(rows, infer_schema_length=None).write_csv(tmp_path / "markers.csv")
    return tmp_path / "markers.csv"


def truth(path: Path) -> dict[str, np.ndarray]:
    """Return the places of each marker in all examinations, without those that are missing or loose."""
    table = pl.read_csv(path, infer_schema_length=None, schema_overrides={"marker": pl.String})
    found: dict[str, np.ndarray] = {}
    for segment, marker in dict.fromkeys(table.select("segment", "marker").iter_rows()):
        rows = table.filter((pl.col("marker") == marker) & pl.col("segment").eq_missing(segment))
        places = rows.select("x_mm", "y_mm", "z_mm").to_numpy().astype(float)
        places[(rows["flags"] == "loose").fill_null(False).to_numpy()] = np.nan
        found[f"{segment}/{marker}" if segment else marker] = places
    return found


def read_trc(path: Path) -> dict[str, np.ndarray]:
    """Read a TRC file as its readers do: names in every third cell of line 4, numbers from line 7."""
    lines = [line.split("\t") for line in path.read_text().split("\n")]
    assert lines[0][:3] == ["PathFileType", "4", "(X/Y/Z)"]
    about = dict(zip(lines[1], lines[2], strict=True))
    assert about["Units"] == "mm"
    names = lines[3][2::3]
    rows = lines[6 : 6 + int(about["NumFrames"])]
    assert [row[0] for row in rows] == ["1", "2", "3"]
    assert len(names) == int(about["NumMarkers"])
    values = np.array([[float(cell) if cell else np.nan for cell in row[2:]] for row in rows])
    return {name: values[:, 3 * k : 3 * k + 3] for k, name in enumerate(names)}


def read_c3d(path: Path) -> dict[str, np.ndarray]:
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["mm"]
    assert file["parameters"]["RSA"]["EXAMS"]["value"] == ["202601010900", "202602010900", "202701010900"]
    missing = file["data"]["meta_points"]["residuals"][0] < 0
    places = np.where(missing, np.nan, file["data"]["points"][:3])
    return {name: places[:, k].T for k, name in enumerate(point["LABELS"]["value"])}


def read_xmalab(path: Path) -> dict[str, np.ndarray]:
    (series,) = make_series(read_markers(path).markers)
    found = {}
    for segment in series.segments:
        for k, marker in enumerate(segment.markers):
            found[f"{segment.name}/{marker}"] = segment.position_mm[:, k]
    table = pl.read_csv(path)
    return found | {"1": table.select("1_X", "1_Y", "1_Z").to_numpy()}


@pytest.mark.parametrize(
    ("name", "read", "tolerance_mm"), [("m.trc", read_trc, PRINTED_MM), ("m.c3d", read_c3d, SINGLE_MM), ("m.csv", read_xmalab, PRINTED_MM)]
)
def test_what_is_written_is_read_back(
    name: str, read: Callable[[Path], dict[str, np.ndarray]], tolerance_mm: float, markers: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if name.endswith("c3d"):
        pytest.importorskip("ezc3d")
    out = markers.with_name(name)
    assert run_app(["export", str(markers), "-o", str(out)]) == 0
    assert "8 markers in 3 frames, 2 places missing" in capsys.readouterr().out
    found, expected = read(out), truth(markers)
    assert set(found) == set(expected)
    for marker, places in expected.items():
        assert np.allclose(found[marker], places, rtol=0, atol=tolerance_mm, equal_nan=True), marker


def test_motion_of_an_exported_table_is_that_of_its_source(markers: Path) -> None:
    """Through XMALab's table the motion stays the same; names of examinations and standard deviations do not."""
    out = markers.parent / "points.csv"
    rsa_vision.export(markers, out)
    names = ["rx_deg", "ty_mm", "mtpm_mm", "e_rb_mm", "n_markers"]
    found, expected = (rsa_vision.motion(path, markers.parent / "out").table.select(names).to_numpy() for path in (out, markers))
    assert np.allclose(found, expected, rtol=0, atol=1e-5, equal_nan=True)


def test_c3d_without_its_package_names_the_extra(
    markers: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    assert run_app(["export", str(markers), "-o", str(markers.with_name("m.c3d"))]) == 2
    assert "rsa-vision[c3d]" in capsys.readouterr().err
    assert not markers.with_name("m.c3d").exists()


def test_wrong_usage_is_refused(markers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    second = pl.read_csv(markers, infer_schema=False)
    pl.concat([second, second.with_columns(subject=pl.lit("S02"))]).write_csv(markers)
    for arguments, said in (
        (["-o", "m.trc"], "there are several subjects; choose with --subject: S01, S02"),
        (["-o", "m.trc", "--subject", "S03"], "there is no subject 'S03'; choose with --subject: S01, S02"),
        (["-o", "m.xyz", "--subject", "S01"], "m.xyz: not a known format; use --format trc|c3d|xmalab"),
        (["-o", "m.trc", "--subject", "S01", "--format", "bvh"], "bvh: not a known format"),
    ):
        assert run_app(["export", str(markers), *arguments]) == 2
        assert said in capsys.readouterr().err
    out = markers.with_name("m.txt")
    assert run_app(["export", str(markers), "-o", str(out), "--subject", "S02", "--format", "trc"]) == 0
    assert len(read_trc(out)) == 8


def test_the_input_is_not_written_over(markers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = markers.read_bytes()
    assert run_app(["export", str(markers), "-o", str(markers), "--format", "xmalab"]) == 2
    assert "this is the input" in capsys.readouterr().err
    assert markers.read_bytes() == before
