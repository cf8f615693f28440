"""Where rays of different foci cross: distances, their errors, and how densely unrelated rays cross there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.geometry.rays import RayBundle, cross
from rsa_vision.identify.densities import log_student
from rsa_vision.identify.depths import log_chance_of_depths
from rsa_vision.identify.looks import FAINT
from rsa_vision.types import Bool, Float, Int

WINDOWS_MM: Final = (3.0, 10.0)  # in which unrelated crossings are counted
SPREAD_OF_MEDIAN: Final = 3.4  # breadth of a uniform distribution over the median distance of two of it, 1 / (1 - sqrt(1/2))
SLACKS_MM: Final = (0.0, 0.01, 0.02, 0.04, 0.08, 0.15, 0.3)  # systematic error of rays beyond their covariance, tried in turn
FRACTIONS: Final = (0.03, 0.1, 0.2, 0.4, 0.7, 0.9)  # of rays that have a partner, tried likewise
SLACK_EVIDENCE: Final = 5.0  # log likelihood by which a slack must be better than none
STATED: Final = 2.0  # errors as stated, presumed beside those of the other pairs
TURNS: Final = 3  # of scale and trust, which depend on each other
WORSE: Final = 0.03  # part of the pairs whose error is WORSE_SIGMA times what is stated: a neighbour or an edge beside an image
WORSE_SIGMA: Final = 3.0
BOUND: Final = 3.0  # times what is usual: from there on an error is no more than a bound
HIGHEST: Final = 0.8  # of a focus above its plane, to which an object may reach

Region = Callable[[Float], Bool]


def cage_region(cage: Cage, foci_mm: Mapping[int, Float]) -> Region:
    """Return where an object may be: before every fiducial plane of the foci, and not too near to a focus.

    Parameters
    ----------
    cage : Cage
    foci_mm : mapping
        Foci in the laboratory frame.

    Returns
    -------
    callable
        From points of shape (..., 3), mm, to bool of shape (...).
    """
    planes = []
    for focus, place in foci_mm.items():
        origin, basis = cage.plane_of(focus).lab_from_plane()
        normal = np.cross(basis[0], basis[1])
        planes.append((origin, normal, HIGHEST * float((np.asarray(place) - origin) @ normal)))

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
    """Rays of two foci (rising), and how any two of them pass each other.

    ``close`` tells which do so at a possible place within each window, ``breadth_mm`` is what they all fill, and ``log_depth`` is NaN where
    the place is not possible.
    """

    first: Int
    second: Int
    close: tuple[Bool, ...]
    breadth_mm: float
    log_depth: Float


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
    log_chance : ndarray of shape (n,)
        Log density of such a depth among unrelated crossings.
    """

    a: Int
    b: Int
    distance_mm: Float
    sigma_mm: Float
    grown_a: Float
    grown_b: Float
    log_density: Float
    log_chance: Float

    def __len__(self) -> int:
        return len(self.a)

    def rows(self, index: Int | Bool) -> Crossings:
        """Return some of them."""
        return Crossings(*(getattr(self, name)[index] for name in self.__slots__))

    @property
    def log_depth(self) -> Float:
        """Log of how far from the foci they are, as a part of the way to the film, both rays together."""
        result: Float = (self.grown_a + self.grown_b) / 2
        return result

    def with_slack(self, slack_mm: float) -> Crossings:
        """Return them with a common error in quadrature to the sigmas."""
        return replace(self, sigma_mm=np.hypot(self.sigma_mm, slack_mm))

    def among(self, neighbours: tuple[Neighbours, ...], weight: Float) -> Crossings:
        """Return them with the density of crossings with rays that count by a weight: their probability to be there without a partner.

        The largest of what is met around either ray in either window counts, but no less than everywhere (all of them, and half a ray more,
        on the breadth that the rays fill). As few are counted in a window, half a ray is added to it, with the room that it has elsewhere.
        """
        density, chance = np.zeros(len(self)), np.zeros(len(self))
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
            if mine.any():
                met = np.isfinite(some.log_depth)
                chance[mine] = log_chance_of_depths(self.log_depth[mine], some.log_depth[met], np.outer(of_a, of_b)[met])
        return replace(self, log_density=np.log(density), log_chance=chance)

    def scale_of_errors(self, pair: Float, usual_mm: float) -> tuple[Float, Float]:
        """Return how large the errors are, in parts of what is stated, and how well that is known, by the other pairs.

        Stated errors share parts (the focus, the film's place) whose size is presumed rather than known.

        Parameters
        ----------
        pair : ndarray of shape (n,)
            Probability of every crossing to be a marker, so far.
        usual_mm : float
            As of :meth:`log_ratio`: errors far larger teach nothing.

        Returns
        -------
        scale, freedom : ndarray of shape (n,)
            Of Student's distribution of the next error over the stated one. No crossing is judged by what its own rays have taught.
        """
        teachers = np.flatnonzero((pair > FAINT) & (self.sigma_mm < BOUND * usual_mm))
        squared = (self.distance_mm[teachers] / self.sigma_mm[teachers]) ** 2
        weight = pair[teachers] * ((self.a[teachers] != self.a[:, None]) & (self.b[teachers] != self.b[:, None]))
        scale, freedom = np.ones(len(self)), STATED + weight.sum(axis=1)
        for _ in range(TURNS):  # an error that is worse than usual teaches less
            trust = weight * 5 / (4 + squared / scale[:, None] ** 2)
            scale = np.sqrt((STATED + trust @ squared) / freedom)
        return scale, freedom

    def log_ratio(self, usual_mm: float = np.inf, scale: Float | float = 1.0, freedom: Float | float = 1e6) -> Float:
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
        usual = self.sigma_mm * np.where(steps > 0, 1.0, scale)
        for step in range(int(steps.max(initial=0.0)) + 1):
            with np.errstate(divide="ignore"):
                here = np.log(step <= steps) - np.log1p(steps)
            result = np.logaddexp(result, here + self._log_error(usual / BOUND**step, freedom))
        return result - self.log_density

    def _log_error(self, sigma_mm: Float, freedom: Float | float) -> Float:
        """Return the log density of the distances."""
        deviation = self.distance_mm / sigma_mm
        usual = np.log(1 - WORSE) + log_student(deviation, freedom)
        worse = np.log(WORSE / WORSE_SIGMA) + log_student(deviation / WORSE_SIGMA, freedom)
        result: Float = np.logaddexp(usual, worse) - np.log(sigma_mm)
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
    parts = [Crossings(none.astype(int), none.astype(int), *[none] * 6)]
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
        with np.errstate(invalid="ignore", divide="ignore"):
            grown_a = np.log(np.linalg.norm(points - bundle.origin_mm[first][:, None], axis=2) / length[first][:, None])
            grown_b = np.log(np.linalg.norm(points - bundle.origin_mm[second], axis=2) / length[second])
        log_depth = np.where(possible, (grown_a + grown_b) / 2, np.nan)
        neighbours.append(Neighbours(first, second, close, max(SPREAD_OF_MEDIAN * median, 2 * WINDOWS_MM[-1]), log_depth))
        i, j = at = np.nonzero(close[0])
        parts.append(Crossings(first[i], second[j], distance[at], sigma[at], grown_a[at], grown_b[at], *[np.zeros(len(i))] * 2))
    crossings = Crossings(*(np.concatenate([getattr(part, name) for part in parts]) for name in Crossings.__slots__))
    return crossings.among(tuple(neighbours), np.ones(len(bundle))), tuple(neighbours)


def common_error(crossed: Sequence[Crossings]) -> float:
    """Estimate a systematic error of the rays: the smallest slack with which the crossings are likely as mixtures of pairs and chance.

    Parameters
    ----------
    crossed : sequence of Crossings
        Of rays of different images each, mixed in parts of their own.

    Returns
    -------
    float
        0 unless there is evidence.
    """
    fraction = np.array(FRACTIONS)[:, None]
    likelihood = np.zeros(len(SLACKS_MM))
    for crossings in crossed:
        rays, order = np.unique(crossings.a, return_inverse=True)
        for k, slack in enumerate(SLACKS_MM):
            ratio = np.full(len(rays), -np.inf)
            np.logaddexp.at(ratio, order, crossings.with_slack(slack).log_ratio())
            likelihood[k] += np.logaddexp(np.log1p(-fraction), np.log(fraction) + ratio).sum(axis=1).max()
    best = int(np.argmax(likelihood))
    return SLACKS_MM[best] if likelihood[best] > likelihood[0] + SLACK_EVIDENCE else 0.0
