"""The commands as functions: ``rsa_vision.measure(...)`` does what ``rsa-vision measure`` does, and raises what that prints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rsa_vision.api_detect import detect
from rsa_vision.api_motion import export, growth, motion, precision, write_motion
from rsa_vision.batch import Outcome, Task, run
from rsa_vision.errors import UsageError
from rsa_vision.ordering import natural_key
from rsa_vision.preparation import cage_content, default_study, group, load_geometry, refuse_unbuilt, settle
from rsa_vision.provenance import environment, file_sha256
from rsa_vision.segments import Segments, read_segments
from rsa_vision.settings import Study
from rsa_vision.store import write_atomic, write_run, write_tables

if TYPE_CHECKING:
    from rsa_vision.cages import Cage
    from rsa_vision.cameras import Camera
    from rsa_vision.proposal import Proposal
__all__ = [
    "Summary",
    "Watcher",
    "demo",
    "detect",
    "export",
    "growth",
    "measure",
    "motion",
    "precision",
    "propose_segments",
    "reconstruct",
    "report",
]


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run did.

    Attributes
    ----------
    out : Path
        Folder of the results.
    outcomes : tuple of Outcome
        One of each examination, in the order of ``exams.csv``.
    ignored : tuple of (Path, str)
        Files that are no films, and why.
    """

    out: Path
    outcomes: tuple[Outcome, ...]
    ignored: tuple[tuple[Path, str], ...] = ()

    def count(self, status: str) -> int:
        """Return how many examinations have a status."""
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def exit_code(self) -> int:
        """0 if every examination is ok, else 1."""
        return int(self.count("ok") < len(self.outcomes))


Watcher = Callable[[Outcome, int], None]
"""Is told every outcome as it comes, and how many there will be."""


def measure(
    folder: str | Path,
    out: str | Path,
    *,
    study: str | Path | None = None,
    segments: str | Path | None = None,
    method: str = "selvik",
    jobs: int = 1,
    dask: str | None = None,
    redo: bool = False,
    timeout_s: float | None = None,
    watch: Watcher | None = None,
    **settings: Any,
) -> Summary:
    """Measure every examination in a folder of films.

    Parameters
    ----------
    folder : path
        Films named as in the documentation, page "Quick start".
    out : path
        Folder for the results.
    study : path, optional
        Study file; default: ``study.toml`` in the folder, if there is one.
    segments : path, optional
        CSV file of the known segments; without it markers are named P01, P02, ... and keep their names through a subject's examinations.
    method : str
        ``selvik``.
    jobs : int
        Number of processes; from a script, call from under ``if __name__ == "__main__":`` if more than one.
    dask : str, optional
        Refused until runs on many machines are built.
    redo : bool
        Measure again what is finished.
    timeout_s : float, optional
        Longest time for one examination.
    watch : callable, optional
        Is called with every outcome and the number of examinations.
    **settings
        Keys of the study file (``cage``, ``pixel_pitch_mm``, ``response`` ...); they win over it. None: not given.

    Returns
    -------
    Summary

    Raises
    ------
    RsaError
        If nothing can be measured at all: wrong options, no cage, no film, results that cannot be written. A film that cannot be used is a
        failed examination, not an exception.
    """
    from rsa_vision.copies import with_copies_reviewed  # late: it needs the mathematics

    started = datetime.now(UTC)
    folder, out = Path(folder), Path(out)
    refuse_unbuilt(method, dask, jobs, timeout_s)
    known = read_segments(Path(segments)) if segments is not None else None
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of the films")
    study_file = Path(study) if study is not None else default_study(folder)
    settled = settle(study_file, settings)
    geometry, about = load_geometry(settled)
    grouping = group(folder, settled, geometry)
    _prepare(out)
    depends_on = {"settings": _described(settled), "geometry": about, "method": method}
    tasks = [Task(files, settled, geometry, depends_on, out, redo) for files in grouping.exams]
    outcomes = run(tasks, jobs, timeout_s, lambda outcome: watch(outcome, len(tasks)) if watch else None)
    outcomes = with_copies_reviewed(grouping.exams, _compared(_followed_up(outcomes, known, settled), geometry, settled))
    write_tables(out, (outcome.rows for outcome in outcomes))
    write_motion(out, settled)
    options = {"method": method, "segments": _hashed(segments), "jobs": jobs, "redo": redo, "timeout_s": timeout_s}
    record = _record("measure", started, folder, study_file, settled, about) | {
        "options": options,
        "inputs": [
            {"path": str(film.path.absolute()), "sha256": outcome.inputs.get(film.path.name)}
            for files, outcome in zip(grouping.exams, outcomes, strict=True)
            for film in files.films
        ],
        "ignored": [{"path": str(path), "why": why} for path, why in grouping.ignored],
        "failures": [
            {"subject": o.subject, "exam": o.exam, "reasons": o.reasons, "message": o.rows["exams"][0]["message"], "trace": o.trace}
            for o in outcomes
            if o.status == "failed"
        ],
    }
    _finish(out, record)
    return Summary(out, tuple(outcomes), grouping.ignored)


def reconstruct(
    points: str | Path,
    out: str | Path,
    *,
    cage: str | Path | None = None,
    study: str | Path | None = None,
    segments: str | Path | None = None,
    **settings: Any,
) -> Summary:
    """Reconstruct markers from image coordinates that were measured elsewhere.

    Parameters
    ----------
    points : path
        CSV with the columns of ``images.csv``, or Selvik's identification numbers.
    out : path
        Folder for the results.
    cage : str or path
        Name or file of a cage; default: the study's.
    study : path, optional
    segments : path, optional
        CSV file of the known segments, by which the markers are named; without it they keep the names that they have.
    **settings
        As of :func:`measure`.

    Returns
    -------
    Summary

    Raises
    ------
    RsaError
        If the points, the cage, the study or the segments cannot be read, or results cannot be written.
    """
    from rsa_vision.cages import load_cage
    from rsa_vision.examination import reconstruct_points
    from rsa_vision.points import read_points
    from rsa_vision.tables import examination_rows

    started = datetime.now(UTC)
    points, out = Path(points), Path(out)
    study_file = Path(study) if study is not None else None
    settled = settle(study_file, {"cage": cage, **settings})
    if settled.cage is None:
        raise UsageError("points are reconstructed with a cage; give it with --cage (see `rsa-vision cage list`)")
    known = read_segments(Path(segments)) if segments is not None else None
    loaded = load_cage(settled.cage)
    exams = read_points(points, loaded)
    _prepare(out)
    outcomes = []
    for (subject, exam), table in sorted(exams.items(), key=lambda item: (natural_key(item[0][0]), natural_key(item[0][1]))):
        began = perf_counter()
        result = reconstruct_points(table, settled, loaded)
        rows = examination_rows(subject, exam, [points.name], result, perf_counter() - began)
        outcomes.append(Outcome(subject, exam, rows))
    if known is not None:  # names that somebody gave stand unless the segments are to give them
        outcomes = _followed_up(outcomes, known, settled)
    outcomes = _compared(outcomes, loaded, settled)
    write_tables(out, (outcome.rows for outcome in outcomes))
    write_motion(out, settled)
    record = _record("reconstruct", started, points, study_file, settled, {"cage": cage_content(loaded)})
    inputs = [{"path": str(points.resolve()), "sha256": file_sha256(points)}]
    _finish(out, record | {"options": {"segments": _hashed(segments)}, "inputs": inputs})
    return Summary(out, tuple(outcomes))


def report(out: str | Path) -> Path:
    """Write ``report.html`` of a results folder again and return its path; :class:`UsageError` if there are no results."""
    from rsa_vision.report import write_report

    return write_report(Path(out))


def propose_segments(results: str | Path, out: str | Path | None = None) -> list[Proposal]:
    """Suggest rigid groups of markers from several examinations; the command ``segments propose``.

    Parameters
    ----------
    results : path
        Folder of results, or its ``markers.csv``.
    out : path, optional
        ``segments.csv`` to write.

    Returns
    -------
    list of Proposal
        With a figure of how sure each is. Bodies that did not move against each other look like one.

    Raises
    ------
    UsageError
        If there are no results, no subject has two examinations, no group is found, or the file cannot be written.
    """
    from rsa_vision.proposal import propose
    from rsa_vision.segments import segments_csv
    from rsa_vision.store import read_tables

    path = Path(results)
    proposals, _ = propose(read_tables(path if path.is_dir() else path.parent)["markers"].to_dicts())
    if not proposals:
        raise UsageError(f"{path}: no three markers keep their distances in two examinations of a subject; measure more examinations")
    if out is not None:
        by_subject = {p.subject: [q.segment for q in proposals if q.subject == p.subject] for p in proposals}
        write_atomic(Path(out), segments_csv(by_subject.items()).encode())
    return proposals


def demo(folder: str | Path = "rsa-vision-demo", *, seed: int = 1, watch: Watcher | None = None) -> list[Summary]:
    """Make a small study of synthetic films with the cages 1A, 1B and 2, and measure it.

    Parameters
    ----------
    folder : path
        Gets a folder for each cage with films, ``truth/`` and ``results/``.
    seed : int
        Of the random numbers.
    watch : callable, optional
        As of :func:`measure`.

    Returns
    -------
    list of Summary
        One for each cage.

    Raises
    ------
    UsageError
        If the folder cannot be written.
    """
    import numpy as np

    from synthetic.demo import make_demo

    try:
        studies = make_demo(Path(folder), rng=np.random.default_rng(seed))
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from error
    return [measure(study, study / "results", segments=study / "truth" / "segments.csv", watch=watch) for study in studies]


def _followed_up(outcomes: Sequence[Outcome], segments: Segments | None, study: Study) -> list[Outcome]:
    from rsa_vision.followup import follow_up

    every = follow_up([outcome.rows for outcome in outcomes], segments, study.limits)
    return [replace(outcome, rows=rows) for outcome, rows in zip(outcomes, every, strict=True)]


def _compared(outcomes: Sequence[Outcome], geometry: Cage | Mapping[int, Camera], study: Study) -> list[Outcome]:
    """Have those examinations reviewed that others of their subject contradict."""
    from rsa_vision.cage_symmetry import turns
    from rsa_vision.cages import Cage
    from rsa_vision.turned import with_turned_reviewed
    from rsa_vision.wrong_pairs import with_wrong_pairs_reviewed

    every = with_wrong_pairs_reviewed([outcome.rows for outcome in outcomes], study.limits)
    every = with_turned_reviewed(every, turns(geometry) if isinstance(geometry, Cage) else ())
    return [replace(outcome, rows=rows) for outcome, rows in zip(outcomes, every, strict=True)]


def _hashed(path: str | Path | None) -> dict[str, str] | None:
    return {"path": str(Path(path).resolve()), "sha256": file_sha256(Path(path))} if path is not None else None


def _prepare(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: not a folder that can be written ({error.strerror}); choose another place with -o") from error


def _described(study: Study) -> dict[str, Any]:
    content: dict[str, Any] = study.model_dump(mode="json")
    return content


def _record(
    command: str, started: datetime, source: Path, study_file: Path | None, study: Study, geometry: Mapping[str, Any]
) -> dict[str, Any]:
    return {
        **environment(),
        "command": command,
        "source": str(source.resolve()),
        "study_file": str(study_file.resolve()) if study_file else None,
        "settings": _described(study),
        **geometry,
        "start": started.isoformat(timespec="milliseconds"),
    }


def _finish(out: Path, record: Mapping[str, Any]) -> None:
    from rsa_vision.report import write_report

    write_run(out, {**record, "end": datetime.now(UTC).isoformat(timespec="milliseconds")})
    write_report(out)
