"""The examinations of one subject in order of time, with their segments: what motion, growth and precision start from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Final

import numpy as np

from rsa_vision.flags import MarkerFlag
from rsa_vision.ordering import natural_key
from rsa_vision.types import Bool, Float, Int, Str, Table

CENTURY: Final = 70  # two-figure years from here on are of the 20th century (Selvik's numbers of ten figures)
DAY_S: Final = 86400.0
DATED: Final = re.compile(
    r"(?P<date>\d{4}(?P<mark>[-./]?)\d\d(?P=mark)\d\d|\d{10}|\d{12})(?:[T ]?(?P<time>\d\d:?\d\d)(?::\d\d(?:\.\d+)?)?)?(?P<letter>[a-z]?)",
    re.IGNORECASE,
)
DAY_OR_MONTH_FIRST: Final = re.compile(r"\d{1,2}([-./])\d{1,2}\1(\d{4}|\d{2})(\D.*)?")
REPEAT: Final = re.compile(r"(?P<first>.+)(?P<letter>[b-z])", re.IGNORECASE)

DOUBTFUL: Final = MarkerFlag.LOOSE | MarkerFlag.AMBIGUOUS  # the marker has moved in its bone, or it may be another one


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTable(Table):
    """Markers of many examinations (the rows of ``markers.csv``).

    Attributes
    ----------
    subject, exam, segment, marker : ndarray of str, shape (n,)
    position_mm : ndarray of shape (n, 3)
        NaN where not determined.
    covariance_mm2 : ndarray of shape (n, 3, 3)
        NaN where not known.
    flags : ndarray of int, shape (n,)
        As of :class:`rsa_vision.flags.MarkerFlag`; predicted, loose and ambiguous markers are not used.
    """

    subject: Str
    exam: Str
    segment: Str
    marker: Str
    position_mm: Float
    covariance_mm2: Float
    flags: Int


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """One segment in all E examinations of a subject.

    Attributes
    ----------
    name : str
    markers : tuple of str
        All n that any examination has, in order.
    position_mm : ndarray of shape (E, n, 3)
        NaN where a marker is missing, stands twice, or must not be used.
    covariance_mm2 : ndarray of shape (E, n, 3, 3)
    duplicate, predicted, doubtful : ndarray of bool, shape (E, n)
        Why not: twice in an examination; placed by the known segment, not by rays; flagged loose or ambiguous.
    """

    name: str
    markers: tuple[str, ...]
    position_mm: Float
    covariance_mm2: Float
    duplicate: Bool
    predicted: Bool
    doubtful: Bool

    @property
    def present(self) -> Bool:
        """Which markers have coordinates, shape (E, n)."""
        result: Bool = np.all(np.isfinite(self.position_mm), axis=2)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """All examinations of a subject.

    Attributes
    ----------
    subject : str
    exams : tuple of str
        In order of time.
    days : ndarray of shape (E,)
        Since the first one; NaN where a name is no date.
    repeat_of : ndarray of int, shape (E,)
        Index of the examination that one repeats (double examination), else -1.
    segments : tuple of Segment
    status : tuple of str
        Of each examination: ``ok``, ``review`` or ``failed``; ``ok`` where not known.
    """

    subject: str
    exams: tuple[str, ...]
    days: Float
    repeat_of: Int
    segments: tuple[Segment, ...]
    status: tuple[str, ...] = field(default=())


@lru_cache(maxsize=65536)
def exam_time(exam: str) -> datetime | None:
    """Return the time that the name of an examination tells, or None.

    Parameters
    ----------
    exam : str
        ``yyyymmdd``, ``yyyymmddhhmm``, ``yyyy-mm-dd`` (also with ``.`` or ``/``, with or without a time ``hh:mm``), or Selvik's ten
        figures ``yymmddhhmm``; a letter after it marks a repeat.

    Returns
    -------
    datetime or None
    """
    match = DATED.fullmatch(exam)
    if match is None:
        return None
    figures = re.sub(r"\D", "", match["date"])
    if len(figures) == 10:
        figures = ("19" if int(figures[:2]) >= CENTURY else "20") + figures
    figures += re.sub(r"\D", "", match["time"] or "")
    try:
        return datetime.strptime(figures.ljust(12, "0"), "%Y%m%d%H%M")
    except ValueError:
        return None


def order_is_unclear(exams: Sequence[str]) -> bool:
    """Return whether the names of a subject's examinations do not tell their order in time.

    They do where all are times, single letters, or differ in numbers alone (``3m``, ``12m``; a letter more marks a repeat); dates with the
    day or the month first do not, nor do words (``preop``, ``1y``, ``6m``).
    """
    if all(exam_time(exam) for exam in exams) or all(len(exam) == 1 for exam in exams):
        return False
    names = {exam.lower() for exam in exams}
    repeats = {name for name in names if name[:-1] in names or f"{name[:-1]}a" in names}
    frames = {re.sub(r"\d+", "0", name[:-1] if name in repeats else name) for name in names}
    return len(exams) > 1 and (len(frames) > 1 or any(DAY_OR_MONTH_FIRST.fullmatch(exam) for exam in exams))


def make_series(table: MarkerTable, status: Mapping[tuple[str, str], str] | None = None) -> tuple[Series, ...]:
    """Sort markers into subjects, examinations and segments.

    Parameters
    ----------
    table : MarkerTable
        Rows without a segment are left out.
    status : mapping of (subject, exam) to str, optional
        Of the examinations, also of those without markers.

    Returns
    -------
    tuple of Series
        By subject.
    """
    known = dict(status or {})
    rows: dict[str, dict[str, list[int]]] = {}
    exams: dict[str, set[str]] = {}
    for subject, exam in known:
        exams.setdefault(subject, set()).add(exam)
    subjects, names, segments = table.subject.tolist(), table.exam.tolist(), table.segment.tolist()
    for i, (subject, exam, segment) in enumerate(zip(subjects, names, segments, strict=True)):
        exams.setdefault(subject, set()).add(exam)
        if segment:
            rows.setdefault(subject, {}).setdefault(segment, []).append(i)
    return tuple(_one_series(table, subject, exams[subject], rows.get(subject, {}), known) for subject in sorted(exams, key=natural_key))


def _one_series(
    table: MarkerTable, subject: str, exams: set[str], rows: Mapping[str, list[int]], status: Mapping[tuple[str, str], str]
) -> Series:
    times = {exam: exam_time(exam) for exam in exams}
    if all(times.values()):
        ordered = tuple(sorted(exams, key=lambda exam: (times[exam], natural_key(exam))))
    else:
        ordered = tuple(sorted(exams, key=natural_key))
    first = times[ordered[0]]
    days = [(time - first).total_seconds() / DAY_S if first and (time := times[exam]) else np.nan for exam in ordered]
    segments = tuple(_segment(table, name, rows[name], ordered) for name in sorted(rows, key=natural_key))
    states = tuple(status.get((subject, exam), "ok") for exam in ordered)
    return Series(subject, ordered, np.array(days), _repeats(ordered), segments, states)


def _repeats(exams: Sequence[str]) -> Int:
    """``1a`` is an examination of its own, ``1b`` a repeat if there is a ``1`` or ``1a``."""
    index = {exam: place for place, exam in enumerate(exams)}
    found = []
    for exam in exams:
        match = REPEAT.fullmatch(exam)
        # words may end in a letter: only after a figure, or as b, it means a repeat
        marks = match is not None and (match["first"][-1].isdecimal() or match["letter"] in "bB")
        original = next((index[name] for name in (match["first"], match["first"] + "a") if name in index), -1) if match and marks else -1
        found.append(original)
    return np.array(found, np.int64)


def _segment(table: MarkerTable, name: str, rows: Sequence[int], exams: Sequence[str]) -> Segment:
    at = np.array(rows)
    place = {exam: index for index, exam in enumerate(exams)}
    labels = table.marker[at].tolist()
    markers = tuple(sorted(set(labels), key=natural_key))
    column = {marker: index for index, marker in enumerate(markers)}
    e = np.array([place[exam] for exam in table.exam[at].tolist()])
    m = np.array([column[label] for label in labels])
    count = np.zeros((len(exams), len(markers)), np.int64)
    np.add.at(count, (e, m), 1)
    duplicate = count > 1
    flags = np.zeros_like(count)
    flags[e, m] = table.flags[at]
    predicted, doubtful = flags & MarkerFlag.PREDICTED > 0, flags & DOUBTFUL > 0
    position = np.full((*duplicate.shape, 3), np.nan)
    covariance = np.full((*duplicate.shape, 3, 3), np.nan)
    position[e, m], covariance[e, m] = table.position_mm[at], table.covariance_mm2[at]
    unusable = duplicate | predicted | doubtful | ~np.isfinite(position).all(axis=2)
    position[unusable] = np.nan
    return Segment(name, markers, position, covariance, duplicate, predicted, doubtful)
