"""Where along their rays markers lie: near the others. Unrelated rays may pass each other at any depth."""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.identify.densities import log_kernels
from rsa_vision.identify.looks import LEARNT_FROM
from rsa_vision.types import Float, Int

LEAST_SPREAD: Final = 0.01  # of log depths, about a centimetre
ELSEWHERE: Final = 1.0  # markers that lie anywhere, of all: one more than there are, until it is met


def log_chance_of_depths(depth: Float, others: Float, tried: int) -> Float:
    """Return the log density of the depths at which unrelated rays pass each other where a marker may be.

    Parameters
    ----------
    depth : ndarray of shape (m,)
        Logarithms, wherever the density is wanted.
    others : ndarray of shape (k,)
        Of any two rays that pass each other at a possible place.
    tried : int
        Any two rays: the density is a part of 1 as large as k is of these.

    Returns
    -------
    ndarray of shape (m,)
    """
    width = np.hypot(LEAST_SPREAD, float(others.std()) * len(others) ** -0.2)
    kernels = np.exp(-0.5 * ((depth[:, None] - others) / width) ** 2) / (np.sqrt(2 * np.pi) * width)
    return np.asarray(np.log((kernels.sum(axis=1) + 1.0) / (tried + 1.0)))  # one that lies anywhere is presumed


def log_odds_of_depths(depth: Float, log_chance: Float, a: Int, b: Int, pair: Float) -> Float:
    """Return the log likelihood ratio of the depths of crossings: those of markers against those of unrelated rays.

    Parameters
    ----------
    depth, log_chance : ndarray of shape (m,)
        Log depth, and its log density for unrelated rays.
    a, b : ndarray of int, shape (m,)
        The rays of every crossing.
    pair : ndarray of shape (m,)
        Probability of every crossing to be a marker, so far.

    Returns
    -------
    ndarray of shape (m,)
        0 where too few markers tell. No crossing is judged by what its own rays have taught.
    """
    result = np.zeros(len(depth))
    for e in range(len(depth)):
        weight = np.where((a != a[e]) & (b != b[e]), pair, 0.0)
        n = float(weight.sum())
        if n >= LEARNT_FROM:
            near = log_kernels(depth[e : e + 1], depth[:, None], weight, np.array([LEAST_SPREAD]), n, 1.0)
            anywhere = np.log(ELSEWHERE / (n + ELSEWHERE)) + log_chance[e]
            result[e] = np.logaddexp(np.log(n / (n + ELSEWHERE)) + near, anywhere) - log_chance[e]
    return result
