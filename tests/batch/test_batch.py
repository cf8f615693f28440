"""One examination that dies, hangs or raises does not stop the others."""

import os
from pathlib import Path

import pytest
from batch_workers import misbehave

from rsa_vision.batch import Outcome, Task, measure_task, run
from rsa_vision.cages import load_cage
from rsa_vision.errors import UsageError
from rsa_vision.settings import Study
from rsa_vision.study_files import ExamFiles, FilmFile

TIMEOUT_S = 8.0  # spawning and importing take 1-2 s on a busy machine


def task(exam: str, out: Path, *films: Path) -> Task:
    files = ExamFiles("S", exam, tuple(FilmFile(path, None) for path in films))
    return Task(files, Study(cage="1A"), load_cage("1A"), {}, out)


def test_a_dead_a_hanging_and_a_raising_worker_fail_their_own_task_alone(tmp_path: Path) -> None:
    before = dict(os.environ)
    seen: list[Outcome] = []
    outcomes = run([task(exam, tmp_path) for exam in ("a", "die", "b", "hang", "raise", "c")], 2, TIMEOUT_S, seen.append, misbehave)
    assert [o.exam for o in outcomes] == ["a", "die", "b", "hang", "raise", "c"]
    assert [o.reasons for o in outcomes] == ["cage-not-found", "internal", "cage-not-found", "timeout", "internal", "cage-not-found"]
    messages = [o.rows["exams"][0]["message"] for o in outcomes]
    assert "exit code 7" in messages[1]
    assert "--timeout-s" in messages[3]
    assert "unforeseen" in messages[4]
    assert messages[0] == "1"  # one thread for BLAS in workers
    assert sorted(o.exam for o in seen) == sorted(o.exam for o in outcomes)
    assert dict(os.environ) == before


def test_a_result_that_cannot_be_written_stops_the_run(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no room"):
        run([task("full", tmp_path)], 1, TIMEOUT_S, lambda _: None, misbehave)


def test_an_unforeseen_failure_is_a_failed_examination_with_its_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = tmp_path / "S_a.tif"
    film.write_bytes(b"not a film")

    def broken(_: Path) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("rsa_vision.images.read_film", broken)
    outcome = measure_task(task("a", tmp_path / "out", film))
    assert (outcome.status, outcome.reasons) == ("failed", "internal")
    assert "ZeroDivisionError: by nothing" in outcome.rows["exams"][0]["message"]
    assert "Traceback" in outcome.trace


def test_a_film_that_vanished_is_unreadable(tmp_path: Path) -> None:
    outcome = measure_task(task("a", tmp_path / "out", tmp_path / "S_a.tif"))
    assert (outcome.status, outcome.reasons) == ("failed", "film-unreadable")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "S_1.tif"
    os.mkfifo(pipe)
    outcome = measure_task(task("1", tmp_path / "out", pipe))
    assert (outcome.status, outcome.reasons) == ("failed", "film-unreadable")
