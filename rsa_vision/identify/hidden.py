"""Markers that one focus alone shows: the pose of a known segment from all rays that see it.

The marker-configuration model (Kaptein, Valstar, Stoel, Rozing, Reiber 2005): the pose that minimises the squared distances of the markers
from their rays, in units of their sd; a marker seen from several foci counts as the point that its rays gave. Which ray belongs to which
marker competes as the names do (:mod:`constellation`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.candidates import FOUND
from rsa_vision.identify.constellation import MOST_RIVALS, NEGLIGIBLE, STRAY, likely_groups
from rsa_vision.identify.hidden_starts import Scene, Start, first_poses
from rsa_vision.identify.packing import pack
from rsa_vision.identify.poses import (
    GATE,
    SCALES,
    TOLERANCE_MM,
    Cloud,
    Pairs,
    Placement,
    nearness,
)
from rsa_vision.identify.ray_poses import off_rays, place_with_rays
from rsa_vision.types import Bool, Float

MOST_TRIED: Final = 150
SAME_MM: Final = 1.0  # by which the markers of one pose may differ


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A segment with markers that one focus alone shows.

    Attributes
    ----------
    pairs : tuple of (marker, point)
    sights : tuple of (marker, ray)
    placement : Placement or None
        By both; None if no pose is found.
    decisive : bool
        No other assignment or pose is nearly as likely.
    rays : RayBundle or None
        Those that `sights` count.
    """

    pairs: Pairs
    sights: Pairs
    placement: Placement | None
    decisive: bool
    rays: RayBundle | None = None


def hidden_markers(
    body: Cloud,
    points: Cloud,
    pairs: Pairs,
    placement: Placement,
    rays: RayBundle,
    missing: Collection[int],
    volume: float,
    posterior: float,
) -> Sighting:
    """Find the missing markers of a segment whose pose is known among rays that belong to nothing.

    Parameters
    ----------
    body, points : Cloud
    pairs : tuple of (marker, point)
    placement : Placement
        By `pairs`.
    rays : RayBundle
    missing : collection of int
        Markers without a point.
    volume : float
        In which markers may be, mm³.
    posterior : float
        Least probability that a ray belongs to a marker.

    Returns
    -------
    Sighting
        ``decisive`` is False where a ray may be of a missing marker, but not decisively.
    """
    scene = Scene(body, points, rays, volume, STRAY)
    away, log_density = off_rays(body, rays, placement)
    marker, ray = np.nonzero(away < GATE)
    tried = [(int(i), int(r)) for i, r in zip(marker, ray, strict=True) if i in missing]
    if not tried:
        return Sighting(pairs, (), placement, True)
    focus = {value: index for index, value in enumerate(sorted(set(rays.focus.tolist())))}
    claims = [(len(rays) + i * len(focus) + focus[int(rays.focus[r])], r) for i, r in tried]
    gain = np.array([log_density[i, r] + scene.worth[1] for i, r in tried])
    packing = pack(claims, gain)
    sure = np.nan_to_num(packing.posterior) >= posterior
    sights = tuple(sorted(pair for pair, chosen, is_sure in zip(tried, packing.chosen, sure, strict=True) if chosen and is_sure))
    together = place_with_rays(body, points, pairs, rays, sights, placement.rotation, placement.translation) if sights else placement
    return Sighting(pairs, sights, together or placement, bool(together) and not (packing.chosen & ~sure).any())


def find_with_rays(
    bodies: Sequence[Cloud],
    points: Cloud,
    rays: RayBundle,
    volume: float,
    posterior: float,
    *,
    around_mm: Float | None = None,
    present: float = 0.5,
) -> list[Sighting]:
    """Find segments whose points alone do not tell their poses, with rays that belong to nothing, or by these alone.

    Parameters
    ----------
    bodies : sequence of Cloud
        All segments that may have these points and rays: they compete for them.
    points : Cloud
        Those that belong to no other segment.
    rays : RayBundle
    volume : float
    posterior : float
    around_mm : ndarray of shape (k, 3), optional
        Places of other markers: how deep along the rays to look. Default: anywhere from the film to near the foci.
    present : float
        Probability that a segment is on the films at all, before they are looked at.

    Returns
    -------
    list of Sighting
        One of each segment: its assignment and pose in the best explanation of all; ``decisive`` only if all others together, and chance,
        leave it the probability `posterior`.

    Notes
    -----
    Two places begin a hypothesis: points of two markers with their distance, or a point and where a ray pierces the sphere about it on
    which another marker must lie. The body is turned about the line through both, and where a third marker meets a ray its pose is fitted
    and grown. So is every pose at which three markers lie on three rays (:mod:`ray_triples`) and a fourth one near another. Beside each
    assignment stand those in which a marker has another ray near it, and those of points alone. All explanations by all bodies are summed,
    each point and each image once: what one body alone would explain surely may be another's as well.
    """
    hypotheses = [_hypotheses(Scene(body, points, rays, volume, STRAY + len(points)), around_mm) for body in bodies]
    listed = [(index, *one) for index, (every, _) in enumerate(hypotheses) for one in every]
    n = len(bodies)
    claims = [
        (index, *(n + a for _, a in pairs), *{n + len(points) + int(rays.image[r]) for _, r in sights})
        for index, _, (pairs, sights), _ in listed
    ]
    packing = pack(claims, np.array([odds for _, odds, _, _ in listed]) - float(np.log(1 / present - 1)))
    chances = np.nan_to_num(packing.posterior)
    found = []
    for index, (body, (_, untried)) in enumerate(zip(bodies, hypotheses, strict=True)):
        mine = [g for g, one in enumerate(listed) if one[0] == index]
        best = next((g for g in mine if packing.chosen[g]), None)
        if best is None:
            found.append(Sighting((), (), None, False))
            continue
        _, _, key, placement = listed[best]
        same = [(float(chances[g]), *listed[g][2]) for g in mine if _alike(body, placement, listed[g][3])]
        pairs, sights, sure = _surest(key, same, posterior)
        markers = {i for i, _ in (*pairs, *sights)}
        decisive = sure and len(markers) >= LEAST_POINTS and untried < len(markers)
        if decisive and (pairs, sights) != key:
            fitted = place_with_rays(body, points, pairs, rays, sights, placement.rotation, placement.translation)
            decisive, placement = fitted is not None, fitted or placement
        found.append(Sighting(pairs, sights, placement, decisive))
    return found


def _hypotheses(scene: Scene, around_mm: Float | None) -> tuple[list[tuple[float, tuple[Pairs, Pairs], Placement]], int]:
    """List the likeliest assignments of a body with their log odds, and say how many markers what was not tried might meet."""
    body = scene.body
    starts = first_poses(scene, around_mm)
    found: dict[tuple[Pairs, Pairs], list[Placement]] = {}

    def add(pairs: Pairs, sights: Pairs, placement: Placement) -> None:
        same = found.setdefault((pairs, sights), [])
        if not any(_alike(body, placement, other) for other in same):
            same.append(placement)

    for _, pairs, placement in likely_groups(body, scene.points, scene.volume, scene.stray):
        add(pairs, (), placement)
    for start in starts[:MOST_TRIED]:
        if (grown := _grown(scene, start)) is not None:
            add(*grown)
    grown_ones = [(_log_odds(scene, *key, one), key, one) for key, placements in found.items() for one in placements]
    best = max((odds for odds, _, _ in grown_ones), default=0.0)
    for _, key, placement in (one for one in grown_ones if one[0] > best + NEGLIGIBLE):
        for other in _neighbours(scene, *key, placement):
            if fit := _fitted(scene, *other, placement):
                add(*other, fit)
    every = [(_log_odds(scene, *key, placement), key, placement) for key, placements in found.items() for placement in placements]
    every = sorted((one for one in every if one[0] > NEGLIGIBLE), key=lambda one: (-one[0], one[1]))
    return every[:MOST_RIVALS], starts[MOST_TRIED].met if len(starts) > MOST_TRIED else 0


def _surest(key: tuple[Pairs, Pairs], same: Sequence[tuple[float, Pairs, Pairs]], posterior: float) -> tuple[Pairs, Pairs, bool]:
    """Return what of an assignment is sure together, by the chances of all at its pose; the least sure have no name."""

    def chance(some_pairs: Pairs, some_sights: Pairs) -> float:
        return sum(one for one, pairs, sights in same if {*some_pairs} <= {*pairs} and {*some_sights} <= {*sights})

    pairs, sights = key
    doubts = sorted([(chance((pair,), ()), pair, 0) for pair in pairs] + [(chance((), (sight,)), sight, 1) for sight in sights])
    while doubts and chance(pairs, sights) < posterior:
        _, doubted, kind = doubts.pop(0)
        pairs = tuple(pair for pair in pairs if kind or pair != doubted)
        sights = tuple(sight for sight in sights if not kind or sight != doubted)
    return pairs, sights, chance(pairs, sights) >= posterior


def _alike(body: Cloud, one: Placement, other: Placement) -> bool:
    """Tell whether two poses are the same within their errors, or nearly."""
    (mine, by_mine), (theirs, by_theirs) = one.predict(body.position_mm), other.predict(body.position_mm)
    away = mine - theirs
    squares = np.einsum("ni,nij,nj->n", away, np.linalg.inv(by_mine + by_theirs + TOLERANCE_MM**2 * np.eye(3)), away)
    return bool((np.linalg.norm(away, axis=1) < SAME_MM).all() or (squares < GATE**2).all())


def _log_odds(scene: Scene, pairs: Pairs, sights: Pairs, placement: Placement) -> float:
    n, found = len(scene.body), len({i for i, _ in (*pairs, *sights)})
    worth = len(pairs) * scene.worth[0] + len(sights) * scene.worth[1] - float(np.log(8 * np.pi**2 * scene.volume))
    return placement.log_likelihood + worth + found * float(np.log(FOUND)) + (n - found) * float(np.log(1 - FOUND))


def _neighbours(scene: Scene, pairs: Pairs, sights: Pairs, placement: Placement) -> Iterator[tuple[Pairs, Pairs]]:
    """Yield assignments in which one marker is left out, or has another point or ray of the same focus that it meets as well."""
    away = nearness(scene.body, scene.points, placement) if len(scene.points) else np.zeros((len(scene.body), 0))
    off, _ = off_rays(scene.body, scene.rays, placement)
    for pair in pairs:
        rest = tuple(other for other in pairs if other != pair)
        yield rest, sights
        for a in np.flatnonzero(away[pair[0]] < GATE).tolist():
            if a not in {b for _, b in pairs}:
                yield tuple(sorted([*rest, (pair[0], a)])), sights
    for sight in sights:
        rest = tuple(other for other in sights if other != sight)
        yield pairs, rest
        for r in np.flatnonzero((off[sight[0]] < GATE) & (scene.rays.focus == scene.rays.focus[sight[1]])).tolist():
            if r not in {x for _, x in sights}:
                yield pairs, tuple(sorted([*rest, (sight[0], r)]))


def _fitted(scene: Scene, pairs: Pairs, sights: Pairs, near: Placement) -> Placement | None:
    if len({i for i, _ in (*pairs, *sights)}) < LEAST_POINTS:
        return None
    return place_with_rays(scene.body, scene.points, pairs, scene.rays, sights, near.rotation, near.translation)


def _grown(scene: Scene, start: Start) -> tuple[Pairs, Pairs, Placement] | None:
    """Fit a first pose, and take in what it meets until nothing changes."""
    body, points, rays = scene.body, scene.points, scene.rays
    pairs, sights, rotation, translation = start.pairs, start.sights, start.rotation, start.translation
    placement: Placement | None = None
    for _ in range(6):
        placement = place_with_rays(body, points, pairs, rays, sights, rotation, translation)
        if placement is None or not (placement.sigmas < GATE * max(SCALES)).all():
            return None
        rotation, translation = placement.rotation, placement.translation
        again = _met(scene, placement)
        if again == (pairs, sights):
            return pairs, sights, placement
        pairs, sights = again
        if 3 * len(pairs) + 2 * len(sights) < 7 or len({i for i, _ in (*pairs, *sights)}) < 3:
            return None
    return (pairs, sights, placement) if placement is not None and (pairs, sights) == _met(scene, placement) else None


def _met(scene: Scene, placement: Placement) -> tuple[Pairs, Pairs]:
    """Return the points and rays that markers meet at a pose: the nearest in units of sd first, points before rays."""
    pairs: dict[int, int] = {}
    sights: dict[tuple[int, int], int] = {}
    away = nearness(scene.body, scene.points, placement) if len(scene.points) else np.zeros((len(scene.body), 0))
    for i, a in _ranked(away, away < GATE):
        if i not in pairs and a not in pairs.values():
            pairs[i] = a
    off, _ = off_rays(scene.body, scene.rays, placement)
    for i, r in _ranked(off, off < GATE):
        seen = (i, int(scene.rays.focus[r]))
        if i not in pairs and seen not in sights and scene.rays.image[r] not in {scene.rays.image[x] for x in sights.values()}:
            sights[seen] = r
    return tuple(sorted(pairs.items())), tuple(sorted((i, r) for (i, _), r in sights.items()))


def _ranked(cost: Float, possible: Bool) -> list[tuple[int, int]]:
    first, second = np.nonzero(possible)
    order = np.argsort(cost[first, second], kind="stable")
    return [(int(first[o]), int(second[o])) for o in order]
