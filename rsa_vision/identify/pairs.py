"""Which object images of different foci show the same marker.

Two rays belong together if they cross: the crossing distance in units of its own sigma, against the density with which unrelated rays would
cross as well. Images of balls of one kind also agree in the size that their depth implies, and in contrast; how well they do is learnt from
the pairs that are beyond doubt. All assignments are summed (:mod:`packing`): a pair carries the probability of being one.

Images of two shapes show two markers. Each shape is paired for itself, with markers, looks and clutter of its own; the error of rays beyond
their covariance is that of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Final

import numpy as np

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.alone import images_alone
from rsa_vision.identify.crossings import Crossings, Neighbours, Region, common_error, find_crossings
from rsa_vision.identify.densities import weighted_median
from rsa_vision.identify.depths import log_odds_of_depths
from rsa_vision.identify.looks import UNSURE, Looks
from rsa_vision.identify.packing import Packing, components, pack
from rsa_vision.identify.pair_looks import log_odds_of_looks
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, Int, Str

ROUNDS: Final = 5
PRIOR: Final = (0.02, 0.95)  # bounds of the learnt fraction of rays that have a partner
MOST_GROUPS: Final = 20_000
MOST_CONTESTED: Final = 100  # groups that are left to the markers' configuration to choose among


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
    unmatched : ndarray of int
        Images that are in no group, rising.
    slack_mm : float
        Error of the rays beyond their covariance that the crossings show (in quadrature to the sigma of a crossing); 0: none.
    reasons : tuple of str
        ``pair-ambiguous`` or nothing.
    contested : tuple of tuple of int
        Every possible group of the images that ambiguous groups claim, and of those linked with them by other possible groups; none if
        there are more than can be weighed.
    contested_log_odds : ndarray of shape (c,)
        Of such a group, against its images being unrelated.
    """

    groups: tuple[tuple[int, ...], ...]
    posterior: Float
    ambiguous: Bool
    crossing_sigma: Float
    unmatched: Int
    slack_mm: float
    reasons: tuple[str, ...]
    contested: tuple[tuple[int, ...], ...] = ()
    contested_log_odds: Float = field(default_factory=lambda: np.zeros(0))


def pair_rays(
    bundle: RayBundle,
    limits: Limits | None = None,
    *,
    region: Region | None = None,
    shape: Str | None = None,
    radius_mm: Float | None = None,
    contrast: Float | None = None,
    quality: Int | None = None,
    error: Float | None = None,
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
    shape : ndarray of str, shape (n,), optional
        Of the ray's image; those of a marker are of one shape. Default: all alike.
    radius_mm : ndarray of shape (n,), optional
        Apparent radius at the ray's ``through_mm``; NaN where unknown.
    contrast : ndarray of shape (n,), optional
        NaN where unknown; of shapes of which none is known sizes are compared alone.
    quality : ndarray of int, shape (n,), optional
        How well the image was fitted: 0 clear, 1 disturbed, 2 not described by the model; default: all alike.
    error : ndarray of shape (n,), optional
        Of the logarithms of radius and contrast, by noise; default: too small to matter.
    slack_mm : float, optional
        Systematic error of the rays; default: estimated from the crossings.

    Returns
    -------
    Pairing
    """
    limits = limits or Limits()
    n = len(bundle)
    known = [np.full(n, np.nan) if values is None else values for values in (radius_mm, contrast)]
    with np.errstate(invalid="ignore", divide="ignore"):
        look = np.log(np.stack(known, axis=1))
    quality = np.zeros(n, np.int64) if quality is None else quality
    error = np.zeros(n) if error is None else np.clip(np.nan_to_num(error), 0.0, UNSURE[0])
    shape = np.full(n, "") if shape is None else shape
    alike = [np.flatnonzero(shape == one) for one in np.unique(shape)] or [np.arange(0)]
    crossed = [find_crossings(bundle.rows(mine), region) for mine in alike]
    slack = common_error([crossings for crossings, _ in crossed]) if slack_mm is None else slack_mm
    parts = [
        _pair_alike(bundle.rows(mine), limits, *found, slack, look[mine], quality[mine], error[mine])
        for mine, found in zip(alike, crossed, strict=True)
    ]
    return _together(parts, alike, slack)


def _together(parts: Sequence[Pairing], rows: Sequence[Int], slack: float) -> Pairing:
    """Join the pairings of some rows of a bundle each."""

    def groups(name: str) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(mine[list(group)].tolist()) for part, mine in zip(parts, rows, strict=True) for group in getattr(part, name))

    return Pairing(
        groups("groups"),
        np.concatenate([part.posterior for part in parts]),
        np.concatenate([part.ambiguous for part in parts]),
        np.concatenate([part.crossing_sigma for part in parts]),
        np.sort(np.concatenate([part.unmatched for part in parts])),
        slack,
        tuple(dict.fromkeys(reason for part in parts for reason in part.reasons)),
        groups("contested"),
        np.concatenate([part.contested_log_odds for part in parts]),
    )


def _pair_alike(
    bundle: RayBundle,
    limits: Limits,
    crossings: Crossings,
    neighbours: tuple[Neighbours, ...],
    slack: float,
    look: Float,
    quality: Int,
    error: Float,
) -> Pairing:
    """Pair the rays of images of one shape, by where they cross and by their looks (n, 2) with their errors."""
    images = np.unique(bundle.image)
    if not len(crossings):
        return Pairing((), np.zeros(0), np.zeros(0, bool), np.zeros(0), images, slack, ())
    crossings = crossings.with_slack(slack)
    crossings = crossings.rows(crossings.distance_mm < limits.crossing_sigma * crossings.sigma_mm)
    look = look[:, : 2 if np.isfinite(look[:, 1]).any() else 1]
    known = Looks(bundle.image, look, quality, crossings.a, crossings.b, crossings.grown_a, crossings.grown_b, error)
    foci = len(np.unique(bundle.focus))
    groups, share, membership = _groups(bundle, crossings, foci)
    claims = [tuple(sorted(set(bundle.image[list(group)].tolist()))) for group in groups]
    by_look, place, of_quality = np.zeros(len(crossings)), np.zeros(len(crossings)), np.zeros(len(bundle))
    scale, freedom = np.ones(len(crossings)), np.full(len(crossings), 1e6)
    unsaid = float(np.log(len(bundle) / len(images)))  # of which focus an image is: a pair needs one of each
    prior, usual_mm = 0.5, float(np.median(crossings.sigma_mm)) if len(crossings) else np.inf
    packing, gain = Packing(np.zeros(0, bool), np.zeros(0)), np.zeros(len(groups))
    for _ in range(ROUNDS):  # what pairs look like, and how many there are, from the pairs themselves
        gain = share @ crossings.log_ratio(usual_mm, scale, freedom) + membership @ (by_look + place)
        gain += np.array([of_quality[list(g)].sum() + (np.log(prior / (1 - prior)) - unsaid) * (len(g) - 1) for g in groups])
        packing = pack(claims, gain)
        prior = _fraction(groups, packing, len(images))
        posterior = np.nan_to_num(packing.posterior)
        paired = np.zeros(int(images.max()) + 1)
        for claim, probability in zip(claims, posterior, strict=True):
            paired[list(claim)] += probability
        of_ray = paired[bundle.image].clip(0, 1)
        of_crossing = posterior @ (membership > 0)
        if of_crossing.sum() > 0:
            usual_mm = float(weighted_median(crossings.sigma_mm[:, None], of_crossing)[0])
        scale, freedom = crossings.scale_of_errors(of_crossing, usual_mm)
        looks = known.as_usual_here(of_crossing)
        alone = images_alone(looks, of_ray)
        crossings = crossings.among(neighbours, (1 - of_ray) + alone.hidden * of_ray)
        place = log_odds_of_depths(crossings.log_depth, crossings.log_chance, crossings.a, crossings.b, of_crossing)
        by_look, of_quality = log_odds_of_looks(looks, of_crossing, alone, images_alone(looks.sizes, of_ray)), alone.log_quality
    found = _pairing(bundle, crossings, groups, membership, packing, images, limits, slack)
    contested = _contested(claims, {claims[groups.index(g)] for g, doubt in zip(found.groups, found.ambiguous, strict=True) if doubt})
    return replace(found, contested=tuple(groups[g] for g in contested), contested_log_odds=gain[contested])


def _contested(claims: list[tuple[int, ...]], ambiguous: set[tuple[int, ...]]) -> list[int]:
    """Return the groups that share images with ambiguous ones, directly or by others."""
    linked = [g for part in components(claims) if any(claims[g] in ambiguous for g in part) for g in part]
    return linked if len(linked) <= MOST_CONTESTED else []


def _groups(bundle: RayBundle, crossings: Crossings, foci: int) -> tuple[list[tuple[int, ...]], Float, Float]:
    """List all groups of mutually crossing rays, their weights on the crossings and their members, shapes (g, crossings).

    k rays have k (k - 1) / 2 crossings, of which 2 k - 3 are independent (their coordinates less the three of the point).
    """
    number = {(int(a), int(b)): e for e, (a, b) in enumerate(zip(crossings.a, crossings.b, strict=True))}
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
    share, membership = np.zeros((len(groups), len(number))), np.zeros((len(groups), len(number)))
    for g, group in enumerate(groups):
        mine = [number[pair] for pair in combinations(group, 2)]
        k = len(group)
        share[g, mine] = (2 * k - 3) / (k * (k - 1) / 2)
        membership[g, mine] = 2 / k
    return groups, share, membership


def _fraction(groups: list[tuple[int, ...]], packing: Packing, images: int) -> float:
    """Return the fraction of images that have a partner."""
    sizes = np.array([len(g) for g in groups])
    paired = float((np.nan_to_num(packing.posterior) * sizes).sum())
    return float(np.clip((paired + 1) / (images + 2), *PRIOR))


def _pairing(
    bundle: RayBundle,
    crossings: Crossings,
    groups: list[tuple[int, ...]],
    membership: Float,
    packing: Packing,
    images: Int,
    limits: Limits,
    slack: float,
) -> Pairing:
    chosen = np.flatnonzero(packing.chosen & ~(packing.posterior < 0.5))
    sigmas = crossings.distance_mm / crossings.sigma_mm
    claimed = [set(bundle.image[list(g)].tolist()) for g in groups]
    posterior = packing.posterior[chosen]
    ambiguous = ~(posterior >= limits.posterior)
    taken = np.unique([i for g in chosen for i in claimed[g]]).astype(int)
    return Pairing(
        tuple(groups[g] for g in chosen),
        posterior,
        ambiguous,
        np.array([sigmas[membership[g] > 0].max() for g in chosen]),
        np.setdiff1d(images, taken),
        slack,
        ("pair-ambiguous",) if ambiguous.any() else (),
    )
