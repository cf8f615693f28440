"""Many examinations: one after the other, or in processes of their own that may die or hang without stopping the run."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass, field
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rsa_vision.errors import FilmError, RsaError, UsageError
from rsa_vision.images import check_file
from rsa_vision.provenance import file_sha256, version
from rsa_vision.settings import Study
from rsa_vision.store import fingerprint, is_finished, read_record, record_path, write_record
from rsa_vision.study_files import ExamFiles, printable
from rsa_vision.tables import Rows, examination_rows, failed_rows
from rsa_vision.threads import one_thread_each

if TYPE_CHECKING:
    from rsa_vision.cages import Cage
    from rsa_vision.cameras import Camera


@dataclass(frozen=True, slots=True)
class Task:
    """One examination to measure; paths, not pixels, go to the workers."""

    files: ExamFiles
    study: Study
    geometry: Cage | Mapping[int, Camera]
    depends_on: Mapping[str, Any]  # whatever else the result depends on, for its fingerprint
    out: Path
    redo: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an examination: its rows in every table, hashes of its films and their pixels, and whether it was kept."""

    subject: str
    exam: str
    rows: Rows
    kept: bool = False
    inputs: Mapping[str, str] = field(default_factory=dict)
    trace: str = ""
    pixels: Mapping[str, str] = field(default_factory=dict)

    @property
    def status(self) -> str:
        """``ok``, ``review`` or ``failed``."""
        return str(self.rows["exams"][0]["status"])

    @property
    def reasons(self) -> str:
        """Reason codes joined by ``;``."""
        return str(self.rows["exams"][0]["reasons"])

    @property
    def seconds(self) -> float:
        """Time it took when it was measured."""
        return float(self.rows["exams"][0]["seconds"])


Worker = Callable[[Task], Outcome]
Watcher = Callable[[Outcome], None]


def run(tasks: Sequence[Task], jobs: int, timeout_s: float | None, watch: Watcher, worker: Worker | None = None) -> list[Outcome]:
    """Measure examinations.

    Parameters
    ----------
    tasks : sequence of Task
    jobs : int
        Processes; 1 without a time limit: in this process.
    timeout_s : float or None
        Longest time for one examination.
    watch : callable
        Is told every outcome as it comes.
    worker : callable, optional
        Measures one task; default :func:`measure_task`. For tests.

    Returns
    -------
    list of Outcome
        In the order of the tasks.

    Raises
    ------
    UsageError
        If results cannot be written.
    """
    work = worker or measure_task
    if jobs == 1 and timeout_s is None:
        outcomes = []
        for task in tasks:
            outcomes.append(work(task))
            watch(outcomes[-1])
        return outcomes
    return _run_pool(tasks, jobs, timeout_s, watch, work)


def measure_task(task: Task) -> Outcome:
    """Measure one examination, or keep its result of an earlier run if films and settings are the same.

    Parameters
    ----------
    task : Task

    Returns
    -------
    Outcome
        Failed for any failure but that to write.

    Raises
    ------
    UsageError
        If the result cannot be written.
    """
    files, started = task.files, perf_counter()
    if files.problem:
        return _failed(files, *files.problem)
    path = record_path(task.out, files.subject, files.exam)
    inputs: dict[str, str] = {}
    try:
        for film in files.films:
            check_file(film.path)
        inputs = {film.path.name: file_sha256(film.path) for film in files.films}
        wanted = fingerprint({**task.depends_on, "version": version(), "exam": [files.subject, files.exam], "films": inputs})
        record = read_record(path)
        if record and not task.redo and is_finished(record, wanted):
            return Outcome(files.subject, files.exam, record["rows"], True, inputs, pixels=_pixels(record["films"]))
        rows, about, pictures = _measure(task, started)
    except UsageError:
        raise
    except RsaError as error:
        return _failed(files, error.code, str(error), started, inputs)
    except OSError as error:
        return _failed(
            files, FilmError.code, f"{error.filename}: cannot be read ({error.strerror}); look at its path and permissions", started, inputs
        )
    except MemoryError:
        return _failed(files, "internal", "not enough memory; run fewer --jobs", started, inputs, traceback.format_exc())
    except Exception as error:  # one examination never stops a run; the trace is kept in run.json
        return _failed(files, "internal", f"{type(error).__name__}: {error}", started, inputs, traceback.format_exc())
    write_record(path, {"fingerprint": wanted, "rows": rows, "films": about, "inputs": inputs}, pictures)
    return Outcome(files.subject, files.exam, rows, False, inputs, pixels=_pixels(about))


def _pixels(films: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    return {film["file"]: film["pixels"] for film in films if "pixels" in film}


def _measure(task: Task, started: float) -> tuple[Rows, list[dict[str, Any]], list[bytes]]:
    from rsa_vision.examination import measure_examination  # late: the mathematics is not needed to find that nothing is to do
    from rsa_vision.images import read_film
    from rsa_vision.overlay import jpeg, preview

    read = [(film.cage_only, (read_film(film.path), film.focus)) for film in task.files.films]
    cage_films = [exposed for cage_only, exposed in read if cage_only]
    films = [exposed for cage_only, exposed in read if not cage_only]
    result = measure_examination(films, task.study, task.geometry, cage_films=cage_films)
    pictures = [jpeg(preview(film.values)) for film, _ in (*cage_films, *films)]
    response = {reading.path: reading.response for reading in result.films}
    about = [
        {"file": film.path.name, "focus": focus, "rows": film.values.shape[0], "cols": film.values.shape[1], "bits": film.bits}
        | {"pixels": sha256(film.values.tobytes()).hexdigest()}
        | {"pitch_mm": film.pitch_mm, "pitch_source": film.pitch_source, "response": response.get(film.path)}
        for film, focus in (*cage_films, *films)
    ]
    names = [film.path.name for film in task.files.films]
    return examination_rows(task.files.subject, task.files.exam, names, result, perf_counter() - started), about, pictures


def _failed(
    files: ExamFiles, code: str, message: str, started: float | None = None, inputs: Mapping[str, str] | None = None, trace: str = ""
) -> Outcome:
    seconds = perf_counter() - started if started is not None else 0.0
    rows = failed_rows(files.subject, files.exam, [printable(film.path.name) for film in files.films], code, message, seconds)
    return Outcome(files.subject, files.exam, rows, False, inputs or {}, trace)


def _run_pool(tasks: Sequence[Task], jobs: int, timeout_s: float | None, watch: Watcher, work: Worker) -> list[Outcome]:
    from pebble import ProcessPool

    done: dict[int, Outcome] = {}
    with one_thread_each(), ProcessPool(max_workers=jobs, context=get_context("spawn"), initializer=_start_worker) as pool:
        try:
            futures: dict[Future[Outcome], int] = {
                pool.schedule(work, args=(task,), timeout=timeout_s): index for index, task in enumerate(tasks)
            }
            for future in as_completed(futures):
                index = futures[future]
                done[index] = _outcome(future, tasks[index].files, timeout_s)
                watch(done[index])
        except BaseException:
            pool.stop()  # type: ignore[no-untyped-call]  # pebble's
            raise
    return [done[index] for index in range(len(tasks))]


def _outcome(future: Future[Outcome], files: ExamFiles, timeout_s: float | None) -> Outcome:
    from pebble import ProcessExpired

    try:
        outcome = future.result()
    except UsageError:
        raise
    except TimeoutError:
        return _failed(files, "timeout", f"not finished within {timeout_s:g} s; allow more with --timeout-s")
    except ProcessExpired as error:
        why = f"its process died (exit code {error.exitcode})"
        return _failed(files, "internal", f"{why}; if memory ran out, run fewer --jobs")
    except Exception as error:
        return _failed(files, "internal", f"{type(error).__name__}: {error}", trace=traceback.format_exc())
    return outcome


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the workers
    import cv2

    cv2.setNumThreads(1)
