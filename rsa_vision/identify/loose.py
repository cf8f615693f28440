"""Which markers of rigid groups are loose: not where the others of their group are, unless the group is two bodies.

Bodies that have moved little against each other may be found as one group, which holds names together and tells nothing of who moved:
its markers are then off by many of their errors without one of them being loose.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from scipy.special import gammaln

from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.candidates import LOOSE, LOOSE_MM
from rsa_vision.identify.constellation import LOOSE_SIGMA, log_usual
from rsa_vision.identify.groups import rigid_groups
from rsa_vision.identify.poses import Cloud, Pairs, place

APART_MM: Final = 10.0  # how far a body may have moved against another


def loose_pairs(bodies: Sequence[Pairs], before: Cloud, points: Cloud, posterior: float) -> set[tuple[int, int]]:
    """Say which markers are not where the others of their rigid group say.

    Parameters
    ----------
    bodies : sequence of tuple of (earlier point, point)
        As of :func:`rsa_vision.identify.constellation.match_bodies`.
    before, points : Cloud
    posterior : float
        Least probability that these are other groups, of whose markers fewer are loose.

    Returns
    -------
    set of (earlier point, point)
        Those more than :data:`LOOSE_SIGMA` standard deviations off.

    Notes
    -----
    Against the groups as they were found stand those of which the distances speak (:mod:`groups`). The log odds of either are the sum of
    ``log L`` over the groups without their loose markers (:mod:`constellation`), ``log u − log 8π²V`` for each group but the largest
    (rotation against that one, ball of :data:`APART_MM`), ``log p − log V`` for each loose marker (ball of :data:`LOOSE_MM`), and the
    logarithm of one over the number of ways to part so many markers into groups of these sizes.
    """
    loose = {pair for body in bodies for pair, moved in zip(body, _have_moved(body, bodies, before, points), strict=True) if moved}
    if not loose:
        return loose
    pairs = sorted(pair for body in bodies for pair in body)
    marks, hits = np.array(pairs, np.int64).T
    parts = [tuple(pairs[k] for k in group.members) for group in rigid_groups([before.rows(marks), points.rows(hits)])]
    parts = [part for part in parts if len(part) >= LEAST_POINTS]
    others = set(pairs) - {pair for part in parts for pair in part}
    others |= {pair for part in parts for pair, sigma in zip(part, _sigmas(part, before, points), strict=True) if sigma > LOOSE_SIGMA}
    as_found = _log_odds([body for body in bodies if len(body) >= LEAST_POINTS], loose, before, points)
    parted = _log_odds(parts, others, before, points)
    return others if parted - as_found > np.log(posterior / (1 - posterior)) else loose


def _log_odds(groups: Iterable[Pairs], loose: set[tuple[int, int]], before: Cloud, points: Cloud) -> float:
    kept = [rest for group in groups if len(rest := tuple(pair for pair in group if pair not in loose)) >= LEAST_POINTS]
    placed = [(rest, placement) for rest in sorted(kept, key=len, reverse=True) if (placement := place(before, points, rest))]
    if not placed or len(placed) < len(kept):
        return -np.inf
    (_, largest), *others = placed
    free = float(np.log(8 * np.pi**2) + _log_ball(APART_MM))
    likely = largest.log_likelihood + sum(one.log_likelihood + log_usual(largest.rotation, one.rotation) - free for _, one in others)
    sizes = np.array([len(rest) for rest in kept])
    ways = float(gammaln(sizes.sum() + 1) - gammaln(sizes + 1).sum())
    return likely + len(loose) * float(np.log(LOOSE) - _log_ball(LOOSE_MM)) - ways


def _log_ball(radius_mm: float) -> float:
    return float(np.log(4 / 3 * np.pi * radius_mm**3))


def _have_moved(body: Pairs, bodies: Sequence[Pairs], before: Cloud, points: Cloud) -> list[bool]:
    """Say which markers of a rigid group are not where its others say; of too small a group, where none of the larger ones does.

    Some of a larger group may have been enough to name a marker that all of it would not.
    """
    if len(body) >= LEAST_POINTS:
        return [sigma > LOOSE_SIGMA for sigma in _sigmas(body, before, points)]
    whole = [other for other in bodies if len(other) >= LEAST_POINTS]
    return [bool(whole) and all(_sigmas((*other, pair), before, points)[-1] > LOOSE_SIGMA for other in whole) for pair in body]


def _sigmas(pairs: Pairs, before: Cloud, points: Cloud) -> list[float]:
    placement = place(before, points, pairs)
    return [0.0] * len(pairs) if placement is None else placement.sigmas.tolist()
