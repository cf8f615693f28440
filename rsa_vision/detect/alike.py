"""Sizes that the marks of a film may have in common: how much they truly differ, from fits that let each have its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from rsa_vision.types import Bool, Float

_LEAST = 5  # from so many on their scatter tells something
_OUTLIER = 3.0  # standard deviations
SD_OF_MAD = 1.4826  # standard deviation of what is normal in units of its median deviation
_MEDIAN_CHI2 = 0.455  # of one degree of freedom


def true_spread(values: Float, variances: Float) -> tuple[float, float, Bool]:
    """Tell how much quantities differ beyond the errors of their measurement (a random-effects model).

    The spread is that for which the squared deviations are what they should be (Paule & Mandel, J. Res. NBS 87, 1982), plus one standard
    deviation of what chance makes of it: few marks cannot prove that all are alike. Outliers are told by a first, robust spread.

    Parameters
    ----------
    values, variances : ndarray of shape (n,)
        Measured, with their variances.

    Returns
    -------
    centre, spread : float
        Mean and standard deviation of the true values; the latter infinite where nothing can be said.
    belongs : ndarray of bool, shape (n,)
        No outliers.
    """
    everything = np.ones(len(values), bool)
    if len(values) < _LEAST:
        return float(np.mean(values)) if len(values) else 0.0, np.inf, everything
    middle = float(np.median(values))
    rough = _solve(lambda s2: float(np.median((values - middle) ** 2 / (variances + s2))) - _MEDIAN_CHI2, values)
    belongs = (values - middle) ** 2 < _OUTLIER**2 * (variances + rough)
    x, v = values[belongs], variances[belongs]
    if len(x) < _LEAST:
        return middle, np.inf, everything

    def excess(s2: float) -> float:
        weight = 1 / (v + s2)
        return float((weight * (x - np.average(x, weights=weight)) ** 2).sum()) - (len(x) - 1)

    s2 = _solve(excess, x)
    weight = 1 / (v + s2)
    s2 += float(np.sqrt(2 / (len(x) - 1)) / weight.mean())
    return float(np.average(x, weights=weight)), float(np.sqrt(s2)), belongs


def _solve(excess: Callable[[float], float], values: Float) -> float:
    most = float(np.ptp(values)) ** 2 * len(values) + 1e-12
    return 0.0 if excess(0.0) <= 0 else float(brentq(excess, 0.0, most, xtol=1e-12, rtol=1e-3))
