"""``motion``, ``growth``, ``precision`` and ``export`` as functions: they start from tables of markers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import ValidationError

from rsa_vision.errors import SettingsError, UsageError
from rsa_vision.exchange import Frames, encode, frames_of
from rsa_vision.kinematics.series import MarkerTable, make_series
from rsa_vision.marker_files import MarkerFile, read_markers
from rsa_vision.motion_tables import (
    group_table,
    growth_tables,
    motion_table,
    precision_table,
    remove_motion_tables,
    rigidity_table,
    write_motion_tables,
)
from rsa_vision.settings import ROOM_C, Motion, Study, describe_validation, load_study
from rsa_vision.store import read_run, write_atomic
from rsa_vision.tables import SCHEMAS

if TYPE_CHECKING:
    import polars as pl

UNNAMED: Final = "-"  # stands for the segment of markers without one
REMEDY: Final = "fill in the column segment, or give the known segments when measuring"


@dataclass(frozen=True, slots=True, eq=False)
class MotionSummary:
    """What ``motion``, ``growth`` or ``precision`` did.

    Attributes
    ----------
    out : Path
        Folder of the results.
    table : polars.DataFrame
        ``motion.csv``, ``growth.csv`` or ``precision.csv``.
    unnamed : int
        Markers without a segment, which were left out.
    """

    out: Path
    table: pl.DataFrame
    unnamed: int = 0

    def count(self, status: str) -> int:
        """Return how many rows have a status."""
        return int((self.table["status"] == status).sum()) if "status" in self.table.columns else 0

    @property
    def exit_code(self) -> int:
        """0 if every row is ok, else 1."""
        return int(self.count("review") + self.count("failed") > 0)


def motion(
    source: str | Path,
    out: str | Path | None = None,
    *,
    reference: str | None = None,
    side: str | None = None,
    study: str | Path | None = None,
) -> MotionSummary:
    """Compute the motion of every segment (KINEMA).

    Parameters
    ----------
    source : path
        Results folder, or a CSV file of markers.
    out : path, optional
        Folder for ``motion.csv``, ``rigidity.csv`` and ``motion_groups.csv``; default: beside the input.
    reference : str, optional
        Segment to which the others move; default: the study's, else the first one of each subject.
    side : str, optional
        ``left`` or ``right``; a left limb's x axis is mirrored. Default: the study's, else right.
    study : path, optional
        Study file; default: the settings of the run, if there is one.

    Returns
    -------
    MotionSummary

    Raises
    ------
    RsaError
        If the input or the settings cannot be read, no marker has a segment, or results cannot be written.
    """
    source = Path(source)
    given = read_markers(source)
    settled = _settle(source, study, {"reference": reference, "side": side})
    _require_segments(given)
    return _write(given, Path(out) if out is not None else given.folder, settled)


def write_motion(out: Path, study: Study) -> MotionSummary | None:
    """Compute the motion of a finished run where segments are known; None, and no files, where they are not.

    Parameters
    ----------
    out : Path
        Folder with ``markers.csv`` and ``exams.csv``.
    study : Study
    """
    remove_motion_tables(out)  # of an earlier run with other markers
    given = read_markers(out, own=True)
    if given.unnamed == len(given.markers):
        return None
    return _write(given, out, study)


def _write(given: MarkerFile, out: Path, study: Study) -> MotionSummary:
    series = make_series(given.markers, given.status)
    table = motion_table(series, study.motion, study.limits, shared_errors=given.shared_errors)
    tables = {"motion": table, "rigidity": rigidity_table(series, study.limits.stable_mm), "motion_groups": group_table(table, series)}
    write_motion_tables(out, tables)
    return MotionSummary(out, table, given.unnamed)


def growth(
    source: str | Path,
    out: str | Path | None = None,
    *,
    standard: str | Path | None = None,
    temperature_c: float | None = None,
    calibrated_at_c: float = 23.5,
    material: str = "plexiglas",
) -> MotionSummary:
    """Compare all lengths between points at two times, or against a standard (GROWTH).

    Parameters
    ----------
    source : path
        Results folder, or a CSV file of markers.
    out : path, optional
        Folder for ``lengths.csv`` and ``growth.csv``; default: beside the input.
    standard : path, optional
        CSV file with the given coordinates (marker, x_mm, y_mm, z_mm; subject and segment where the input has them).
    temperature_c : float, optional
        Temperature of the cage, where the input was measured without it: coordinates are multiplied by
        ``1 + expansion * (temperature_c - calibrated_at_c)``.
    calibrated_at_c : float
    material : str
        Of the cage: ``plexiglas``, ``mirror-glass`` or ``quartz-glass``.

    Returns
    -------
    MotionSummary

    Raises
    ------
    RsaError
        If the input cannot be read or has nothing to compare, or results cannot be written.
    """
    from rsa_vision.cage_checks import EXPANSION_PER_C, material_name

    if material_name(material) not in EXPANSION_PER_C:
        raise UsageError(f"material {material!r} is not known; use one of {', '.join(EXPANSION_PER_C)}")
    if not 0 <= (temperature_c or 0) <= ROOM_C:
        raise UsageError(f"temperature {temperature_c:g} is none of a room; give that of the cage, 0 to {ROOM_C:g} degrees C")
    scale = 1.0 if temperature_c is None else 1 + EXPANSION_PER_C[material_name(material)] * (temperature_c - calibrated_at_c)
    given = read_markers(Path(source))
    series = make_series(_all_named(given), given.status)
    fixed = make_series(_all_named(read_markers(Path(standard), standard=True))) if standard is not None else None
    if fixed and any(len(one.exams) > 1 for one in fixed):
        raise UsageError(f"{standard}: a standard has one set of coordinates; there are several examinations in it")
    lengths, table = growth_tables(series, fixed, scale)
    if not len(table):
        raise UsageError(f"{source}: one examination of each subject is nothing to compare; give a standard with --standard")
    place = Path(out) if out is not None else given.folder
    write_motion_tables(place, {"lengths": lengths, "growth": table})
    return MotionSummary(place, table)


def precision(source: str | Path, out: str | Path | None = None, *, reference: str | None = None) -> MotionSummary:
    """Summarise double examinations.

    Parameters
    ----------
    source : path
        Results folder (image coordinates are summarised, too), or a CSV file of markers. A repeat of an examination has its name and a
        letter: ``202601010900`` and ``202601010900b``.
    out : path, optional
        Folder for ``precision.csv``; default: beside the input.
    reference : str, optional
        Segment to which the others move; default: the study's, else the first one of each subject.

    Returns
    -------
    MotionSummary

    Raises
    ------
    RsaError
        If the input cannot be read or has no double examination, or the result cannot be written.
    """
    import polars as pl

    source = Path(source)
    given = read_markers(source)
    settled = _settle(source, None, {"reference": reference})
    _require_segments(given)
    series = make_series(given.markers, given.status)
    if not any((one.repeat_of >= 0).any() for one in series):
        raise UsageError(f"{source}: no double examination in it; a repeat has the name of its examination and a letter (202601010900b)")
    images = source / "images.csv"
    try:
        points = pl.read_csv(images, schema=dict(SCHEMAS["images"])) if source.is_dir() and images.is_file() else None
    except pl.exceptions.PolarsError as error:
        raise UsageError(f"{images}: not the table of measure ({error})") from error
    table = precision_table(series, settled.motion, settled.limits, points)
    place = Path(out) if out is not None else given.folder
    write_motion_tables(place, {"precision": table})
    return MotionSummary(place, table, given.unnamed)


def export(source: str | Path, out: str | Path, *, format_name: str | None = None, subject: str | None = None) -> Frames:
    """Write the markers of a subject for programs of motion analysis: each examination is a frame.

    Parameters
    ----------
    source : path
        Results folder, or a CSV file of markers.
    out : path
        The file.
    format_name : str, optional
        ``trc``, ``c3d`` (needs the package ezc3d) or ``xmalab``; default: by the suffix of the file (``.trc``, ``.c3d``, ``.csv``).
    subject : str, optional
        Needed where the input has several.

    Returns
    -------
    Frames
        What was written. Markers that motion does not use (predicted, loose, ambiguous, twice in an examination) are missing in it.

    Raises
    ------
    RsaError
        If the input cannot be read, the subject or the format is not known, or the file cannot be written.
    """
    if Path(out).exists() and Path(out).samefile(Path(source)):
        raise UsageError(f"{out}: this is the input, which holds more than the export; choose another name")
    given = read_markers(Path(source))
    series = {one.subject: one for one in make_series(_all_named(given), given.status)}
    chosen = next(iter(series)) if subject is None and len(series) == 1 else subject
    if chosen not in series:
        which = "several subjects" if subject is None else f"no subject {subject!r}"
        raise UsageError(f"{source}: there {'are' if subject is None else 'is'} {which}; choose with --subject: {', '.join(series)}")
    frames = frames_of(series[chosen], UNNAMED)
    write_atomic(Path(out), encode(frames, Path(out), format_name))
    return frames


def _require_segments(given: MarkerFile) -> None:
    if given.unnamed == len(given.markers):
        raise UsageError(f"{given.path}: no marker has a segment, and motion is that of segments; {REMEDY}")


def _all_named(given: MarkerFile) -> MarkerTable:
    """Lengths need no segments: points without one count as one model."""
    segment = np.where(given.markers.segment == "", UNNAMED, given.markers.segment)
    return replace(given.markers, segment=segment) if given.unnamed else given.markers


def _settle(source: Path, study: str | Path | None, options: dict[str, Any]) -> Study:
    if study is not None:
        base = load_study(Path(study))
    else:
        settings = read_run(source).get("settings", {}) if source.is_dir() else {}
        try:
            base = Study.model_validate({key: settings[key] for key in ("motion", "limits") if key in settings})
        except ValidationError as error:
            raise SettingsError(f"{source / 'run.json'}: wrong settings\n{describe_validation(error)}") from error
    given = {key: value for key, value in options.items() if value is not None}
    try:
        chosen = Motion.model_validate(base.motion.model_dump() | given)
    except ValidationError as error:
        raise SettingsError(f"wrong options\n{describe_validation(error)}") from error
    return base.model_copy(update={"motion": chosen})
