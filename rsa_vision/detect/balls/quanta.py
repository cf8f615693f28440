"""Noise of which neighbours share more under balls than beside them: quanta that a screen spreads, which grain hides beside marks.

How much neighbours share is measured beside marks. Through a film's curve the same light makes another share of the noise at the rims of
balls, with grain and rounding the rest, and a centre is moved by what neighbours share. Of the residuals, weighted as they enter the
centres, the products over near neighbours are summed (the variance of an estimator in noise of unknown correlation: Conley, Journal of
Econometrics 92, 1999), over what noise as stated leaves of them through the same fits.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from rsa_vision.detect.balls.fits import mirrored
from rsa_vision.detect.balls.random_effects import Common, Solution, variance_of
from rsa_vision.detect.balls.surroundings import Modes
from rsa_vision.detect.film.noise import LAGS, power_spectrum
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.types import Float, Int

ENOUGH = 60  # balls that are asked
_DRAWS = 2  # of noise for each
_LEAST = 8  # balls that tell something
_NEAR = 1.2  # blurs: width of the neighbourhoods
_SURE, _WORTH_IT = 3.0, 0.25  # standard deviations of chance, and part more, from which it is no chance


def left_and_expected(found: Solution, which: Int, background: Float, known: Modes, half: int, common: Common) -> tuple[Float, Float]:
    """Return the sums over neighbours of what fits left (n,), and of what noise and structure as stated leave through them (draws, n).

    Parameters
    ----------
    found : Solution
    which : ndarray of int, shape (n,)
        Clear balls of it.
    background : ndarray of shape (n,)
        Of these.
    known : Modes
        Surfaces of their windows.
    half : int
        Half the side of their windows.
    common : Common
    """
    side, noise = 2 * half + 1, common.noise
    weight, estimator, images = found.weight[which], found.estimator[which], found.images[which]
    root = np.sqrt(weight)
    size = next_fast_len(side + LAGS, real=True)
    spectrum = _white(len(which), size) * np.sqrt(np.maximum(power_spectrum(noise.correlation, (size, size)), 0.0))
    drawn = irfft2(spectrum, s=(size, size))[..., :side, :side].reshape(_DRAWS, len(which), -1)
    drawn = np.sqrt(common.under) * drawn / np.where(weight > 0, root, np.inf)
    structure = variance_of(known, found.structure[which]) * noise.variance_at(background)[:, None]
    bends = np.random.default_rng(1).standard_normal((_DRAWS, *structure.shape)) * np.sqrt(structure)
    drawn += np.matmul(bends, known.surface.T) * found.shade[which, 0] * (weight > 0)
    seen = whiten_rows(drawn * root, side, noise)
    change = np.einsum("nij,njp,dnp->dni", found.inverse[which], found.white[which], seen, optimize=True)
    residuals = np.concatenate([found.residual[None, which], drawn - np.einsum("dni,nip->dnp", change, images, optimize=True)])
    opposite = mirrored(found.local_px[which], side)
    pairs = (weight > 0) & np.take_along_axis(weight > 0, opposite, 1)
    odd = _odd(residuals * (weight > 0), found.local_px[which], side) * pairs
    parts = (estimator * odd[:, :, None]).astype(np.float32).reshape(-1, side, side)
    near_px = _NEAR * common.optics.sigma_px
    sums = [float(np.square(cv2.GaussianBlur(part, (0, 0), near_px, borderType=cv2.BORDER_CONSTANT)).sum()) for part in parts]
    squares = np.array(sums).reshape(1 + _DRAWS, len(which), 2).sum(axis=2)
    return squares[0], squares[1:]


def shared_more(told: list[tuple[Float, Float]]) -> float:
    """Return the variance of centres by noise in units of what is stated, from all balls of a film; one where it may be chance.

    ``told``: batches of :func:`left_and_expected`.
    """
    left, expected = (np.concatenate(of, axis=-1) for of in zip(*told, strict=True)) if told else (np.zeros(0), np.zeros((_DRAWS, 0)))
    mean = expected.mean(axis=0)
    if np.count_nonzero(mean > 0) < _LEAST:
        return 1.0
    ratio = float(np.mean(left[mean > 0]) / np.mean(mean[mean > 0]))
    scatter = float(np.std(expected[:, mean > 0] / mean[mean > 0])) * np.sqrt(_DRAWS / (_DRAWS - 1))
    chance = scatter * np.sqrt((1 + 1 / _DRAWS) / np.count_nonzero(mean > 0))
    return ratio if ratio > 1 + max(_SURE * chance, _WORTH_IT) else 1.0


def _odd(values: Float, local_px: Float, side: int) -> Float:
    """Return values (k, n, pixels) less those at the opposite places: errors of the model are even and do not move a centre."""
    windows = values.reshape(len(values), -1, side, side)[..., ::-1, ::-1].astype(np.float32)
    out = values.copy()
    for i, (col, row) in enumerate(2 * local_px - (side - 1)):
        shift = np.array([[1.0, 0.0, col], [0.0, 1.0, row]])
        for k, window in enumerate(windows[:, i]):
            out[k, i] -= cv2.warpAffine(np.ascontiguousarray(window), shift, (side, side), flags=cv2.INTER_CUBIC).ravel()
    return out


@lru_cache(maxsize=8)
def _white(count: int, size: int) -> NDArray[np.complex64]:
    """Spectra of draws of white noise, the same every time, shape (draws, count, size, size // 2 + 1)."""
    drawn = np.random.default_rng(0).standard_normal((_DRAWS, count, size, size), np.float32)
    return np.asarray(rfft2(drawn))
