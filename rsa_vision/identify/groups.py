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
    speaks for one body with ``Σ log N(Δ; v) − log N(Δ; v + MOVED²)``. The largest set of which every pair speaks for it is a group (of
    equally large ones that with the largest sum), then the largest of the rest. At last each marker goes to
    the group that it fits best on average.
    """
    odds, changes = _log_odds(exams)
    groups: list[list[int]] = []
    left = list(range(len(odds)))
    while left:
        grown = [_grown(odds, start, left) for start in left]
        groups.append(max(grown, key=lambda group: (len(group), float(odds[np.ix_(group, group)].sum()), [-i for i in group])))
        left = [i for i in left if i not in groups[-1]]
    groups = _settled(odds, groups)
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


def _grown(odds: Float, start: int, left: Sequence[int]) -> list[int]:
    """Return the group about a marker: in the largest company first, as long as every pair speaks for one body."""
    group, others = [start], [i for i in left if i != start and odds[start, i] > 0]
    while others:
        company = [(sum(odds[i, j] > 0 for j in others), float(odds[i, group].min()), -i) for i in others]
        group.append(others[company.index(max(company))])
        others = [i for i in others if i not in group and odds[i, group].min() > 0]
    return sorted(group)


def _settled(odds: Float, groups: list[list[int]]) -> list[list[int]]:
    """Return the groups after markers have gone to where they fit best: one near two bodies may have been taken by the wrong one."""
    for _ in range(len(odds)):
        for i, mine in ((i, group) for group in groups for i in group):
            homes = [group for group in groups if len(set(group) - {i}) >= SMALLEST - 1 and odds[i, [j for j in group if j != i]].min() > 0]
            best = max(homes, key=lambda group: float(odds[i, [j for j in group if j != i]].mean()), default=mine)
            if best is not mine:
                groups = [sorted({*group, i}) if group is best else [j for j in group if j != i] for group in groups]
                groups = [group for group in groups if group]
                break
        else:
            break
    return groups


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
