"""What the film around a ball would do to its centre: the fit's own estimator, held over places beside it where no mark is.

Noise that is what the model says gives there the errors that are stated. Bone gives more: what a quadratic surface does not follow goes on
under the ball, where no residual shows it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits, derivatives, half_size
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import cut
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float

_DIRECTIONS = 2 * np.pi * np.arange(8) / 8
_FARTHER = (1.0, 1.5)  # distances, in units of the nearest one that is free of the ball
_PRESUMED = 12.0  # places that the film's usual ratio counts for
_LEAST = 4  # free places from which a ball's surroundings tell something
_QUIETEST = 0.6  # less than that is chance
_MEDIAN = 1.386  # of chi2 with two degrees of freedom


def variance_of_surroundings(
    film: NDArray[Any], balls: BallFits, others_px: Float, reach_px: Float, optics: Optics, noise: NoiseModel
) -> Float:
    """Return the squared errors that the surroundings of balls would make of their centres, over what noise would.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    others_px : ndarray of shape (m, 2)
        (col, row) of pins and tees.
    reach_px : ndarray of shape (m,)
        How far their images go.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    ndarray of shape (n,)
        Medians over the places around each ball, drawn towards the median over the film; 1 where there are none.
    """
    n = len(balls.depth)
    marks = np.concatenate([balls.position_px, others_px])
    reach = np.concatenate([balls.radius_px + 3 * optics.sigma_px, reach_px])
    halves = np.array([half_size(r, optics.sigma_px) for r in balls.radius_px])
    angle = np.tile(_DIRECTIONS, len(_FARTHER)) + np.repeat(np.arange(len(_FARTHER)), len(_DIRECTIONS)) * np.pi / 8
    ratio = np.full((n, len(angle)), np.nan)
    for half in np.unique(halves):
        index = np.nonzero(halves == half)[0]
        nearest = half + balls.radius_px[index] + 3 * optics.sigma_px
        distance = nearest[:, None] * np.repeat(_FARTHER, len(_DIRECTIONS))
        place = balls.position_px[index, None] + distance[:, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        gap = np.abs(place[:, :, None] - marks).max(axis=3)
        free = (gap > half + reach).all(axis=2)
        ball, where = np.nonzero(free)
        patches = cut(film, place[ball, where], int(half), noise)
        whole = patches.valid.all(axis=(1, 2))
        ball, where, values = ball[whole], where[whole], patches.values[whole].reshape(-1, (2 * int(half) + 1) ** 2)
        by_film, covariance = _estimator(balls.rows(index), int(half), optics, noise)
        places = np.split(values - values.mean(axis=1, keepdims=True), np.searchsorted(ball, np.arange(1, len(index))))
        error = np.concatenate([at @ one.T for at, one in zip(places, by_film, strict=True)])
        square = np.einsum("ki,ki->k", error, np.linalg.solve(covariance[ball], error[:, :, None])[:, :, 0])
        ratio[index[ball], where] = square / noise.variance_at(values.mean(axis=1)) / _MEDIAN
    counted = np.isfinite(ratio).sum(axis=1)
    if not (counted >= _LEAST).any():
        return np.ones(n)
    usual = float(np.nanmedian(ratio))
    own = np.array([np.nanmedian(r) if k >= _LEAST else usual for r, k in zip(ratio, counted, strict=True)])
    weight = np.where(counted >= _LEAST, counted, 0) / (counted + _PRESUMED)
    return np.asarray(np.exp(weight * np.log(np.maximum(own, _QUIETEST)) + (1 - weight) * np.log(max(usual, _QUIETEST))))


def _estimator(balls: BallFits, half: int, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """Least-squares estimators (n, 2, pixels) of centres from windows, and their covariances for noise of variance one."""
    jac = derivatives(balls.radius_px, half, optics.sigma_px, optics.mu_px)
    inverse = np.linalg.pinv(np.matmul(jac, jac.transpose(0, 2, 1)), hermitian=True)
    estimator = -np.matmul(inverse[:, :2], jac) / balls.depth[:, None, None]
    windows = estimator.reshape(len(balls.depth), 2, 2 * half + 1, 2 * half + 1)
    return estimator, influence_covariance(windows, noise.correlation)
