"""What each pin or tee has of its own where others may have the same: its blur, and of pins the taper.

A focal spot's penumbra grows with the distance from the film, and a cage has marks in two planes; pins of several lengths have points of
one angle. How far they differ, the needles of a film tell. Where that is no more than errors of measurement make, all have the same, which
is what sharpens tips most; where it is more, each may differ as far as those of the film do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.types import Float

MOST_BLURRIER = 0.8  # of the logarithm of a needle's blur over the film's
MOST_TAPER = 0.4  # of the taper of a pin over the usual one
_ALIKE = 1e-4  # of either, by which equal ones differ
_BY_CHANCE, _OUTLIER = 4.0, 3.0  # standard deviations: of the mean square by which all differ; of one that is as odd as any
_LEAST = 5  # needles that can tell


@dataclass(frozen=True, slots=True, eq=False)
class Differing:
    """How far the needles of a film may differ: logarithms of their blurs over the film's, or tapers.

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
    """Take the blurs of all needles of the windows of a film as equal, or what their tapers differ."""
    return Differing(0.0, [np.full(len(members), _ALIKE) for members in sets])


def differing(values: list[Float], variances: list[Float], most: float) -> Differing | None:
    """Tell how far needles differ from what fits in which all are free leave, by windows; nothing where it is what chance makes.

    Parameters
    ----------
    values, variances : list of ndarrays of shape (members,)
        Measured, and the squares of their errors.
    most : float
        How far one may differ that is as odd as any.

    Returns
    -------
    Differing or None
    """
    of_all, variance = np.concatenate(values), np.concatenate(variances)
    if len(of_all) < _LEAST:
        return None
    squares = np.minimum(np.square(of_all - np.average(of_all, weights=1 / variance)) / variance, _OUTLIER**2)
    if squares.mean() < 1 + _BY_CHANCE * np.sqrt(2 / len(of_all)):
        return None
    centre, spread, belongs = true_spread(of_all, variance)
    if not spread < most:
        return None
    each = np.where(belongs, spread, most)
    return Differing(centre, np.split(each, np.cumsum([len(of) for of in values])[:-1]))
