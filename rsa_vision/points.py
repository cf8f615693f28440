"""Image coordinates that were measured elsewhere: the columns of ``images.csv``, or Selvik's identification numbers."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.errors import PointsError
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import ImagePoints

COMMON: Final = ("subject", "exam", "col_px", "row_px")
NAMED: Final = ("focus", "role", "number")
COVARIANCE: Final = ("sd_col_px", "sd_row_px", "cov_col_row_px2")
ROLES: Final = ("fiducial", "control", "object", "unassigned")
SHAPES: Final = ("ball", "pin", "tee", "")
FLAGS: Final = {flag.name.lower().replace("_", "-"): int(flag) for flag in MarkerFlag if flag.name}

Row = Mapping[str, str]
Name = tuple[int, str, str]


@dataclass(frozen=True, slots=True)
class _Point:
    line: int
    exam: tuple[str, str]
    name: Name
    position: tuple[float, float]
    covariance: tuple[float, float, float]  # of col and col, row and row, col and row
    shape: str
    flags: int
    file: str


def read_points(path: Path, cage: Cage | None = None) -> dict[tuple[str, str], ImagePoints]:
    """Read a table of named image points.

    Parameters
    ----------
    path : Path
        A CSV file with the columns subject, exam, col_px, row_px, and either focus, role, number (as ``images.csv``), or ``id``:
        Selvik's identification number, ``10 * number + focus``, with two figures for fiducial marks, three for control points and more
        for object points. Optional: sd_col_px, sd_row_px, cov_col_row_px2, shape, flags, file; other columns are ignored. The
        coordinates may have any unit, since an affine change of the film is absorbed.
    cage : Cage, optional
        Its table decides what an ``id`` means that the number of figures would tell wrongly (fiducial mark 10 of cage 1B is 101 and 102).

    Returns
    -------
    dict of (subject, exam) to ImagePoints
        In the order of the file. Covariances are NaN where none was given.

    Raises
    ------
    PointsError
        If the file cannot be read, lacks columns, or has wrong values; every error is listed with its line.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            header = [name.strip() for name in next(reader, [])]
            lines = [(reader.line_num, cells) for cells in reader if any(cell.strip() for cell in cells)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PointsError(f"{path}: not a readable CSV file ({error})") from error
    _require_columns(path, header, bool(lines))
    problems: list[str] = []
    points: list[_Point] = []
    first: dict[tuple[tuple[str, str], Name], int] = {}
    for line, cells in lines:
        if len(cells) != len(header):
            problems.append(f"line {line}: {len(cells)} values for {len(header)} columns")
            continue
        point, found = _read_row(line, dict(zip(header, (cell.strip() for cell in cells), strict=True)), cage)
        problems += [f"line {line}: {problem}" for problem in found]
        if point is None:
            continue
        points.append(point)
        focus, role, number = point.name
        earlier = first.setdefault((point.exam, point.name), line)
        if earlier != line and role != "unassigned":
            problems.append(f"line {line}: {role} {number} of focus {focus} stands already in line {earlier}")
    if problems:
        raise PointsError(f"{path}: wrong values\n" + "\n".join(f"  {problem}" for problem in problems))
    exams: dict[tuple[str, str], list[_Point]] = {}
    for point in points:
        exams.setdefault(point.exam, []).append(point)
    return {exam: _table(rows) for exam, rows in exams.items()}


def _require_columns(path: Path, header: list[str], has_rows: bool) -> None:
    problems = [f"column {name} stands twice" for name in sorted(set(header)) if name and header.count(name) > 1]
    wanted = COMMON if "id" in header else COMMON + NAMED
    missing = [name for name in wanted if name not in header]
    if missing:
        alternative = "" if "id" in header else "; instead of focus, role, number there may be one column id (10 * number + focus)"
        problems.append(f"missing columns: {', '.join(missing)}{alternative}")
    if "id" in header and set(NAMED) & set(header):
        problems.append("give either the column id or focus, role, number, not both")
    if not has_rows:
        problems.append("there is no point in it")
    if problems:
        raise PointsError(f"{path}: " + "; ".join(problems))


def _read_row(line: int, row: Row, cage: Cage | None) -> tuple[_Point | None, list[str]]:
    problems = [f"{name} is empty" for name in ("subject", "exam") if not row[name]]
    name = _name_by_id(row["id"], cage, problems) if "id" in row else _name_by_columns(row, problems)
    position = (_number(row, "col_px", problems), _number(row, "row_px", problems))
    covariance = _covariance(row, problems)
    if (shape := row.get("shape", "")) not in SHAPES:
        problems.append(f"shape {shape!r} is none of ball, pin, tee")
    flags = 0
    for flag in filter(None, row.get("flags", "").split(";")):
        if flag.strip() not in FLAGS:
            problems.append(f"flag {flag!r} is not known")
        flags |= FLAGS.get(flag.strip(), 0)
    if problems or name is None:
        return None, problems
    return _Point(line, (row["subject"], row["exam"]), name, position, covariance, shape, flags, row.get("file", "")), []


def _number(row: Row, column: str, problems: list[str]) -> float:
    try:
        value = float(row[column])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        problems.append(f"{column} is {row[column]!r}, not a finite number")
    return value


def _covariance(row: Row, problems: list[str]) -> tuple[float, float, float]:
    given = [column for column in COVARIANCE if row.get(column, "").lower() not in ("", "nan")]
    if not given:
        return math.nan, math.nan, math.nan
    if not {"sd_col_px", "sd_row_px"} <= set(given):
        problems.append("sd_col_px and sd_row_px must both be given, or none of the covariance columns")
        return math.nan, math.nan, math.nan
    values = {column: _number(row, column, problems) for column in given}
    sd_col, sd_row, cov = values["sd_col_px"], values["sd_row_px"], values.get("cov_col_row_px2", 0.0)
    if sd_col < 0 or sd_row < 0 or abs(cov) > sd_col * sd_row * (1 + 1e-6):  # rounded in print
        problems.append(f"sd_col_px {sd_col:g}, sd_row_px {sd_row:g}, cov_col_row_px2 {cov:g} are no covariance")
    return sd_col**2, sd_row**2, cov


def _name_by_columns(row: Row, problems: list[str]) -> Name | None:
    role, number = row["role"], row["number"]
    if role not in ROLES:
        problems.append(f"role {role!r} is none of {', '.join(ROLES)}")
        return None
    if role == "unassigned":
        return int(row["focus"]) if row["focus"].isdecimal() else 0, role, ""
    if not row["focus"].isdecimal() or int(row["focus"]) < 1:
        problems.append(f"focus {row['focus']!r} is not a number from 1")
        return None
    if role in ("fiducial", "control"):
        if not number.isdecimal():
            problems.append(f"number {number!r} of a {role} mark is not a number of the cage")
            return None
        number = str(int(number))
    elif not number:
        problems.append("number of an object point is empty")
        return None
    return int(row["focus"]), role, number


def _name_by_id(text: str, cage: Cage | None, problems: list[str]) -> Name | None:
    if not text.isdecimal() or int(text) < 11:
        problems.append(f"id {text!r} is not an identification number (10 * number + focus)")
        return None
    number, focus = divmod(int(text), 10)
    figures = "fiducial" if number < 10 else "control" if number < 100 else "object"
    if focus < 1 or (cage is not None and focus not in cage.foci):
        problems.append(f"id {text}: its last figure {focus} is no focus" + (f" of cage {cage.name}" if cage and focus else ""))
        return None
    if cage is None:
        if number == 10:
            problems.append(f"id {text}: fiducial mark 10, or control point 10? give the cage")
            return None
        return focus, figures, str(number)
    roles = {mark.role for mark in cage.mark if mark.number == number and focus in mark.foci}
    roles = roles or {mark.role for mark in cage.mark if mark.number == number}  # seen by another focus only
    if not roles and figures == "object":
        return focus, "object", str(number)
    if len(roles) == 1 and figures != "object":
        return focus, roles.pop(), str(number)
    if roles:
        problems.append(f"id {text} can be more than one point with cage {cage.name}: give the columns focus, role, number instead")
    else:
        problems.append(f"id {text}: cage {cage.name} has no mark {number}, and object points have more than three figures")
    return None


def _table(points: list[_Point]) -> ImagePoints:
    files = list(dict.fromkeys(point.file for point in points))
    variances = np.array([point.covariance for point in points])
    return ImagePoints(
        focus=np.array([point.name[0] for point in points], dtype=np.int64),
        role=np.array([point.name[1] for point in points], dtype=np.str_),
        number=np.array([point.name[2] for point in points], dtype=np.str_),
        shape=np.array([point.shape for point in points], dtype=np.str_),
        position_px=np.array([point.position for point in points], dtype=np.float64),
        covariance_px2=variances[:, [0, 2, 2, 1]].reshape(-1, 2, 2),
        flags=np.array([point.flags for point in points], dtype=np.int64),
        film=np.array([files.index(point.file) for point in points], dtype=np.int64),
    )
