"""What film shows of the light that marks leave: how much of it is gone, bent by the curve of the film."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Float


def film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """What film shows of blurred opacities, by the two coefficients of :attr:`Optics.curve`."""
    shifted = _shifted(opacity, curve[0])
    return np.asarray(shifted + curve[1] * shifted * (1 - shifted) * (1 - 2 * shifted))


def by_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> list[Float]:
    """Derivatives of what film shows by the two coefficients of its curve, whatever is blurred after it."""
    shifted = _shifted(opacity, curve[0])
    bow = shifted * (1 - shifted)
    return [bow * (1 + curve[1] * (1 - 6 * bow)), bow * (1 - 2 * shifted)]


def slope_of_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """Derivative of what film shows by the blurred opacity."""
    shifted, within = _shifted(opacity, curve[0]), np.clip(opacity, 0.0, 1.0)
    factor = math.exp(curve[0])
    return np.asarray(factor / (1 + (factor - 1) * within) ** 2 * (1 + curve[1] * (1 - 6 * shifted * (1 - shifted))))


def _shifted(opacity: NDArray[Any], by: float) -> Float:
    """Opacities whose log odds are by so much more; those of overshoots, which have none, go on straight."""
    within = np.asarray(np.clip(opacity, 0.0, 1.0), np.float64)
    beyond = opacity - within
    factor = math.exp(by)
    return np.asarray(within / (within + (1 - within) / factor) + beyond * np.where(beyond < 0, factor, 1 / factor))
