"""Double images: one ball drawn by a focal spot, or two balls of the film's own that touch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.least_squares import columns
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.blobs import STRETCH, long_axis
from rsa_vision.detect.neighbours.group_images import GroupWindow, images_in, window_around
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.types import Bool, Float

_LEAST_SPREAD, _MOST_SPREAD = 0.2, 0.35  # of the logarithms of what balls of one film have in common


def gain_over_two(
    film: NDArray[Any],
    drawn: BallFits,
    images: Callable[[int, Float, Float], Float],
    single: BallFits,
    known: BallFits,
    optics: Optics,
    noise: NoiseModel,
    needles: Images | None,
) -> tuple[Float, Float]:
    """Compare each ball drawn by a spot with two balls like those of the film, fitted freely.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    drawn : BallFits
        As fitted with the spot.
    images : callable
        ``images(i, cols, rows)``: image of ball ``i`` of them, of depth one.
    single : BallFits
        The same as single blurred balls.
    known : BallFits
        Clear balls: what two have to be like.
    optics : Optics
    noise : NoiseModel
    needles : callable, optional
        Images to be subtracted.

    Returns
    -------
    gain : ndarray of shape (n,)
        Twice the logarithm of the likelihood of one ball and a spot over that of two balls, in units of what the better one leaves where
        that is more than noise: then neither model is true to the last.
    half : ndarray of shape (n, 2)
        From the middle of the two to either, px.
    """
    size, depth = (_usual(value, variance) for value, variance in _sizes_and_depths(known))
    gain, half = np.zeros(len(drawn.depth)), np.zeros((len(drawn.depth), 2))
    for i in range(len(gain)):
        axis, gain[i] = long_axis(film, single.rows([i]), np.sign(single.depth[i])), np.inf
        start_radius = np.full(2, single.radius_px[i] if len(known.depth) == 0 else np.exp(size[0]))
        for stretch in STRETCH:
            start = single.position_px[i] + np.array([[-0.5], [0.5]]) * stretch * axis
            two = fit_group(film, start, start_radius, optics, noise, needles)
            window = window_around(film, two.position_px, two.radius_px, optics.sigma_px, noise, needles)
            cols, rows = window.cols + window.corner_px[0], window.rows + window.corner_px[1]
            local = two.position_px - window.corner_px
            of_two = images_in(window, window.surface, local, two.radius_px, optics).linear
            of_one = columns([images(i, cols, rows)[None], window.surface.T])
            place = np.concatenate([two.position_px, drawn.position_px[[i]]])
            reach = np.append(two.radius_px, max(drawn.radius_px[i], single.radius_px[i])) + optics.sigma_px
            under = (np.hypot(cols - place[:, :1], rows - place[:, 1:]) < reach[:, None]).any(axis=0)
            by_two, by_one = (_left(window, basis, under, noise) for basis in (of_two, of_one))
            unit = noise.correlation.sum() * max(min(by_two, by_one) / np.count_nonzero(under), 1.0)
            better = (by_two - by_one) / unit + _unlike(two, size, depth) - _unlike(drawn.rows([i]), (0.0, np.inf), depth)
            if better < gain[i]:
                gain[i], half[i] = better, 0.5 * (two.position_px[1] - two.position_px[0])
    return gain, half


def _left(window: GroupWindow, basis: Float, under: Bool, noise: NoiseModel) -> float:
    """Sum of squares that a linear combination leaves of these pixels, in units of the variance of the noise."""
    residual, weight = window.left_by(basis, noise)
    return float((weight * residual**2)[under].sum())


def _sizes_and_depths(fits: BallFits) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Logarithms of radii and of depths, with their variances."""
    depth = np.maximum(np.abs(fits.depth), 1e-9)
    return (np.log(fits.radius_px), fits.covariance[:, 2, 2] / fits.radius_px**2), (np.log(depth), fits.covariance[:, 3, 3] / depth**2)


def _usual(logs: Float, variances: Float) -> tuple[float, float]:
    """Mean and standard deviation of logarithms; the latter infinite where none are known."""
    if len(logs) == 0:
        return 0.0, np.inf
    centre, spread, _ = true_spread(logs, variances)
    return centre, float(np.clip(spread, _LEAST_SPREAD, _MOST_SPREAD))


def _unlike(fits: BallFits, size: tuple[float, float], depth: tuple[float, float]) -> float:
    """Twice the logarithm of the likelihood that balls of the film's usual sizes and depths lose by being as these are."""
    both = zip((size, depth), _sizes_and_depths(fits), strict=True)
    return float(sum((np.square(value - centre) / (spread**2 + variance)).sum() for (centre, spread), (value, variance) in both))
