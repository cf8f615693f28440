"""Where rays of different foci cross: distances, their errors, and how densely unrelated rays cross there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.geometry.rays import RayBundle, cross
from rsa_vision.types import Bool, Float, Int

WINDOWS_MM: Final = (3.0, 10.0)  # in which unrelated crossings are counted
SPREAD_OF_MEDIAN: Final = 3.4  # breadth of a uniform distribution over the median distance of two of it, 1 / (1 - sqrt(1/2))
SLACKS_MM: Final = (0.0, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3)  # systematic error of rays beyond their covariance, tried in turn
FRACTIONS: Final = (0.03, 0.1, 0.2, 0.4, 0.7, 0.9)  # of rays that have a partner, tried likewise
SLACK_EVIDENCE: Final = 5.0  # log likelihood by which a slack must be better than none
WORSE: Final = 0.03  # part of the pairs whose error is WORSE_SIGMA times what is stated: a neighbour or an edge beside an image
WORSE_SIGMA: Final = 3.0
BOUND: Final = 3.0  # times what is usual: from there on an error is no more than a bound

Region = Callable[[Float], Bool]


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


def in_front(bundle: RayBundle) -> Region:
    """Return where rays of all foci may meet: in front of the foci."""
    origins = np.unique(bundle.origin_mm, axis=0)
    towards = np.array([bundle.direction[(bundle.origin_mm == o).all(axis=1)].mean(axis=0) for o in origins])

    def inside(points: Float) -> Bool:
        result: Bool = np.logical_and.reduce(
            [np.ones(points.shape[:-1], bool)] + [(points - o) @ d > 0 for o, d in zip(origins, towards, strict=True)]
        )
        return result

    return inside


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """Rays of two foci (rising), which of them pass each other at a possible place within each window, and the breadth they all fill."""

    first: Int
    second: Int
    close: tuple[Bool, ...]
    breadth_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Crossings:
    """Pairs of rays that may belong together.

    Attributes
    ----------
    a, b : ndarray of int, shape (n,)
        Rows of the bundle.
    distance_mm, sigma_mm : ndarray of shape (n,)
        Crossing distance and its standard deviation.
    grown_a, grown_b : ndarray of shape (n,)
        Log of the distances from the focus, crossing over film.
    log_density : ndarray of shape (n,)
        Log density of unrelated crossings, per mm of signed distance.
    """

    a: Int
    b: Int
    distance_mm: Float
    sigma_mm: Float
    grown_a: Float
    grown_b: Float
    log_density: Float

    def __len__(self) -> int:
        return len(self.a)

    def rows(self, index: Int | Bool) -> Crossings:
        """Return some of them."""
        return Crossings(*(getattr(self, name)[index] for name in self.__slots__))

    def with_slack(self, slack_mm: float) -> Crossings:
        """Return them with a common error in quadrature to the sigmas."""
        return replace(self, sigma_mm=np.hypot(self.sigma_mm, slack_mm))

    def among(self, neighbours: tuple[Neighbours, ...], weight: Float) -> Crossings:
        """Return them with the density of crossings with rays that count by a weight: their probability to be there without a partner.

        The largest of what is met around either ray in either window counts, but no less than everywhere (all of them, and half a ray more,
        on the breadth that the rays fill). As few are counted in a window, half a ray is added to it, with the room that it has elsewhere.
        """
        density = np.zeros(len(self))
        for some in neighbours:
            mine = np.isin(self.a, some.first) & np.isin(self.b, some.second)
            i, j = np.searchsorted(some.first, self.a[mine]), np.searchsorted(some.second, self.b[mine])
            of_a, of_b = weight[some.first], weight[some.second]
            everywhere = (max(float(of_a.sum()), float(of_b.sum())) + 0.5) / some.breadth_mm
            density[mine] = everywhere
            for window, close in zip(WINDOWS_MM, some.close, strict=True):
                around_a, around_b = close @ of_b, of_a @ close
                others = np.maximum(around_a[i] - of_b[j], around_b[j] - of_a[i])
                density[mine] = np.maximum(density[mine], (others.clip(0) + 0.5) / (2 * window + 0.5 / everywhere))
        return replace(self, log_density=np.log(density))

    def log_ratio(self, usual_mm: float = np.inf) -> Float:
        """Return the log likelihood ratio of the crossing distance, pair against chance.

        Parameters
        ----------
        usual_mm : float
            Error of the crossings that are clear. Errors far larger are stated for images that nothing describes well: so far
            off the centre may be, and most lie as near as any other. Every size between is as likely as the next, by steps
            of :data:`BOUND`.

        Returns
        -------
        ndarray of shape (n,)
        """
        steps = np.floor(np.log(np.maximum(self.sigma_mm / usual_mm, 1.0)) / np.log(BOUND))
        result = np.full(len(self), -np.inf)
        for step in range(int(steps.max(initial=0.0)) + 1):
            with np.errstate(divide="ignore"):
                here = np.log(step <= steps) - np.log1p(steps)
            result = np.logaddexp(result, here + self._log_error(self.sigma_mm / BOUND**step))
        return result - self.log_density

    def _log_error(self, sigma_mm: Float) -> Float:
        """Return the log density of the distances."""
        squared = -0.5 * (self.distance_mm / sigma_mm) ** 2
        usual = np.log(1 - WORSE) + squared
        worse = np.log(WORSE / WORSE_SIGMA) + squared / WORSE_SIGMA**2
        result: Float = np.logaddexp(usual, worse) - np.log(np.sqrt(2 * np.pi) * sigma_mm)
        return result


def find_crossings(bundle: RayBundle, region: Region | None) -> tuple[Crossings, tuple[Neighbours, ...]]:
    """List the pairs of rays of different foci and images that cross within the smallest window at a possible place.

    Parameters
    ----------
    bundle : RayBundle
        Rays with NaN are left out.
    region : callable or None
        Where a marker may be; None: in front of the foci.

    Returns
    -------
    crossings : Crossings
        Their densities by all rays alike.
    neighbours : tuple of Neighbours
        For every two foci.
    """
    known: Bool = np.array(np.isfinite(bundle.through_mm).all(axis=1) & np.isfinite(bundle.covariance_mm2).all(axis=(1, 2)))
    inside = region or in_front(bundle.rows(known))
    length = np.linalg.norm(bundle.through_mm - bundle.origin_mm, axis=1)
    none = np.zeros(0)
    parts = [Crossings(none.astype(int), none.astype(int), *[none] * 5)]
    neighbours = []
    for p, q in combinations(np.unique(bundle.focus[known]), 2):
        first, second = np.flatnonzero(known & (bundle.focus == p)), np.flatnonzero(known & (bundle.focus == q))
        points, distance, sigma = cross(bundle.rows(first), bundle.rows(second))
        with np.errstate(invalid="ignore"):
            possible = np.isfinite(distance) & (sigma > 0) & (bundle.image[first][:, None] != bundle.image[second][None])
            possible &= inside(np.nan_to_num(points))
            close = tuple(possible & (distance < window) for window in WINDOWS_MM)
        with np.errstate(invalid="ignore"):
            median = float(np.median(distance[np.isfinite(distance)])) if np.isfinite(distance).any() else 0.0
        neighbours.append(Neighbours(first, second, close, max(SPREAD_OF_MEDIAN * median, 2 * WINDOWS_MM[-1])))
        i, j = np.nonzero(close[0])
        a, b, at = first[i], second[j], points[i, j]
        grown_a = np.log(np.linalg.norm(at - bundle.origin_mm[a], axis=1) / length[a])
        grown_b = np.log(np.linalg.norm(at - bundle.origin_mm[b], axis=1) / length[b])
        parts.append(Crossings(a, b, distance[i, j], sigma[i, j], grown_a, grown_b, np.zeros(len(a))))
    crossings = Crossings(*(np.concatenate([getattr(part, name) for part in parts]) for name in Crossings.__slots__))
    return crossings.among(tuple(neighbours), np.ones(len(bundle))), tuple(neighbours)


def common_error(crossings: Crossings) -> float:
    """Estimate a systematic error of the rays: the smallest slack with which the crossings are likely as a mixture of pairs and chance."""
    order = np.unique(crossings.a, return_inverse=True)[1]
    fraction = np.array(FRACTIONS)[:, None]
    likelihood = []
    for slack in SLACKS_MM:
        ratio = np.full(order.max() + 1, -np.inf)
        np.logaddexp.at(ratio, order, crossings.with_slack(slack).log_ratio())
        likelihood.append(float(np.logaddexp(np.log1p(-fraction), np.log(fraction) + ratio).sum(axis=1).max()))
    best = int(np.argmax(likelihood))
    return SLACKS_MM[best] if likelihood[best] > likelihood[0] + SLACK_EVIDENCE else 0.0
