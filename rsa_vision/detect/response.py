"""Film response undone: films of which the values are light through the film become films of logarithms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits
from rsa_vision.detect.decide import LEAST_KNOWN, look_clear
from rsa_vision.detect.find import fit_at
from rsa_vision.detect.noise import QUANTISATION, NoiseModel
from rsa_vision.detect.optics import estimate_optics
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import MarkerImages

BITS = 16  # of a film of logarithms
_HIGH = 0.25  # of its background, the depth of the typical ball: of a lower one the logarithm is as straight as the value
_NOISE = 0.15  # of the background: of larger noise the logarithm is no longer even about its middle
_STRAIGHTER = 1.1  # times less that the logarithms leave of a ball's variance


def logarithms(film: NDArray[Any], bits: int, noise: NoiseModel) -> tuple[NDArray[Any], NoiseModel]:
    """Return the logarithms of film values, spread over 16 bits, and their noise; the ends of the scale stay its ends.

    Light through a film is a power of ten of its density, and balls against black film are a hundred times as bright as that: their images
    are no longer the chord through a ball bent a little. In density, which film records nearly as the logarithm of the exposure, they are.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int
    noise : NoiseModel
        Of ``film``.

    Returns
    -------
    logarithms : ndarray of uint16, shape (rows, cols)
    noise : NoiseModel
        To first order.
    """
    full = 2**bits - 1
    unit = (2**BITS - 1) / np.log1p(full)
    table = np.rint(unit * np.log1p(np.arange(full + 1))).astype(np.uint16)
    level, floor, ceiling = (unit * np.log1p(np.maximum(value, 0.0)) for value in (noise.level, noise.floor, noise.ceiling))
    variance = noise.variance * np.square(unit / (1 + noise.level)) + QUANTISATION
    return table[np.minimum(film, full)], NoiseModel(
        level, variance, noise.correlation, floor if noise.floor >= 0 else noise.floor, ceiling
    )


def scale_matters(looks: BallFits, noise: NoiseModel) -> bool:
    """Say whether clear balls are so much brighter than what is around them that logarithms differ from values in more than a factor."""
    clear = looks.rows(look_clear(looks, noise) & (looks.depth > 0) & (looks.background > 0))
    if len(clear.depth) < LEAST_KNOWN:
        return False
    high, noisy = (np.median(part / clear.background) for part in (clear.depth, np.sqrt(noise.variance_at(clear.background))))
    return bool(high > _HIGH and noisy < _NOISE)


def is_straighter(
    film: NDArray[Any], noise: NoiseModel, other: NDArray[Any], other_noise: NoiseModel, looks: BallFits, optics: Optics
) -> bool:
    """Say whether the balls of a film are described better in another scale of its values.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    noise : NoiseModel
    other : ndarray of shape (rows, cols)
        The same film in the other scale.
    other_noise : NoiseModel
    looks : BallFits
        First looks at ``film``.
    optics : Optics
        Of ``film``.

    Returns
    -------
    bool
        Clear balls leave less of their variance there.
    """
    clear = looks.rows(look_clear(looks, noise))
    seeds = fit_at(other, clear.position_px, clear.radius_px, optics, other_noise)
    here = fit_at(film, clear.position_px, clear.radius_px, optics, noise)
    there = fit_at(other, clear.position_px, clear.radius_px, estimate_optics(other, seeds, other_noise)[0], other_noise)
    return bool(np.median((1 - here.explained) / np.maximum(1 - there.explained, 1e-9)) > _STRAIGHTER)


def in_film_values(images: MarkerImages, bits: int) -> MarkerImages:
    """Return images measured on logarithms with contrast and background as parts of the film's full scale, which no mark exceeds."""
    full = 2**bits - 1
    background, top = (
        np.expm1(np.log1p(full) * np.minimum(part, 1.0)) / full for part in (images.background, images.background + images.contrast)
    )
    return replace(images, contrast=top - background, background=background)
