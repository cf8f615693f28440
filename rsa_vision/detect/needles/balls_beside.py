"""Balls beside pins and on them as the fits of pins see them: taken away, and the pixels under them not looked at.

What a film shows where a ball lies on a pin, only its curve tells, and a pin has one arm: no pixel there is believed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.patches import Box
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.types import Bool, Float

_FADED = 2.0  # blurs beyond the rim of a ball, to which it hides what is under it


@dataclass(frozen=True, slots=True, eq=False)
class BallsBeside:
    """Balls of a film, beside its pins.

    Attributes
    ----------
    shown : callable
        What they show at pixels (cols, rows), in film values.
    balls : BallFits
    optics : Optics
        Of the balls.
    """

    shown: Images
    balls: BallFits
    optics: Optics

    def and_others(self, others: Images | None) -> Images:
        """Return what they and other neighbours show."""
        if others is None:
            return self.shown

        def images(cols: Float, rows: Float) -> Float:
            total: Float = self.shown(cols, rows) + others(cols, rows)
            return total

        return images

    def over(self, cols: Float, rows: Float) -> Bool:
        """Say at which pixels they hide what is under them."""
        return under_balls(self.balls, self.optics, cols, rows)


def under_balls(balls: BallFits, optics: Optics, cols: Float, rows: Float) -> Bool:
    """Say at which pixels balls hide what is under them, in the shape of these."""
    hidden = np.zeros(cols.shape, bool)
    for at, radius in zip(balls.position_px, balls.radius_px, strict=True):
        hidden |= np.hypot(cols - at[0], rows - at[1]) < radius + _FADED * optics.sigma_px
    return hidden


def mask_under(box: Box, balls: BallFits, optics: Optics) -> None:
    """Put NaN where balls hide what is under them, in place."""
    size = box.values.shape[::-1]
    reach = balls.radius_px[:, None] + _FADED * optics.sigma_px + 1
    low, high = (np.clip(np.rint(balls.position_px + to) - box.corner_px, 0, size).astype(np.intp) for to in (-reach, reach + 1))
    for k, ((left, top), (right, bottom)) in enumerate(zip(low, high, strict=True)):
        rows, cols = np.mgrid[top:bottom, left:right] + box.corner_px[::-1, None, None].astype(np.float64)
        box.values[top:bottom, left:right][under_balls(balls.rows([k]), optics, cols, rows)] = np.nan


def lapped(pins: list[NeedleFit], balls: BallFits, optics: Optics) -> Bool:
    """Say over which pins the images of balls lie, shape (n,).

    Parameters
    ----------
    pins : list of NeedleFit
    balls : BallFits
    optics : Optics

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    return np.array([_laps(pin, balls, optics.sigma_px) for pin in pins], bool)


def _laps(pin: NeedleFit, balls: BallFits, sigma_px: float) -> bool:
    dx, dy = (balls.position_px - pin.position_px).T
    c, s = np.cos(pin.angles[0]), -np.sin(pin.angles[0])
    along = np.clip(dx * c + dy * s, 0.0, pin.shape.length_px)
    half_width = pin.shape.half_width_px * np.minimum(along / (pin.shape.taper * pin.shape.length_px), 1.0)
    return bool((np.hypot(dx - along * c, dy - along * s) < balls.radius_px + half_width + sigma_px).any())
