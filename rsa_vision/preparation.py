"""What a run needs before it starts: settings, the cage or the cameras, the examinations. Wrong usage is refused here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import ValidationError

from rsa_vision.errors import CageError, FilmError, SettingsError, UsageError
from rsa_vision.provenance import file_sha256
from rsa_vision.settings import Study, describe_validation, load_study
from rsa_vision.study_files import Grouping, group_films

if TYPE_CHECKING:
    from rsa_vision.cages import Cage
    from rsa_vision.cameras import Camera

STUDY_FILE: Final = "study.toml"
METHODS: Final = ("selvik",)


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


def refuse_unbuilt(method: str, dask: object, jobs: int, timeout_s: float | None) -> None:
    """Raise :class:`UsageError` for options that cannot be used."""
    if method == "bundle":
        raise UsageError('method "bundle" is not built yet; use --method selvik')
    if method not in METHODS:
        raise UsageError(f"method {method!r} is not known; use selvik")
    if dask is not None:
        raise UsageError("runs on many machines are not built yet; leave --dask out and use --jobs")
    if jobs < 1:
        raise UsageError(f"--jobs {jobs}: at least one process is needed")
    if timeout_s is not None and not timeout_s > 0:
        raise UsageError(f"--timeout-s {timeout_s:g}: a positive number of seconds is needed")


def default_study(folder: Path) -> Path | None:
    """Return the study file that lies among the films, if any."""
    path = folder / STUDY_FILE
    return path if path.is_file() else None


def load_geometry(study: Study) -> tuple[Cage | dict[int, Camera], dict[str, Any]]:
    """Return the cage or the cameras of a study, and their content for ``run.json``.

    Raises
    ------
    UsageError, SettingsError, CageError, CalibrationError
        If there is none, or it cannot be read or used.
    """
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
    return cage, {"cage": cage_content(cage)}


def cage_content(cage: Cage) -> dict[str, Any]:
    """Return a cage as it stands in ``run.json``."""
    return {"name": cage.name, "sha256": cage.sha256, "content": cage.model_dump(mode="json", exclude_none=True)}


def group(folder: Path, study: Study, geometry: Cage | dict[int, Camera]) -> Grouping:
    """Return the examinations of a folder (:func:`rsa_vision.study_files.group_films`)."""
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
