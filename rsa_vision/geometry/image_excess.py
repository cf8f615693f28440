"""By how much image errors are larger than stated: what the crossings of all markers of an examination say together.

Errors of homographies and foci bend the crossings of all markers in a few ways that they have in common; they are usually larger than the
errors of the single images and hide them in each marker's crossing error alone. In the joint covariance of all crossings they take up only
those ways, and the rest shows the single images.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import chdtrc, chdtri

from rsa_vision.types import Float

_LEAST: Final = 5  # markers that can tell an error of all
_UNEXPLAINED_P: Final = 0.01
_MOST: Final = 100.0


def image_excess(crossing_mm: Float, own_variance_mm2: Float, effect_mm: Float) -> float:
    """Return the factor by which the images' own standard deviations are too small, 1 unless it is significant.

    Parameters
    ----------
    crossing_mm : ndarray of shape (n,)
        Signed crossing errors of markers.
    own_variance_mm2 : ndarray of shape (n,)
        Their variances by errors of the single images.
    effect_mm : ndarray of shape (n, m)
        Their change for one standard deviation of each error that markers share.

    Returns
    -------
    float
        The factor f for which d^T (f^2 V + E E^T)^-1 d is what chi-square has on average, the marker that fits worst left out on both
        sides: a single wrong pair shows by its own crossing error and says nothing of the others.
    """
    n = len(crossing_mm)
    if n < _LEAST:
        return 1.0
    shared = effect_mm @ effect_mm.T

    def left(factor: float) -> float:
        inverse = np.linalg.inv(np.diag(factor**2 * own_variance_mm2) + shared)
        solved = inverse @ crossing_mm
        # chi-square of the others, without one marker: its squared deviation from what they predict is taken off
        return float(crossing_mm @ solved - (solved**2 / inverse.diagonal()).max())

    expected = n - min(float(chdtri(1, np.exp(-np.euler_gamma) / n)), n - 1.0)
    if chdtrc(n - 1, left(1.0)) > _UNEXPLAINED_P:
        return 1.0
    low, high = 1.0, _MOST
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if left(middle) > expected else (low, middle)
    return float(np.sqrt(low * high)) if low > 1 else 1.0
