"""Blur and attenuation that the marks of a film have in common, and whether they are darker or brighter than their surroundings."""

from __future__ import annotations

from dataclasses import dataclass
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
from rsa_vision.detect.balls.fits import BallFits, ball_image, slopes
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.places import pairs_within
from rsa_vision.detect.models.profiles import Optics, ball_table
from rsa_vision.types import Bool, Float, Int

SIGMAS_PX = (0.55, 0.75, 1.05, 1.5, 2.1, 2.9)
KAPPA = 0.5  # attenuation along one blur width while the blur is looked for
# what is expected before the balls are asked, tantalum of 0.5 to 1 mm at 8 per mm and blurs of 0.1 to 0.3 mm: blur over radius,
# attenuation along a radius (less where film curve or scatter hide it), and the errors of the logarithms of blur and attenuation
_BLUR, _ATTENUATION, _EXPECTED = 0.4, 2.5, np.array([0.6, 0.8])
_SIGMA_PX, _KAPPA = (0.4, 4.0), (0.03, 4.0)
_ROUNDS = 8
_STEP = 0.05  # of the logarithms, for derivatives
_MOST_BY_STEP = 0.5
_SHORTER = 3  # attempts at a step that gains
_ODD = 6.0  # three times what the two numbers of the optics gain by chance
_SETTLED = 0.3  # standard deviations
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
    return _most_likely(film, fits, Optics(sigma, KAPPA / sigma), noise)


def _most_likely(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel) -> tuple[Optics, float]:
    """Maximise the likelihood of all balls together over blur and attenuation; the evidence for balls comes with it.

    Each ball's own numbers are eliminated first (variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973). Its say is
    divided by what the model leaves of it, as if the variance of each were unknown: bone under it and errors of the model are no noise.
    """
    halves = np.ceil(fits.radius_px + 2.5 * optics.sigma_px + 1)
    fits = fit_at(film, fits.position_px, fits.radius_px, optics, noise, quick=True)
    first = fits
    now = _equations(film, fits, first, halves, optics, noise)
    expected = np.array([[1.0, 0.0], [-1.0, 1.0]]) / _EXPECTED[:, None]
    for _ in range(_ROUNDS):
        say = 1 / (np.maximum.reduce([fits.chi2_core, fits.chi2_ring, np.ones(len(halves))]) * now.spread)
        # Student's weights: what would gain much by optics of its own is none of the film's balls
        own = np.einsum("ni,nij,nj->n", now.right, invert(now.normal), now.right)
        say /= 1 + say * own / _ODD
        normal = np.einsum("n,nij->ij", say, now.normal) + expected.T @ expected
        step = np.linalg.solve(normal, say @ now.right - expected.T @ _unexpected(optics, fits))
        if (np.abs(step) < _SETTLED * np.sqrt(np.diag(np.linalg.inv(normal)))).all():
            optics = _stepped(optics, step)  # so little is gained for certain
            break
        step *= min(1.0, _MOST_BY_STEP / float(np.abs(step).max()))
        expected_before = unexpected(optics, fits)
        for _ in range(_SHORTER):
            trial = _stepped(optics, step)
            moved = fit_at(film, fits.position_px, fits.radius_px, trial, noise, quick=True)
            then = _equations(film, moved, first, halves, trial, noise)
            gain = np.clip(say * (now.left - then.left), -_ODD, _ODD)  # a fit that has gone elsewhere does not decide
            if gain.sum() + expected_before > unexpected(trial, moved):
                optics, fits, now = trial, moved, then
                break
            step = step / 3
        else:
            break
    return optics, ball_evidence(fits, noise)


def _stepped(optics: Optics, step: Float) -> Optics:
    """Optics after a step of the logarithms of blur and of attenuation along it."""
    sigma = float(np.clip(optics.sigma_px * np.exp(step[0]), *_SIGMA_PX))
    kappa = float(np.clip(optics.mu_px * optics.sigma_px * np.exp(step[1]), *_KAPPA))
    return Optics(sigma, kappa / sigma)


def unexpected(optics: Optics, fits: BallFits) -> float:
    """Return minus twice the logarithm of the prior of blur and attenuation, but for a constant, given the sizes of balls.

    Parameters
    ----------
    optics : Optics
    fits : BallFits

    Returns
    -------
    float
    """
    return float(np.square(_unexpected(optics, fits)).sum())


def _unexpected(optics: Optics, fits: BallFits) -> Float:
    """Logarithms of blur and attenuation over the expected ones, in units of what is expected of them."""
    radius = float(np.median(fits.radius_px))
    return np.asarray(np.log([optics.sigma_px / (_BLUR * radius), optics.mu_px * radius / _ATTENUATION]) / _EXPECTED)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """What balls say of the logarithms of the blur and of the attenuation along its width, each ball's own numbers eliminated."""

    normal: Float  # (n, 2, 2)
    right: Float  # (n, 2)
    left: Float  # (n,): squared residuals over the variance
    spread: Float  # (n,): variance of ``right`` over that of white noise


def _equations(film: NDArray[Any], fits: BallFits, first: BallFits, halves: Float, optics: Optics, noise: NoiseModel) -> _Equations:
    """``first``: fits that say which pixels are asked, with which weight: the same all the time, or likelihoods could not be compared."""
    n, h = len(fits.depth), np.exp(_STEP)
    sigma, mu = optics.sigma_px, optics.mu_px
    out = _Equations(np.zeros((n, 2, 2)), np.zeros((n, 2)), np.zeros(n), np.ones(n))
    for half in np.unique(halves):
        index = np.nonzero(halves == half)[0]
        one = fits.rows(index)
        patches = cut(film, first.position_px[index], int(half), noise)
        rows, cols = np.mgrid[0 : patches.size, 0 : patches.size].reshape(2, 1, -1).astype(np.float64)
        dx, dy = (axis - at[:, None] for axis, at in zip((cols, rows), (one.position_px - patches.corner_px).T, strict=True))
        either = (Optics(sigma * h, mu / h), Optics(sigma / h, mu * h), Optics(sigma, mu * h), Optics(sigma, mu / h))
        sides = [ball_image(dx, dy, one.radius_px, of) for of in either]
        shared = np.stack([sides[0] - sides[1], sides[2] - sides[3]], 1) / (2 * _STEP)
        value, by_dx, by_dy, by_radius = slopes(ball_table(optics), dx, dy, one.radius_px, sigma)
        surface = polynomial(half, cols[0] - half, rows[0] - half).T
        depth, background = one.depth[:, None], one.background[:, None]
        of_ball = np.stack([value, depth * by_dx, depth * by_dy, depth * by_radius], 1)
        own = np.concatenate([of_ball, np.broadcast_to(surface, (len(index), *surface.shape))], 1)
        root = np.sqrt(patches.valid.reshape(len(index), -1) / noise.variance_at(first.background[index, None]))
        target = (root * (patches.values.reshape(len(index), -1) - background - depth * value))[:, :, None]
        own, shared = own * root[:, None], shared * (depth * root)[:, None]
        # what a step of its own numbers alone still takes away is none of the others' business
        inverse = invert(np.matmul(own, own.transpose(0, 2, 1)))
        target = target - np.matmul(own.transpose(0, 2, 1), np.matmul(inverse, np.matmul(own, target)))
        of_own = np.matmul(inverse, np.matmul(own, shared.transpose(0, 2, 1)))
        rest = shared - np.matmul(of_own.transpose(0, 2, 1), own)
        out.normal[index] = np.matmul(rest, rest.transpose(0, 2, 1))
        out.right[index] = np.matmul(rest, target)[:, :, 0]
        out.left[index] = np.square(target).sum((1, 2))
        windows = rest.reshape(len(index), 2, patches.size, patches.size)
        scatter = influence_covariance(windows, noise.correlation)
        spread = 0.5 * np.einsum("nij,nji->n", invert(out.normal[index]), scatter)
        out.spread[index] = np.where(spread > 0, spread, 1.0)  # a fit that has left the film says nothing
    return out


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
