"""What film shows of the light that marks leave: how much of it is gone, bent by the curve of the film.

Most films and plates record the logarithm of the exposure, or a power of it: with the logarithm ``k`` of the contrast between all the light
and what is left under full opacity, the logarithm shows ``-log(1 - (1 - exp(-k)) o) / k`` of the opacity ``o``.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Float

_STRAIGHT: Final = 1e-4  # below it nothing of the bend is left but its derivative


def film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """What film shows of blurred opacities, by the two coefficients of :attr:`Optics.curve`."""
    shown = _logged(opacity, curve[0])
    return np.asarray(shown + curve[1] * shown * (1 - shown) * (1 - 2 * shown))


def by_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> list[Float]:
    """Derivatives of what film shows by the two coefficients of its curve, whatever is blurred after it."""
    shown, within = _logged(opacity, curve[0]), np.clip(opacity, 0.0, 1.0)
    inside = shown * (1 - shown)
    if abs(curve[0]) < _STRAIGHT:
        bow = within * (1 - within)
    else:
        bow = (math.exp(2 * curve[0]) * within / (1 + math.expm1(2 * curve[0]) * within) - np.clip(shown, 0.0, 1.0)) / curve[0]
    return [bow * (1 + curve[1] * (1 - 6 * inside)), inside * (1 - 2 * shown)]


def slope_of_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """Derivative of what film shows by the blurred opacity."""
    shown, within = _logged(opacity, curve[0]), np.clip(opacity, 0.0, 1.0)
    return np.asarray(_slope(within, curve[0]) * (1 + curve[1] * (1 - 6 * shown * (1 - shown))))


def _slope(opacity: NDArray[Any] | float, bend: float) -> Float:
    if abs(bend) < _STRAIGHT:
        return 1 + bend * (1 - 2 * np.asarray(opacity))
    factor = math.expm1(2 * bend)
    return np.asarray(factor / (2 * bend) / (1 + factor * np.asarray(opacity)))


def _logged(opacity: NDArray[Any], bend: float) -> Float:
    """Logarithm of the light, ``bend`` being half the contrast with its sign; overshoots, which may have none, go on straight."""
    within = np.asarray(np.clip(opacity, 0.0, 1.0), np.float64)
    beyond = opacity - within
    straight = abs(bend) < _STRAIGHT
    shown = within * (1 + bend * (1 - within)) if straight else np.log1p(math.expm1(2 * bend) * within) / (2 * bend)
    return np.asarray(shown + beyond * np.where(beyond < 0, _slope(0.0, bend), _slope(1.0, bend)))
