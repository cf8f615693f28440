"""Pairs of rays that the rays alone cannot decide, decided by where the markers of known segments must be.

Points near one epipolar plane are crossed by each other's rays: each way of pairing them gives other places. Every possible pair is a
candidate with the odds that its rays and images give it; a segment at its pose speaks for those that lie where its markers are. All
assignments of images to pairs and of pairs to markers are summed together (:mod:`packing`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.constellation import STRAY, likely_groups
from rsa_vision.identify.constellation import log_odds as assignment_log_odds
from rsa_vision.identify.packing import pack
from rsa_vision.identify.poses import Cloud, Pairs, place, volume_mm3
from rsa_vision.types import Bool, Float


def settle(segments: Sequence[Cloud], sure: Cloud, candidates: Cloud, images: Sequence[tuple[int, ...]], log_odds: Float) -> Float:
    """Return how probable candidates are, if known segments are among the points.

    Parameters
    ----------
    segments : sequence of Cloud
        Three markers or more each, in any frame.
    sure : Cloud
        Points that nobody contests.
    candidates : Cloud
        Points of which some are real, n of them.
    images : sequence of tuple of int
        What each candidate is seen by: candidates that share an image exclude each other.
    log_odds : ndarray of shape (n,)
        Of a candidate, against its images being unrelated.

    Returns
    -------
    ndarray of shape (n,)
        Sum of the probabilities of all ways to explain the images and the points in which the candidate is real, with a name or without;
        0 where there were too many to sum.

    Notes
    -----
    The odds of a segment's assignment are those of :mod:`constellation`, against its points being strays. To them come the log odds of
    its candidates: a stray must exist as well, and counts with these alone.
    """
    n, first = len(candidates), len(sure)
    points, apart = _joined(sure, candidates), _at_once(images, log_odds)
    volume = volume_mm3(_joined(sure, candidates.rows(apart)))
    stray = STRAY + max(0, first + int(apart.sum()) - sum(map(len, segments)))
    image_of = {image: first + k for k, image in enumerate(sorted({i for one in images for i in one}))}
    claims = [tuple(image_of[i] for i in one) for one in images]  # strays, then what a segment claims at once
    gain = log_odds.tolist()
    members: list[list[int]] = [[c] for c in range(n)]
    for index, segment in enumerate(segments):
        for odds, pairs in _possible(segment, points, volume, stray, ((),) * first + tuple(images)):
            mine = [a - first for _, a in pairs if a >= first]
            taken = (image_of[i] for c in mine for i in images[c])
            claims.append((*(a for _, a in pairs if a < first), *taken, first + len(image_of) + index))
            gain.append(odds + float(log_odds[mine].sum()))
            members.append(mine)
    chances = np.nan_to_num(pack(claims, np.array(gain)).posterior)
    result = np.zeros(n)
    for mine, chance in zip(members, chances.tolist(), strict=True):
        result[mine] += chance
    return result


def _joined(one: Cloud, other: Cloud) -> Cloud:
    places, covariances = (one.position_mm, other.position_mm), (one.covariance_mm2, other.covariance_mm2)
    return Cloud(np.concatenate(places), np.concatenate(covariances))


def _possible(segment: Cloud, points: Cloud, volume: float, stray: float, images: Sequence[tuple[int, ...]]) -> list[tuple[float, Pairs]]:
    """List the assignments of a segment that use no image twice; of others what is left without one or the other point."""
    listed = {pairs: odds for odds, pairs, _ in likely_groups(segment, points, volume, stray)}
    found: dict[Pairs, float] = {}
    left = list(listed)
    while left:
        pairs = left.pop()
        clash = next(((p, q) for p, q in combinations(pairs, 2) if set(images[p[1]]) & set(images[q[1]])), ())
        if clash:
            left += [rest for out in clash if len(rest := tuple(pair for pair in pairs if pair != out)) >= LEAST_POINTS]
        elif pairs not in found:
            placement = place(segment, points, pairs) if pairs not in listed else None
            odds = listed.get(pairs, -np.inf) if placement is None else assignment_log_odds(len(segment), placement, pairs, volume, stray)
            found[pairs] = odds
    return [(odds, pairs) for pairs, odds in found.items() if odds > -np.inf]


def _at_once(images: Sequence[tuple[int, ...]], log_odds: Float) -> Bool:
    """Return candidates that may all be real, the likeliest first."""
    chosen, taken = np.zeros(len(images), bool), set[int]()
    for c in np.argsort(-log_odds, kind="stable").tolist():
        if not taken & set(images[c]):
            chosen[c] = True
            taken |= set(images[c])
    return chosen
