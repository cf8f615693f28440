"""Marks that are no higher than the waves that lossy compression makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsa_vision.detect.balls.fits import RADIUS_PX, ball_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import MarkerImages

_SEVERAL = 2.5  # times a wave: one of two steps and a half, not one and a half, with half of it from others at the place


def like_waves(images: MarkerImages, height: float, optics: Optics) -> MarkerImages:
    """Flag marks that are no higher than waves.

    Parameters
    ----------
    images : MarkerImages
    height : float
        Of a wave, as a part of the film's range; zero if there are none.
    optics : Optics
        Of the film.

    Returns
    -------
    MarkerImages
    """
    if height == 0.0 or not len(images):
        return images
    middle = np.zeros((len(images), 1))
    seen = ball_image(middle, middle, np.clip(images.radius_px, *RADIUS_PX), optics)[:, 0]
    low = images.contrast * seen < _SEVERAL * height
    return replace(images, flags=images.flags | np.where(low, MarkerFlag.UNLIKE, 0))
