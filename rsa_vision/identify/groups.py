"""Rigid groups suggested by several examinations: markers whose distances from each other stay the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.identify.poses import TOLERANCE_MM, Cloud, distances
from rsa_vision.types import Float

MOVED_MM: Final = 1.0  # sd of the change of a distance between markers of bodies that move
SMALLEST: Final = 3


@dataclass(frozen=True, slots=True)
class Group:
    """Markers that seem to be one rigid body.

    Attributes
    ----------
    members : tuple of int
    probability : float
        Of the doubtful decision about it: of the two of its markers that are least surely rigid to each other, or of the two groups
        that are least surely apart.
    change_um : float
        Root mean square of the changes of the distances within.
    """

    members: tuple[int, ...]
    probability: float
    change_um: float


def rigid_groups(exams: Sequence[Cloud]) -> list[Group]:
    """Group the markers of several examinations.

    Parameters
    ----------
    exams : sequence of Cloud
        The same markers in every examination; NaN where a marker is missing.

    Returns
    -------
    list of Group
        By their first members, also those with fewer than three.

    Notes
    -----
    The change Δ of a distance since the first examination that shows both markers, of variance v by the markers' errors and the tolerance,
    speaks for one body with ``Σ log N(Δ; v) − log N(Δ; v + MOVED²)``. Groups are merged while every pair of both speaks for it, the surest
    first (complete linkage).
    """
    odds, changes = _log_odds(exams)
    groups = [[i] for i in range(len(odds))]
    while len(groups) > 1:
        links = [(float(odds[np.ix_(a, b)].min()), p, q) for p, a in enumerate(groups) for q, b in enumerate(groups) if p < q]
        best, p, q = max(links, key=lambda link: (link[0], -link[1], -link[2]))
        if best <= 0:
            break
        groups[p] = sorted(groups[p] + groups[q])
        del groups[q]
    result = []
    for members in sorted(groups):
        rest = np.setdiff1d(np.arange(len(odds)), members)
        inside = odds[np.ix_(members, members)][np.triu_indices(len(members), 1)]
        others = [odds[np.ix_(members, other)].min() for other in groups if len(other) >= SMALLEST and set(other) <= set(rest.tolist())]
        doubt = min([*inside.tolist(), *(-float(value) for value in others)], default=0.0)
        moved = changes[:, members][:, :, members]
        known = moved[np.isfinite(moved) & (moved != 0)]
        change = float(1000 * np.sqrt((known**2).mean())) if len(known) else 0.0
        result.append(Group(tuple(members), float(1 / (1 + np.exp(-doubt))), change))
    return result


def _log_odds(exams: Sequence[Cloud]) -> tuple[Float, Float]:
    """Return for all pairs the log odds of one body, and the changes of their distances, shape (exams, n, n)."""
    length, variance = (np.stack(parts) for parts in zip(*(distances(exam) for exam in exams), strict=True))
    n = length.shape[1]
    first = np.isfinite(length).argmax(axis=0)
    at = (first, *np.indices((n, n)))
    change = length - length[at]
    spread = variance + variance[at] + 4 * TOLERANCE_MM**2
    later = np.isfinite(change) & (np.arange(len(exams))[:, None, None] > first)
    with np.errstate(invalid="ignore"):
        wide = spread + MOVED_MM**2
        ratio = 0.5 * change**2 * (1 / wide - 1 / spread) + 0.5 * np.log(wide / spread)
    odds: Float = np.where(later, ratio, 0.0).sum(axis=0)
    return odds, np.where(later, change, np.nan)
