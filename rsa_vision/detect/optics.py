"""Blur and attenuation that the marks of a film have in common, and whether they are darker or brighter than their surroundings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits
from rsa_vision.detect.find import COARSE_MU_PX, COARSE_SIGMA_PX, EXPLAINED, MISFIT, fit_at, misfit, refine, significance
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float

SIGMAS_PX = (0.55, 0.75, 1.05, 1.5, 2.1, 2.9)
NEAR = (0.74, 0.86, 1.0, 1.16, 1.35)  # a second look around the best blur
KAPPA = 0.5  # attenuation along one blur width while the blur is looked for
KAPPAS = (0.1, 0.25, 0.5, 1.0, 2.0)
_MOST_TRIED, _MOST_SEEDS = 40, 16
_SHARP = 0.4  # part of the tolerated misfit that balls leave once the blur is right; other blobs leave more
_CLOSE, _UNLIKE = 0.05, 3.0  # misfit and what is not explained: of any ball, or against the closest quarter
_CAP = 50.0  # significance beyond which a ball is no better evidence


def ball_evidence(fits: BallFits, noise: NoiseModel) -> float:
    """Return how much the fits speak for balls: significances, weighted by how closely the model describes each."""
    rest = np.maximum(misfit(fits, noise) / MISFIT, (1 - fits.explained) / (1 - EXPLAINED))
    whole = (fits.valid_fraction > 0.95) & (fits.window_fraction > 0.8)
    return float((np.minimum(significance(fits), _CAP) * np.exp(-((rest / _SHARP) ** 2)))[whole].sum())


def estimate_optics(film: NDArray[Any], seeds: BallFits, noise: NoiseModel) -> tuple[Optics, float]:
    """Estimate blur and attenuation that the best candidates of a film have in common, by maximum likelihood on a grid.

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
    clear = seeds.rows((seeds.valid_fraction > 0.98) & (seeds.window_fraction > 0.8))
    seeds = clear if len(clear.depth) else seeds
    best = np.argsort(_closeness(seeds, noise))[:_MOST_TRIED]
    position, radius = seeds.position_px[best], seeds.radius_px[best]

    def fit(sigma: float, kappa: float) -> BallFits:
        return fit_at(film, position, radius, Optics(sigma, kappa / sigma), noise, quick=True)

    # whatever fits badly at every blur is no ball and has no say
    trials = [fit(sigma, KAPPA) for sigma in SIGMAS_PX]
    closest = np.min([_closeness(t, noise) for t in trials], axis=0)
    chosen = np.argsort(closest)[:_MOST_SEEDS]
    chosen = chosen[closest[chosen] < max(0.08, 1.5 * closest[chosen[0]])]
    position, radius = position[chosen], radius[chosen]
    sigma = refine(SIGMAS_PX, [_cost(t.rows(chosen), s) for s, t in zip(SIGMAS_PX, trials, strict=True)])
    # what came close at another blur only, as two balls in one at a wide one, is none of the film's balls
    close = _closeness(fit(sigma, KAPPA), noise)
    kept = close < max(_CLOSE, _UNLIKE * float(np.sort(close)[len(close) // 4]))
    if not kept.all():
        chosen, position, radius = chosen[kept], position[kept], radius[kept]
        sigma = refine(SIGMAS_PX, [_cost(t.rows(chosen), s) for s, t in zip(SIGMAS_PX, trials, strict=True)])
    kappa = round(refine(KAPPAS, [_cost(fit(sigma, k), sigma) for k in KAPPAS]), 2)
    near = [sigma * f for f in NEAR]
    last = [fit(s, kappa) for s in near]
    sigma = refine(tuple(near), [_cost(t, s) for s, t in zip(near, last, strict=True)])
    evidence = max(ball_evidence(t, noise) for t in last)
    return Optics(sigma, kappa / sigma), evidence


def _closeness(fits: BallFits, noise: NoiseModel) -> Float:
    return misfit(fits, noise) + (1 - fits.explained)


def _cost(fits: BallFits, sigma: float) -> float:
    area = np.pi * (fits.radius_px + sigma) ** 2
    return float((area * np.log(np.maximum(fits.chi2_core, 0.05))).sum())
