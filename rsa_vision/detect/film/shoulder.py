"""What a film hides where its curve is nearly flat, as in black air around a limb: the light that there is changes, its values do not.

Under a mark less light falls on it, and the same change shows in full. It pulls at the centre where no value beside it tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.tiles import QUANTISATION, medians
from rsa_vision.types import Float

_MOST_LOOKED_AT = 1500**2  # pixels that tell between which values a film's curve runs
_LEAST = 0.5  # values from an end of the curve
_BLOCK = 32  # pixels in a row that show the light together
_SEEN = 0.1  # of the steepest part of the curve, from which it shows
_NO_NOISE = 1.5 * QUANTISATION  # variance of noise that rounding alone may be
_NONE = 1e-6  # what is as good as none
_NEAR, _APART, _BY = 1.0, 0.5, 0.1  # logarithms of the light, near the end and between balls; of radii, by which they are smaller
_LEAST_TELLING, _SURE = 5, 5.0  # balls; standard deviations: sizes may go with places by chance
_ROUNDED = 1 / (np.pi * np.sqrt(2))  # root mean square of what rounding does to a mean, without noise that breaks it up


@dataclass(frozen=True, slots=True)
class Curve:
    """A film's curve, taken for a logistic one.

    Attributes
    ----------
    low, high : float
        Its ends, in film values.
    shading : float
        Root mean square of the slope of the logarithm of the light, where the film shows it, 1 / px.
    even : tuple of two floats
        The least and the largest value that it has over a block of pixels, which noise does not move.
    told : bool
        Marks tell that it is one: they look smaller towards its end.
    """

    low: float
    high: float
    shading: float
    even: tuple[float, float] = (-np.inf, np.inf)
    told: bool = False

    def _between(self, values: Float) -> Float:
        return np.clip(values, self.low + _LEAST, self.high)

    def slope(self, values: Float) -> Float:
        """Return by how much values change with the logarithm of the light, but for the film's gradient."""
        inside = self._between(values)
        return np.asarray((inside - self.low) * (self.high + _LEAST - inside) / (self.high + _LEAST - self.low))

    def logarithm(self, values: Float) -> Float:
        """Return the logarithm of the light, but for the film's gradient and a constant."""
        inside = self._between(values)
        return np.asarray(np.log((inside - self.low) / (self.high + _LEAST - inside)))

    def value(self, logarithm: Float) -> Float:
        """Return the values that this light makes."""
        return np.asarray(self.low + (self.high + _LEAST - self.low) * expit(logarithm))


def curve_of(film: NDArray[Any]) -> Curve:
    """Return between which values the curve of a film runs, those that it has, and how the light changes along its rows.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)

    Returns
    -------
    Curve
    """
    sample = film[:: max(1, film.size // _MOST_LOOKED_AT)]
    curve = Curve(float(sample.min()), float(sample.max()), 0.0)
    rows, count = sample[::_BLOCK], sample.shape[1] // _BLOCK
    middle = medians(rows[:, : count * _BLOCK].reshape(len(rows), count, _BLOCK))  # marks are narrower than half of that
    slope, climbs = np.diff(curve.logarithm(middle)) / _BLOCK, curve.slope(middle)
    seen = np.minimum(climbs[:, 1:], climbs[:, :-1]) > _SEEN * curve.slope(np.array((curve.low + curve.high) / 2))
    shading = float(np.sqrt(np.square(slope[seen]).mean())) if seen.any() else 0.0
    return replace(curve, shading=shading, even=(float(middle.min(initial=np.inf)), float(middle.max(initial=-np.inf))))


def shown(values: Float, background: Float, change: Float, curve: Curve, noise: NoiseModel) -> Float:
    """Return by how much more than the background the values under a mark change with the light.

    The characteristic curve of film, density against the logarithm of the exposure (Hurter and Driffield, 1890), is taken for a logistic
    one between its ends. A film of which the largest values are no end of its curve, as one that is linear in exposure, looks the same. But
    noise goes through the curve as well: the ratio of its standard deviations is the most that is believed of a curve, and on a linear film
    there is less noise under a mark than beside it. Unless marks tell: noise of a scanner does not go through the curve of its film.

    Parameters
    ----------
    values : ndarray of shape (n, pixels)
        That are expected where the background is the same all over.
    background : ndarray of shape (n,)
    change : ndarray of shape (n, pixels)
        Of the background.
    curve : Curve
    noise : NoiseModel

    Returns
    -------
    ndarray of shape (n, pixels)
        0 where the curve is not steeper under the mark.
    """
    level = background[:, None]
    light = curve.logarithm(values) + curve.logarithm(level + change) - curve.logarithm(level)
    logistic = np.maximum(curve.slope(values) / curve.slope(level) - 1, _NONE)
    if curve.told:
        return np.asarray(np.where(logistic > _NONE, curve.value(light) - values - change, 0.0))
    there, here = (noise.variance_at(at) - _NO_NOISE for at in (values, level))
    most = np.sqrt(np.maximum(there, 0.0) / np.maximum(here, _NONE)) - 1
    part = np.where(logistic > _NONE, np.clip(most / logistic, 0.0, 1.0), 0.0)
    return np.asarray(part * (curve.value(light) - values - change))


def told_by(background: Float, depth: Float, radius_px: Float, curve: Curve) -> Curve:
    """Return the curve as balls tell it: they look the smaller the nearer the film beside them is to its end, which hides their rims.

    Then it is one, and this end no farther than the film is over a block of pixels; the largest value of all is one of noise.

    Parameters
    ----------
    background, depth, radius_px : ndarray of shape (n,)
        Balls of any sizes.
    curve : Curve

    Returns
    -------
    Curve
        The same where they do not.
    """
    light = curve.logarithm(background)
    near = np.maximum(np.where(depth < 0, light, -light), 0.0)
    if np.count_nonzero(near > _NEAR) < _LEAST_TELLING:
        return curve
    size, near = np.log(radius_px) - np.log(radius_px).mean(), near - near.mean()
    spread = float(near @ near)
    if not spread > _APART**2 * len(near):  # on about one value: what noise does to it, it does to the radius of a fit as well
        return curve
    slope = float(near @ size) / spread
    left = float(np.square(size - slope * near).sum()) / (len(size) - 2)
    if slope >= -_SURE * np.sqrt(left / spread) or -slope * np.ptp(near) < _BY:
        return curve
    if np.median(depth) < 0:
        return replace(curve, told=True, high=max(curve.even[1], float(background.max())))
    return replace(curve, told=True, low=min(curve.even[0], float(background.min())))


def unseen_slope(background: Float, half: int, curve: Curve, noise: NoiseModel) -> Float:
    """Return by how much the film at balls may rise in any direction without a value that tells, in values per pixel, shape (n,).

    As steep as the light changes elsewhere, but what windows of ``2 half + 1`` pixels would show in spite of rounding.
    """
    expected, told = curve.shading * curve.slope(background), 2 * rounding(background, noise) / half  # a step in the middle leans so
    return np.asarray(expected * told / np.maximum(np.hypot(expected, told), _NONE))


def rounding(background: Float, noise: NoiseModel) -> Float:
    """Return the root mean square of what rounding does to means of values, shape (n,).

    The first harmonic of the sawtooth, which noise damps (Widrow and Kollar, Quantization Noise, 2008): of what is left of slow changes
    in film that noise hardly moves from one value to the next.
    """
    moved = np.maximum(noise.variance_at(background) - QUANTISATION, 0.0)
    return np.asarray(_ROUNDED * np.exp(-2 * np.pi**2 * moved))
