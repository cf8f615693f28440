"""Noise of neighbouring pixels made independent, for fits that are efficient where screens and scanners blur the noise.

Least squares with weights alone stays unbiased in correlated noise but loses to generalised least squares (Aitken, Proceedings of the
Royal Society of Edinburgh 55, 1935): a filter with the inverse root of the noise's power spectrum on data and model alike. Its matrix over
a window, with nothing beyond, comes to the inverse of the covariance to a few per cent in the errors of centres.

Bone is slow against the rims of arms and points, which tell where these are. Where it does more than noise, what is slower than a square of
a few widths is taken out of data and model as well: the inverse root of a spectrum that falls with the frequency, near enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel, power_spectrum

_REACH = 4  # pixels; a longer filter does no better
_NOTHING = 3e-3  # of the filter's middle, from which a tap counts
_PERIOD = 64
_LEAST_POWER = 0.3  # of white noise of the same variance: no frequency is known to have less, nor a mark to be so like its model


def whiten(images: NDArray[Any], noise: NoiseModel) -> NDArray[Any]:
    """Filter windows so that the film's noise in them is white, of variance one if it was.

    Parameters
    ----------
    images : ndarray of shape (..., rows, cols)
        In units of the noise of each pixel; 0 where masked. Their kind is that of the result.
    noise : NoiseModel

    Returns
    -------
    ndarray of shape (..., rows, cols)
        The filter is its own transpose.
    """
    if noise.is_white:
        return images
    rows, cols = images.shape[-2:]
    kernel = _kernel(noise.correlation.tobytes(), len(noise.correlation))
    # side by side, with a gap that keeps them from each other: long rows are filtered several times as fast as short ones
    apart = np.zeros((rows, images.size // (rows * cols), cols + len(kernel) // 2), images.dtype)
    apart[:, :, :cols] = images.reshape(-1, rows, cols).swapaxes(0, 1)
    out = cv2.filter2D(apart.reshape(rows, -1), -1, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(out.reshape(apart.shape)[:, :, :cols].swapaxes(0, 1).reshape(images.shape))


@dataclass(frozen=True, slots=True)
class Filter:
    """What data and model go through before they are compared.

    Attributes
    ----------
    noise : NoiseModel
        That is made white.
    side_px : int
        Odd; of the squares around each pixel whose mean is taken away. 0: none is.
    """

    noise: NoiseModel
    side_px: int = 0

    def __call__(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Filter images (n, rows, cols), in units of the noise of each pixel, 0 where masked; the filter is its own transpose."""
        if not self.side_px:
            return whiten(images, self.noise)
        n, rows, cols = images.shape
        # what leaks out of the images comes back in
        room = np.zeros((n, rows + 2 * _REACH, cols + 2 * _REACH + self.side_px // 2), np.float32)
        room[:, _REACH : _REACH + rows, _REACH : _REACH + cols] = images
        white = np.ascontiguousarray(whiten(room, self.noise).swapaxes(0, 1)).reshape(room.shape[1], -1)
        white -= cv2.boxFilter(white, -1, (self.side_px, self.side_px), borderType=cv2.BORDER_CONSTANT)
        apart = white.reshape(room.shape[1], n, room.shape[2]).swapaxes(0, 1)
        return np.asarray(apart[:, _REACH : _REACH + rows, _REACH : _REACH + cols])


def whiten_rows(windows: NDArray[Any], side: int, noise: NoiseModel) -> NDArray[Any]:
    """Return the same of square windows that are rows of pixels, shape (..., side * side)."""
    return whiten(windows.reshape(-1, side, side), noise).reshape(windows.shape)


def variance_left(noise: NoiseModel) -> float:
    """Return the variance of noise of variance one that was made white: less than one where some frequency is not believed to be so quiet.

    Parameters
    ----------
    noise : NoiseModel

    Returns
    -------
    float
    """
    if noise.is_white:
        return 1.0
    power, believed = _powers(noise.correlation.tobytes(), len(noise.correlation))
    part = np.maximum(power, 0.0) / believed
    return float((2 * part.sum() - part[:, [0, -1]].sum()) / _PERIOD**2)  # all but the first and the last frequency stand for two


def _powers(correlation: bytes, side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of the noise at the frequencies of ``rfft2``, and what of it is believed."""
    power = power_spectrum(np.frombuffer(correlation).reshape(side, side), (_PERIOD, _PERIOD))
    return power, power + max(0.0, _LEAST_POWER - power.min())


@lru_cache(maxsize=64)
def _kernel(correlation: bytes, side: int) -> NDArray[np.float64]:
    kernel = np.fft.irfft2(1 / np.sqrt(_powers(correlation, side)[1]), s=(_PERIOD, _PERIOD))
    reach = int(np.flatnonzero(np.abs(kernel[0, : _REACH + 1]) > _NOTHING * kernel[0, 0]).max())
    return np.asarray(np.roll(kernel, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1].copy())
