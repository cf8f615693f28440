"""The commands as functions: ``rsa_vision.measure(...)`` does what ``rsa-vision measure`` does, and raises what that prints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from rsa_vision.batch import Outcome, Task, run
from rsa_vision.errors import CageError, FilmError, SettingsError, UsageError
from rsa_vision.provenance import environment, file_sha256
from rsa_vision.settings import Study, describe_validation, load_study
from rsa_vision.store import to_csv, write_atomic, write_run, write_tables
from rsa_vision.study_files import Grouping, group_films

if TYPE_CHECKING:
    import polars as pl

    from rsa_vision.cages import Cage
    from rsa_vision.cameras import Camera

STUDY_FILE: Final = "study.toml"
METHODS: Final = ("selvik",)


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
        Refused until markers are matched with known segments.
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
    started = datetime.now(UTC)
    folder, out = Path(folder), Path(out)
    _refuse(method, segments, dask, jobs, timeout_s)
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give the folder of the films")
    study_file = Path(study) if study is not None else _default_study(folder)
    settled = settle(study_file, settings)
    geometry, about = _geometry(settled)
    grouping = _group(folder, settled, geometry)
    _prepare(out)
    depends_on = {"settings": _described(settled), "geometry": about, "method": method}
    tasks = [Task(files, settled, geometry, depends_on, out, redo) for files in grouping.exams]
    outcomes = run(tasks, jobs, timeout_s, lambda outcome: watch(outcome, len(tasks)) if watch else None)
    write_tables(out, (outcome.rows for outcome in outcomes))
    options = {"method": method, "jobs": jobs, "redo": redo, "timeout_s": timeout_s}
    record = _record("measure", started, folder, study_file, settled, about) | {
        "options": options,
        "inputs": [
            {"path": str(film.path.resolve()), "sha256": outcome.inputs.get(film.path.name)}
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
    points: str | Path, out: str | Path, *, cage: str | Path | None = None, study: str | Path | None = None, **settings: Any
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
    **settings
        As of :func:`measure`.

    Returns
    -------
    Summary

    Raises
    ------
    RsaError
        If the points, the cage or the study cannot be read, or results cannot be written.
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
    loaded = load_cage(settled.cage)
    exams = read_points(points, loaded)
    _prepare(out)
    outcomes = []
    for (subject, exam), table in sorted(exams.items(), key=lambda item: _exam_key(*item[0])):
        began = perf_counter()
        result = reconstruct_points(table, settled, loaded)
        rows = examination_rows(subject, exam, [points.name], result, perf_counter() - began)
        outcomes.append(Outcome(subject, exam, rows))
    write_tables(out, (outcome.rows for outcome in outcomes))
    record = _record("reconstruct", started, points, study_file, settled, {"cage": _cage_content(loaded)})
    _finish(out, record | {"inputs": [{"path": str(points.resolve()), "sha256": file_sha256(points)}]})
    return Summary(out, tuple(outcomes))


def detect(
    images: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    overlay: str | Path | None = None,
    response: str = "auto",
    failures: list[tuple[Path, str]] | None = None,
    watch: Callable[[Path, int], None] | None = None,
) -> pl.DataFrame:
    """Find the marker images of single films; no cage and no pixel pitch is needed.

    Parameters
    ----------
    images : sequence of path
    out : path, optional
        CSV file for the result.
    overlay : path, optional
        PNG file for a drawing; with several images the name of each is added to it.
    response : str
        Film response, as in the study file.
    failures : list, optional
        Films that cannot be used are added to it as (path, message); without it the first one is raised.
    watch : callable, optional
        Is called after every film with its path and the number of markers found, -1 where it failed.

    Returns
    -------
    polars.DataFrame
        Columns file, shape, col_px, row_px, sd_col_px, sd_row_px, cov_col_row_px2, radius_px, angle_deg, contrast, snr, flags.

    Raises
    ------
    FilmError
        If a film cannot be used and there is no list of failures.
    SettingsError
        If the response is unknown.
    UsageError
        If no image is given, or a result cannot be written.
    """
    from rsa_vision.detect import detect_markers
    from rsa_vision.images import read_film
    from rsa_vision.overlay import overlay_png
    from rsa_vision.tables import DETECTIONS, detection_rows, frame

    if not images:
        raise UsageError("no image given; name the films to look at")
    settle(None, {"response": response})  # refuses an unknown one
    rows: list[dict[str, Any]] = []
    for name in images:
        try:
            film = read_film(Path(name))
            found = detect_markers(film.values, bits=film.bits, response=response).images
        except FilmError as error:
            if failures is None:
                raise
            failures.append((Path(name), str(error)))
            if watch:
                watch(Path(name), -1)
            continue
        rows += detection_rows(str(name), found)
        if overlay is not None:
            write_atomic(_overlay_path(Path(overlay), Path(name), len(images)), overlay_png(film.values, found))
        if watch:
            watch(Path(name), len(found))
    table = frame(rows, DETECTIONS)
    if out is not None:
        write_atomic(Path(out), to_csv(table))
    return table


def report(out: str | Path) -> Path:
    """Write ``report.html`` of a results folder again and return its path; :class:`UsageError` if there are no results."""
    from rsa_vision.report import write_report

    return write_report(Path(out))


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
    return [measure(study, study / "results", watch=watch) for study in studies]


def settle(study_file: Path | None, options: Mapping[str, Any]) -> Study:
    """Return the settings of a study file with options over them.

    Parameters
    ----------
    study_file : Path or None
    options : mapping
        Keys of the study file; None is "not given".

    Returns
    -------
    Study

    Raises
    ------
    SettingsError
        If a key is unknown or a value wrong; all are listed.
    """
    base = load_study(study_file) if study_file is not None else Study()
    given = {key: str(value) if isinstance(value, Path) else value for key, value in options.items() if value is not None}
    try:
        return Study.model_validate({**base.model_dump(exclude_unset=True), **given})
    except ValidationError as error:
        raise SettingsError(f"wrong options\n{describe_validation(error)}") from error


def _refuse(method: str, segments: object, dask: object, jobs: int, timeout_s: float | None) -> None:
    if method == "bundle":
        raise UsageError('method "bundle" is not built yet; use --method selvik')
    if method not in METHODS:
        raise UsageError(f"method {method!r} is not known; use selvik")
    if segments is not None:
        raise UsageError("markers are not matched with known segments yet; leave --segments out: they are named P01, P02, ...")
    if dask is not None:
        raise UsageError("runs on many machines are not built yet; leave --dask out and use --jobs")
    if jobs < 1:
        raise UsageError(f"--jobs {jobs}: at least one process is needed")
    if timeout_s is not None and not timeout_s > 0:
        raise UsageError(f"--timeout-s {timeout_s:g}: a positive number of seconds is needed")


def _default_study(folder: Path) -> Path | None:
    path = folder / STUDY_FILE
    return path if path.is_file() else None


def _geometry(study: Study) -> tuple[Cage | dict[int, Camera], dict[str, Any]]:
    """Return the cage or the cameras, and their content for ``run.json``."""
    from rsa_vision.cages import load_cage

    if study.calibration:
        from rsa_vision.cameras import load_camera

        cameras = {focus: load_camera(path) for focus, path in sorted(study.calibration.items())}
        if len(cameras) < 2:
            raise UsageError("calibration: one camera sees no depth; give the files of two or more")
        about = {str(focus): {"path": str(path), "sha256": file_sha256(path)} for focus, path in sorted(study.calibration.items())}
        return cameras, {"calibration": about}
    if study.cage is None:
        raise UsageError("no cage: name it with --cage or `cage` in study.toml (see `rsa-vision cage list`), or give `calibration` there")
    cage = load_cage(study.cage)
    if unknown := sorted(set(study.foci) - set(cage.foci)):
        raise SettingsError(f"[foci]: cage {cage.name} has no focus {unknown[0]}; it has {', '.join(map(str, sorted(cage.foci)))}")
    if len(cage.foci) < 2:
        raise CageError(f"cage {cage.name} has one focus, which sees no depth; two or more are needed to measure")
    return cage, {"cage": _cage_content(cage)}


def _cage_content(cage: Cage) -> dict[str, Any]:
    return {"name": cage.name, "sha256": cage.sha256, "content": cage.model_dump(mode="json", exclude_none=True)}


def _group(folder: Path, study: Study, geometry: Cage | dict[int, Camera]) -> Grouping:
    from rsa_vision.cages import Cage

    if isinstance(geometry, Cage):
        foci = sorted(geometry.foci)
        shared = len({id(geometry.plane_of(focus)) for focus in foci}) == 1
    else:
        foci, shared = sorted(geometry), False
    return group_films(folder, foci, study.film, shared_possible=shared, file_pattern=study.file_pattern, read_tags=_dicom_tags)


def _dicom_tags(path: Path) -> Mapping[str, str] | None:
    from rsa_vision.images import open_header

    try:
        header = open_header(path)
    except FilmError:
        return None
    return header.meta if header.format == "DICOM" else None


def _exam_key(subject: str, exam: str) -> Any:
    from rsa_vision.study_files import natural_key

    return natural_key(subject), natural_key(exam)


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


def _overlay_path(overlay: Path, image: Path, count: int) -> Path:
    return overlay if count == 1 else overlay.with_name(f"{overlay.stem}_{image.stem}{overlay.suffix or '.png'}")
