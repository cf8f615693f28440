"""Sizes that the marks of a film may have in common: how much they truly differ, from fits that let each have its own."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from rsa_vision.types import Bool, Float

_LEAST = 5  # from so many on their scatter tells something
_OUTLIER = 3.0  # standard deviations
SD_OF_MAD = 1.4826  # standard deviation of what is normal in units of its median deviation
_MEDIAN_CHI2 = 0.455  # of one degree of freedom
_HARDLY, _ORDERS = 0.2, 40  # part of an error of measurement; spreads that are tried
_STEPS = (np.arange(200) + 0.5) / 200  # spreads over themselves and the scatter


def true_spread(values: Float, variances: Float) -> tuple[float, float, Bool]:
    """Tell how much quantities differ beyond the errors of their measurement (a random-effects model).

    The variance of the true values is the mean of its marginal likelihood, as if all variances were as likely before (Gelman, Bayesian
    Analysis 1, 2006): few marks cannot prove that all are alike. Outliers are told by a first, robust spread.

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
    belongs = (values - middle) ** 2 < _OUTLIER**2 * (variances + _robust_variance(values - middle, variances))
    x, v = values[belongs], variances[belongs]
    if len(x) < _LEAST:
        return middle, np.inf, everything
    # spreads from none to endless, close to each other where they are like the scatter of the values or less
    spread = _STEPS / (1 - _STEPS) * np.sqrt(x.var() + np.median(v))
    centre, log_likelihood = _of_spreads(x, v, spread)
    likelihood = np.exp(log_likelihood - log_likelihood.max()) * _STEPS / (1 - _STEPS) ** 3  # times the variance from step to step
    return float(np.average(centre, weights=likelihood)), float(np.sqrt(np.average(spread**2, weights=likelihood))), belongs


def evidence_of_spread(values: Float, variances: Float, most: float) -> float:
    """Return the logarithm of the odds that quantities differ against that they are all the same, which are even before.

    If they differ, all orders of magnitude of their spread up to ``most`` are as likely before, from that on which hardly shows.

    Parameters
    ----------
    values, variances : ndarray of shape (n,)
        Measured, with their variances.
    most : float

    Returns
    -------
    float
    """
    least = min(_HARDLY * float(np.sqrt(np.median(variances))), 0.5 * most)
    _, log_likelihood = _of_spreads(values, variances, np.concatenate([[0.0], np.geomspace(least, most, _ORDERS)]))
    same, differ = log_likelihood[0], log_likelihood[1:]
    return float(differ.max() - same + np.log(np.mean(np.exp(differ - differ.max()))))


def _of_spreads(values: Float, variances: Float, spread: Float) -> tuple[Float, Float]:
    """Mean of true values and logarithm of the marginal likelihood, by their spreads (k,)."""
    weight = 1 / (variances + spread[:, None] ** 2)
    centre = (weight @ values) / weight.sum(1)
    squares = (weight * (values - centre[:, None]) ** 2).sum(1)
    return centre, 0.5 * (np.log(weight).sum(1) - np.log(weight.sum(1)) - squares)


def robust_sd(values: Float) -> float:
    """Return the standard deviation of values that are normal but for a few, by how far they are from their median, (n,)."""
    return SD_OF_MAD * float(np.median(np.abs(values - np.median(values))))


def _robust_variance(offsets: Float, variances: Float) -> float:
    """Return the variance, beyond these, of which the median square is what it should be."""

    def excess(s2: float) -> float:
        return float(np.median(offsets**2 / (variances + s2))) - _MEDIAN_CHI2

    most = float(np.ptp(offsets)) ** 2 * len(offsets) + 1e-12
    return 0.0 if excess(0.0) <= 0 else float(brentq(excess, 0.0, most, xtol=1e-12, rtol=1e-3))
