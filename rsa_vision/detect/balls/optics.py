"""Blur and attenuation that the marks of a film have in common, and whether they are darker or brighter than their surroundings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import over_clutter
from rsa_vision.detect.balls.find import (
    COARSE_MU_PX,
    COARSE_SIGMA_PX,
    EXPLAINED,
    MISFIT,
    SURE,
    explained_over_noise,
    fit_at,
    in_correlated_noise,
    misfit,
    refine,
)
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.balls.likeliest import most_likely
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import pairs_within
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float, Int

SIGMAS_PX = (0.55, 0.75, 1.05, 1.5, 2.1, 2.9)
KAPPA = 0.5  # attenuation along one blur width while the blur is looked for
_MOST_TRIED, _MOST_SEEDS = 40, 40
_WHOLE, _INSIDE = (0.98, 0.8), 0.8  # of the pixels under a ball, most first, and of its window
_SURER = 3.0  # times the significance of what is a part of another
_SPECKS = 0.5  # of all the evidence that there is
_BY_CHANCE = 4.0  # significance that there is plenty of on any film: dozens of specks are no rival for a few balls
_SHARP = 0.4  # part of the tolerated misfit that balls leave once the blur is right; other blobs leave more
_CLOSE, _UNLIKE = 0.05, 3.0  # misfit and what is not explained: of any ball, or against the closest quarter
_MUCH_MORE = 1.5  # times the variance
CAP = 50.0  # significance beyond which a mark is no better evidence
OF_CUT_OFF = 0.2  # of the evidence of a whole mark, of one that is cut off: plateaus have rims as well


def ball_evidence(fits: BallFits, noise: NoiseModel) -> float:
    """Return how much the fits speak for balls: significances over noise and structure, weighted by how closely each is described."""
    rest = np.maximum(misfit(fits, noise) / MISFIT, (1 - fits.explained) / (1 - EXPLAINED))
    whole = (fits.valid_fraction > 0.95) & (fits.window_fraction > 0.8)
    say = np.where(whole, 1.0, OF_CUT_OFF)
    return float(say @ (np.clip(over_clutter(fits) - _BY_CHANCE, 0.0, CAP) * np.exp(-((rest / _SHARP) ** 2))))


def estimate_optics(film: NDArray[Any], seeds: BallFits, noise: NoiseModel) -> tuple[Optics, float]:
    """Estimate blur and attenuation that the best candidates of a film have in common: a grid tells which are balls, all of them the rest.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    seeds : BallFits
        Of one polarity.
    noise : NoiseModel

    Returns
    -------
    Optics
    evidence : float
        For balls of this polarity, as of :func:`ball_evidence`.
    """
    if len(seeds.depth) == 0:
        return Optics(COARSE_SIGMA_PX, COARSE_MU_PX), 0.0
    # those that are whole tell most; not where they are specks beside balls of which noise or saturation takes a part
    rest = np.maximum(misfit(seeds, noise) / MISFIT, (1 - explained_over_noise(seeds)) / (1 - EXPLAINED))
    strength, inside = np.minimum(seeds.significance, CAP) * np.exp(-(rest**2)), seeds.window_fraction > _INSIDE
    if inside.any():
        tiers = (inside & (seeds.valid_fraction > least) for least in _WHOLE)
        seeds = seeds.rows(next((t for t in tiers if strength[t].sum() >= _SPECKS * strength[inside].sum()), inside))
    seeds = seeds.rows(~_within_others(seeds))
    noisy = _much_more_noise(seeds, noise)
    best = np.argsort(_closeness(seeds, noise, noisy))[:_MOST_TRIED]
    position, radius = seeds.position_px[best], seeds.radius_px[best]

    def fit(sigma: float, kappa: float) -> BallFits:
        return fit_at(film, position, radius, Optics(sigma, kappa / sigma), noise, quick=True)

    # whatever fits badly at every blur is no ball and has no say
    trials = [fit(sigma, KAPPA) for sigma in SIGMAS_PX]
    closest = np.min([_closeness(t, noise, noisy) for t in trials], axis=0)
    chosen = np.argsort(closest)[:_MOST_SEEDS]
    chosen = chosen[closest[chosen] < max(0.08, 1.5 * closest[chosen[0]])]
    known = np.minimum(in_correlated_noise(seeds.rows(best), COARSE_SIGMA_PX, noise), CAP) / CAP
    say = known**2 if noisy else np.ones(len(best))  # specks say little of the blur

    def likeliest(these: Int) -> float:
        return refine(SIGMAS_PX, [_cost(t.rows(these), say[these]) for t in trials])

    position, radius = position[chosen], radius[chosen]
    sigma = likeliest(chosen)
    # what came close at another blur only, as two balls in one at a wide one, is none of the film's balls
    fits = fit(sigma, KAPPA)
    close = _closeness(fits, noise, noisy)
    kept = close < max(_CLOSE, _UNLIKE * float(np.sort(close)[len(close) // 4]))
    if not kept.all():
        position, radius = position[kept], radius[kept]
        sigma = likeliest(chosen[kept])
        fits = fit(sigma, KAPPA)
    optics, fits = most_likely(film, fits, Optics(sigma, KAPPA / sigma), noise)
    return optics, ball_evidence(fits, noise)


def _within_others(seeds: BallFits) -> Bool:
    """Say which lie within the images of far surer ones: slopes of large balls look like small balls, in less noise than beside."""
    one, other = pairs_within(seeds.position_px, seeds.position_px, seeds.radius_px)
    return np.isin(np.arange(len(seeds.depth)), one[seeds.significance[other] > _SURER * seeds.significance[one]])


def _much_more_noise(seeds: BallFits, noise: NoiseModel) -> bool:
    """Say whether there is much more noise under sure marks than beside them: the noise of specks is soon like any ball then."""
    sure = seeds.rows(in_correlated_noise(seeds, COARSE_SIGMA_PX, noise) > SURE)
    more = noise.variance_at(sure.background + sure.depth) / noise.variance_at(sure.background)
    return bool(len(more) and np.median(more) > _MUCH_MORE)


def _closeness(fits: BallFits, noise: NoiseModel, noisy: bool) -> Float:
    """What fits leave and do not explain; of specks in much noise that is soon little, but nor is much known of it."""
    unexplained = (
        1 - explained_over_noise(fits) + 1 / np.maximum(in_correlated_noise(fits, COARSE_SIGMA_PX, noise), 1.0)
        if noisy
        else 1 - fits.explained
    )
    return np.asarray(misfit(fits, noise) + unexplained)


def _cost(fits: BallFits, say: Float) -> float:
    """Minus twice a log-likelihood: of noise where the model is nearly right, of errors of unknown size where it is far off."""
    return float(2 * say @ np.log1p(fits.chi2_core))
