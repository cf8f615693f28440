"""Object markers that are pins: from rendered films, and with calibrated cameras, through the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial import cKDTree

from rsa_vision.cli import run_app
from rsa_vision.types import Float
from synthetic.motion import Motion
from synthetic.scene import ObjectMarker
from synthetic.study import RenderedExamination, render_examination

BALLS, PINS = 6, 5
DIAMETER_MM, LENGTH_MM = 0.5, 2.0
SIGMAS = 4.5  # of a few tens of tips in three directions
TEXT = {"exam": pl.String, "number": pl.String, "segment": pl.String, "marker": pl.String, "flags": pl.String, "reasons": pl.String}
LOW: dict[str, Any] = {"fine": 2}


def some_markers(cage: str, seed: int, **options: Any) -> tuple[dict[int, Float], list[ObjectMarker]]:
    """Return foci, and markers with room about them: some of them pins, along y more or less, so that no focus sees one from its end."""
    rng = np.random.default_rng(seed)
    start = render_examination(cage, rng=rng, n_objects=BALLS + PINS, gap_diameters=5.0, fine=1, quanta=None, pitch_mm=0.4, **options)
    axes = np.column_stack([rng.uniform(-0.5, 0.5, PINS), rng.choice([-1.0, 1.0], PINS), rng.uniform(-0.5, 0.5, PINS)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    pins = [
        replace(marker, arms=(tuple(axis.tolist()),), diameter_mm=DIAMETER_MM, length_mm=LENGTH_MM)
        for marker, axis in zip(start.scene.markers, axes, strict=False)
    ]
    return dict(start.scene.foci_mm), [*pins, *start.scene.markers[PINS:]]


def measured(folder: Path, *options: str) -> tuple[int, dict[str, pl.DataFrame]]:
    code = run_app(["measure", str(folder / "films"), "-o", str(folder / "out"), *options])
    return code, {name: pl.read_csv(folder / "out" / f"{name}.csv", schema_overrides=TEXT) for name in ("exams", "markers", "images")}


def places(table: pl.DataFrame) -> Float:
    return table.select("x_mm", "y_mm", "z_mm").to_numpy()


def sigmas(markers: pl.DataFrame, truth: Sequence[ObjectMarker]) -> tuple[Float, Float]:
    """Return the errors of markers in units of their standard deviations (Mahalanobis), and which marker each is."""
    tips = np.array([marker.position_mm for marker in truth])
    covariance = np.zeros((len(markers), 3, 3))
    covariance[:, *np.triu_indices(3, 1)] = markers.select("cov_xy_mm2", "cov_xz_mm2", "cov_yz_mm2").to_numpy()
    covariance += covariance.swapaxes(1, 2)
    covariance[:, range(3), range(3)] = markers.select("sd_x_mm", "sd_y_mm", "sd_z_mm").to_numpy() ** 2
    away, nearest = cKDTree(tips).query(places(markers))
    assert (away < 1.0).all()
    error = places(markers) - tips[nearest]
    return np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)), nearest


@pytest.mark.parametrize(("cage", "seed"), [("2", 4), ("1A", 1)])
def test_balls_and_pins_are_found_named_and_followed(cage: str, seed: int, tmp_path: Path) -> None:
    foci, markers = some_markers(cage, seed)
    about, turn = np.mean([marker.position_mm for marker in markers], axis=0), Motion((1.5, -1.0, 2.0)).matrix()
    later = [marker.moved(turn, np.array([1.0, -1.5, 1.0]), about) for marker in markers]
    for exam, some in (("202601010900", markers), ("202602010900", later)):
        shown = render_examination(cage, rng=np.random.default_rng(seed), exam=exam, markers=some, foci_mm=foci, **LOW)
        shown.write(tmp_path / "films")
    code, tables = measured(tmp_path, "--cage", cage)
    assert (code, tables["exams"]["status"].to_list()) == (0, ["ok", "ok"]), tables["exams"]["message"].to_list()
    names = []
    for exam, truth in (("202601010900", markers), ("202602010900", later)):
        here = tables["markers"].filter(pl.col("exam") == exam)
        away, nearest = sigmas(here, truth)
        assert sorted(nearest.tolist()) == list(range(BALLS + PINS))
        assert (away < SIGMAS).all()
        names.append({int(k): str(name) for k, name in zip(nearest, here["marker"], strict=True)})
        shapes = tables["images"].filter((pl.col("exam") == exam) & (pl.col("role") == "object"))
        assert {(name, shape) for name, shape in shapes.select("number", "shape").iter_rows()} == {
            (name, truth[k].shape) for k, name in names[-1].items()
        }
    assert names[0] == names[1]
    by_height = sorted(range(BALLS + PINS), key=lambda k: markers[k].position_mm[1])
    assert [names[0][k] for k in by_height] == [f"P{k + 1:02d}" for k in range(BALLS + PINS)]
    report = (tmp_path / "out" / "report.html").read_text()
    assert all(f"object {name} of focus 1, {markers[k].shape}" in report for k, name in names[0].items())


def test_pins_of_a_known_segment_are_named_by_it(tmp_path: Path) -> None:
    foci, markers = some_markers("2", 4)
    render_examination("2", rng=np.random.default_rng(4), markers=markers, foci_mm=foci, **LOW).write(tmp_path / "films")
    rows = ["subject,segment,marker,x_mm,y_mm,z_mm"]
    for segment, some in (("implant", markers[:PINS]), ("bone", markers[PINS:])):
        rows += [f",{segment},{k + 1}," + ",".join(f"{x:.4f}" for x in marker.position_mm) for k, marker in enumerate(some)]
    (tmp_path / "segments.csv").write_text("\n".join(rows))
    code, tables = measured(tmp_path, "--cage", "2", "--segments", str(tmp_path / "segments.csv"))
    assert code == 0, tables["exams"]["message"].to_list()
    _, nearest = sigmas(tables["markers"], markers)
    told = [f"implant/{k + 1}" if k < PINS else f"bone/{k - PINS + 1}" for k in nearest.tolist()]
    assert [f"{segment}/{marker}" for segment, marker in tables["markers"].select("segment", "marker").iter_rows()] == told


def test_a_pin_that_one_film_shows_has_no_partner_and_the_others_keep_theirs(tmp_path: Path) -> None:
    foci, markers = some_markers("2", 4)
    options: dict[str, Any] = {"foci_mm": foci, **LOW}
    without = render_examination("2", rng=np.random.default_rng(4), markers=markers[1:], **options)
    both: RenderedExamination = render_examination("2", rng=np.random.default_rng(4), markers=markers, **options)
    one, two = both.films
    replace(both, films={one: both.films[one], two: without.films[two]}).write(tmp_path / "films")
    code, tables = measured(tmp_path, "--cage", "2")
    (exam,) = tables["exams"].to_dicts()
    assert (code, exam["status"]) == (1, "review")
    assert "marker-one-view" in exam["reasons"].split(";")
    lost = both.images.filter((pl.col("file") == one) & (pl.col("role") == "object") & (pl.col("number") == f"P/{markers[0].marker}"))
    col, row = lost.select("col_px", "row_px").row(0)
    assert f"{one}: an image at col {col:.0f}, row {row:.0f} looks like a marker but has no partner" in exam["message"]
    _, nearest = sigmas(tables["markers"], markers)
    assert sorted(nearest.tolist()) == list(range(1, BALLS + PINS))
