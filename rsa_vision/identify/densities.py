"""Densities that are learnt from few values: kernels, and Student's distribution where values may lie far off."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from rsa_vision.types import Float


def log_kernels(value: Float, sample: Float, weight: Float, least: Float, n: float, scott: float = 0.5) -> float:
    """Return the log of a kernel density estimate; kernels are half as wide as Scott's where there may be several kinds of balls."""
    middle = weight @ sample / weight.sum()
    spread = np.sqrt(weight @ (sample - middle) ** 2 / weight.sum())
    width = np.hypot(least, scott * max(n, 1.0) ** (-1 / 6) * spread)
    kernels = (log_student((value - sample) / width, n) - np.log(width)).sum(axis=1)
    with np.errstate(divide="ignore"):
        return float(np.logaddexp.reduce(kernels + np.log(weight / weight.sum())))


def weighted_median(values: Float, weight: Float) -> Float:
    """Return the median of every column."""
    order = np.argsort(values, axis=0)
    total = np.cumsum(weight[order], axis=0)
    place = (total < total[-1] / 2).sum(axis=0)
    result: Float = np.take_along_axis(values, np.take_along_axis(order, place[None], axis=0), axis=0)[0]
    return result


def log_student(t: Float, freedom: Float | float) -> Float:
    """Return the log density of Student's t distribution, of two degrees of freedom at least."""
    v = np.maximum(freedom, 2.0)
    scale = gammaln((v + 1) / 2) - gammaln(v / 2) - 0.5 * np.log(v * np.pi)
    result: Float = scale - (v + 1) / 2 * np.log1p(np.square(t) / v)
    return result
