"""What film shows of the light that marks leave: how much of it is gone, bent by the curve of the film.

Density and transmitted light shift the log odds of the opacity, and skew them a little. Where film or plate records the logarithm of the
light, and nothing scatters into the shadow, all of that under thick metal comes from the steep end of the logarithm: no such shift follows
that, so that a positive skewness leads to the logarithm itself.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Float

_STRAIGHT: Final = 0.02  # bends below which logarithms and shifts differ by hardly more than a skewness
_OF_LOG: Final = 1 / 6  # of the square of its bend is the skewness of a logarithm, to the first order


def skewness_of_log(bend: float) -> float:
    """Return the skewness that makes a logarithm of a curve with this bend."""
    return _OF_LOG * bend**2


def curve_of_bend(bend: float) -> tuple[float, float]:
    """Return the curve of one number: a logarithm where it is negative, a shift of the log odds where it is not."""
    return bend, skewness_of_log(bend) if bend < 0 else 0.0


def film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """What film shows of blurred opacities, by the two coefficients of :attr:`Optics.curve`."""
    shifted = _shifted(opacity, curve[0])
    return np.asarray(shifted + curve[1] * _skew(opacity, shifted, curve)) if curve[1] else shifted


def by_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> list[Float]:
    """Derivatives of what film shows by the two coefficients of its curve, whatever is blurred after it."""
    bend, skewness = curve
    shifted = _shifted(opacity, bend)
    bow = shifted * (1 - shifted)
    if not _is_logged(curve):
        return [bow * (1 + skewness * (1 - 6 * bow)), _skew(opacity, shifted, curve)]
    within, factor = np.clip(opacity, 0.0, 1.0), math.expm1(2 * bend)
    by_bend = ((factor + 1) * within / (1 + factor * within) - np.log1p(factor * within) / (2 * bend)) / bend
    skew = _skew(opacity, shifted, curve)
    return [bow + skewness * ((by_bend - bow) / skewness_of_log(bend) - 2 * skew / bend), skew]


def slope_of_film_curve(opacity: NDArray[Any], curve: tuple[float, float]) -> Float:
    """Derivative of what film shows by the blurred opacity."""
    bend, skewness = curve
    shifted, within = _shifted(opacity, bend), np.clip(opacity, 0.0, 1.0)
    slope = _slope_of_shift(within, bend)
    if not _is_logged(curve):
        return np.asarray(slope * (1 + skewness * (1 - 6 * shifted * (1 - shifted))))
    return np.asarray(slope + skewness * _slope_of_log_skew(within, bend))


def _is_logged(curve: tuple[float, float]) -> bool:
    """Say whether the skew leads to the logarithm: of a curve the other way about that would be one of the shadow."""
    return curve[0] < -_STRAIGHT and curve[1] > 0


def _shifted(opacity: NDArray[Any], by: float) -> Float:
    """Opacities whose log odds are by so much more; those of overshoots, which have none, go on straight."""
    within = np.asarray(np.clip(opacity, 0.0, 1.0), np.float64)
    factor = math.exp(by)
    shifted = within / (within + (1 - within) / factor)
    beyond = opacity - within
    return np.asarray(shifted + beyond * np.where(beyond < 0, factor, 1 / factor)) if beyond.any() else shifted


def _skew(opacity: NDArray[Any], shifted: Float, curve: tuple[float, float]) -> Float:
    """What a skewness of one adds to the shift: zero at either end."""
    bend = curve[0]
    if not _is_logged(curve):
        return np.asarray(shifted * (1 - shifted) * (1 - 2 * shifted))
    within = np.asarray(np.clip(opacity, 0.0, 1.0), np.float64)
    logged = np.log1p(math.expm1(2 * bend) * within) / (2 * bend)
    beyond = opacity - within
    if not beyond.any():
        return np.asarray((logged - shifted) / skewness_of_log(bend))
    return np.asarray((logged - _shifted(within, bend)) / skewness_of_log(bend) + beyond * _slope_of_log_skew(within, bend))


def _slope_of_shift(within: Float, bend: float) -> Float:
    return np.asarray(math.exp(bend) / (1 + math.expm1(bend) * within) ** 2)


def _slope_of_log_skew(within: Float, bend: float) -> Float:
    factor = math.expm1(2 * bend)
    return np.asarray((factor / (2 * bend) / (1 + factor * within) - _slope_of_shift(within, bend)) / skewness_of_log(bend))
