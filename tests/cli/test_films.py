"""The main job from rendered films, through the command line: detection, names, coordinates, verdict."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial import cKDTree

from rsa_vision.cli import run_app
from synthetic.study import render_examination

RMS_UM = {"1A": 18.0, "1B": 12.0, "2": 6.0}  # the reach of 3-D error at full quality: 0.1 mm pitch, 4000 quanta
OTHERS_UM = 2.0  # times that for other responses and 8 bits
TEXT = {"exam": pl.String, "number": pl.String, "marker": pl.String, "flags": pl.String}

CASES: dict[str, tuple[str, dict[str, Any], list[str], float]] = {
    "1A": ("1A", {}, [], 1.0),
    "1B": ("1B", {}, [], 1.0),
    "2": ("2", {}, [], 1.0),
    "1B separate, transmission, 8 bit": ("1B", {"shared": False, "response": "transmission", "bits": 8}, [], OTHERS_UM),
    "2, linear, 12 bit, DICOM": ("2", {"response": "linear", "bits": 12, "extension": "dcm"}, [], OTHERS_UM),
    "1B, log, inverted": ("1B", {"response": "log", "inverted": True}, [], OTHERS_UM),
    "1A, mirrored": ("1A", {"mirrored": True}, ["--orientation", "mirrored"], 1.0),
    "1B, bone": ("1B", {"bone": True, "scatter": 0.2}, [], 1.0),
    "2, turned and stretched": ("2", {"rotation_deg": -20.0, "anisotropy": 0.01, "shear": 0.003}, [], 1.0),
}


@pytest.mark.parametrize("case", CASES)
def test_every_marker_found_none_false_and_coordinates_within_reach(case: str, tmp_path: Path, record_property: Any) -> None:
    cage, look, options, factor = CASES[case]
    exam = render_examination(cage, rng=np.random.default_rng(list(map(ord, case))), **look)
    exam.write(tmp_path / "films")
    out = tmp_path / "out"
    code = run_app(["measure", str(tmp_path / "films"), "-o", str(out), "--cage", cage, *options])
    (row,) = pl.read_csv(out / "exams.csv", schema_overrides=TEXT).to_dicts()
    assert (code, row["status"]) == (0, "ok"), row
    markers = pl.read_csv(out / "markers.csv", schema_overrides=TEXT).select("x_mm", "y_mm", "z_mm").to_numpy()
    truth = exam.markers.select("x_mm", "y_mm", "z_mm").to_numpy()
    distance, nearest = cKDTree(truth).query(markers)
    assert sorted(nearest.tolist()) == list(range(len(truth)))
    rms_um = 1000 * float(np.sqrt((distance**2).mean()))
    record_property("rms_um", rms_um)
    assert rms_um <= RMS_UM[cage] * factor


def test_a_film_of_another_cage_is_never_ok(tmp_path: Path) -> None:
    render_examination("1B-420", rng=np.random.default_rng(1), pitch_mm=0.15, fine=2).write(tmp_path / "films")
    assert run_app(["measure", str(tmp_path / "films"), "-o", str(tmp_path / "out"), "--cage", "1B"]) == 1
    (row,) = pl.read_csv(tmp_path / "out" / "exams.csv", schema_overrides=TEXT).to_dicts()
    assert {"cage-not-found", "film-stretched"} & set(row["reasons"].split(";")), row


def test_a_killed_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    for month in (1, 2, 3):
        render_examination("2", rng=rng, exam=f"20260{month}010900", pitch_mm=0.15, fine=2, n_objects=4).write(tmp_path / "films")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "rsa_vision", "measure", str(tmp_path / "films"), "-o", str(out), "--cage", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        assert "202601010900" in process.stderr.readline()
        process.kill()
    assert not (out / "exams.csv").exists()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    lines = done.stderr.splitlines()
    assert "internal" not in done.stderr
    assert lines[0].endswith("kept")
    assert not lines[-1].endswith("kept")
    assert len(pl.read_csv(out / "exams.csv")) == 3
