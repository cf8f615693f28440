"""What fits leave under balls, against what the same fits leave of free places: the noise under marks, which no tile of a film tells."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls import derivatives, half_size
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.surroundings import Places
from rsa_vision.detect.whitening import whiten
from rsa_vision.types import Bool, Float

_FITTED = 4  # parameters that ``uneven`` counts off
_AT_RIM = 0.7  # the rim, which tells the centre, lies at half the depth; the mean of all that is under a ball at seven tenths
_OUTLIER = 3.0  # times the median
LEAST = 8  # marks, and places, that tell something
_NOTHING = 0.01  # places leave less only where there is no noise
_MOST = 0.4, 2.5  # what they may tell


def noise_under(uneven: Float, radius_px: Float, quiet: float, places: list[Places], optics: Optics, noise: NoiseModel) -> float:
    """Return the variance at the rims of a film's balls in units of that beside them, from what all of them leave together.

    The values under marks occur nowhere else on a film, so that no tile tells their noise: quanta are fewer there, the slope of the film
    curve is another, and bone goes on. Of the residuals only the odd part counts, which the model's own errors do not have.

    Parameters
    ----------
    uneven, radius_px : ndarray of shape (n,)
        ``chi2_uneven`` and radii of clear balls.
    quiet : float
        ``chi2_ring`` of clear balls is less; so has it to be on places they are compared with.
    places : list of Places
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    float
        One where too few tell.
    """
    if len(uneven) < LEAST:
        return 1.0
    usual_half = half_size(float(np.median(radius_px)), optics.sigma_px)
    near = [these for these in places if abs(these.half - usual_half) <= 1 and len(these.values)]  # a crowded film has none
    left = [_uneven(these, float(np.median(radius_px)), quiet, optics, noise) for these in near]
    beside = np.concatenate([np.zeros(0), *left])
    if len(beside) < LEAST:
        return 1.0
    usual = usual_square(beside)
    return at_rims(usual_square(uneven) / usual) if usual > _NOTHING else 1.0


def at_rims(under: float) -> float:
    """Return the variance at the rims of marks, given that under them, in units of that beside them."""
    return float(np.clip(under**_AT_RIM, *_MOST))


def usual_square(squares: Float) -> float:
    """Return the mean of those that are not far beyond the median."""
    return float(squares[squares <= _OUTLIER * np.median(squares)].mean())


def _uneven(places: Places, radius_px: float, quiet: float, optics: Optics, noise: NoiseModel) -> Float:
    """Mean squares of the odd part of what the fit of a ball leaves of quiet places, under where the ball would be."""
    half = places.half
    basis = np.linalg.qr(derivatives(np.array([radius_px]), half, optics.sigma_px, optics.mu_px)[0].T)[0]
    level = places.values.mean(axis=1, keepdims=True)
    values = (places.values - level) / np.sqrt(noise.variance_at(level))
    rest = values - (values @ basis) @ basis.T
    white = whiten(rest.reshape(-1, 2 * half + 1, 2 * half + 1), noise).reshape(rest.shape)
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    core = np.hypot(cols, rows) < radius_px + optics.sigma_px
    under, ring = (_odd(left, where) for left, where in ((white, core), (rest, ~core)))
    return np.asarray(under[ring < quiet])


def _odd(left: Float, where: Bool) -> Float:
    square = 0.5 * np.square(left - left[:, ::-1])  # windows are symmetric
    return np.asarray(square[:, where].sum(axis=1) / max(np.count_nonzero(where) - _FITTED, 1))
