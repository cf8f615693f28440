"""The assignments of a body's markers to points that compete with each other.

What is missing here competes with nothing: a wrong assignment is sure of itself where the true one was not listed. So every three markers
with the right distances are listed as they are, and with what their pose explains besides, marker by marker as far as it is told.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np

from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.poses import (
    GATE,
    GATE_SCALE,
    TOLERANCE_MM,
    Cloud,
    Pairs,
    Placement,
    distances,
    nearness,
    place_many,
    pose_jacobian,
)
from rsa_vision.types import Bool, Float

THIN_MM: Final = 1.0  # height of a triangle that determines no pose
ALIKE: Final = 4.0  # variances of predicted places are alike up to this ratio
CHUNK: Final = 1000  # poses that are fitted at once
MOST_CLIMBED: Final = 40  # assignments from which better ones are sought
FOUND: Final = 0.9  # probability that a marker of a known body is among the points
LOOSE: Final = 0.02  # probability that a marker found has moved in its bone
LOOSE_MM: Final = 3.0  # how far a marker may have moved in its bone and still be known by its place


def candidate_poses(body: Cloud, points: Cloud, log_worth: float) -> list[tuple[Pairs, Placement]]:
    """List the assignments of a body's markers to points that a rigid motion explains, three markers or more each.

    Parameters
    ----------
    body, points : Cloud
    log_worth : float
        Gain in log likelihood, with densities in 1/mm³, for a point that need not be explained otherwise.

    Returns
    -------
    list of (pairs, Placement)
        Every assignment once: any three markers with the right distances, what grows from these, the better ones on the way to the best
        next to them, and all next to that (one marker left out, or on a point that is near enough).
    """
    if min(len(body), len(points)) < LEAST_POINTS:
        return []
    close = _compatible(body, points)
    found: dict[Pairs, Placement] = {}
    ends: list[Pairs] = []
    new = list(_triples(body, close))
    while new:
        grown: dict[Pairs, Pairs] = {}
        for poses in _placed(body, points, new):
            found |= poses
            larger = _grown(body, points, close, poses)
            ends += [pairs for pairs in poses if pairs not in larger]
            grown |= larger
        new = [pairs for pairs in dict.fromkeys(grown.values()) if pairs not in found]

    def value(pairs: Pairs) -> float:
        return found[pairs].log_likelihood + len(pairs) * log_worth

    climbed: set[Pairs] = set()
    front = set(sorted(ends, key=lambda pairs: (-value(pairs), pairs))[:MOST_CLIMBED])
    while front:
        climbed |= front
        beside = {pairs: [pairs, *_neighbours(body, points, pairs, found[pairs])] for pairs in sorted(front)}
        for poses in _placed(body, points, dict.fromkeys(pairs for near in beside.values() for pairs in near if pairs not in found)):
            found |= poses
        front = {max((pairs for pairs in near if pairs in found), key=value) for near in beside.values()} - climbed
    return list(found.items())


def loose_triples(body: Cloud, points: Cloud, triples: Iterable[Pairs]) -> list[tuple[Pairs, Placement]]:
    """List all ways to name the points of triples by their markers if two keep their distance, and the third has moved in its bone.

    Parameters
    ----------
    body, points : Cloud
    triples : iterable of tuple of (marker, point)
        Three pairs each.

    Returns
    -------
    list of (pairs, Placement)
        The one that has moved is the last pair. The two others leave open how the body is turned about their line: it is turned so that
        the third is nearest to its point, and the likelihood holds all turns within reach, the density of its point there, and the chance.
    """
    sets = {(tuple(i for i, _ in triple), tuple(sorted(a for _, a in triple))) for triple in triples}
    every = [
        (three, order)
        for (i, j, k), theirs in sorted(sets)
        for three in ((i, j, k), (i, k, j), (j, k, i))
        for order in permutations(theirs)
    ]
    marks, hits = np.array(every, np.int64).reshape(-1, 2, 3).swapaxes(0, 1)  # (t, 3)
    _, foot, height = _about_line(body.position_mm[marks])
    (axis, _, away), there = _about_line(points.position_mm[hits]), points.position_mm[hits]
    side = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    nearest = there[:, :2].mean(axis=1) + foot * axis + np.linalg.norm(height, axis=1, keepdims=True) * side
    thin = np.minimum(np.linalg.norm(height, axis=1), np.linalg.norm(away, axis=1)) < THIN_MM
    near = np.flatnonzero(~thin & (np.linalg.norm(there[:, 2] - nearest, axis=1) < LOOSE_MM))
    if not len(near):
        return []
    ball = points.covariance_mm2[hits[near, 2]] + LOOSE_MM**2 / 5 * np.eye(3)  # a ball has this covariance
    turned = Cloud(np.concatenate([points.position_mm, nearest[near]]), np.concatenate([points.covariance_mm2, ball]))
    at = np.column_stack([hits[near, :2], len(points) + np.arange(len(near))])
    named = [tuple(zip(mine, theirs, strict=True)) for mine, theirs in zip(marks[near].tolist(), hits[near].tolist(), strict=True)]
    return [
        (pairs, replace(placement, log_likelihood=placement.log_likelihood + float(np.log(LOOSE))))
        for pairs, placement in zip(named, place_many(body, turned, marks[near], at), strict=True)
        if placement
    ]


def _about_line(three_mm: Float) -> tuple[Float, Float, Float]:
    """Return the directions, shape (t, 3), from first to second points, how far (t, 1) thirds are along them from the middle, and off."""
    axis = three_mm[:, 1] - three_mm[:, 0]
    axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    arm = three_mm[:, 2] - three_mm[:, :2].mean(axis=1)
    along = (arm * axis).sum(axis=1, keepdims=True)
    return axis, along, arm - along * axis


def _compatible(body: Cloud, points: Cloud) -> Bool:
    """Tell which pairs of markers may be which pairs of points, shape (n, n, m, m): their distances agree."""
    (mine, mine_var), (theirs, theirs_var) = distances(body), distances(points)
    variance = GATE_SCALE**2 * (mine_var[:, :, None, None] + theirs_var) + 2 * TOLERANCE_MM**2
    close: Bool = np.abs(mine[:, :, None, None] - theirs) < GATE * np.sqrt(variance)
    m = np.arange(len(points))
    close[:, :, m, m] = False
    return close


def _triples(body: Cloud, close: Bool) -> Iterator[Pairs]:
    n = len(body)
    place_of = body.position_mm
    for i in range(n):
        for j in range(i + 1, n):
            first, second = np.nonzero(close[i, j])
            if not len(first):
                continue
            side = place_of[j] - place_of[i]
            for k in range(j + 1, n):
                longest = max(np.linalg.norm(side), np.linalg.norm(place_of[k] - place_of[i]), np.linalg.norm(place_of[k] - place_of[j]))
                if np.linalg.norm(np.cross(side, place_of[k] - place_of[i])) < THIN_MM * longest:
                    continue
                row, third = np.nonzero(close[i, k][first] & close[j, k][second])
                for a, b, c in zip(first[row].tolist(), second[row].tolist(), third.tolist(), strict=True):
                    yield (i, a), (j, b), (k, c)


def _placed(body: Cloud, points: Cloud, listed: Iterable[Pairs]) -> Iterator[dict[Pairs, Placement]]:
    """Yield the poses of assignments, those of one size together, and not too many."""
    sizes: dict[int, list[Pairs]] = {}
    for pairs in listed:
        sizes.setdefault(len(pairs), []).append(pairs)
    for same in sizes.values():
        for first in range(0, len(same), CHUNK):
            some = same[first : first + CHUNK]
            placements = place_many(body, points, *np.array(some).transpose(2, 0, 1))
            if poses := {pairs: placement for pairs, placement in zip(some, placements, strict=True) if placement}:
                yield poses


def _grown(body: Cloud, points: Cloud, close: Bool, poses: Mapping[Pairs, Placement]) -> dict[Pairs, Pairs]:
    """Return assignments of one size that grow: with what lies where their poses put it, of those markers whose places are told best.

    Three markers tell the places of those beside them, and hardly that of another body: all at once would take in a body that has moved
    little, and settle on neither.
    """
    listed, placements = list(poses), list(poses.values())
    marks, hits = np.array(listed).transpose(2, 0, 1)  # (t, k)
    rotation, translation = np.stack([one.rotation for one in placements]), np.stack([one.translation for one in placements])
    centre, by_pose = np.stack([one.centre_mm for one in placements]), np.stack([one.covariance for one in placements])
    possible = np.ones((len(listed), len(body), len(points)), bool)
    for i, a in zip(marks.T, hits.T, strict=True):
        possible &= close[:, i, :, a]
    each = np.arange(len(listed))[:, None]
    possible[each, marks] = possible[each, :, hits] = False
    t, mine, theirs = np.nonzero(possible)
    moved = (rotation[t] @ body.position_mm[mine, :, None])[..., 0] + translation[t]
    jacobian, turn = pose_jacobian(moved - centre[t]), rotation[t]
    own = turn @ body.covariance_mm2[mine] @ turn.swapaxes(1, 2) + points.covariance_mm2[theirs]
    covariance = GATE_SCALE**2 * own + jacobian @ by_pose[t] @ jacobian.swapaxes(1, 2) + TOLERANCE_MM**2 * np.eye(3)
    away = (points.position_mm[theirs] - moved)[..., None]
    squares = (away.swapaxes(1, 2) @ np.linalg.solve(covariance, away))[:, 0, 0]
    spread = np.where(squares < GATE**2, np.trace(covariance, axis1=1, axis2=2), np.inf)
    best = np.full(len(listed), np.inf)
    np.minimum.at(best, t, spread)
    told = np.flatnonzero(np.isfinite(spread) & (spread <= ALIKE * best[t]))
    told = told[np.lexsort((squares[told], t[told]))]
    grown: dict[int, list[tuple[int, int]]] = {}
    for one, marker, point in zip(t[told].tolist(), mine[told].tolist(), theirs[told].tolist(), strict=True):
        pairs = grown.setdefault(one, list(listed[one]))
        if all(marker != i and point != a for i, a in pairs):
            pairs.append((marker, point))
    return {listed[one]: tuple(sorted(pairs)) for one, pairs in grown.items()}


def _neighbours(body: Cloud, points: Cloud, pairs: Pairs, placement: Placement) -> Iterator[Pairs]:
    if len(pairs) > LEAST_POINTS:
        for pair in pairs:
            yield tuple(other for other in pairs if other != pair)
    away = nearness(body, points, placement)
    for marker, point in zip(*(index.tolist() for index in np.nonzero(away < 2 * GATE)), strict=True):
        if (marker, point) not in pairs:
            kept = [(i, a) for i, a in pairs if i != marker and a != point]
            yield tuple(sorted([*kept, (marker, point)]))
            freed = dict(pairs).get(marker)
            owner = next((i for i, a in pairs if a == point), None)
            if freed is not None and owner is not None:
                yield tuple(sorted([*kept, (marker, point), (owner, freed)]))


def disjoint(groups: Sequence[Pairs]) -> list[Pairs]:
    """Return the larger parts of assignments that overlap: each less the markers and points of another."""
    parts: dict[Pairs, None] = {}
    for one in groups:
        for other in groups:
            markers, hits = {i for i, _ in other}, {a for _, a in other}
            rest = tuple(pair for pair in one if pair[0] not in markers and pair[1] not in hits)
            if LEAST_POINTS <= len(rest) < len(one):
                parts[rest] = None
    return list(parts)
