"""Markers known again: constellations of known segments, or rigid groups of an earlier examination, among the points found.

Assignments (:mod:`poses`) compete for the points: all ways of explaining the points are summed (:mod:`packing`), and a name carries the sum
of the probabilities of all that give it. Below the limit there is no name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import expit, gammaln

from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.candidates import FOUND, LOOSE, LOOSE_MM, candidate_poses, disjoint, loose_triples
from rsa_vision.identify.packing import pack
from rsa_vision.identify.poses import GATE, Cloud, Pairs, Placement, nearness, place, volume_mm3
from rsa_vision.identify.twins import twins
from rsa_vision.types import Bool, Float, Int

STRAY: Final = 3.0  # expected points that belong to nothing known, at least
LOOSE_SIGMA: Final = 4.0  # residual of a marker that has moved
TURN_RAD: Final = 0.5  # sd of the rotation of a body about each axis since it was seen before,
TURNED: Final = 1e-3  # but for so many that are turned anyhow
NEGLIGIBLE: Final = -7.0  # log odds below which an assignment is not counted
MOST_RIVALS: Final = 60  # assignments of one body that compete
MOST_PARTS: Final = 8  # overlapping bodies that are taken apart


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What became of one segment.

    Attributes
    ----------
    pairs : tuple of (marker, point)
        Decisive names.
    doubtful : tuple of (marker, point)
        Names that are the best, but not decisive.
    loose : tuple of (marker, point)
        Markers that do not fit the rigid body: of `pairs`, and points that lie alone near the place of a marker that is missing.
    lost : tuple of int
        Markers without a point.
    placement : Placement or None
        By `pairs`; None with fewer than three.
    """

    pairs: Pairs
    doubtful: Pairs
    loose: Pairs
    lost: tuple[int, ...]
    placement: Placement | None

    def among(self, rows: Int) -> Known:
        """Return this of all points, if it was found among some of them: these rows."""
        pairs, doubtful, loose = (tuple((i, int(rows[a])) for i, a in some) for some in (self.pairs, self.doubtful, self.loose))
        return Known(pairs, doubtful, loose, self.lost, self.placement)


def match_segments(segments: Sequence[Cloud], points: Cloud, posterior: float, before: Sequence[Float | None] | None = None) -> list[Known]:
    """Find the markers of known segments among points; each segment has a pose of its own.

    Parameters
    ----------
    segments : sequence of Cloud
        Three markers or more each, in any frame.
    points : Cloud
    posterior : float
        Least probability of a name.
    before : sequence of (ndarray of shape (3, 3) or None), optional
        Rotation that each segment should nearly have, as in an earlier examination: names that turn it over have to hold against that, too.
        It makes no name likelier.

    Returns
    -------
    list of Known
        One of each segment.
    """
    volume = volume_mm3(points)
    stray = STRAY + max(0, len(points) - sum(map(len, segments)))
    rivals = [rival for index, body in enumerate(segments) for rival in _rivals(index, body, points, volume, stray)]
    rivals += _twins(segments, points, rivals, volume, stray)
    claims = [(*(a for _, a in (*rival.rigid, *rival.loose)), *rival.beyond, len(points) + rival.body) for rival in rivals]
    since = [None] * len(segments) if before is None else before
    usual = [0.0 if (turn := since[rival.body]) is None else log_usual(turn, rival.rotation) for rival in rivals]
    chosen, chances = _packed(claims, [rival.odds for rival in rivals], usual)
    known = []
    for index, segment in enumerate(segments):
        mine = [g for g, rival in enumerate(rivals) if rival.body == index]
        names = _names([(*rivals[g].rigid, *rivals[g].loose) for g in mine], chances[:, mine])
        best = next((rivals[g] for g in mine if chosen[g]), None)
        rigid, loose = ((), ()) if best is None else (best.rigid, best.loose)
        known.append(_known(segment, points, rigid, loose, names, posterior))
    return _with_loose(segments, points, known)


def _packed(claims: Sequence[tuple[int, ...]], odds: Sequence[float], usual: Sequence[float]) -> tuple[Bool, Float]:
    """Return the groups of the best explanation, and chances of all, shape (2, g): any rotation being as likely, and usual ones more."""
    packing = pack(claims, np.array(odds))
    as_usual = pack(claims, np.array(odds) + usual) if any(usual) else packing
    return packing.chosen, np.nan_to_num([packing.posterior, as_usual.posterior])


def log_usual(before: Float, after: Float) -> float:
    """Return the log density of a rotation after another one, over that of any rotation."""
    squared_rad = np.arccos(np.clip((np.trace(after @ before.T) - 1) / 2, -1, 1)) ** 2
    small = 8 * np.pi**2 / (2 * np.pi * TURN_RAD**2) ** 1.5 * np.exp(-squared_rad / (2 * TURN_RAD**2))
    return float(np.log(TURNED + (1 - TURNED) * small))


def likely_groups(segment: Cloud, points: Cloud, volume: float, stray: float) -> list[tuple[float, Pairs, Placement]]:
    """List the assignments of a segment to points.

    Parameters
    ----------
    segment, points : Cloud
    volume : float
        In which points may be, mm³.
    stray : float
        How many points are expected that belong to nothing known.

    Returns
    -------
    list of (log odds, pairs, Placement)
        Against all these points being strays, the likeliest first.
    """
    found = dict(candidate_poses(segment, points, float(np.log(volume / stray))))
    rivals = _sorted([(log_odds(len(segment), placement, pairs, volume, stray), pairs) for pairs, placement in found.items()])
    return [(odds, pairs, found[pairs]) for odds, pairs in rivals[:MOST_RIVALS]]


@dataclass(frozen=True, slots=True, eq=False)
class _Rival:
    """An assignment of a segment, with a marker that has moved, and points of markers that nobody knew."""

    body: int
    odds: float
    rigid: Pairs
    loose: Pairs
    rotation: Float
    beyond: tuple[int, ...] = ()


def _rivals(index: int, segment: Cloud, points: Cloud, volume: float, stray: float) -> list[_Rival]:
    """List the assignments of a segment, as they are and with one marker more that has moved in its bone: anywhere near its place.

    Without the latter a wrong assignment of all markers competes neither with the true one of those that have not moved, which may be two
    alone, nor with a stray point that happens to lie where the marker that moved is missing.
    """
    gain = np.log(LOOSE * FOUND / (1 - FOUND) * volume / stray / (4 / 3 * np.pi * LOOSE_MM**3))
    groups = likely_groups(segment, points, volume, stray)
    rivals: list[_Rival] = []
    for odds, pairs, placement in groups:
        lost, free = _others(len(segment), dict(pairs).keys()), _others(len(points), dict(pairs).values())
        away = np.linalg.norm(points.position_mm[free] - placement.predict(segment.position_mm[lost])[0][:, None], axis=-1)
        near = [((int(lost[i]), int(free[a])),) for i, a in np.argwhere(away < LOOSE_MM).tolist()]
        rivals.append(_Rival(index, odds, pairs, (), placement.rotation))
        rivals += [_Rival(index, odds + float(gain), pairs, one, placement.rotation) for one in near]
    triples = [pairs for _, pairs, _ in groups if len(pairs) == LEAST_POINTS]
    for pairs, placement in loose_triples(segment, points, triples):
        rivals.append(_Rival(index, log_odds(len(segment), placement, pairs, volume, stray), pairs[:2], pairs[2:], placement.rotation))
    rivals = [rival for rival in rivals if rival.odds > NEGLIGIBLE]
    return sorted(rivals, key=lambda rival: (-rival.odds, rival.rigid, rival.loose))[:MOST_RIVALS]


def _twins(segments: Sequence[Cloud], points: Cloud, rivals: Sequence[_Rival], volume: float, stray: float) -> list[_Rival]:
    """List the assignments once more with what else they may explain if segments are alike."""
    first = np.cumsum([0, *map(len, segments)]).tolist()
    rigid = {tuple((first[rival.body] + i, a) for i, a in rival.rigid): rival for rival in rivals if not rival.loose}
    if not rigid:
        return []
    markers = Cloud(*(np.concatenate([getattr(body, name) for body in segments]) for name in ("position_mm", "covariance_mm2")))
    alike = twins(markers, points, [(rival.odds, pairs) for pairs, rival in rigid.items()], volume, stray, whole=True)
    return [replace(rigid[pairs], odds=odds, beyond=beyond) for odds, pairs, beyond in alike]


def log_odds(n: int, placement: Placement, pairs: Pairs, volume: float, stray: float) -> float:
    """Return the log odds of an assignment of a segment of n markers, as :func:`likely_groups` does."""
    k = len(pairs)
    return _odds(placement, k, volume, stray) + k * float(np.log(FOUND)) + (n - k) * float(np.log(1 - FOUND))


def match_bodies(before: Cloud, points: Cloud, posterior: float) -> tuple[list[Pairs], Bool]:
    """Find again the points of an earlier examination where the rigid groups are not known.

    Parameters
    ----------
    before, points : Cloud
    posterior : float
        Least probability of a name.

    Returns
    -------
    bodies : list of tuple of (earlier point, point)
        Decisive names by the rigid group that shows them; none turned over since, unless no other explanation comes near.
    doubtful : ndarray of bool, shape (m,)
        Points that fit an earlier one, but not decisively.

    Notes
    -----
    What is decisive is fixed, and the rest looked at again: three markers left over are three of fewer that could be tried, and a group
    that shares three names or more with what is fixed is judged by what it adds.
    """
    volume = volume_mm3(points)
    listed = candidate_poses(before, points, float(np.log(volume / max(len(points), 1))))
    listed += _parts(before, points, listed)
    named: dict[int, int] = {}
    bodies: list[Pairs] = []
    chosen: list[Pairs] = []
    while True:
        mine, theirs = _others(len(before), named.keys()), _others(len(points), named.values())
        left = candidate_poses(before.rows(mine), points.rows(theirs), float(np.log(volume / max(len(theirs), 1)))) if named else []
        again = [(tuple((int(mine[i]), int(theirs[a])) for i, a in pairs), placement) for pairs, placement in left]
        rigid = {**dict(listed), **dict(again)}
        rivals = _additions(before, points, rigid, named, volume)
        few, uncounted = _counted(rivals, len(points))
        triples = [pairs for _, pairs, _ in few if pairs in rigid and len(pairs) == LEAST_POINTS]
        turned = dict(loose_triples(before, points, triples))
        alike = twins(before, points, [(odds, pairs) for odds, pairs, _ in few], volume, len(points), whole=False)
        usual = {pairs: one for _, pairs, one in few}
        competing = [*few, *_additions(before, points, turned, named, volume), *((odds, pairs, usual[pairs]) for odds, pairs, _ in alike)]
        beyond = [()] * (len(competing) - len(alike)) + [more for _, _, more in alike]
        chances, best = _summed(competing, len(points), beyond)
        chosen = [competing[g][1] for g in best]
        odds = {few[g][1]: few[g][0] for g in best if g < len(few)}  # what is best with a loose marker of three gets no names
        chances = _with_uncounted(chances, odds, uncounted)
        found = [kept for body in odds if (kept := tuple(pair for pair in body if chances[pair] >= posterior))]
        if not found:
            break
        bodies += found
        named |= {i: a for body in found for i, a in body}
    doubtful = np.zeros(len(points), bool)
    doubtful[[a for body in chosen for _, a in body]] = True
    return bodies, doubtful


def _others(n: int, taken: Iterable[int]) -> Int:
    return np.setdiff1d(np.arange(n), list(taken)).astype(np.int64)


def _parts(before: Cloud, points: Cloud, listed: Sequence[tuple[Pairs, Placement]]) -> list[tuple[Pairs, Placement]]:
    """Take overlapping bodies apart: bodies that have moved little against each other fit one pose in parts."""
    largest: list[Pairs] = []
    for pairs, _ in sorted(listed, key=lambda one: (-len(one[0]), -one[1].log_likelihood, one[0])):
        if len(largest) < MOST_PARTS and not any(set(pairs) <= set(other) for other in largest):
            largest.append(pairs)
    known = dict(listed)
    parts = [part for part in disjoint(largest) if part not in known]
    return [(part, placement) for part in parts if (placement := place(before, points, part))]


def _additions(
    before: Cloud, points: Cloud, listed: Mapping[Pairs, Placement], named: Mapping[int, int], volume: float
) -> list[tuple[float, Pairs, float]]:
    """Return the log odds of what each group adds to the names, that contradict none, and how usual its rotation is if it has its own.

    The points that are left lie as close to each other as all do: few of them do not make it less of a chance that three fit.
    """
    n, m = len(before) - len(named), len(points)
    owner = {a: i for i, a in named.items()}
    base: dict[Pairs, float] = {}
    rivals: dict[Pairs, tuple[float, float]] = {}
    for pairs, placement in listed.items():
        if any(named.get(i, a) != a or owner.get(a, i) != i for i, a in pairs):
            continue
        old, new = tuple(pair for pair in pairs if pair[0] in named), tuple(pair for pair in pairs if pair[0] not in named)
        k = len(new)
        if not new or 0 < len(old) < LEAST_POINTS:
            continue
        odds = k * float(np.log(FOUND)) - _log_ways(n, k)  # any k may be the body
        usual = 0.0 if old else log_usual(np.eye(3), placement.rotation)
        if not old:
            odds += _odds(placement, k, volume, m)
        else:
            if old not in base:
                base[old] = fixed.log_likelihood if (fixed := place(before, points, old)) else np.inf
            odds += placement.log_likelihood - base[old] - k * float(np.log(m / volume)) - _log_ways(len(named), len(old))
        rivals[new] = max(rivals.get(new, (-np.inf, 0.0)), (odds, usual))
    return [(odds, pairs, rivals[pairs][1]) for odds, pairs in _sorted([(odds, pairs) for pairs, (odds, _) in rivals.items()])]


def _log_ways(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _counted(rivals: list[tuple[float, Pairs, float]], m: int) -> tuple[list[tuple[float, Pairs, float]], list[tuple[float, Pairs, float]]]:
    """Return the rivals that are summed, and the others: the likeliest, and the best explanation by those that say most for each point.

    Where two bodies together fit one pose badly, both at once are likelier by far than the larger one, but each alone is not, and parts of
    that would leave neither among the likeliest.
    """
    few, others = rivals[:MOST_RIVALS], rivals[MOST_RIVALS:]
    dense = sorted(rivals, key=lambda rival: (-rival[0] / len(rival[1]), rival[1]))[:MOST_RIVALS] if others else []
    apart = [dense[g] for g in _summed(dense, m)[1]]
    return few + [one for one in others if one in apart], [one for one in others if one not in apart]


def _summed(
    rivals: Sequence[tuple[float, Pairs, float]], m: int, beyond: Sequence[tuple[int, ...]] = ()
) -> tuple[dict[tuple[int, int], float], list[int]]:
    groups = [pairs for _, pairs, _ in rivals]
    more = beyond or [()] * len(groups)
    claims = [(*(a for _, a in pairs), *points, *(m + i for i, _ in pairs)) for pairs, points in zip(groups, more, strict=True)]
    chosen, chances = _packed(claims, [odds for odds, _, _ in rivals], [usual for _, _, usual in rivals])
    return _names(groups, chances), np.flatnonzero(chosen).tolist()


def _with_uncounted(
    chances: Mapping[tuple[int, int], float], chosen: Mapping[Pairs, float], uncounted: Sequence[tuple[float, Pairs, float]]
) -> dict[tuple[int, int], float]:
    """Return the chances of names, less by those rivals of the chosen bodies that were too many to be summed.

    A rival has the odds of its own against those of the markers and points that it takes away, as parts of their bodies.
    """
    against: dict[Pairs, list[float]] = {body: [-np.inf] for body in chosen}
    for odds, rival, _ in uncounted:
        markers, points = dict(rival), {a: i for i, a in rival}
        taken = {body: sum(i in markers or a in points for i, a in body) for body in chosen}
        gain = odds - sum(chosen[body] * count / len(body) for body, count in taken.items())
        for body in chosen:
            if any(markers.get(i, a) != a or points.get(a, i) != i for i, a in body):
                against[body].append(gain)
    result = dict(chances)
    for body, gains in against.items():
        result |= {pair: chances[pair] * float(expit(-np.logaddexp.reduce(gains))) for pair in body}
    return result


def _odds(placement: Placement, k: int, volume: float, stray: float) -> float:
    """Return the log odds of a body at an unknown pose against `stray` points that lie anywhere in the volume."""
    return placement.log_likelihood - float(np.log(8 * np.pi**2 * volume)) - k * float(np.log(stray / volume))


def _sorted(rivals: list[tuple[float, Pairs]]) -> list[tuple[float, Pairs]]:
    """Return what counts, the likeliest first."""
    return sorted((rival for rival in rivals if rival[0] > NEGLIGIBLE), key=lambda rival: (-rival[0], rival[1]))


def _names(groups: Sequence[Pairs], chances: Float) -> dict[tuple[int, int], float]:
    """Return the least chance of each name, of chances of shape (2, g)."""
    names: dict[tuple[int, int], Float] = {}
    for pairs, both in zip(groups, chances.T, strict=True):
        for pair in pairs:
            names[pair] = names.get(pair, 0.0) + both
    return {pair: float(both.min()) for pair, both in names.items()}


def _known(segment: Cloud, points: Cloud, rigid: Pairs, loose: Pairs, names: dict[tuple[int, int], float], posterior: float) -> Known:
    pairs = tuple(pair for pair in rigid if names[pair] >= posterior)
    doubtful = tuple(pair for pair in rigid if names[pair] < posterior)
    placement = place(segment, points, pairs) if len(pairs) >= LEAST_POINTS else None
    if placement is None:
        pairs, doubtful, loose = (), tuple(sorted((*rigid, *loose))), ()
    moved = () if placement is None else tuple(p for p, sigma in zip(pairs, placement.sigmas, strict=True) if sigma > LOOSE_SIGMA)
    moved += tuple(pair for pair in loose if names[pair] >= posterior)
    named = {i for i, _ in (*rigid, *doubtful, *moved)}
    return Known(pairs, doubtful, tuple(sorted(moved)), tuple(i for i in range(len(segment)) if i not in named), placement)


def _with_loose(segments: Sequence[Cloud], points: Cloud, known: list[Known]) -> list[Known]:
    """Add markers that have moved in their bone: a point that nothing else explains, alone near the place of one missing marker alone."""
    taken = {a for one in known for _, a in (*one.pairs, *one.doubtful, *one.loose)}
    free = np.array([a for a in range(len(points)) if a not in taken], dtype=np.int64)
    near: list[tuple[int, int, int]] = []
    for index, (segment, one) in enumerate(zip(segments, known, strict=True)):
        if one.placement is not None and one.lost and len(free):
            missing = segment.rows(np.array(one.lost))
            away = np.linalg.norm(points.position_mm[free] - one.placement.predict(missing.position_mm)[0][:, None], axis=-1)
            close = (away < LOOSE_MM) | (nearness(missing, points.rows(free), one.placement) < GATE)
            near += [(index, one.lost[i], int(free[a])) for i, a in zip(*np.nonzero(close), strict=True)]
    alone = [x for x in near if sum(x[:2] == y[:2] for y in near) == 1 and sum(x[2] == y[2] for y in near) == 1]
    result = []
    for index, one in enumerate(known):
        mine = tuple((i, a) for s, i, a in alone if s == index)
        lost = tuple(i for i in one.lost if i not in {i for i, _ in mine})
        result.append(Known(one.pairs, one.doubtful, tuple(sorted({*one.loose, *mine})), lost, one.placement))
    return result
