"""Follow-ups whose films lay otherwise, where the cage looks the same: its marks cannot tell, but the markers of the subject can."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.followup import judged
from rsa_vision.geometry.rigid import LEAST_POINTS, fit_rigid
from rsa_vision.tables import AXES, Rows, name_of
from rsa_vision.types import Float
from rsa_vision.verdict import Finding

MOST_TURNED_DEG: Final = 45.0  # by which a patient may lie otherwise besides


def with_turned_reviewed(exams: Sequence[Rows], turns: Sequence[Float]) -> list[Rows]:
    """Have those examinations reviewed whose markers are all turned as a film that was turned would show them.

    Parameters
    ----------
    exams : sequence of dict
        Rows of the tables of each examination, markers named, those of a subject in the order of time.
    turns : sequence of ndarray of shape (3, 3)
        Rotations that the marks of the cage do not tell (:func:`rsa_vision.cage_symmetry.turns`).

    Returns
    -------
    list of dict
        With the reason ``cage-ambiguous`` where all markers that an examination shares with the first one of its subject that has three of
        them are turned so, to :data:`MOST_TURNED_DEG`.
    """
    earlier: dict[str, list[tuple[str, dict[str, Float]]]] = {}
    result: list[Rows] = []
    for rows in exams:
        about = rows["exams"][0]
        places = {name_of(row): np.array([row[axis] for axis in AXES]) for row in rows["markers"] if row["x_mm"] is not None}
        before = earlier.setdefault(about["subject"], [])
        found = _finding(before, places, turns)
        before.append((about["exam"], places))
        result.append({**rows, "exams": [judged(about, found)]} if found else rows)
    return result


def _finding(before: Iterable[tuple[str, Mapping[str, Float]]], places: Mapping[str, Float], turns: Sequence[Float]) -> list[Finding]:
    for exam, known in before if turns else ():
        if len(both := sorted(known.keys() & places.keys())) < LEAST_POINTS:
            continue
        try:
            turned = fit_rigid(*(np.array([of[name] for name in both]) for of in (known, places))).rotation
        except GeometryError:  # markers in line tell no rotation
            continue
        if any(_angle_deg(turned @ turn.T) < MOST_TURNED_DEG for turn in turns):
            told = f"all markers are turned by {_angle_deg(turned):.0f} deg against examination {exam}"
            return [("cage-ambiguous", f"{told}: did one of the films lie otherwise? The marks of this cage cannot tell")]
        return []
    return []


def _angle_deg(rotation: Float) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
