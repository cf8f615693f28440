"""Whether images of a shape of which none is paired are more than clutter would be.

Markers show on the other films as well: as such images, or as others where they are seen from another side. So their rays meet more than
unrelated rays would; and if the other films show nothing that they meet, there are more of them than clutter as thick as there explains.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.stats import nbinom, poisson

from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.crossings import WINDOWS_MM, Region, find_crossings
from rsa_vision.types import Bool, Float

LEAST: Final = 2  # images: a single one may be a part of something else
BY_CHANCE: Final = 0.05  # how probable as many by chance must not be
MET_SIGMA: Final = 3.0  # distance of two rays in units of its standard deviation
PRESUMED: Final = (0.1, 0.05)  # images of clutter, and films that they were counted on, beside those of the examination


def more_than_clutter(bundle: RayBundle, asked: Bool, others: Bool, region: Region | None, slack_mm: float) -> Bool:
    """Return which of the rays are of a focus where they are more than clutter.

    Parameters
    ----------
    bundle : RayBundle
    asked : ndarray of bool, shape (n,)
        The rays in question.
    others : ndarray of bool, shape (n,)
        The rays that may be of the same markers, of whatever shape their images are.
    region : callable or None
        Where a marker may be, as of :func:`~rsa_vision.identify.crossings.find_crossings`.
    slack_mm : float
        Error of the rays beyond their covariance, in quadrature to the sigma of a crossing.

    Returns
    -------
    ndarray of bool, shape (n,)
        Of the focus's rays that are asked none, or all.
    """
    if not asked.any():
        return np.zeros(len(bundle), bool)
    meets, expected = _met(bundle, others, region, slack_mm)
    result = np.zeros(len(bundle), bool)
    exposures = PRESUMED[1] + max(len(np.unique(bundle.focus)) - 1, 1)
    for focus in np.unique(bundle.focus[asked]):
        mine = asked & (bundle.focus == focus)
        elsewhere = asked & (bundle.focus != focus)
        met = int(meets[mine].sum())
        many = nbinom.sf(mine.sum() - 1, PRESUMED[0] + elsewhere.sum(), exposures / (exposures + 1)) < BY_CHANCE
        found = met >= LEAST and poisson.sf(met - 1, expected[mine].sum()) < BY_CHANCE
        if mine.sum() >= LEAST and (many or found):
            result |= mine
    return result


def _met(bundle: RayBundle, others: Bool, region: Region | None, slack_mm: float) -> tuple[Bool, Float]:
    """Return which rays meet another one, and how many of those they would meet if they had nothing to do with what is near."""
    rows = np.flatnonzero(others)
    crossings = find_crossings(bundle.rows(rows), region)[0].with_slack(slack_mm)
    near = crossings.distance_mm < MET_SIGMA * crossings.sigma_mm
    part = np.minimum(MET_SIGMA * crossings.sigma_mm / WINDOWS_MM[0], 1.0 - 1e-9)
    meets, log_none = np.zeros(len(bundle), bool), np.zeros(len(bundle))
    for side in (rows[crossings.a], rows[crossings.b]):
        meets[side[near]] = True
        np.add.at(log_none, side, np.log1p(-part))
    return meets, -np.expm1(log_none)
