"""Noise of which neighbours share more under balls than beside them: quanta that a screen spreads, which grain hides beside marks.

How much neighbours share is measured beside marks. Through a film's curve the same light makes another share of the noise at the rims of
balls, with grain and rounding the rest, and a centre is moved by what neighbours share. Of the residuals, weighted as they enter the
centres, the products over near neighbours are summed (the variance of an estimator in noise of unknown correlation: Conley, Journal of
Econometrics 92, 1999), over what noise as stated leaves of them through the same fits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from rsa_vision.detect.balls.fits import mirrored
from rsa_vision.detect.balls.random_effects import Common, Solution, variance_of
from rsa_vision.detect.balls.surroundings import Modes
from rsa_vision.detect.film.noise import LAGS, NoiseModel, power_spectrum
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float, Int

ENOUGH = 60  # balls that are asked
_DRAWS = 2  # of noise for each
_LEAST = 4  # balls that tell something
_CAUTION = 1.8  # standard deviations of chance: no more than these is not believed, and what is more not wholly
_NEAR = 1.2  # blurs: width of the neighbourhoods
_SPREAD = 0.7  # blurs: what a screen spreads has not been through the focal spot, which makes the other half of the variance


@dataclass(frozen=True, slots=True, eq=False)
class Left:
    """What fits left of some balls, summed over neighbours, and what noise would.

    Attributes
    ----------
    found : ndarray of shape (n,)
    expected, shared : ndarrays of shape (draws, n)
        By noise and structure as stated, and by as much noise that a screen has spread.
    speckled : ndarray of bool, shape (n,)
        Dust may be what is left.
    """

    found: Float
    expected: Float
    shared: Float
    speckled: Bool


def spread(noise: NoiseModel, optics: Optics) -> NoiseModel:
    """Return as much noise by quanta that a screen has spread."""
    return noise.blurred_by(_SPREAD * optics.sigma_px)


def left_over(found: Solution, which: Int, background: Float, speckled: Bool, known: Modes, half: int, common: Common) -> Left:
    """Return the sums over neighbours of what fits left, and of what noise leaves through them.

    Parameters
    ----------
    found : Solution
    which : ndarray of int, shape (n,)
        Clear balls of it.
    background : ndarray of shape (n,)
        Of these.
    speckled : ndarray of bool, shape (n,)
        There are specks on these.
    known : Modes
        Surfaces of their windows.
    half : int
        Half the side of their windows.
    common : Common

    Returns
    -------
    Left
    """
    side, noise = 2 * half + 1, common.noise
    weight, estimator, images = found.weight[which], found.estimator[which], found.images[which]
    root = np.sqrt(weight)
    sd = np.sqrt(common.under / np.where(weight > 0, weight, np.inf))
    stated, shared = (sd * _drawn(of, len(which), side) for of in (noise, spread(noise, common.optics)))
    structure = variance_of(known, found.structure[which]) * noise.variance_at(background)[:, None]
    bends = np.random.default_rng(1).standard_normal((_DRAWS, *structure.shape)) * np.sqrt(structure)
    stated += np.matmul(bends, known.surface.T) * found.shade[which, 0] * (weight > 0)
    drawn = np.concatenate([stated, shared])
    seen = whiten_rows(drawn * root, side, noise)
    change = np.einsum("nij,njp,dnp->dni", found.inverse[which], found.white[which], seen, optimize=True)
    residuals = np.concatenate([found.residual[None, which], drawn - np.einsum("dni,nip->dnp", change, images, optimize=True)])
    opposite = mirrored(found.local_px[which], side)
    pairs = (weight > 0) & np.take_along_axis(weight > 0, opposite, 1)
    odd = _odd(residuals * (weight > 0), found.local_px[which], side) * pairs
    parts = (estimator * odd[:, :, None]).astype(np.float32).reshape(-1, side, side)
    near_px = _NEAR * common.optics.sigma_px
    sums = [float(np.square(cv2.GaussianBlur(part, (0, 0), near_px, borderType=cv2.BORDER_CONSTANT)).sum()) for part in parts]
    squares = np.array(sums).reshape(1 + 2 * _DRAWS, len(which), 2).sum(axis=2)
    return Left(squares[0], squares[1 : 1 + _DRAWS], squares[1 + _DRAWS :], speckled)


def shared_more(told: list[Left]) -> float:
    """Return how much noise that a screen has spread there is besides what is stated, in units of its variance.

    Of what all balls of a film tell as much is believed as is not chance (James and Stein, Fourth Berkeley Symposium, 1961).
    """
    if not told:
        return 0.0
    found, expected, shared = (np.concatenate([getattr(left, name) for left in told], axis=-1) for name in ("found", "expected", "shared"))
    mean = expected.mean(axis=0)
    seen = mean > 0
    plain = seen & ~np.concatenate([left.speckled for left in told])
    if np.count_nonzero(plain) >= _LEAST:
        seen = plain
    if np.count_nonzero(seen) < _LEAST:
        return 0.0
    more = float(np.mean(found[..., seen]) / np.mean(mean[seen])) - 1
    scatter = float(np.std(expected[:, seen] / mean[seen])) * np.sqrt(_DRAWS / (_DRAWS - 1))
    chance = scatter * np.sqrt((1 + 1 / _DRAWS) / np.count_nonzero(seen))
    by_chance = _CAUTION * chance
    if more <= by_chance:
        return 0.0
    return float((more - by_chance**2 / more) * np.mean(mean[seen]) / np.mean(shared[:, seen]))


def _drawn(noise: NoiseModel, count: int, side: int) -> Float:
    """Draw noise of variance one, shape (draws, count, pixels), the same every time."""
    size = next_fast_len(side + LAGS, real=True)
    spectrum = _white(count, size) * np.sqrt(np.maximum(power_spectrum(noise.correlation, (size, size)), 0.0))
    return np.asarray(irfft2(spectrum, s=(size, size))[..., :side, :side].reshape(_DRAWS, count, -1))


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
