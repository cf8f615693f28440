"""What pulls at the centre of a ball and is none of its neighbours: a speck on its rim, a wire beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.random_effects import Solution
from rsa_vision.types import Bool, Float


@dataclass(frozen=True, slots=True, eq=False)
class Pulls:
    """What the centres of some balls are corrected by; filled ball by ball.

    Attributes
    ----------
    shift_px : ndarray of shape (n, 2)
        To be added to the centres; 0 where nothing pulls.
    covariance : ndarray of shape (n, 2, 2)
        Of that.
    image : ndarray of shape (n, pixels)
        To be taken from what is left of the windows.
    """

    shift_px: Float
    covariance: Float
    image: Float

    @property
    def found(self) -> Bool:
        """Say which balls something pulls at, shape (n,)."""
        return np.asarray(self.shift_px.any(axis=1))

    def put(self, i: int, solution: Solution, image: Float, fitted: Float, height: float, variance: float) -> None:
        """Correct one ball for something of this image, height and variance of that, of which the others take up the fitted part.

        Parameters
        ----------
        i : int
        solution : Solution
        image : ndarray of shape (pixels,)
            Of height one.
        fitted : ndarray of shape (10 + k,)
            What it makes of the other coefficients.
        height, variance : float
        """
        self.shift_px[i] = -height * fitted[:2]
        self.covariance[i] = variance * np.outer(fitted[:2], fitted[:2])
        self.image[i] = height * (image - fitted @ solution.images[i])

    def but(self, others: Pulls) -> Pulls:
        """Return these, or others where there are any."""
        other = others.found
        return Pulls(
            np.where(other[:, None], others.shift_px, self.shift_px),
            np.where(other[:, None, None], others.covariance, self.covariance),
            np.where(other[:, None], others.image, self.image),
        )


def no_pulls(solution: Solution) -> Pulls:
    """Return none, for as many balls."""
    count, pixels = solution.residual.shape
    return Pulls(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.zeros((count, pixels)))
