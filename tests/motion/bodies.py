"""Subjects made of rigid segments that move as told: tables of markers, and the motions that are true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rsa_vision.kinematics.kinema import Columns, motions
from rsa_vision.kinematics.series import MarkerTable, make_series
from rsa_vision.settings import Limits, Motion

SEGMENTS = ("bone", "cup", "stem")


@dataclass(frozen=True)
class Subject:
    """Markers of each segment, and the pose of each segment in each examination."""

    markers: dict[str, np.ndarray]
    rotation: dict[tuple[int, str], Rotation]
    shift: dict[tuple[int, str], np.ndarray]

    def place(self, exam: int, segment: str) -> np.ndarray:
        return self.rotation[exam, segment].apply(self.markers[segment]) + self.shift[exam, segment]


def subject(
    rng: np.random.Generator,
    *,
    exams: int = 3,
    segments: tuple[str, ...] = SEGMENTS,
    markers: int = 5,
    angle_deg: float = 10,
    shift_mm: float = 5,
) -> Subject:
    """Make a subject whose segments turn by `angle_deg` at most and move by about `shift_mm` from each pose to any other."""
    shapes = {name: rng.normal(0, 15, (markers, 3)) + rng.normal(0, 60, 3) for name in segments}
    rotation, shift = {}, {}
    for exam in range(exams):
        for name in segments:
            axis = rng.normal(0, 1, 3)
            rotation[exam, name] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(angle_deg * rng.uniform() if exam else 0))
            shift[exam, name] = rng.normal(0, shift_mm, 3) if exam else np.zeros(3)
    return Subject(shapes, rotation, shift)


def exam_name(exam: int) -> str:
    return f"2026{exam + 1:02d}010900"


def table(subjects: list[Subject], rng: np.random.Generator | None = None, covariance: np.ndarray | None = None) -> MarkerTable:
    """Return the markers of subjects, with noise of a covariance where one is given; without one the table has none."""
    rows, places = [], []
    for number, one in enumerate(subjects):
        for exam, segment in one.rotation:
            points = one.place(exam, segment)
            rows += [(f"S{number + 1:03d}", exam_name(exam), segment, str(k + 1)) for k in range(len(points))]
            places.append(points)
    position = np.concatenate(places)
    if covariance is not None and rng is not None:
        position = position + rng.multivariate_normal(np.zeros(3), covariance, len(position))
    own = np.full((3, 3), np.nan) if covariance is None else covariance
    texts = np.array(rows)
    return MarkerTable(
        texts[:, 0], texts[:, 1], texts[:, 2], texts[:, 3], position, np.tile(own, (len(rows), 1, 1)), np.zeros(len(rows), np.int64)
    )


def analyse(markers: MarkerTable, reference: str | None = None, limits: Limits | None = None, **settings: object) -> Columns:
    return motions(make_series(markers), Motion(reference=reference, **settings), limits or Limits(stable_mm=5.0, e_rb_mm=5.0))


def pick(columns: Columns, **key: str) -> int:
    """Return the one row with these keys."""
    rows = np.flatnonzero(np.logical_and.reduce([columns[name] == value for name, value in key.items()]))
    assert len(rows) == 1, key
    return int(rows[0])


def vector(columns: Columns, pattern: str, row: int) -> np.ndarray:
    """Return the columns ``pattern`` with x, y, z in the place of ``?`` of one row."""
    return np.array([columns[pattern.replace("?", axis)][row] for axis in "xyz"], float)
