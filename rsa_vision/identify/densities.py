"""Densities that are learnt from few values: kernels, and Student's distribution where values may lie far off."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import gammaln

from rsa_vision.types import Float, Int

AT_A_TIME: Final = 20_000


def log_kernels(value: Float, sample: Float, weight: Float, least: Float, n: Float | float, scott: float = 0.5) -> Float:
    """Return the log of kernel density estimates; kernels are half as wide as Scott's where there may be several kinds of balls.

    Parameters
    ----------
    value : ndarray of shape (..., d)
        Where each estimate is asked.
    sample : ndarray of shape (..., m, d)
    weight : ndarray of shape (..., m)
        Those of 0 count for nothing.
    least : ndarray of shape (..., d)
        Least widths of kernels.
    n : ndarray of shape (...), or float
        Values that the sample counts for.
    scott : float
        Part of the width by Scott's rule.

    Returns
    -------
    ndarray of shape (...)
    """
    n = np.asarray(n)
    part = weight / weight.sum(axis=-1, keepdims=True)
    middle = np.einsum("...m,...md->...d", part, sample)
    spread = np.sqrt(np.einsum("...m,...md->...d", part, np.square(sample - middle[..., None, :])))
    width = np.hypot(least, scott * np.maximum(n, 1.0)[..., None] ** (-1 / 6) * spread)
    kernels = log_student((value[..., None, :] - sample) / width[..., None, :], n[..., None, None]).sum(axis=-1)
    with np.errstate(divide="ignore"):
        result: Float = np.logaddexp.reduce(kernels + np.log(part), axis=-1) - np.log(width).sum(axis=-1)
    return result


def weighted_median(values: Float, weight: Float) -> Float:
    """Return the median (..., d) of values (..., m, d) that count by weights (..., m), some of which are more than 0."""
    order = np.argsort(values, axis=-2)
    total = np.cumsum(np.take_along_axis(np.broadcast_to(weight[..., None], values.shape), order, axis=-2), axis=-2)
    place = np.argmax(total >= total[..., -1:, :] / 2, axis=-2)[..., None, :]
    result: Float = np.take_along_axis(values, np.take_along_axis(order, place, axis=-2), axis=-2)[..., 0, :]
    return result


def log_student(t: Float, freedom: Float | float) -> Float:
    """Return the log density of Student's t distribution, of two degrees of freedom at least."""
    v = np.maximum(freedom, 2.0)
    scale = gammaln((v + 1) / 2) - gammaln(v / 2) - 0.5 * np.log(v * np.pi)
    result: Float = scale - (v + 1) / 2 * np.log1p(np.square(t) / v)
    return result


def some_of(rows: Int, columns: int) -> list[Int]:
    """Split rows into so few at a time that what is asked of all their columns takes little memory."""
    return np.array_split(rows, len(rows) * columns // AT_A_TIME + 1) if len(rows) else []
