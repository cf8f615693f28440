"""The examples run as they are, and print what is right."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chi2

from synthetic.study import RenderedExamination, render_examination

ROOT = Path(__file__).parents[2]
NUMBER = r"(-?\d+\.\d+) \+- (\d+\.\d+)"
MARKER = re.compile(rf"(\S+): x +{NUMBER}  y +{NUMBER}  z +{NUMBER} mm")
FAR_MM = 0.1  # coarse, quickly rendered films; a wrong pair is off by millimetres


def run(*command: str | Path, cwd: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False, cwd=cwd, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def printed(text: str) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return names, coordinates and standard deviations, shape (n, 3), of the markers in a print-out."""
    found = MARKER.findall(text)
    numbers = np.array([row[1:] for row in found], float).reshape(-1, 3, 2)
    return [row[0] for row in found], numbers[..., 0], numbers[..., 1]


@pytest.fixture(scope="module")
def exam() -> RenderedExamination:
    return render_examination("2", rng=np.random.default_rng(11), pitch_mm=0.15, fine=2, n_objects=5)


def test_reconstruct_points_prints_the_true_markers_within_their_uncertainty(tmp_path: Path) -> None:
    names, places, deviations = printed(run(ROOT / "examples" / "reconstruct_points.py", cwd=tmp_path))
    table = pl.read_csv(ROOT / "examples" / "points_1A.csv", schema_overrides={"number": pl.String}).filter(pl.col("role") == "object")
    truth = {row["number"]: [row[f"true_{axis}_mm"] for axis in "xyz"] for row in table.iter_rows(named=True)}
    assert sorted(names) == sorted(truth)
    off = (places - np.array([truth[name] for name in names])) / deviations
    # the coordinates share the errors of the foci: their squares are bounded one by one
    assert np.abs(off).max() < np.sqrt(chi2.isf(0.001, 1))
    assert np.sqrt((off**2).mean()) > 0.2  # stated errors that are far too large would hide all


def test_measure_folder_prints_every_marker(exam: RenderedExamination, tmp_path: Path) -> None:
    exam.write(tmp_path / "films")
    text = run(ROOT / "examples" / "measure_folder.py", "films", "results", "2", cwd=tmp_path)
    assert "S01 202601010900: ok" in text
    places = printed(text)[1]
    distance, nearest = cKDTree(exam.markers.select("x_mm", "y_mm", "z_mm").to_numpy()).query(places)
    assert sorted(nearest.tolist()) == list(range(len(exam.markers)))
    assert distance.max() < FAR_MM


def test_measure_folder_says_what_is_wrong(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "examples" / "measure_folder.py"), "none", "results"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr


@pytest.mark.parametrize("page", ["README.md", "docs/quickstart.md"])
def test_the_python_of_the_pages_runs(page: str, exam: RenderedExamination, tmp_path: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    assert code
    exam.write(tmp_path / "films")
    text = run("-c", "\n".join(code).replace('cage="1A"', 'cage="2"'), cwd=tmp_path)
    assert "1 of 1 examinations are ok" in text
    assert "P05" in text
