"""What a fit leaves of correlated noise: it takes more with it than it has parameters, so that residuals look quieter than the noise is."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from rsa_vision.detect.balls import derivatives, half_size
from rsa_vision.detect.noise import LAGS, NoiseModel
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float

_FITTED = 4  # parameters that ``uneven`` counts off
_AT_RIM = 0.7  # the rim, which tells the centre, lies at half the depth; the mean of all that is under a ball at seven tenths
_OUTLIER = 3.0  # times the median


def expected_uneven(radius_px: float, optics: Optics, noise: NoiseModel) -> float:
    """Return what the noise of a film leaves of ``BallFits.chi2_uneven`` in the mean.

    The residuals of a linear fit with the projection ``H`` have the covariance ``(I - H) C (I - H)^T``; of it the odd part under the ball.

    Parameters
    ----------
    radius_px : float
    optics : Optics
    noise : NoiseModel
        With the correlation ``C``.

    Returns
    -------
    float
        One for white noise.
    """
    half = half_size(radius_px, optics.sigma_px)
    size = 2 * half + 1
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    jac = derivatives(np.array([radius_px]), half, optics.sigma_px, optics.mu_px)[0].T
    images = jac.T.reshape(-1, size, size)
    shared = fftconvolve(images, noise.correlation[None], mode="same", axes=(1, 2)).reshape(len(images), -1).T
    core = np.hypot(cols, rows) < radius_px + optics.sigma_px
    fit = jac[core] @ np.linalg.pinv(jac.T @ jac, hermitian=True)
    d_row, d_col = (np.subtract.outer(x[core], x[core]) for x in (rows, cols))
    near = (np.abs(d_row) <= LAGS) & (np.abs(d_col) <= LAGS)
    own = np.where(near, noise.correlation[np.clip(d_row + LAGS, 0, 2 * LAGS), np.clip(d_col + LAGS, 0, 2 * LAGS)], 0.0)
    mixed = fit @ shared[core].T
    left = own - mixed - mixed.T + fit @ (jac.T @ shared) @ fit.T
    # the pixels of the core are in reading order, and it is symmetric: opposite ones are as far from either end
    odd = 0.5 * (np.diag(left) + np.diag(left)[::-1] - 2 * np.diag(left[:, ::-1]))
    return float(odd.sum() / max(len(odd) - _FITTED, 1))


def noise_under(uneven: Float, radius_px: Float, optics: Optics, noise: NoiseModel) -> float:
    """Return the variance at the rims of a film's balls in units of that beside them, from what all of them leave together.

    The values under marks occur nowhere else on a film, so that no tile tells their noise: quanta are fewer there, the slope of the film
    curve is another, and bone goes on. Of the residuals only the odd part counts, which the model's own errors do not have.

    Parameters
    ----------
    uneven, radius_px : ndarray of shape (n,)
        ``chi2_uneven`` and radii of clear balls.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    float
    """
    usual = uneven[uneven < _OUTLIER * np.median(uneven)]
    return float((usual.mean() / expected_uneven(float(np.median(radius_px)), optics, noise)) ** _AT_RIM)
