"""`detect`, `reconstruct`, `cage`, and how quickly the program starts."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import polars as pl
import pytest

import rsa_vision
import rsa_vision.detect
from rsa_vision.cli import run_app
from rsa_vision.errors import FilmError
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import MarkerImages
from synthetic.study import RenderedExamination, render_examination

EXACT_MM = 1e-6  # exact image points
HELP_S = 0.3  # and nothing heavy is imported; the slowest of a busy machine is not judged
TEXT = {"exam": pl.String, "number": pl.String, "marker": pl.String, "flags": pl.String}


@pytest.fixture
def two_images(monkeypatch: pytest.MonkeyPatch) -> MarkerImages:
    """Let every film show a ball and a tee."""
    images = MarkerImages(
        position_px=np.array([[100.25, 200.5], [300.0, 50.0]]),
        covariance_px2=np.array([[[4e-4, 1e-4], [1e-4, 9e-4]], [[np.nan, np.nan], [np.nan, np.nan]]]),
        shape=np.array(["ball", "tee"]),
        radius_px=np.array([4.0, 2.5]),
        angle_deg=np.array([np.nan, 90.0]),
        contrast=np.array([0.6, 0.3]),
        background=np.array([0.8, 0.5]),
        snr=np.array([40.0, 20.0]),
        flags=np.array([0, MarkerFlag.EDGE | MarkerFlag.SATURATED]),
    )
    monkeypatch.setattr("rsa_vision.detect.detect_markers", lambda values, **_: SimpleNamespace(images=images))
    return images


@pytest.mark.usefixtures("two_images")
def test_detect_writes_the_published_columns(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    films = [str(path) for path in sorted(folder.glob("*_f1.tif"))]
    out = tmp_path / "found.csv"
    assert run_app(["detect", *films, "-o", str(out), "--overlay", str(tmp_path / "seen.png")]) == 0
    assert "4 marker images on 2 films" in capsys.readouterr().out
    table = pl.read_csv(out)
    published = "file, shape, col_px, row_px, sd_col_px, sd_row_px, cov_col_row_px2, radius_px, angle_deg, contrast, snr, flags"
    assert table.columns == published.split(", ")
    assert table["file"].to_list() == [films[0]] * 2 + [films[1]] * 2
    ball, tee = table.to_dicts()[:2]
    assert ball["sd_col_px"] == pytest.approx(0.02)
    assert ball["cov_col_row_px2"] == pytest.approx(1e-4)
    assert ball["angle_deg"] is None
    assert (tee["sd_row_px"], tee["flags"]) == (None, "edge;saturated")
    for name in ("202601010900", "202602010900"):
        drawn = cv2.imread(str(tmp_path / f"seen_S01_{name}_f1.png"))
        colour = np.abs(drawn.astype(int) - drawn[..., :1]).max(axis=-1) > 60
        rows, cols = np.nonzero(colour[150:250, 50:150])
        assert abs(rows.mean() + 150 - 200.5) < 2
        assert abs(cols.mean() + 50 - 100.25) < 2


@pytest.mark.parametrize(
    ("out", "overlay"),
    [("film", None), ("found.csv", "film"), ("found.csv", "found.csv"), (".", None)],
    ids=["-o", "--overlay", "both", "a folder"],
)
def test_detect_overwrites_nothing(out: str, overlay: str | None, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = sorted(folder.glob("*_f1.tif"))[0]
    before = film.read_bytes()
    named = [str(film if name == "film" else tmp_path / name) for name in (out, overlay) if name is not None]
    assert run_app(["detect", str(film), "-o", named[0], *(["--overlay", named[1]] if overlay else [])]) == 2
    assert named[-1] in capsys.readouterr().err
    assert film.read_bytes() == before
    assert not (tmp_path / "found.csv").exists()


@pytest.mark.usefixtures("two_images")
def test_detect_goes_on_after_a_bad_film(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film, bad = next(folder.glob("*.tif")), tmp_path / "bad.tif"
    bad.write_bytes(b"II*\0")
    assert run_app(["detect", str(bad), str(film), "-o", str(tmp_path / "found.csv")]) == 1
    assert "bad.tif" in capsys.readouterr().err
    assert len(pl.read_csv(tmp_path / "found.csv")) == 2
    with pytest.raises(rsa_vision.RsaError, match=r"bad\.tif"):
        rsa_vision.detect([bad])


@pytest.mark.usefixtures("two_images")
@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names themselves")
def test_names_of_films_that_cannot_be_written_or_printed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film = next(folder.glob("*.tif"))
    latin, steering = (Path(shutil.copy(film, tmp_path / name)) for name in ("caf\udce9.tif", "new\nline\x1b[31m.tif"))
    out = tmp_path / "found.csv"
    assert run_app(["detect", str(latin), str(steering), str(film), "-o", str(out)]) == 1
    told = capsys.readouterr().err
    assert r"caf\udce9.tif: the name is no UTF-8" in told
    assert r"new\nline\x1b[31m.tif: 2 marker images" in told
    assert pl.read_csv(out)["file"].unique().sort().to_list() == sorted([str(steering), str(film)])
    steering.write_bytes(b"")
    assert run_app(["detect", str(steering), "-o", str(out)]) == 1
    assert r"new\nline\x1b[31m.tif: the file is empty" in capsys.readouterr().err


def test_an_unreadable_film_fails_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    film = tmp_path / "film.tif"
    film.write_bytes(b"II*\0")
    monkeypatch.setattr(os, "access", lambda *_, **__: False)  # as it is for others than root
    monkeypatch.setattr("rsa_vision.images.read_film", lambda path: _refuse(path))
    assert run_app(["detect", str(film), "-o", str(tmp_path / "found.csv")]) == 1
    assert "film.tif: no" in capsys.readouterr().err


def _refuse(path: Path) -> None:
    raise FilmError(f"{path}: no")


def test_a_run_without_a_usable_film_leaves_the_old_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.csv"
    out.write_bytes(b"old")
    assert run_app(["detect", str(tmp_path / "*.tif"), "-o", str(out)]) == 1
    assert out.read_bytes() == b"old"
    assert "as it was" in capsys.readouterr().err


def test_films_without_marks_are_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rsa_vision.detect.detect_markers", lambda values, **_: SimpleNamespace(images=MarkerImages.empty()))
    films = [str(path) for path in sorted(folder.glob("*_f1.tif"))]
    assert run_app(["detect", *films, "-o", str(tmp_path / "found.csv")]) == 0
    assert f"no marker image on {', '.join(films)}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["-o", "FILM/found.csv"], "another place with -o"),
        (["-o", "TMP/" + 252 * "n" + ".csv"], "another place with -o"),
        (["-o", "TMP/pipe.csv"], "no regular file"),
        (["-o", "TMP/found.csv", "--overlay", "FILM/seen.png"], "another place with --overlay"),
        (["-o", "TMP/found.csv", "--overlay", "TMP/seen.jpg"], "ends in .png"),
    ],
)
def test_what_cannot_be_written_is_told_before_the_work(
    arguments: list[str], told: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = str(next(folder.glob("*.tif")))
    os.mkfifo(tmp_path / "pipe.csv")
    assert run_app(["detect", film, *(a.replace("TMP", str(tmp_path)).replace("FILM", film) for a in arguments)]) == 2
    shown = capsys.readouterr().err
    assert told in shown
    assert "marker images" not in shown
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pipe.csv", folder.name]


@pytest.mark.usefixtures("two_images")
def test_endings_of_any_case_long_names_and_links(folder: Path, tmp_path: Path) -> None:
    film = next(folder.glob("*.tif"))
    link, long = tmp_path / "link.PARQUET", tmp_path / (251 * "n" + ".csv")
    link.symlink_to(tmp_path / "real.parquet")
    assert run_app(["detect", str(film), "-o", str(link), "--overlay", str(tmp_path / "seen.PNG")]) == 0
    assert link.is_symlink()
    assert len(pl.read_parquet(tmp_path / "real.parquet")) == 2
    assert run_app(["detect", str(film), "-o", str(long)]) == 0
    assert len(rsa_vision.detect(str(film))) == len(rsa_vision.detect(film)) == 2


@pytest.fixture(scope="module")
def exposure() -> RenderedExamination:
    return render_examination("1A", rng=np.random.default_rng(5), n_objects=5, pitch_mm=0.4, fine=1, quanta=None)


@pytest.mark.parametrize("columns", ["names", "id"])
def test_reconstruct_from_exact_points(exposure: RenderedExamination, tmp_path: Path, columns: str) -> None:
    points = exposure.images.filter(pl.col("role") != "unassigned")
    objects = {name: str(101 + k) for k, name in enumerate(sorted(points.filter(pl.col("role") == "object")["number"].unique()))}
    points = points.with_columns(pl.col("number").replace(objects)).select("subject", "exam", "focus", "role", "number", "col_px", "row_px")
    if columns == "id":
        number = pl.col("number").cast(pl.Int64) * 10 + pl.col("focus")
        points = points.with_columns(number.alias("id")).select("subject", "exam", "id", "col_px", "row_px")
    points.write_csv(tmp_path / "points.csv")
    out = tmp_path / "out"
    assert run_app(["reconstruct", str(tmp_path / "points.csv"), "--cage", "1A", "-o", str(out)]) == 0
    markers = pl.read_csv(out / "markers.csv", schema_overrides=TEXT)
    truth = exposure.markers.with_columns((pl.col("segment") + "/" + pl.col("marker")).replace(objects).alias("name"))
    both = truth.join(markers, left_on="name", right_on="marker", suffix="_found")
    assert len(both) == len(truth) == len(markers)
    for axis in "xyz":
        assert (both[f"{axis}_mm"] - both[f"{axis}_mm_found"]).abs().max() < EXACT_MM
    assert {"exams.csv", "images.csv", "foci.csv", "markers.csv", "run.json", "report.html"} <= {path.name for path in out.iterdir()}


def test_reconstruct_refuses_what_it_cannot_use(exposure: RenderedExamination, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = tmp_path / "points.csv"
    fiducials = exposure.images.filter(pl.col("role") == "fiducial")
    fiducials.write_csv(points)
    assert run_app(["reconstruct", str(points), "-o", str(tmp_path / "out")]) == 2
    assert "--cage" in capsys.readouterr().err
    assert run_app(["reconstruct", str(tmp_path / "none.csv"), "--cage", "1A", "-o", str(tmp_path / "out")]) == 2
    assert run_app(["reconstruct", str(points), "--cage", "1A", "-o", str(tmp_path / "out")]) == 1
    (row,) = pl.read_csv(tmp_path / "out" / "exams.csv").to_dicts()
    assert (row["status"], row["reasons"]) == ("failed", "geometry")
    assert len(pl.read_csv(tmp_path / "out" / "images.csv")) == len(fiducials)


def test_cages_are_listed_drawn_and_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["cage", "list"]) == 0
    listed = capsys.readouterr().out
    assert [line.split()[0] for line in listed.splitlines()] == ["1A", "1B", "1B-420", "2"]
    drawing = tmp_path / "1A.svg"
    assert run_app(["cage", "show", "1A", "-o", str(drawing)]) == 0
    assert "ambiguity" in capsys.readouterr().out
    assert "<svg" in drawing.read_text()
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('name = "W"\nfilm = "loose"\n')
    assert run_app(["cage", "check", str(wrong)]) == 2
    message = capsys.readouterr().err
    assert "film" in message
    assert "foci" in message


@pytest.mark.parametrize("arguments", [["frobnicate"], ["measure", "--frobnicate"], ["cage", "show"], []])
def test_usage_errors_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(arguments) == 2
    assert "Usage" in (shown := capsys.readouterr()).out + shown.err


def test_commands_that_are_not_built_are_not_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(
        command in shown for command in ("measure", "detect", "reconstruct", "motion", "growth", "precision", "report", "cage", "demo")
    )
    assert not any(command in shown for command in ("calibrate", "plan", "review"))


def _run(*arguments: str) -> tuple[subprocess.CompletedProcess[str], float]:
    """Run Python; return what it printed and its processor seconds, which other processes hardly change."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return done, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_help_imports_nothing_heavy_and_is_quick() -> None:
    done, _ = _run("-X", "importtime", "-m", "rsa_vision", "--help")
    assert done.returncode == 0
    heavy = {"numpy", "scipy", "cv2", "polars", "pydantic", "jinja2", "matplotlib"}
    assert not heavy & {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    empty = min(_run("-c", "")[1] for _ in range(3))
    assert min(_run("-m", "rsa_vision", "--help")[1] for _ in range(3)) - empty < HELP_S


def test_importing_a_module_does_not_hide_the_command_of_its_name() -> None:
    for name in ("detect", "report"):
        code = f"import rsa_vision as r; print(callable(r.{name})); import rsa_vision.{name} as m; print(callable(m), m.__file__)"
        done, _ = _run("-c", code)
        assert done.stdout.startswith("True\nTrue"), done.stderr


def test_an_unexpected_failure_is_a_message_not_a_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("rsa_vision.api.report", broken)
    assert run_app(["report", "anywhere"]) == 2
    message = capsys.readouterr().err
    assert "ZeroDivisionError: by nothing" in message
    assert "Traceback" not in message


def test_ctrl_c_says_what_is_left(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    for command in ("measure", "detect"):
        monkeypatch.setattr(f"rsa_vision.api.{command}", interrupted)
    assert run_app(["measure", "a", "-o", "b"]) == 130
    assert "goes on" in capsys.readouterr().err
    assert run_app(["detect", "a", "-o", "b.csv"]) == 130
    told = capsys.readouterr().err
    assert "goes on" not in told
    assert "an older one is as it was" in told


@pytest.mark.usefixtures("two_images")
def test_films_of_one_name_have_drawings_of_their_own_and_parquet_is_parquet(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    film = sorted(folder.glob("*_f1.tif"))[0]
    same = shutil.copy(film, tmp_path / "other" / film.name)
    out = tmp_path / "found.parquet"
    assert run_app(["detect", str(film), str(same), "-o", str(out), "--overlay", str(tmp_path / "seen.png")]) == 0
    assert len(pl.read_parquet(out)) == 4
    assert sorted(path.name for path in tmp_path.glob("seen*")) == [f"seen_{film.stem}_{k}.png" for k in (1, 2)]
    third = shutil.copy(film, tmp_path / "other" / f"{film.stem}_1.tif")  # takes the first number
    assert run_app(["detect", str(film), str(same), str(third), "-o", str(out), "--overlay", str(tmp_path / "drawn.png")]) == 0
    assert sorted(path.name for path in tmp_path.glob("drawn*")) == [f"drawn_{film.stem}_{k}.png" for k in (1, 2, 3)]


@pytest.mark.parametrize(
    ("redirection", "code"), [("2>&-", 0), (">&-", 0), (">/dev/full", 2), ("| true; exit ${PIPESTATUS[0]}", 0)], ids=str
)
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_closed_and_full_streams_cost_nothing(redirection: str, code: int, unbuffered: str) -> None:
    command = f"{sys.executable} -m rsa_vision cage show 1A {redirection}"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, check=False, env=os.environ | {"PYTHONUNBUFFERED": unbuffered}
    )
    assert (done.returncode, done.stderr.count("\n")) == (code, int(code > 0)), done.stderr


def test_what_an_encoding_lacks_is_printed_as_escapes(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rsa_vision", "cage", "show", "1A", "-o", str(tmp_path / "骨.svg")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0
    assert r"\u9aa8.svg" in done.stdout
