"""Blur of each pin or tee: a focal spot's penumbra grows with the distance from the film, and a cage has marks in two planes.

How far blurs differ, the needles of a film tell. Where that is no more than errors of measurement make, all have the same, which is what
sharpens tips most; where it is more, each may differ as far as those of the film do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.types import Float

MOST = 0.8  # of the logarithm of a needle's blur over the film's
_ALIKE = 1e-4  # of that, by which equal ones differ
_BY_CHANCE, _OUTLIER = 4.0, 3.0  # standard deviations: of the mean square by which all differ; of one that is as odd as any
_LEAST = 5  # needles that can tell


@dataclass(frozen=True, slots=True, eq=False)
class Blurs:
    """How far the blurs of a film's needles may differ, as logarithms over the film's.

    Attributes
    ----------
    typical : float
        What is usual.
    spread : list of ndarrays of shape (members,)
        Standard deviations of each needle from that, by windows.
    """

    typical: float
    spread: list[Float]


def equal(sets: list[list[NeedleFit]]) -> Blurs:
    """Take the blurs of all needles of the windows of a film as equal."""
    return Blurs(0.0, [np.full(len(members), _ALIKE) for members in sets])


def differing(blurs: list[Float], variances: list[Float]) -> Blurs | None:
    """Tell how far blurs differ from what fits in which all are free leave, by windows; nothing where it is what chance makes.

    Parameters
    ----------
    blurs, variances : list of ndarrays of shape (members,)
        Measured, and the squares of their errors.

    Returns
    -------
    Blurs or None
    """
    values, variance = np.concatenate(blurs), np.concatenate(variances)
    if len(values) < _LEAST:
        return None
    squares = np.minimum(np.square(values - np.average(values, weights=1 / variance)) / variance, _OUTLIER**2)
    if squares.mean() < 1 + _BY_CHANCE * np.sqrt(2 / len(values)):
        return None
    centre, spread, belongs = true_spread(values, variance)
    if not spread < MOST:
        return None
    each = np.where(belongs, spread, MOST)
    return Blurs(centre, np.split(each, np.cumsum([len(of) for of in blurs])[:-1]))
