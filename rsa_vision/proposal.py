"""``segments propose``: rigid groups of the markers of finished examinations, as a ``segments.csv`` to look at and to correct."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsa_vision.contests import cloud_of
from rsa_vision.errors import GeometryError
from rsa_vision.geometry.rigid import fit_rigid
from rsa_vision.identify.groups import SMALLEST, rigid_groups
from rsa_vision.identify.poses import Cloud
from rsa_vision.segments import Segment
from rsa_vision.tables import Row
from rsa_vision.types import Float


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A segment that several examinations suggest.

    Attributes
    ----------
    subject : str
    segment : Segment
    probability : float
        As of :class:`rsa_vision.identify.groups.Group`.
    change_um : float
        Root mean square change of its distances.
    n_exams : int
        Examinations of the subject.
    """

    subject: str
    segment: Segment
    probability: float
    change_um: float
    n_exams: int


def propose(markers: Sequence[Row]) -> tuple[list[Proposal], dict[str, list[str]]]:
    """Suggest segments.

    Parameters
    ----------
    markers : sequence of dict
        Rows of ``markers.csv``; those without measured coordinates, loose or doubtful ones are left out.

    Returns
    -------
    proposals : list of Proposal
        Named S1, S2, ... by their first markers; coordinates of the examination that shows most, others brought into its frame.
    left : dict of str to list of str
        By subject the markers that belong to no group of three or more, and all of a subject with one examination.
    """
    proposals: list[Proposal] = []
    left: dict[str, list[str]] = {}
    for subject in sorted({row["subject"] for row in markers}):
        rows = [row for row in markers if row["subject"] == subject and _measured(row)]
        exams = sorted({row["exam"] or "" for row in rows})
        names = sorted({_name(row) for row in rows})
        clouds = [_filled([row for row in rows if (row["exam"] or "") == exam], names) for exam in exams]
        grouped: set[str] = set()
        for group in rigid_groups(clouds) if len(exams) > 1 else []:
            if len(group.members) < SMALLEST:
                continue
            members, places = _together(clouds, group.members)
            if len(members) < SMALLEST:
                continue
            count = sum(p.subject == subject for p in proposals)
            segment = Segment(f"S{count + 1}", tuple(names[i].replace("/", "-") for i in members), places)
            proposals.append(Proposal(subject, segment, group.probability, group.change_um, len(exams)))
            grouped |= {names[i] for i in members}
        left[subject] = [name for name in names if name not in grouped]
    return proposals, left


def _measured(row: Row) -> bool:
    flags = set((row["flags"] or "").split(";"))
    return row["x_mm"] is not None and not flags & {"predicted", "loose", "ambiguous"}


def _name(row: Row) -> str:
    return f"{row['segment']}/{row['marker']}" if row["segment"] else str(row["marker"])


def _filled(rows: Sequence[Row], names: Sequence[str]) -> Cloud:
    cloud = cloud_of(rows)
    position, covariance = np.full((len(names), 3), np.nan), np.full((len(names), 3, 3), np.nan)
    at = [names.index(_name(row)) for row in rows]
    position[at], covariance[at] = cloud.position_mm, cloud.covariance_mm2
    return Cloud(position, covariance)


def _together(clouds: Sequence[Cloud], members: Sequence[int]) -> tuple[list[int], Float]:
    """Return the members whose places in one frame are known, and these."""
    chosen = list(members)
    places = [cloud.position_mm[chosen] for cloud in clouds]
    best = max(places, key=lambda place: int(np.isfinite(place).all(axis=1).sum())).copy()
    for place in places:
        known, here = np.isfinite(best).all(axis=1), np.isfinite(place).all(axis=1)
        if (here & ~known).any() and (here & known).sum() >= SMALLEST:
            try:
                best[here & ~known] = fit_rigid(place[here & known], best[here & known]).move(place[here & ~known])
            except GeometryError:
                continue
    complete = np.flatnonzero(np.isfinite(best).all(axis=1)).tolist()
    return [chosen[k] for k in complete], best[complete]
