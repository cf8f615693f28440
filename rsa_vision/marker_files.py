"""Tables of markers from files: ``markers.csv``, a folder that holds it, or any CSV with the columns needed."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from rsa_vision.errors import PointsError, UsageError
from rsa_vision.flags import flag_value
from rsa_vision.kinematics.series import MarkerTable
from rsa_vision.marker_columns import DEVIATIONS, PLACE, PRODUCTS, recognise
from rsa_vision.types import Bool, Float

MOST_ERRORS: Final = 20  # of a wrong file that are printed
LARGEST: Final = 1e6  # mm; nothing in a radiograph is a kilometre away
ROUNDING: Final = 1e-6  # of a covariance in print


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFile:
    """Markers, what is known of their examinations, and where they come from.

    Attributes
    ----------
    markers : MarkerTable
    status : dict of (subject, exam) to str
        From ``exams.csv``; empty for a single CSV.
    path : Path
        The CSV.
    folder : Path
        Where results go by default.
    unnamed : int
        Rows without a segment.
    shared_errors : bool
        The covariances hold errors of the foci (``foci.csv`` tells them), which all markers of an examination share.
    """

    markers: MarkerTable
    status: dict[tuple[str, str], str]
    path: Path
    folder: Path
    unnamed: int
    shared_errors: bool


def read_markers(source: Path, *, standard: bool = False, own: bool = False) -> MarkerFile:
    """Read a table of markers.

    Parameters
    ----------
    source : Path
        A folder of results, or a CSV file with the columns exam, segment, marker, x_mm, y_mm, z_mm. Optional: subject, sd_x_mm ..,
        cov_xy_mm2 .., flags; other columns are ignored. Names and arrangements of other programs are recognised
        (:func:`rsa_vision.marker_columns.recognise`). The separator may be a comma, a semicolon or a tab. Empty or NaN coordinates mean
        *not determined*.
    standard : bool
        The columns subject, exam and segment may be missing.
    own : bool
        The table of a run that has just ended: no marker is no error, and values that cannot be used are left out, so that a marker far
        off does not end the run.

    Returns
    -------
    MarkerFile

    Raises
    ------
    UsageError
        If there is no such file or folder.
    PointsError
        If the file cannot be read, lacks columns, or has wrong values; every error is listed with its line.
    """
    path = source / "markers.csv" if source.is_dir() else source
    if not path.is_file():
        what = "no markers.csv in it; measure the films first" if source.is_dir() else "no such file or folder"
        raise UsageError(f"{source}: {what}, or give a CSV file of markers")
    table = recognise(str(path), _read_csv(path))
    if not len(table) and not own:
        raise PointsError(f"{path}: there is no marker in it")
    markers = _check(path, table, standard, own)
    status = _read_status(source / "exams.csv") if source.is_dir() else {}
    folder = source if source.is_dir() else path.parent
    shared = source.is_dir() and _has_uncertain_foci(source / "foci.csv")
    return MarkerFile(markers, status, path, folder, int((markers.segment == "").sum()), shared)


def _read_csv(path: Path) -> pl.DataFrame:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise PointsError(f"{path}: not a readable CSV file ({error}); save it as UTF-8") from error
    header = text.split("\n", 1)[0].strip()
    separator = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.split(separator)]
    if twice := sorted({name for name in names if name and names.count(name) > 1}):
        raise PointsError(f"{path}: columns that stand twice: {', '.join(twice)}")
    try:
        table = pl.read_csv(io.StringIO(text), separator=separator, infer_schema=False)
    except pl.exceptions.PolarsError as error:
        reason = str(error).split("\n", 1)[0]
        raise PointsError(f"{path}: not a readable CSV file ({reason})") from error
    return table.rename({old: old.strip() for old in table.columns if old != old.strip()}).select(pl.all().str.strip_chars())


def _check(path: Path, table: pl.DataFrame, standard: bool, own: bool) -> MarkerTable:
    free = ("subject", "exam", "segment") if standard else ("subject",)
    wanted = [name for name in ("subject", "exam", "segment", "marker", *PLACE) if name not in free]
    if missing := [name for name in wanted if name not in table.columns]:
        there = ", ".join(table.columns) or "none"
        raise PointsError(f"{path}: missing columns: {', '.join(missing)}; there are {there}; rename those that are meant")
    problems: list[tuple[int, str]] = []

    def text(name: str, needed: bool = False) -> Any:
        values = table[name].fill_null("").to_numpy().astype(str) if name in table.columns else np.full(len(table), "", "U1")
        if needed:
            problems.extend((int(i), f"{name} is empty") for i in np.flatnonzero(values == ""))
        return values

    def number(name: str) -> Float:
        given = table[name].fill_null("")
        values = given.cast(pl.Float64, strict=False)
        wrong = ((values.is_null() & (given != "")) | (values.is_not_nan() & (values.abs() > LARGEST)).fill_null(False)).to_numpy()
        problems.extend((int(i), f"{name} is {given[int(i)]!r}, not a number of mm") for i in np.flatnonzero(wrong))
        return np.where(wrong, np.nan, values.fill_null(np.nan).to_numpy())

    names = [text("subject"), text("exam", not standard), text("segment"), text("marker", True)]
    position = np.stack([number(name) for name in PLACE], axis=1)
    covariance = np.full((len(table), 3, 3), np.nan)
    if set(DEVIATIONS) <= set(table.columns):
        deviation = np.stack([number(name) for name in DEVIATIONS], axis=1)
        covariance = deviation[:, :, None] ** 2 * np.eye(3)
        for name, (i, j) in PRODUCTS.items():
            if name in table.columns:
                covariance[:, i, j] = covariance[:, j, i] = np.nan_to_num(number(name))
        valid = _valid(covariance, deviation)
        problems += [(int(i), "the standard deviations and covariances are no covariance") for i in np.flatnonzero(~valid)]
        covariance[~valid] = np.nan
        covariance[~(deviation > 0).all(axis=1)] = np.nan  # 0 stands for "not known": no marker is exact
    if problems and not own:
        lines = [f"  line {row + 2}: {problem}" for row, problem in sorted(problems)]
        more = [f"  and {len(lines) - MOST_ERRORS} more"] if len(lines) > MOST_ERRORS else []
        raise PointsError(f"{path}: wrong values\n" + "\n".join(lines[:MOST_ERRORS] + more))
    known, where = np.unique(text("flags"), return_inverse=True)
    flags = np.array([flag_value(names) for names in known.tolist()], np.int64)[where]
    subject, exam, segment, marker = names
    return MarkerTable(subject, exam, segment, marker, position, covariance, flags)


def _valid(covariance: Float, deviation: Float) -> Bool:
    known: Bool = np.all(np.isfinite(covariance), axis=(1, 2))
    smallest = np.linalg.eigvalsh(np.where(known[:, None, None], covariance, np.eye(3)))[:, 0]
    with np.errstate(invalid="ignore"):
        negative = (deviation < 0).any(axis=1)
        largest = np.nan_to_num(deviation**2).max(axis=1, initial=0.0)
    result: Bool = (~known | (smallest >= -ROUNDING * largest)) & ~negative
    return result


def _read_status(path: Path) -> dict[tuple[str, str], str]:
    if not path.is_file():
        return {}
    table = _read_csv(path)
    if not {"subject", "exam", "status"} <= set(table.columns):
        raise PointsError(f"{path}: missing columns: subject, exam and status are needed")
    return {(subject, exam): status for subject, exam, status in table.select("subject", "exam", "status").iter_rows() if exam}


def _has_uncertain_foci(path: Path) -> bool:
    if not path.is_file():
        return False
    table = _read_csv(path)
    deviations = [table[name].cast(pl.Float64, strict=False) for name in DEVIATIONS if name in table.columns]
    return any((values > 0).any() for values in deviations)
