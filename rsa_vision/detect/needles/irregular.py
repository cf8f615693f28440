"""Tees that are not quite alike: arms off their common directions, or of lengths of their own (pins set by hand, a plane that tilts).

How far arms differ, the tees of a film tell. Where that is no more than errors of measurement make, all are taken as alike, which
is what sharpens tips most; where it is more, each arm may be as far off as those of the film are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.models.needles import NeedleFit, wrapped
from rsa_vision.types import Float

# logarithms of the lengths of stem and both halves of the bar, of the two ways in which they differ
OF_STRETCH = np.array([[1.0, 0.0], [-0.5, 0.5], [-0.5, -0.5]])
ARMS, WAYS = 3, 4  # leans of the two halves of the bar against the stem, and these
_ALIKE = 1e-4  # radians and logarithms by which regular arms differ
_BY_CHANCE, _OUTLIER = 3.0, 3.0  # standard deviations: of the mean square by which all differ; of one that is as odd as any
_LEAST = 4  # tees that can tell
_MOST = 0.3  # radians and logarithms, of a way


@dataclass(frozen=True, slots=True, eq=False)
class Regularity:
    """How far the arms of a film's tees may differ.

    Attributes
    ----------
    common : ndarray of shape (2,)
        Angles of the halves of the bar against the stem, radians.
    typical : ndarray of shape (4,)
        What is usual of each way.
    spread : list of ndarrays of shape (members, 4)
        Standard deviations of each tee from that, by windows.
    """

    common: Float
    typical: Float
    spread: list[Float]


def regular(sets: list[list[NeedleFit]]) -> Regularity:
    """Take all tees of the windows of a film as alike."""
    turned = np.array([f.angles[1:] - f.angles[0] for members in sets for f in members])
    return Regularity(np.median(turned, axis=0), np.zeros(WAYS), [np.full((len(members), WAYS), _ALIKE) for members in sets])


def ways_of(fit: NeedleFit, common: Float) -> Float:
    """Return how far a tee's arms differ from the common directions and from each other's lengths, shape (4,)."""
    lean = wrapped(fit.angles[1:] - fit.angles[0] - common)
    logs = np.log(np.broadcast_to(fit.shape.arms, ARMS))
    return np.append(lean, [(2 * logs[0] - logs[1] - logs[2]) / 3, logs[1] - logs[2]])


def moved_arms(fit: NeedleFit, step: Float) -> tuple[Float, tuple[float, ...]]:
    """Return angles (3,) and lengths of the arms in units of the common one after a step of these ways (4,)."""
    step = np.clip(step, -_MOST, _MOST)
    logs = np.log(np.broadcast_to(fit.shape.arms, ARMS)) + OF_STRETCH @ step[2:]
    return fit.angles + np.append(0.0, step[:2]), tuple(np.exp(np.clip(logs, -_MOST, _MOST)).tolist())


def told_by(ways: list[Float], variances: list[Float], known: Regularity) -> Regularity | None:
    """Tell how far arms differ from what fits in which all are free leave, by windows; nothing where it is what chance makes.

    Parameters
    ----------
    ways, variances : list of ndarrays of shape (members, 4)
        Measured, and the squares of their errors.
    known : Regularity
        So far.

    Returns
    -------
    Regularity or None
    """
    values, variance = np.concatenate(ways), np.concatenate(variances)
    if len(values) < _LEAST:
        return None
    squares = np.minimum(np.square(values - known.typical) / variance, _OUTLIER**2)
    lean, stretch = squares[:, :2].mean(), squares[:, 2:].mean()
    if max(lean, stretch) < 1 + _BY_CHANCE / np.sqrt(len(values)):  # the standard deviation of a mean of squares, two of each tee
        return None
    typical, spread = known.typical.copy(), np.full(values.shape, _ALIKE)
    for way in range(WAYS):
        centre, sd, belongs = true_spread(values[:, way], variance[:, way])
        if not sd < _MOST:
            return None  # whatever crosses there, these are no arms of tees
        typical[way], spread[:, way] = centre, np.where(belongs, sd, np.inf)
    parts = np.cumsum([len(of) for of in ways])[:-1]
    return Regularity(known.common, typical, np.split(spread, parts))
