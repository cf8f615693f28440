"""What each pin or tee has of its own where others may have the same: its blur, and of pins the taper and the attenuation.

A focal spot's penumbra grows with the distance from the film, and a cage has marks in two planes; pins of several lengths have points of
one angle. How far they differ, the needles of a film tell. Where that is no more than errors of measurement make, all have the same, which
is what sharpens tips most; where it is more, each may differ as far as those of the film do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.alike import evidence_of_spread, true_spread
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.types import Float

MOST_BLURRIER = 0.8  # of the logarithm of a needle's blur over the film's
MOST_DENSER = 1.0  # of the logarithm of a pin's attenuation over the film's
SLANTED = 0.3  # spread of that among pins that point anywhere: a ray at 45 degrees goes 1.4 times as far through them
MOST_TAPER = 0.4  # of the taper of a pin over the usual one
_ALIKE = 1e-4  # of any of these, by which equal ones differ
_OUTLIER = 3.0  # standard deviations of one that is as odd as any: it alone says little of the others
LEAST_TELLING = 5  # needles


@dataclass(frozen=True, slots=True, eq=False)
class Differing:
    """How far the needles of a film may differ: logarithms of their blurs or attenuations over the film's, or tapers.

    Attributes
    ----------
    typical : float
        What is usual.
    spread : list of ndarrays of shape (members,)
        Standard deviations of each needle from that, by windows.
    """

    typical: float
    spread: list[Float]

    @property
    def nothing(self) -> bool:
        """They are taken as equal."""
        return all(bool((of == _ALIKE).all()) for of in self.spread)


def equal(sets: list[list[NeedleFit]]) -> Differing:
    """Take the blurs of all needles of the windows of a film as equal, or what their tapers or attenuations differ."""
    return Differing(0.0, [np.full(len(members), _ALIKE) for members in sets])


def unknown(values: list[Float], spread: float) -> Differing:
    """Take it that needles differ by so much, of which too few tell anything."""
    return Differing(0.0, [np.full(len(of), spread) for of in values])


def differing(values: list[Float], variances: list[Float], most: float, sure: float) -> Differing | None:
    """Tell how far needles differ from what fits in which all are free leave, by windows.

    The square of the spread is the mean over both, that they differ and that they are all the same.

    Parameters
    ----------
    values, variances : list of ndarrays of shape (members,)
        Measured, and the squares of their errors.
    most : float
        How far one may differ that is as odd as any.
    sure : float
        Logarithm of the odds that they do, below which it is taken for chance.

    Returns
    -------
    Differing or None
        None where it is chance, or more than can be.
    """
    of_all, variance = np.concatenate(values), np.concatenate(variances)
    if len(of_all) < LEAST_TELLING:
        return None
    centre, spread, belongs = true_spread(of_all, variance)
    middle, far = np.average(of_all, weights=1 / variance), _OUTLIER * np.sqrt(variance)
    odds = evidence_of_spread(np.clip(of_all, middle - far, middle + far), variance, most)
    if odds < sure or not spread < most:
        return None
    each = np.where(belongs, spread / math.sqrt(1 + math.exp(-odds)), most)
    return Differing(centre, np.split(each, np.cumsum([len(of) for of in values])[:-1]))
