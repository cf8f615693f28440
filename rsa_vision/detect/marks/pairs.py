"""The blur of films on which every ball lies over another: no single one tells it, and a pair fitted as one takes any."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import ANYTHING, DOUBTFUL, MISFIT, distinct, first_look, fit_at, misfit, plausible, refine
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.likeliest import unexpected
from rsa_vision.detect.balls.optics import KAPPA, SIGMAS_PX, ball_evidence
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import for_all, nothing
from rsa_vision.detect.neighbours.blobs import CLEAR, LEAST_GAIN, NEARLY, OF_A_BLOB, STRETCH, long_axis
from rsa_vision.detect.neighbours.group_images import GroupWindow, images_in, window_around
from rsa_vision.detect.neighbours.groups import STEPS, fit_group
from rsa_vision.detect.neighbours.not_round import are_not_round
from rsa_vision.detect.search.candidates import Candidates

_MOST = 100  # seeds among which single balls are looked for
_STRONGEST = 24  # candidates that are asked where there is no seed
_FEW = 8  # of the seeds, asked first
_ASKED, _AT_FIRST = 4, 2  # surest blobs; those asked while the blur is anybody's
_ROUGH_STEPS = 10  # of these: most pairs need eight, what is none does not come to rest
_COARSE, _NEAR = 2.0, 1.5  # times the misfit of pairs, of rough ones and at a blur that is nearly right
_FINER = (0.76, 0.87, 1.0, 1.15, 1.32)  # steps of the blur around the best of the coarse ones
_WIDE = 1.5  # times the radius of a blob: what is looked at of pairs
_ALIKE = 0.2  # logarithm of the radii of two balls in one


def optics_of_pairs(
    film: NDArray[Any], candidates: Candidates, seeds: BallFits, optics: Optics, noise: NoiseModel
) -> tuple[Optics, float, BallFits] | None:
    """Estimate the blur from blobs as pairs of balls, where few of the film's surest seeds are single ones.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
        Round ones of one polarity; a pair that hardly laps is unlike any ball, so that there are no seeds of it.
    seeds : BallFits
        First looks of that polarity.
    optics : Optics
        As single balls would have it.
    noise : NoiseModel

    Returns
    -------
    optics, evidence : Optics, float
        As of :func:`rsa_vision.detect.balls.optics.estimate_optics`; None where there are single balls enough, and where no pairs are.
    looks : BallFits
        These pairs, and what may be more of them; several may have come to the same place.
    """
    sure = _surest(seeds)
    if len(sure.depth) == 0:
        sure = _surest(distinct(first_look(film, candidates.rows(slice(_STRONGEST)), noise, slack=ANYTHING), noise))
    if len(sure.depth) == 0:
        return None
    for some in (sure.rows(slice(_FEW)), sure):  # mostly a few are enough
        single = fit_at(film, some.position_px, some.radius_px, optics, noise, quick=True)
        close = plausible(single, noise) & (misfit(single, noise) < DOUBTFUL * MISFIT)
        alone = close & ~are_not_round(film, single, for_all(nothing), optics, noise)
        if np.count_nonzero(alone) >= len(alone) / 3:
            return None
    rest = ~alone & np.isfinite(single.position_px).all(axis=1)
    if not rest.any():
        return None
    blobs = [single.rows([i]) for i in np.flatnonzero(rest)[:_ASKED]]

    @cache  # the middle one of the finer blurs has been asked before
    def as_two(sigma_px: float, *, rough: bool = False) -> list[BallFits]:
        if rough:
            return [_as_two(film, blob, sigma_px, noise, STRETCH[:1], _ROUGH_STEPS) for blob in blobs[:_AT_FIRST]]
        return [_as_two(film, blob, sigma_px, noise, STRETCH) for blob in blobs]

    windows = [window_around(film, blob.position_px, _WIDE * blob.radius_px, optics.sigma_px, noise, None) for blob in blobs]

    def left(pairs: list[BallFits], sigma_px: float) -> float:
        of_noise = sum(_left(window, pair, sigma_px, noise) for window, pair in zip(windows, pairs, strict=False))
        return of_noise / float(noise.correlation.sum()) + unexpected(Optics(sigma_px, KAPPA / sigma_px), join(pairs))

    trials = [as_two(sigma, rough=True) for sigma in SIGMAS_PX]
    costs = [left(pairs, sigma) for pairs, sigma in zip(trials, SIGMAS_PX, strict=True)]
    if not any(_are_two(pair, blob, noise, _COARSE) for pair, blob in zip(trials[int(np.argmin(costs))], blobs, strict=False)):
        return None
    sigma = refine(SIGMAS_PX, costs)
    if not any(_are_two(pair, blob, noise, _NEAR) for pair, blob in zip(as_two(sigma), blobs, strict=True)):
        return None
    finer = tuple(sigma * step for step in _FINER)
    sigma = refine(finer, [left(as_two(sigma), sigma) for sigma in finer])
    found = [pair for pair, blob in zip(as_two(sigma), blobs, strict=True) if _are_two(pair, blob, noise)]
    if not found:
        return None
    others = first_look(film, candidates, noise, slack=ANYTHING)
    return Optics(sigma, KAPPA / sigma), ball_evidence(join(found), noise), join([*found, others])


def _surest(seeds: BallFits) -> BallFits:
    sure = seeds.rows((seeds.significance > CLEAR) & (seeds.explained > NEARLY))
    return sure.rows(np.argsort(-sure.significance)[:_MOST])


def _as_two(
    film: NDArray[Any], blob: BallFits, sigma_px: float, noise: NoiseModel, stretches: Sequence[float], steps: int = STEPS
) -> BallFits:
    axis = long_axis(film, blob, np.sign(blob.depth[0]))
    radius = np.full(2, OF_A_BLOB * blob.radius_px[0])
    fits = []
    for stretch in stretches:
        starts = blob.position_px + np.array([[-0.5], [0.5]]) * stretch * axis
        fits.append(fit_group(film, starts, radius, Optics(sigma_px, KAPPA / sigma_px), noise, steps=steps))
    return min(fits, key=lambda pair: float(pair.chi2_core.mean()))


def _left(window: GroupWindow, pair: BallFits, sigma_px: float, noise: NoiseModel) -> float:
    """Minus twice the log-likelihood, were the variance unknown, on the same pixels at all blurs."""
    images = images_in(window, window.surface, pair.position_px - window.corner_px, pair.radius_px, Optics(sigma_px, KAPPA / sigma_px))
    rest, weight = window.left_by(images.linear, noise)
    return float(window.valid.sum() * np.log(np.maximum(weight @ rest**2, 1e-12)))


def _are_two(pair: BallFits, single: BallFits, noise: NoiseModel, slack: float = 1.0) -> bool:
    """Say whether two balls of one size explain a blob far better than one."""
    least = LEAST_GAIN * noise.correlation.sum() / (np.pi * single.radius_px[0] ** 2)
    alike = abs(float(np.log(pair.radius_px[0] / pair.radius_px[1]))) < _ALIKE and pair.depth[0] * pair.depth[1] > 0
    return bool(alike and plausible(pair, noise, slack).all() and single.chi2_core[0] - pair.chi2_core.mean() > least)
