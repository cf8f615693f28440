"""Where along their rays markers lie: near the others. Rays of images without a partner pass each other wherever these images let them."""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.identify.densities import log_kernels, some_of
from rsa_vision.identify.looks import FAINT, LEARNT_FROM
from rsa_vision.types import Float, Int

STEP: Final = 0.005  # of log depths, in which unrelated crossings are counted
LEAST_SPREAD: Final = 0.01  # of log depths, about a centimetre
ELSEWHERE: Final = 1.0  # markers that lie anywhere, of all: one more than there are, until it is met
PRESUMED: Final = 1.0  # unrelated crossings like those of any two rays, beside those of images without a partner


def log_chance_of_depths(depth: Float, met: Float, weight: Float) -> Float:
    """Return the log density of the depths at which unrelated rays pass each other where a marker may be.

    Parameters
    ----------
    depth : ndarray of shape (m,)
        Logarithms, wherever the density is wanted.
    met : ndarray of shape (k,)
        Of any two rays that pass each other at a possible place.
    weight : ndarray of shape (k,)
        Probability of both images to be there without a partner.

    Returns
    -------
    ndarray of shape (m,)
    """
    width = np.hypot(LEAST_SPREAD, float(met.std()) * len(met) ** -0.2)
    steps = np.ceil(5 * width / STEP)  # the kernel is no longer than what it smooths, even about a single depth
    low, high = float(min(met.min(), depth.min())) - steps * STEP, float(max(met.max(), depth.max())) + steps * STEP
    edges = np.arange(low, high + 2 * STEP, STEP)
    counts = np.histogram(met, edges, weights=weight + PRESUMED / len(met))[0]
    middle = (edges[:-1] + edges[1:]) / 2
    reach = np.arange(-steps, steps + 1) * STEP
    kernel = np.exp(-0.5 * (reach / width) ** 2)
    density = np.convolve(counts / counts.sum(), kernel / (kernel.sum() * STEP), mode="same")
    return np.asarray(np.log(np.maximum(np.interp(depth, middle, density), np.finfo(float).tiny)))


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
    teachers = np.flatnonzero(pair > FAINT)
    weights = pair[teachers] * ((a[teachers] != a[:, None]) & (b[teachers] != b[:, None]))
    for at in some_of(np.flatnonzero(weights.sum(axis=1) >= LEARNT_FROM), len(teachers)):
        n = weights[at].sum(axis=1)
        near = log_kernels(depth[at, None], np.tile(depth[teachers, None], (len(at), 1, 1)), weights[at], np.array([LEAST_SPREAD]), n, 1.0)
        anywhere = np.log(ELSEWHERE / (n + ELSEWHERE)) + log_chance[at]
        result[at] = np.logaddexp(np.log(n / (n + ELSEWHERE)) + near, anywhere) - log_chance[at]
    return result
