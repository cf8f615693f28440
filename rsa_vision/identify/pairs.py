"""Which object images of different foci show the same marker.

Two rays belong together if they cross: the crossing distance in units of its own sigma, against the density with which unrelated rays would
cross as well. Images of balls of one kind also agree in the size that their depth implies, and in contrast; how well they do is learnt from
the pairs that are beyond doubt. All assignments are summed (:mod:`packing`): a pair carries the probability of being one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import gammaln

from rsa_vision.cages import Cage
from rsa_vision.geometry.rays import RayBundle, cross
from rsa_vision.identify.packing import Packing, pack
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, Int

WINDOWS_MM: Final = (3.0, 10.0)  # in which unrelated crossings are counted
SLACKS_MM: Final = (0.0, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3)  # systematic error of rays beyond their covariance, tried in turn
FRACTIONS: Final = (0.03, 0.1, 0.2, 0.4, 0.7, 0.9)  # of rays that have a partner, tried likewise
SLACK_EVIDENCE: Final = 5.0  # log likelihood by which a slack must be better than none
LEARNT_FROM: Final = 5  # pairs beyond doubt that teach what pairs look like
SURE: Final = 0.99
PRIOR: Final = (0.02, 0.95)  # bounds of the learnt fraction of rays that have a partner
FEATURES: Final = (("size", 0.01, 0.2), ("size ratio", 0.01, 0.2), ("contrast ratio", 0.03, 0.4))  # least sd, sd of unrelated images; logs
UNKNOWN: Final = 5.0  # unrelated crossings that a guess of their looks weighs like
MOST_GROUPS: Final = 20_000

Region = Callable[[Float], Bool]


@dataclass(frozen=True, slots=True, eq=False)
class Pairing:
    """Object images put together across foci.

    Attributes
    ----------
    groups : tuple of tuple of int
        Rows of the bundle that show one marker, one of each focus at most, by rising focus; every image once.
    posterior : ndarray of shape (g,)
        Probability that the group is right among all assignments; NaN where there were too many to sum.
    ambiguous : ndarray of bool, shape (g,)
        Posterior below the limit.
    crossing_sigma : ndarray of shape (g,)
        Largest crossing distance within the group in units of its sigma.
    rivals : tuple of tuple of int
        For each group the likeliest different one that claims an image of it; empty if none.
    unmatched : ndarray of int
        Images that are in no group, rising.
    slack_mm : float
        Error of the rays beyond their covariance that the crossings show (in quadrature to the sigma of a crossing); 0: none.
    reasons : tuple of str
        ``pair-ambiguous`` or nothing.
    """

    groups: tuple[tuple[int, ...], ...]
    posterior: Float
    ambiguous: Bool
    crossing_sigma: Float
    rivals: tuple[tuple[int, ...], ...]
    unmatched: Int
    slack_mm: float
    reasons: tuple[str, ...]


def cage_region(cage: Cage, foci_mm: Mapping[int, Float], *, highest: float = 0.8) -> Region:
    """Return where an object may be: before every fiducial plane of the foci, and not too near to a focus.

    Parameters
    ----------
    cage : Cage
    foci_mm : mapping
        Foci in the laboratory frame.
    highest : float
        As a fraction of the focus's height above its plane.

    Returns
    -------
    callable
        From points of shape (..., 3), mm, to bool of shape (...).
    """
    planes = []
    for focus, place in foci_mm.items():
        origin, basis = cage.plane_of(focus).lab_from_plane()
        normal = np.cross(basis[0], basis[1])
        planes.append((origin, normal, highest * float((np.asarray(place) - origin) @ normal)))

    def inside(points: Float) -> Bool:
        heights = [((points - origin) @ normal, top) for origin, normal, top in planes]
        result: Bool = np.logical_and.reduce([(height > -2.0) & (height < top) for height, top in heights])
        return result

    return inside


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Pairs of rays that may belong together."""

    a: Int
    b: Int
    distance_mm: Float
    sigma_mm: Float
    log_density: Float  # of unrelated crossings, per mm of signed distance
    features: Float  # (n, 3), NaN where unknown

    def rows(self, index: Int | Bool) -> _Edges:
        return _Edges(*(getattr(self, name)[index] for name in self.__slots__))

    def with_slack(self, slack_mm: float) -> _Edges:
        return replace(self, sigma_mm=np.hypot(self.sigma_mm, slack_mm))

    def log_ratio(self) -> Float:
        """Log likelihood ratio of the crossing distance, pair against chance."""
        gauss = -0.5 * (self.distance_mm / self.sigma_mm) ** 2 - np.log(np.sqrt(2 * np.pi) * self.sigma_mm)
        result: Float = gauss - self.log_density
        return result


def pair_rays(
    bundle: RayBundle,
    limits: Limits | None = None,
    *,
    region: Region | None = None,
    radius_mm: Float | None = None,
    contrast: Float | None = None,
    slack_mm: float | None = None,
) -> Pairing:
    """Find the rays that belong to one marker.

    Parameters
    ----------
    bundle : RayBundle
        Rays of all object images; an image of a shared film occurs as a ray of each of its foci, with the same ``image``.
    limits : Limits, optional
        ``crossing_sigma`` and ``posterior``.
    region : callable, optional
        Where a marker may be, as of :func:`cage_region`; default: in front of the foci.
    radius_mm : ndarray of shape (n,), optional
        Apparent radius at the ray's ``through_mm``; NaN where unknown.
    contrast : ndarray of shape (n,), optional
    slack_mm : float, optional
        Systematic error of the rays; default: estimated from the crossings.

    Returns
    -------
    Pairing
    """
    limits = limits or Limits()
    images = np.unique(bundle.image)
    known = np.isfinite(bundle.through_mm).all(axis=1) & np.isfinite(bundle.covariance_mm2).all(axis=(1, 2))
    finite: Bool = np.array(known, dtype=np.bool_)
    edges = _edges(bundle, finite, region or _in_front(bundle, finite), radius_mm, contrast)
    if not len(edges.a):
        return Pairing((), np.zeros(0), np.zeros(0, bool), np.zeros(0), (), images, 0.0, ())
    slack = _slack(edges) if slack_mm is None else slack_mm
    edges = edges.with_slack(slack)
    crossing = edges.distance_mm < limits.crossing_sigma * edges.sigma_mm
    edges, unrelated = edges.rows(crossing), edges.rows(~crossing)
    foci = len(np.unique(bundle.focus))
    groups, crossings, membership = _groups(bundle, edges, foci)
    look = np.zeros(len(edges.a))
    prior = 0.5
    packing = Packing(np.zeros(0, bool), np.zeros(0))
    for _ in range(4):  # what pairs look like, and how many there are, from the pairs themselves
        gain = crossings @ (edges.log_ratio()) + membership @ look + np.log(prior / (1 - prior)) * (np.array([len(g) for g in groups]) - 1)
        packing = pack([tuple(sorted(set(bundle.image[list(g)].tolist()))) for g in groups], gain)
        prior = _fraction(groups, packing, len(images), foci)
        look = _appearance(edges, unrelated, membership, packing)
    return _pairing(bundle, edges, groups, membership, packing, images, limits, slack)


def _in_front(bundle: RayBundle, finite: Bool) -> Region:
    origins = np.unique(bundle.origin_mm[finite], axis=0)
    towards = np.array([bundle.direction[finite & (bundle.origin_mm == o).all(axis=1)].mean(axis=0) for o in origins])

    def inside(points: Float) -> Bool:
        result: Bool = np.logical_and.reduce(
            [np.ones(points.shape[:-1], bool)] + [(points - o) @ d > 0 for o, d in zip(origins, towards, strict=True)]
        )
        return result

    return inside


def _edges(bundle: RayBundle, finite: Bool, region: Region, radius_mm: Float | None, contrast: Float | None) -> _Edges:
    """List the pairs of rays of different foci and images that cross within the widest window at a possible place."""
    parts: list[_Edges] = []
    n = len(bundle)
    with np.errstate(invalid="ignore", divide="ignore"):
        log_radius = np.log(radius_mm) if radius_mm is not None else np.full(n, np.nan)
        log_contrast = np.log(contrast) if contrast is not None else np.full(n, np.nan)
    length = np.linalg.norm(bundle.through_mm - bundle.origin_mm, axis=1)
    for p, q in combinations(np.unique(bundle.focus[finite]), 2):
        first, second = np.flatnonzero(finite & (bundle.focus == p)), np.flatnonzero(finite & (bundle.focus == q))
        points, distance, sigma = cross(bundle.rows(first), bundle.rows(second))
        with np.errstate(invalid="ignore"):
            possible = np.isfinite(distance) & (sigma > 0) & (bundle.image[first][:, None] != bundle.image[second][None])
            possible &= region(np.nan_to_num(points))
        density = np.zeros_like(distance)
        for window in WINDOWS_MM:
            close = possible & (distance < window)
            for axis in (0, 1):  # unrelated to the one ray, or to the other; half a crossing more, as few are counted
                others = close.sum(axis=axis, keepdims=True) - close
                density = np.maximum(density, (others + 0.5) / (2 * window))
        a, b = np.nonzero(possible & (distance < WINDOWS_MM[0]))
        scale_a = np.log(np.linalg.norm(points[a, b] - bundle.origin_mm[first[a]], axis=1) / length[first[a]])
        scale_b = np.log(np.linalg.norm(points[a, b] - bundle.origin_mm[second[b]], axis=1) / length[second[b]])
        size_a, size_b = log_radius[first[a]] + scale_a, log_radius[second[b]] + scale_b
        features = np.stack([(size_a + size_b) / 2, size_a - size_b, log_contrast[first[a]] - log_contrast[second[b]]], axis=1)
        features[~np.isfinite(features)] = np.nan
        parts.append(_Edges(first[a], second[b], distance[a, b], sigma[a, b], np.log(density[a, b]), features))
    if not parts:
        none = np.zeros(0)
        return _Edges(none.astype(int), none.astype(int), none, none, none, np.zeros((0, 3)))
    return _Edges(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Edges.__slots__))


def _slack(edges: _Edges) -> float:
    """Estimate a systematic error of the rays: the smallest slack with which the crossings are likely as a mixture of pairs and chance."""
    order = np.unique(edges.a, return_inverse=True)[1]
    fraction = np.array(FRACTIONS)[:, None]
    likelihood = []
    for slack in SLACKS_MM:
        ratio = np.full(order.max() + 1, -np.inf)
        np.logaddexp.at(ratio, order, edges.with_slack(slack).log_ratio())
        likelihood.append(float(np.logaddexp(np.log1p(-fraction), np.log(fraction) + ratio).sum(axis=1).max()))
    best = int(np.argmax(likelihood))
    return SLACKS_MM[best] if likelihood[best] > likelihood[0] + SLACK_EVIDENCE else 0.0


def _groups(bundle: RayBundle, edges: _Edges, foci: int) -> tuple[list[tuple[int, ...]], Float, Float]:
    """List all groups of mutually crossing rays, their weights on the crossings and their members, shapes (g, edges).

    k rays have k (k - 1) / 2 crossings, of which 2 k - 3 are independent (their coordinates less the three of the point).
    """
    number = {(int(a), int(b)): e for e, (a, b) in enumerate(zip(edges.a, edges.b, strict=True))}
    groups: list[tuple[int, ...]] = list(number)
    last = groups
    later: dict[int, set[int]] = {}
    for a, b in number:
        later.setdefault(a, set()).add(b)
    for _ in range(foci - 2):
        last = [
            (*group, c)
            for group in last
            for c in sorted(set.intersection(*(later.get(r, set()) for r in group)))
            if bundle.image[c] not in bundle.image[list(group)]
        ]
        groups = [*groups, *last]
        if len(groups) > MOST_GROUPS:
            break
    crossings, membership = np.zeros((len(groups), len(number))), np.zeros((len(groups), len(number)))
    for g, group in enumerate(groups):
        mine = [number[pair] for pair in combinations(group, 2)]
        k = len(group)
        crossings[g, mine] = (2 * k - 3) / (k * (k - 1) / 2)
        membership[g, mine] = 2 / k
    return groups, crossings, membership


def _fraction(groups: list[tuple[int, ...]], packing: Packing, images: int, foci: int) -> float:
    """Return the fraction of images that have a partner."""
    sizes = np.array([len(g) for g in groups])
    paired = float((np.nan_to_num(packing.posterior) * sizes).sum())
    return float(np.clip((paired + 1) / (images + 2), *PRIOR))


def _appearance(edges: _Edges, unrelated: _Edges, membership: Float, packing: Packing) -> Float:
    """Return the log likelihood ratio of what each pair looks like: by the sure pairs, against crossings that are surely none.

    Images of two markers of one kind may cross by chance, too, and then look like a pair: the unrelated crossings know.
    """
    sure = (membership[np.nan_to_num(packing.posterior) * packing.chosen > SURE] > 0).any(axis=0)
    total = np.zeros(len(edges.a))
    for column, (_, least, wide) in enumerate(FEATURES):
        value, others = edges.features[:, column], unrelated.features[:, column]
        others = others[np.isfinite(others)]
        known = np.isfinite(value)
        for e in np.flatnonzero(known):  # a pair is not judged by what itself has taught
            taught = value[sure & known & (edges.a != edges.a[e]) & (edges.b != edges.b[e])]
            n = len(taught)
            if n < LEARNT_FROM:
                continue
            middle = float(np.median(taught))
            spread = max(1.4826 * float(np.median(np.abs(taught - middle))), least) * np.sqrt(1 + 1 / n)
            unlike = (1 + (np.abs(taught - middle) > 4 * spread).sum()) / (n + 2)
            broad = _log_student((value[e] - middle) / wide, 3) - np.log(wide)
            near = np.exp(-0.5 * ((value[e] - others) / spread) ** 2).sum() / (spread * np.sqrt(2 * np.pi))
            null = float(np.log(near + UNKNOWN * np.exp(broad)) - np.log(len(others) + UNKNOWN))
            alike = _log_student((value[e] - middle) / spread, n - 1) - np.log(spread)
            total[e] += np.logaddexp(np.log1p(-unlike) + alike, np.log(unlike) + null) - null
    return total


def _log_student(t: float, freedom: int) -> float:
    v = float(freedom)
    return float(gammaln((v + 1) / 2) - gammaln(v / 2) - 0.5 * np.log(v * np.pi) - (v + 1) / 2 * np.log1p(t * t / v))


def _pairing(
    bundle: RayBundle,
    edges: _Edges,
    groups: list[tuple[int, ...]],
    membership: Float,
    packing: Packing,
    images: Int,
    limits: Limits,
    slack: float,
) -> Pairing:
    chosen = np.flatnonzero(packing.chosen & ~(packing.posterior < 0.5))
    sigmas = edges.distance_mm / edges.sigma_mm
    claimed = [set(bundle.image[list(g)].tolist()) for g in groups]
    rivals = []
    for g in chosen:
        others = [h for h in range(len(groups)) if h != g and claimed[h] & claimed[g] and not set(groups[h]) < set(groups[g])]
        best = max(others, key=lambda h: float(np.nan_to_num(packing.posterior[h], nan=1.0)), default=-1)
        rivals.append(groups[best] if best >= 0 else ())
    posterior = packing.posterior[chosen]
    ambiguous = ~(posterior >= limits.posterior)
    taken = np.unique([i for g in chosen for i in claimed[g]]).astype(int)
    return Pairing(
        tuple(groups[g] for g in chosen),
        posterior,
        ambiguous,
        np.array([sigmas[membership[g] > 0].max() for g in chosen]),
        tuple(rivals),
        np.setdiff1d(images, taken),
        slack,
        ("pair-ambiguous",) if ambiguous.any() else (),
    )
