"""Images of balls that a focal spot draws which is no Gaussian: the spot as four points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.fits import slopes
from rsa_vision.detect.models.profiles import Optics, ball_table
from rsa_vision.types import Float


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """Focal spot, as spread over marks of one height.

    Attributes
    ----------
    points : ndarray of shape (4, 2)
        (col, row) from the centroid, px.
    weights : ndarray of shape (4,)
    """

    points: Float
    weights: Float

    @property
    def reach_px(self) -> float:
        """How far its points are from the centroid."""
        return float(np.hypot(*self.points.T).max())


def shapes_of(optics: Optics, spot: Spot | None, dx: Float, dy: Float, radius: Float) -> tuple[Float, Float, Float, Float]:
    """Return the images of balls of depth one and their derivatives.

    Parameters
    ----------
    optics : Optics
    spot : Spot or None
        None where blur is a Gaussian.
    dx, dy : ndarray of shape (n, p)
        Pixels from the centres.
    radius : ndarray of shape (n,)

    Returns
    -------
    value, by_dx, by_dy, by_radius : ndarrays of shape (n, p)
    """
    table = ball_table(optics)
    if spot is None:
        return slopes(table, dx, dy, radius, optics.sigma_px)
    total = np.zeros((4, *dx.shape))
    for point, weight in zip(spot.points, spot.weights, strict=True):
        total += weight * np.stack(slopes(table, dx - point[0], dy - point[1], radius, optics.sigma_px))
    return total[0], total[1], total[2], total[3]
