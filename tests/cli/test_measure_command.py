"""`rsa-vision measure` as a user meets it; marker images come from the truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial import cKDTree

import rsa_vision
from rsa_vision.cages import load_cage
from rsa_vision.cli import run_app
from rsa_vision.examination import name_and_reconstruct
from rsa_vision.flags import REASONS
from rsa_vision.images import read_film
from rsa_vision.readings import FilmReading
from rsa_vision.settings import Study
from rsa_vision.types import MarkerImages
from synthetic.study import RenderedExamination
from synthetic.write import write_film

FIRST, SECOND = "S01_202601010900", "S01_202602010900"
TEXT = {"exam": pl.String, "number": pl.String, "marker": pl.String, "flags": pl.String, "reasons": pl.String}
SIGMAS = 5.0  # of coordinates from their truth; 36 values
Counter = Callable[[], int]
pytestmark = pytest.mark.usefixtures("count_detections")


def read(out: Path, table: str) -> pl.DataFrame:
    return pl.read_csv(out / f"{table}.csv", schema_overrides=TEXT)


def statuses(out: Path) -> dict[str, tuple[str, str]]:
    rows = read(out, "exams").fill_null("")
    return {f"{r['subject']}_{r['exam']}".rstrip("_"): (r["status"], r["reasons"]) for r in rows.to_dicts()}


def test_markers_of_every_examination_at_their_true_places(folder: Path, tmp_path: Path, exams: list[RenderedExamination]) -> None:
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out)]) == 0
    assert statuses(out) == {FIRST: ("ok", ""), SECOND: ("ok", "")}
    markers = read(out, "markers")
    for exam, rendered in zip(("202601010900", "202602010900"), exams, strict=True):
        found = markers.filter(pl.col("exam") == exam)
        truth = rendered.markers.select("x_mm", "y_mm", "z_mm").to_numpy()
        place = found.select("x_mm", "y_mm", "z_mm").to_numpy()
        sd = found.select("sd_x_mm", "sd_y_mm", "sd_z_mm").to_numpy()
        nearest = cKDTree(truth).query(place)[1]
        assert sorted(nearest.tolist()) == list(range(len(truth)))
        assert np.abs((place - truth[nearest]) / sd).max() < SIGMAS
        assert sd.max() < 0.05
        assert found["marker"].to_list() == [f"P{k + 1:02d}" for k in range(len(truth))]
        assert found["segment"].fill_null("").unique().to_list() == [""]


def test_every_image_stands_in_the_table_with_its_names(folder: Path, tmp_path: Path, exams: list[RenderedExamination]) -> None:
    out = tmp_path / "out"
    run_app(["measure", str(folder), "-o", str(out)])
    images = read(out, "images")
    for name, rendered in ((n, e) for e in exams for n in e.films):
        found = images.filter((pl.col("file") == name) & pl.col("role").is_in(["fiducial", "control"]))
        truth = rendered.images.filter((pl.col("file") == name) & pl.col("role").is_in(["fiducial", "control"]))
        keys = ["focus", "role", "number"]
        joined = truth.join(found, on=keys, how="left", suffix="_found")
        assert len(joined) == len(truth) == len(found)
        off = joined.select(
            (pl.col("col_px") - pl.col("col_px_found")).abs().max(), (pl.col("row_px") - pl.col("row_px_found")).abs().max()
        )
        assert max(off.row(0)) < 0.2
        assert len(images.filter(pl.col("file") == name)) == len(rendered.images.filter(pl.col("file") == name))


def test_run_json_is_enough_to_run_again(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_app(["measure", str(folder), "-o", str(out), "--response", "density"])
    run = json.loads((out / "run.json").read_text())
    assert run["settings"]["cage"] == "2"
    assert run["settings"]["response"] == "density"
    assert run["cage"]["sha256"] == rsa_vision.load_cage("2").sha256
    assert rsa_vision.Cage.model_validate(run["cage"]["content"]) == rsa_vision.load_cage("2")
    assert {Path(i["path"]).name: i["sha256"] for i in run["inputs"]} == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.tif")
    }
    assert run["start"] < run["end"]
    assert {"rsa_vision", "host", "python"} <= set(run)


def test_finished_examinations_are_kept_until_something_changes(folder: Path, tmp_path: Path, count_detections: Counter) -> None:
    out = tmp_path / "out"
    command = ["measure", str(folder), "-o", str(out)]
    assert run_app(command) == 0
    before = {path.name: path.read_bytes() for path in out.glob("*.csv")}
    assert count_detections() == 4
    assert run_app(command) == 0
    assert count_detections() == 4
    assert {path.name: path.read_bytes() for path in out.glob("*.csv")} == before
    (out / "exams" / f"{SECOND}.json").unlink()  # as if it had been stopped there
    assert run_app(command) == 0
    assert count_detections() == 6
    assert run_app([*command, "--redo"]) == 0
    assert count_detections() == 10
    assert run_app([*command, "--temperature-c", "24"]) == 0
    assert count_detections() == 14
    (folder / f"{FIRST}_f1.tif").write_bytes((folder / f"{SECOND}_f1.tif").read_bytes())
    assert run_app([*command, "--temperature-c", "24"]) == 1
    assert count_detections() == 16
    assert statuses(out)[FIRST][0] != "ok"


def test_one_bad_film_never_stops_a_run(folder: Path, tmp_path: Path, other_film: Callable[[str, str], Path]) -> None:
    film = (folder / f"{FIRST}_f1.tif").read_bytes()
    for subject, bad in {"EMPTY": b"", "TRUNC": film[: len(film) // 2], "TEXT": b"no film" * 100}.items():
        (folder / f"{subject}_1_f1.tif").write_bytes(bad)
        other_film(f"{FIRST}_f2.tif", f"{subject}_1_f2.tif")
    other_film(f"{FIRST}_f1.tif", "ALONE_1_f1.tif")
    other_film(f"{FIRST}_f1.tif", "nameless.tif")
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out)]) == 1
    assert statuses(out) == {
        "ALONE_1": ("failed", "film-missing"),
        "EMPTY_1": ("failed", "film-unreadable"),
        "TEXT_1": ("failed", "film-unreadable"),
        "TRUNC_1": ("failed", "film-unreadable"),
        FIRST: ("ok", ""),
        SECOND: ("ok", ""),
        "nameless": ("failed", "film-name"),
    }
    messages = dict(read(out, "exams").select("subject", "message").iter_rows())
    assert "_f2" in messages["ALONE"]
    assert all(messages[subject] for subject in ("EMPTY", "TRUNC", "TEXT", "nameless"))


def test_a_film_given_for_two_examinations_is_reviewed_in_both(
    folder: Path, tmp_path: Path, other_film: Callable[[str, str], Path]
) -> None:
    subject, _, exam = FIRST.partition("_")
    for k in (1, 2):
        other_film(f"{FIRST}_f{k}.tif", f"{subject}_20270101_f{k}.tif")
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out)]) == 1
    assert statuses(out) == {
        FIRST: ("review", "film-duplicate"),
        SECOND: ("ok", ""),
        f"{subject}_20270101": ("review", "film-duplicate"),
    }
    messages = dict(read(out, "exams").select("exam", "message").iter_rows())
    assert f"{subject}_20270101_f2.tif is the same film as {FIRST}_f2.tif" in messages["20270101"]
    assert f"{subject}_20270101_f1.tif" in messages[exam]


def test_copies_are_told_by_their_pixels(folder: Path, tmp_path: Path, other_film: Callable[[str, str], Path]) -> None:
    copy = other_film(f"{FIRST}_f1.tif", f"{FIRST.partition('_')[0]}_20270101_f1.tif")
    other_film(f"{FIRST}_f2.tif", f"{FIRST.partition('_')[0]}_20270101_f2.tif")
    copy.write_bytes(copy.read_bytes() + b"another file")  # beyond what TIFF's tables point at
    out = tmp_path / "out"
    for _ in range(2):  # measured, and kept
        assert run_app(["measure", str(folder), "-o", str(out)]) == 1
        messages = dict(read(out, "exams").select("exam", "message").iter_rows())
        assert f"{copy.name} is the same film as {FIRST}_f1.tif" in messages["20270101"]


def test_films_without_pitch_fail_and_name_the_option(tmp_path: Path, exams: list[RenderedExamination]) -> None:
    folder, out = tmp_path / "bare", tmp_path / "out"
    exams[0].write(folder, with_pitch=False)
    command = ["measure", str(folder), "-o", str(out), "--cage", "2"]
    assert run_app(command) == 1
    assert statuses(out) == {FIRST: ("failed", "pitch-missing")}
    assert "--pixel-pitch-mm" in read(out, "exams")["message"][0]
    assert run_app([*command, "--pixel-pitch-mm", "0.15"]) == 0


def test_films_without_markers_or_of_another_cage_are_never_ok(folder: Path, tmp_path: Path, exams: list[RenderedExamination]) -> None:
    out = tmp_path / "out"
    assert run_app(["measure", str(folder), "-o", str(out), "--cage", "1B", "--film", "separate"]) == 1
    assert {status for status, _ in statuses(out).values()} == {"failed"}
    assert len(read(out, "images")) == sum(len(exam.images) for exam in exams)  # what was found is kept
    assert not len(read(out, "markers"))


def test_the_cage_exposed_apart(folder: Path, tmp_path: Path, other_film: Callable[[str, str], Path]) -> None:
    for k in (1, 2):
        other_film(f"{FIRST}_f{k}.tif", f"{FIRST}_f{k}_cage.tif")
    out = tmp_path / "out"
    run_app(["measure", str(folder), "-o", str(out)])
    images = read(out, "images").filter(pl.col("exam") == "202601010900")
    roles = {(role, "_cage" in file) for role, file in images.select("role", "file").iter_rows()}
    assert {("fiducial", True), ("control", True), ("object", False)} <= roles
    assert not roles & {("fiducial", False), ("control", False), ("object", True)}


@pytest.mark.parametrize("larger", [1.0, 1.05])
def test_a_cage_film_of_another_pixel_pitch_is_refused(folder: Path, tmp_path: Path, larger: float) -> None:
    """Its marks were taken for places on the other film: every marker was wrong by millimetres in an examination that was `ok`."""
    for k in (1, 2):
        film = read_film(folder / f"{FIRST}_f{k}.tif")
        assert film.pitch_mm is not None
        pitch = (larger * film.pitch_mm[0], larger * film.pitch_mm[1])
        write_film(folder / f"{FIRST}_f{k}_cage.tif", film.values, bits=film.bits, pitch_mm=pitch)
    out = tmp_path / "out"
    run_app(["measure", str(folder), "-o", str(out)])
    refused = statuses(out)[FIRST] == ("failed", "cage-film-differs")
    assert refused == (larger != 1.0)
    assert statuses(out)[SECOND] == ("ok", "")


@pytest.mark.parametrize("rows", [1000, 997])
def test_so_is_one_that_was_cut(rows: int) -> None:
    images = MarkerImages.empty().rows(np.zeros(0, np.intp))
    one = replace(
        images, **{f.name: np.zeros((1, *getattr(images, f.name).shape[1:]), getattr(images, f.name).dtype) for f in fields(images)}
    )
    films = [FilmReading(Path(name), 1, (n, 900), (0.1, 0.1), "auto", one) for name, n in (("a_cage.tif", rows), ("a.tif", 1000))]
    verdict = name_and_reconstruct(films, Study(cage="2"), load_cage("2"), n_cage_films=1).verdict
    assert (verdict.reasons == ("cage-film-differs",)) == (rows != 1000)
    assert verdict.status == "failed"  # one mark is no cage


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (["--cage", "3C"], "cage list"),
        (["--method", "bundle"], "selvik"),
        (["--segments", "missing.csv"], "missing.csv"),
        (["--dask", "tcp://somewhere"], "--jobs"),
        (["--jobs", "0"], "at least one"),
        (["--timeout-s", "-1"], "positive"),
        (["--response", "loud"], "response"),
        (["--pixel-pitch-mm", "nan"], "pixel_pitch_mm"),
        (["--study", "missing.toml"], "missing.toml"),
        (["--file-pattern", "("], "file_pattern"),
    ],
)
def test_wrong_usage_stops_the_run_with_one_message(
    folder: Path, tmp_path: Path, options: list[str], remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app(["measure", str(folder), "-o", str(tmp_path / "out"), *options]) == 2
    message = capsys.readouterr().err
    assert remedy in message
    assert "Traceback" not in message
    assert not (tmp_path / "out" / "exams.csv").exists()


def test_no_cage_no_folder_no_film_and_a_place_that_cannot_be_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "study.toml").unlink()
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "file").write_bytes(b"")
    for arguments, remedy in [
        ([str(folder), "-o", str(tmp_path / "out")], "--cage"),
        ([str(tmp_path / "none"), "-o", str(tmp_path / "out")], "no such folder"),
        ([str(empty), "-o", str(tmp_path / "out"), "--cage", "2"], "no film"),
        ([str(folder), "-o", str(tmp_path / "file"), "--cage", "2"], "another place with -o"),
        ([str(folder)], "out"),
    ]:
        assert run_app(["measure", *arguments]) == 2
        assert remedy in capsys.readouterr().err


def test_the_report_is_one_page_made_from_the_results_alone(folder: Path, tmp_path: Path, other_film: Callable[[str, str], Path]) -> None:
    other_film(f"{FIRST}_f1.tif", "A<b>_1_f1.tif")
    out = tmp_path / "out"
    run_app(["measure", str(folder), "-o", str(out)])
    first = (out / "report.html").read_text()
    assert "A&lt;b&gt;" in first
    assert "<b>_1" not in first
    assert REASONS["film-missing"].split(";")[0] in first.replace("&#39;", "'")
    assert first.count("data:image/jpeg;base64,") == 4
    assert "http://" not in first
    assert "https://" not in first
    for path in folder.iterdir():
        path.unlink()
    (out / "report.html").unlink()
    assert run_app(["report", str(out)]) == 0
    assert (out / "report.html").read_text() == first
    assert run_app(["report", str(tmp_path)]) == 2


def test_the_python_function_does_the_same_and_raises_what_the_command_prints(folder: Path, tmp_path: Path) -> None:
    summary = rsa_vision.measure(folder, tmp_path / "out", cage="2")
    assert (summary.exit_code, summary.count("ok")) == (0, 2)
    with pytest.raises(rsa_vision.RsaError, match="selvik"):
        rsa_vision.measure(folder, tmp_path / "out", method="bundle")
    with pytest.raises(rsa_vision.RsaError, match="unknown_key"):
        rsa_vision.measure(folder, tmp_path / "out", unknown_key=1)


def test_links_in_a_circle_fail_alone_and_the_run_ends_with_its_report(tmp_path: Path) -> None:
    films = tmp_path / "films"
    films.mkdir()
    (films / "S_1_f1.tif").symlink_to(films / "S_1_f1.tif")
    (films / "S_1_f2.tif").write_bytes(b"")
    assert run_app(["measure", str(films), "-o", str(tmp_path / "out"), "--cage", "2"]) == 1
    assert (tmp_path / "out" / "run.json").exists()
    assert (tmp_path / "out" / "report.html").exists()


def test_a_mistyped_setting_is_named_with_the_one_that_is_meant(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text("pixel_pich_mm = 0.1\n[limits]\nposterier = 0.99\n")
    with pytest.raises(rsa_vision.RsaError, match=r"posterior meant(.|\n)*pixel_pitch_mm meant"):
        rsa_vision.measure(tmp_path, tmp_path / "out", study=tmp_path / "study.toml")


@pytest.mark.usefixtures("count_detections")
def test_a_cage_that_is_not_found_says_with_which_pitch_it_would_be(folder: Path, tmp_path: Path) -> None:
    assert run_app(["measure", str(folder), "-o", str(tmp_path / "out"), "--pixel-pitch-mm", "0.1"]) == 1  # it is 0.15
    for row in pl.read_csv(tmp_path / "out" / "exams.csv").to_dicts():
        assert (row["status"], row["reasons"]) == ("failed", "cage-not-found")
        assert row["message"].count("it would be found with pixel_pitch_mm = 0.15 or so instead of 0.1: look which is true") == 2


@pytest.mark.usefixtures("count_detections")
def test_names_that_may_be_turned_over_say_that_upright_decides(folder: Path, tmp_path: Path) -> None:
    for orientation, status in (("any", "review"), ("upright", "ok")):
        run_app(["measure", str(folder), "-o", str(tmp_path / orientation), "--orientation", orientation])
        for row in pl.read_csv(tmp_path / orientation / "exams.csv").to_dicts():
            assert row["status"] == status
            assert ('orientation = "upright" decides if the film lies so' in (row["message"] or "")) == (orientation == "any")


def test_names_do_not_steer_the_terminal(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / f"{FIRST}_f1.tif").rename(folder / "S\x1b[31m.tif")
    assert run_app(["measure", str(folder), "-o", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    assert r"S\x1b[31m" in shown.out
    assert "\x1b" not in shown.out + shown.err
