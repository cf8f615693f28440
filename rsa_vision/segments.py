"""Known segments: the constellation of markers in each bone or implant (``segments.csv``)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from rsa_vision.errors import SettingsError
from rsa_vision.types import Float

COLUMNS: Final = ("subject", "segment", "marker", "x_mm", "y_mm", "z_mm")
SD_COLUMNS: Final = ("sd_x_mm", "sd_y_mm", "sd_z_mm")  # all or none
LEAST_MARKERS: Final = 3
LEAST_HEIGHT_MM: Final = 1.0  # of the markers from the line that fits them best
LEAST_DISTANCE_MM: Final = 0.2  # less is the same marker twice
MOST_SD_MM: Final = 0.5  # with more, 4.5 sd of two markers, twice as large as stated, reach from one marker of a bone to the next


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Markers that move as one rigid body.

    Attributes
    ----------
    name : str
    markers : tuple of str
    position_mm : ndarray of shape (n, 3)
        In any rigid frame.
    sd_mm : ndarray of shape (n, 3), optional
        Standard deviations of these coordinates, independent of each other; None: they are exact.
    problem : str
        Why its markers cannot be known again, and what to do; empty if they can.
    """

    name: str
    markers: tuple[str, ...]
    position_mm: Float
    sd_mm: Float | None = None
    problem: str = ""


Segments = Mapping[str, Sequence[Segment]]
"""Segments by subject; those of the empty subject belong to everybody."""


def segments_of(segments: Segments, subject: str) -> list[Segment]:
    """Return the segments of a subject: its own, and those of everybody that it has not."""
    own = list(segments.get(subject, ()))
    names = {segment.name for segment in own}
    return own + ([segment for segment in segments.get("", ()) if segment.name not in names] if subject else [])


def read_segments(path: Path) -> dict[str, list[Segment]]:
    """Read the segments of all subjects.

    Parameters
    ----------
    path : Path
        CSV file with the columns subject (may be empty: of everybody), segment, marker, x_mm, y_mm, z_mm, and sd_x_mm, sd_y_mm, sd_z_mm
        if the coordinates have errors; others are ignored.

    Returns
    -------
    dict of str to list of Segment
        By subject, in the order of the file; those whose markers do not determine a pose say so as their problem.

    Raises
    ------
    SettingsError
        If it cannot be read, lacks columns, names a marker twice or not at all, or has values that are no numbers or impossible standard
        deviations; every error is listed with its line.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            header = [name.strip() for name in next(reader, [])]
            lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cell.strip() for cell in cells)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SettingsError(f"{path}: not a readable CSV file ({error}); give a table with the columns {', '.join(COLUMNS)}") from error
    problems = [f"column {name} is missing" for name in COLUMNS if name not in header]
    problems += [f"column {name} stands twice" for name in (*COLUMNS, *SD_COLUMNS) if header.count(name) > 1]
    with_sd = any(name in header for name in SD_COLUMNS)
    lacking = [name for name in SD_COLUMNS if name not in header] if with_sd else []
    problems += [f"column {name} is missing: give the standard deviations of all three coordinates, or none" for name in lacking]
    if not (lines or problems):
        problems.append("there is no marker in it")
    found: dict[tuple[str, str], dict[str, tuple[float, ...]]] = {}
    if not problems:
        for line, cells in lines:
            problems += [f"line {line}: {problem}" for problem in _read_line(header, cells, found)]
    if problems:
        raise SettingsError(f"{path}: wrong segments\n" + "\n".join(f"  {problem}" for problem in problems))
    result: dict[str, list[Segment]] = {}
    for (subject, name), markers in found.items():
        values = np.array(list(markers.values()))
        place, sd = values[:, :3], values[:, 3:]
        problem = _problem(subject, name, tuple(markers), place)
        result.setdefault(subject, []).append(Segment(name, tuple(markers), place, sd if sd.any() else None, problem))
    return result


def segments_csv(subjects: Iterable[tuple[str, Sequence[Segment]]]) -> str:
    """Return segments as the text of a ``segments.csv``; the rest of the digits of a micrometre is left out."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for subject, segments in subjects:
        for segment in segments:
            for marker, place in zip(segment.markers, segment.position_mm.tolist(), strict=True):
                writer.writerow([subject, segment.name, marker, *(f"{value:.4f}" for value in place)])
    return text.getvalue()


def _read_line(header: list[str], cells: list[str], found: dict[tuple[str, str], dict[str, tuple[float, ...]]]) -> list[str]:
    if len(cells) != len(header):
        return [f"{len(cells)} values for {len(header)} columns"]
    row = dict(zip(header, cells, strict=True))
    problems = [f"{name} is empty" for name in ("segment", "marker") if not row[name]]
    problems += [f"{name} {row[name]!r} must not hold a slash" for name in ("segment", "marker") if "/" in row[name]]
    place = [_number(row[axis]) for axis in COLUMNS[3:]]
    problems += [
        f"{axis} is {row[axis]!r}, not a finite number" for axis, x in zip(COLUMNS[3:], place, strict=True) if not math.isfinite(x)
    ]
    sd = {name: _number(row[name]) for name in SD_COLUMNS if name in header}
    for name in (name for name, value in sd.items() if not 0 <= value <= MOST_SD_MM):
        told = f"{name} of {row['segment']}/{row['marker']} is {row[name]!r}, not a standard deviation of 0 to {MOST_SD_MM:g} mm"
        problems.append(f"{told}: correct it (0: exact), or leave the marker out")
    markers = found.setdefault((row["subject"], row["segment"]), {})
    if row["marker"] in markers:
        problems.append(f"marker {row['segment']}/{row['marker']} stands there already")
    markers[row["marker"]] = (*place, *sd.values())
    return problems


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _problem(subject: str, name: str, markers: Sequence[str], places: Float) -> str:
    whose = f"segment {name}" + (f" of {subject}" if subject else "") + " in segments.csv"
    if len(markers) < LEAST_MARKERS:
        return f"{whose}: {len(markers)} markers, {LEAST_MARKERS} or more are needed to know it again: add markers or leave it out"
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    same = [f"{markers[i]} and {markers[j]}" for i, j in np.argwhere(apart < LEAST_DISTANCE_MM).tolist() if i < j]
    if same:
        return f"{whose}: {', '.join(same)} are the same place: correct one of them"
    if np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] < LEAST_HEIGHT_MM:
        return f"{whose}: its markers lie in line and determine no pose: add a marker beside the line, or leave it out"
    return ""
