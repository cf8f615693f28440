"""Known bodies whose coordinates have errors, as their markers were first measured.

Coordinates from CT have errors of tenths of a millimetre, and a marker that moves by less does not show against them. Against where it was
when it was first measured it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsa_vision.identify.poses import Cloud, Pairs, Placement


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A body in an examination: its pose, and which of its markers are which of the points."""

    placement: Placement
    pairs: Pairs
    points: Cloud


def as_measured(body: Cloud, seen: Sequence[Seen]) -> Cloud:
    """Return a body with its markers where they were first measured.

    Parameters
    ----------
    body : Cloud
        As it is known beforehand.
    seen : sequence of Seen
        In examinations, in order of time; each placed by what the ones before it made of the body.

    Returns
    -------
    Cloud
        In the frame of `body`, with the covariances of the points that stand in.

    Notes
    -----
    A point ``r`` goes back by ``Rᵀ (r − t)``, its covariance C by ``Rᵀ C R``. The error of the first pose moves all markers measured there
    alike, so that it counts with the others, as does that of a later pose with the markers first measured by it.
    """
    position, covariance = body.position_mm.copy(), body.covariance_mm2.copy()
    measured: set[int] = set()
    for one in seen:
        new = [(i, a) for i, a in one.pairs if i not in measured]
        if not new:
            continue
        turn, by_pose = one.placement.rotation, one.placement.predict(position)[1]
        if not measured:
            covariance += turn.T @ by_pose @ turn
        marker, point = np.array(new, np.int64).T
        errors = one.points.covariance_mm2[point] + (by_pose[marker] if measured else 0.0)
        position[marker] = (one.points.position_mm[point] - one.placement.translation) @ turn
        covariance[marker] = turn.T @ errors @ turn
        measured |= set(marker.tolist())
    return Cloud(position, covariance)
