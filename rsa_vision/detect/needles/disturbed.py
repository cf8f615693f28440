"""What else than noise lies over pins and tees: wires, edges, bone, told by what their fits leave that is as smooth as images are.

A fit takes up of whatever lies over a mark the part that looks like a change of its own numbers, and leaves the rest. Both are as smooth
as blur makes everything on a film, so that what is left of so few frequencies tells how much has been taken up: the variance that a tip
responds to is that of these frequencies, not that of single pixels, among which a faint wire is lost. What is smoother still is background.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.needles.crossing import Window
from rsa_vision.detect.needles.equations import Equations
from rsa_vision.types import Float

_SURE = 4.0  # standard deviations of what noise alone leaves
_WIDE = 3.0  # times the blur: what is as smooth as that is background to a tip


def louder(window: Window, e: Equations, own: Float, common: Float, sigma_px: float) -> float:
    """Return the variance of what lies over needles in the frequencies of their images, in units of that of noise; one where it is noise.

    Parameters
    ----------
    window : Window
    e : Equations
        Of this window, filtered.
    own, common : ndarray of shape (p,), (c,)
        Last changes of its own parameters and of the common ones.
    sigma_px : float
        Blur of the film.

    Returns
    -------
    float
    """
    left = e.residual - own @ e.own - common @ e.common
    square = float(np.square(_band(window, left[None], sigma_px)).sum())
    kept, expected = _of_noise(window, len(left), sigma_px)
    if square < expected:
        return 1.0
    band = _band(window, e.own, sigma_px)
    expected -= float((e.inverse * (band @ band.T)).sum())  # fits take up a part of it
    if expected <= 0:
        return 1.0
    ratio = square / expected
    # as many independent values as the squares of what neighbours share leave of the pixels
    return ratio if ratio > 1 + _SURE * np.sqrt(4 * np.pi * sigma_px**2 * kept / expected) else 1.0


def _band(window: Window, values: Float | NDArray[np.float32], sigma_px: float) -> Float:
    """Leave the frequencies of images of values at the pixels of a window, shape (p, n)."""
    fine, coarse = (_smooth(window, values, sigma) for sigma in (sigma_px, _WIDE * sigma_px))
    return np.asarray(fine - coarse, np.float64)


def _of_noise(window: Window, count: int, sigma_px: float) -> tuple[float, float]:
    """Return the part of the variance of white noise in that band, and what its squares come to over the pixels of a window.

    The squares of the weights with which a pixel's surroundings enter it, those within the window.
    """
    ones, wide = np.ones((1, count)), _WIDE * sigma_px
    parts = []
    for factor, one, other in ((1, sigma_px, sigma_px), (-2, sigma_px, wide), (1, wide, wide)):
        both = one**2 + other**2  # a product of two Gaussians is a third
        kept = factor / (2 * np.pi * both)
        parts.append((kept, kept * float(_smooth(window, ones, one * other / np.sqrt(both)).sum())))
    kept, expected = np.sum(parts, axis=0)
    return float(kept), float(expected)


def _smooth(window: Window, values: Float | NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Blur values at the pixels of a window, shape (p, n)."""
    boxes = [cv2.GaussianBlur(box, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT) for box in window.boxes(values)]
    return np.asarray(boxes).reshape(len(boxes), -1).take(window.place, axis=1)
