"""What images look like: size, contrast, and how well they were fitted. Logarithms are used throughout, so that a shift is a factor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rsa_vision.types import Float, Int

LEARNT_FROM: Final = 3.0  # pairs (sum of their probabilities) that teach what pairs look like
FAINT: Final = 1e-3  # pairs less probable than that teach nothing
KIND: Final = np.array([0.03, 0.05])  # sd of sizes and contrasts within a kind of ball
WIDE: Final = np.array([0.7, 0.7])  # sd of sizes and contrasts of any images
UNSURE: Final = np.array([0.2, 0.4])  # error of the logs of size and contrast of an image that is not clear
CLASSES: Final = 3  # of images: clear, disturbed (by a neighbour, an edge, saturation), and not described by the model


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """What is known of the looks of rays and of their crossings.

    Attributes
    ----------
    image : ndarray of int, shape (n,)
        Image of every ray.
    of_ray : ndarray of shape (n, 2) or (n, 1)
        Log of apparent radius and of contrast, or of the radius alone; NaN where unknown.
    quality : ndarray of int, shape (n,)
        Class of the image of every ray, below :data:`CLASSES`.
    a, b : ndarray of int, shape (m,)
        The rays of every crossing.
    grown_a, grown_b : ndarray of shape (m,)
        Log of the factor by which a marker at the crossing is smaller than its images.
    error : ndarray of shape (n,)
        Of the logs of size and contrast of every ray's image, by noise; 0 where it is not known.
    """

    image: Int
    of_ray: Float
    quality: Int
    a: Int
    b: Int
    grown_a: Float
    grown_b: Float
    error: Float

    @property
    def unsure(self) -> Float:
        """Error of the look of every ray, shape as `of_ray`."""
        unclear = np.where((self.quality > 0)[:, None], UNSURE[: self.of_ray.shape[1]], 0.0)
        result: Float = np.hypot(unclear, self.error[:, None])
        return result

    @property
    def sizes(self) -> Looks:
        """The same without contrast."""
        return replace(self, of_ray=self.of_ray[:, :1])

    def as_usual_here(self, pair: Float) -> Looks:
        """Take disturbed images for clear ones where too few pairs are clear to teach: on saturated films all look like that.

        Parameters
        ----------
        pair : ndarray of shape (m,)
            Probability of every crossing to be a marker, so far.

        Returns
        -------
        Looks
        """
        clear = (self.quality[self.a] == 0) & (self.quality[self.b] == 0)
        return self if pair[clear].sum() >= LEARNT_FROM else replace(self, quality=np.maximum(self.quality - 1, 0))
