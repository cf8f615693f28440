"""Balls at many places of a film: first looks, fits in windows that suit them, and the figures by which they are judged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import ndtri

from rsa_vision.detect.balls.fits import BallFits, fit_balls, half_size, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Beside, beside_each
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool, Float

BATCH = 96  # windows that stay in the cache
_LIKE = 1.25  # ratio of their sizes
_PADDED = 10_000  # pixels by which smaller ones may be too large besides: another batch costs as much
ROUNDNESS = 0.2  # less round extrema are ridges
COARSE_SIGMA_PX, COARSE_MU_PX = 1.1, 0.5  # for the first look only
_COARSE_BLUR = 0.25  # of the radius that answers, where that is more: between the sharpest and the softest images there are
MISFIT = 0.09  # model errors beyond the noise, RMS over depth, that a tantalum ball may leave (film curve, focal spot): see docs/method.md
DOUBTFUL = 0.6  # of it: more may be two balls, or something else
ANYTHING = 6.0  # times the misfit that is tolerated otherwise, which pairs leave that hardly lap
CHANCE = 4.0  # standard deviations of the mean square of noise, for which no mark is blamed
QUIET = 1.25  # less variance than this around a ball, in units of the noise, is noise: chance excuses what such a ball leaves
EXPLAINED = 0.9
_PROMISING = 0.85  # of the significance a mark must have: better fits are 3 % more significant mostly, 10 % at the most
SURE = 9.0  # significance over clutter that trabeculae and soft shadows seldom reach; tantalum mostly does
_CAP, _CAP_MISFIT, _CAP_SURE = 0.4, 0.03, 20.0  # of a ball seen, that is enough if it leaves so little and stands out so far
_CAP_PIXELS = 12  # of such a one, if nothing beside it is seen
_SMALLEST_PX = 2.5  # radius of the smallest marks looked for: so many independent places has a film
STANDS_OUT = 7.0  # significance over noise and structure around, from which noise may hide the ball's form


def fit_at(
    film: NDArray[Any],
    position_px: Float,
    radius_px: Float,
    optics: Optics,
    noise: NoiseModel,
    others: Beside | None = None,
    *,
    quick: bool = False,
    sparse: bool = False,
) -> BallFits:
    """Fit balls at these places, in windows that suit their radii.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    position_px : ndarray of shape (n, 2)
    radius_px : ndarray of shape (n,)
    optics : Optics
    noise : NoiseModel
    others : callable, optional
        ``others(i, cols, rows)``: images of the neighbours of ball ``i`` at these pixels, and where they are not to be trusted.
    quick, sparse : bool
        As of :func:`rsa_vision.detect.balls.fits.fit_balls`.

    Returns
    -------
    BallFits
        In the order of the positions.
    """
    if not len(radius_px):
        return no_fits()
    halves = np.array([half_size(r, optics.sigma_px) for r in radius_px])
    order, parts = np.argsort(halves, kind="stable"), []
    begin = 0
    while begin < len(order):
        # windows of nearly one size at once; what of them is not a smaller one's is masked
        index = order[begin : begin + BATCH]
        sides = 2 * halves[index] + 1
        padded = np.arange(len(index)) * sides**2 - np.cumsum(np.append(0, sides[:-1] ** 2))
        index = index[: int(((sides <= _LIKE * sides[0]) | (padded <= _PADDED)).argmin()) or len(index)]
        begin += len(index)
        patches = cut(film, position_px[index], int(halves[index[-1]]), noise)
        extra = None
        if others is not None:
            extra, doubtful = beside_each(patches, index, others)
            patches = replace(patches, valid=patches.valid & ~doubtful)
        start = (position_px[index], radius_px[index], halves[index])
        parts.append(fit_balls(patches, *start, optics, noise, extra, quick=quick, sparse=sparse))
    return join(parts).rows(np.argsort(order))


def misfit(fits: BallFits, noise: NoiseModel, chance: float = 0.0) -> Float:
    """Return the RMS residual under the ball beyond the noise, as a fraction of the depth, shape (n,).

    ``chance``: what is within so many standard deviations of the mean square of noise alone does not count.
    """
    excess = np.maximum(fits.chi2_core - 1.0, 0.0)
    excess = np.where(excess > chance * noise.scatter(fits.n_core), excess, 0.0) * noise.variance_at(fits.background)
    rest: Float = np.sqrt(excess) / np.maximum(np.abs(fits.depth), 1e-9)
    return rest


def plausible(fits: BallFits, noise: NoiseModel, slack: float = 1.0) -> Bool:
    """Say which fits look like balls: the model leaves little, and explains nearly all.

    Parameters
    ----------
    fits : BallFits
    noise : NoiseModel
    slack : float
        Above 1: more tolerant, for a first look.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    left = misfit(fits, noise, CHANCE)
    # little is left of the window beside a saturated area: enough if the ball itself is whole, or what is seen of it a ball's to the last
    # per cent; of a ball that is cut off, its rim
    like_a_cap = (left < _CAP_MISFIT * slack) & (fits.significance > _CAP_SURE)
    whole = fits.valid_fraction > np.where(like_a_cap, _CAP, 0.6)
    seen = ((fits.valid_fraction > 0.1) & (fits.window_fraction > 0.5)) | (whole & (fits.window_fraction > 0.05))
    seen |= like_a_cap & (fits.n_core >= _CAP_PIXELS) & (fits.hidden != 0) & ~short_of_end(fits, noise)
    seen &= fits.hidden * fits.depth <= 0  # beyond the upper end only dark marks can be, beyond the lower one bright ones
    usable = seen & np.isfinite(fits.position_px).all(1)
    # of a weak image noise leaves more than a tenth; that it is a ball is then told by how far it stands out of all around it
    least = 1 - (1 - EXPLAINED) * slack
    stands_out = fits.significance / np.sqrt(np.maximum(fits.chi2_ring, 1.0)) > STANDS_OUT
    by_chance = np.where(fits.chi2_ring < QUIET, CHANCE * noise.scatter(fits.n_core), 0.0)
    explained = (fits.explained > least) | ((explained_over_noise(fits, by_chance) > least) & stands_out)
    return usable & (left < MISFIT * slack) & explained & (fits.significance > 5.0)


def short_of_end(fits: BallFits, noise: NoiseModel) -> Bool:
    """Say which have a background that does not come to the end of the range that is said to hide it, shape (n,)."""
    slack = MISFIT * np.abs(fits.depth)
    upper, lower = fits.background < noise.ceiling - slack, fits.background > noise.floor + slack
    return np.asarray(np.where(fits.hidden > 0, upper, (fits.hidden < 0) & lower))


def in_correlated_noise(fits: BallFits, sigma_px: float, noise: NoiseModel) -> Float:
    """Return the significance of quick fits, which is that in white noise, less what the correlation of the noise takes from it, (n,)."""
    return np.asarray(fits.significance / np.sqrt(noise.gain(np.hypot(sigma_px, 0.5 * fits.radius_px))))


def promising(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel) -> Bool:
    """Say which quick fits may become marks: their significance is that in white noise, and the correlation of the noise takes from it.

    Parameters
    ----------
    fits : BallFits
    limit : float
        Significance that a mark must have, as of :func:`significance_limit`.
    sigma_px : float
        Blur they were fitted with.
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    return np.asarray(in_correlated_noise(fits, sigma_px, noise) > _PROMISING * limit)


def explained_over_noise(fits: BallFits, by_chance: Float | float = 0.0) -> Float:
    """Return the part of the excess over the noise under each ball that the ball explains, shape (n,).

    ``by_chance``: of what it leaves, in units of the noise, so much more than the noise does not count.
    """
    left = fits.chi2_core
    raised = left / np.maximum(1.0 - fits.explained, 1e-9)
    out: Float = 1.0 - np.maximum(left - 1.0 - by_chance, 0.0) / np.maximum(raised - 1.0, 1e-9)
    return np.where(raised > 1.0, out, 0.0)


def first_look(film: NDArray[Any], candidates: Candidates, noise: NoiseModel, slack: float = 2.5) -> BallFits:
    """Fit every candidate with guessed optics and keep what may be a ball.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
    noise : NoiseModel
    slack : float
        As of :func:`plausible`.

    Returns
    -------
    BallFits
        In the order of the candidates; several may have come to the same place.
    """
    if len(candidates.radius_px) == 0:
        return no_fits()
    sizes, size = np.unique(candidates.radius_px, return_inverse=True)
    parts = []
    for k, radius in enumerate(sizes):
        same, guess = size == k, guessed_optics(float(radius))
        parts.append(fit_at(film, candidates.position_px[same], candidates.radius_px[same], guess, noise, quick=True, sparse=True))
    fits = join(parts).rows(np.argsort(np.argsort(size, kind="stable")))
    return fits.rows(plausible(fits, noise, slack))


def guessed_optics(radius_px: float) -> Optics:
    """Return what balls of this size may look like, before a film's own are known."""
    sigma = max(COARSE_SIGMA_PX, _COARSE_BLUR * radius_px)
    return Optics(sigma, COARSE_MU_PX * COARSE_SIGMA_PX / sigma)


def distinct(fits: BallFits, noise: NoiseModel) -> BallFits:
    """Of fits that fell on the same place keep the better one (best first); what is sure comes before specks, which fit well."""
    if len(fits.depth) == 0:
        return fits
    near = KDTree(fits.position_px).query_ball_point(fits.position_px, 0.5 * fits.radius_px)
    speck = fits.significance < SURE * np.sqrt(np.maximum(fits.chi2_ring, 1.0))
    order, kept = np.lexsort((misfit(fits, noise) + (1 - fits.explained), speck)), np.zeros(len(near), bool)
    for i in order:
        kept[i] = not kept[near[i]].any()
    return fits.rows(order[kept[order]])


def refine(grid: tuple[float, ...], costs: list[float]) -> float:
    """Return the minimum on a grid, moved by a parabola through it and its neighbours (in the logarithm)."""
    values = np.array(costs)
    k = int(values.argmin())
    if not 0 < k < len(grid) - 1:
        return float(grid[k])
    x = np.log(np.array(grid[k - 1 : k + 2]))
    a, b, _ = np.polyfit(x, values[k - 1 : k + 2], 2)
    return float(np.exp(np.clip(-b / (2 * a), x[0], x[2]))) if a > 0 else float(grid[k])


def significance_limit(film_size: int, false_detections: float) -> float:
    """Return the depth, in standard deviations, that noise alone exceeds ``false_detections`` times on a film.

    Parameters
    ----------
    film_size : int
        Pixels.
    false_detections : float
        Expected number for the whole film.

    Returns
    -------
    float
    """
    places = film_size / (np.pi * _SMALLEST_PX**2) * 4  # four filters
    limit = 3.0
    for _ in range(20):  # a fit goes to the highest point around: maxima of a random field are 0.44 u^2 as many as the tail alone has it
        limit = float(-ndtri(min(0.5, false_detections / (places * max(1.0, 0.44 * limit**2)))))
    return limit


def no_fits() -> BallFits:
    """Return an empty table."""
    none = np.zeros(0)
    return BallFits(np.zeros((0, 2)), none, none, np.zeros((0, 4, 4)), *(none,) * 10, np.zeros(0, bool), np.zeros(0, np.int64))
