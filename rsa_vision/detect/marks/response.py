"""Film response undone: films of which the values are light through the film become films of its log odds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, look_clear
from rsa_vision.detect.balls.find import fit_at
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.balls.optics import estimate_optics
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.tiles import QUANTISATION
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Float, MarkerImages

BITS = 16  # of a film of log odds
_CLEAR = 1.1  # of full scale: the light where nothing is in its way; nearer to the end of the scale noise would grow without limit
_HIGH = 0.25  # of its background, the depth of the typical ball: of a lower one the log odds are as straight as the value
_OVER_NOISE = 10.0  # height of the typical ball in logarithms, over the noise of a pixel: of less, what is bent does not show
_ASKED = 40  # balls, of all heights, that tell which scale is theirs
_SIZES = (1.0, 1.6)  # in log odds, where one of them is in values
_SURE = 2.0  # standard deviations
_STRAIGHTER = 1.05  # times less that log odds leave of a ball's variance


def log_odds(film: NDArray[Any], bits: int, noise: NoiseModel) -> tuple[NDArray[Any], NoiseModel]:
    """Return the log odds of the light that passes a film, spread over 16 bits, and their noise; the ends of the scale stay its ends.

    Balls against black film are a hundred times as bright as that: their images are no longer the chord through a ball, bent a little.
    Where film is dark the logarithm of the light is minus its density, which goes with the logarithm of the exposure. Where it is clear, in
    the toe of its curve, density goes with a power of the exposure, and is the light that does not pass. The log odds have both ends.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int
    noise : NoiseModel
        Of ``film``.

    Returns
    -------
    log_odds : ndarray of uint16, shape (rows, cols)
    noise : NoiseModel
        To first order.
    """
    scale, top = _LogOdds(2**bits - 1), float(2**BITS - 1)
    level = np.clip(noise.level, 0.0, scale.full)
    table = np.rint(top * scale.part(np.arange(scale.full + 1.0))).astype(np.uint16)
    floor, ceiling = (float(table[int(end)]) if 0 <= end <= scale.full else end for end in (noise.floor, noise.ceiling))
    variance = noise.variance * np.square(top * scale.slope(level)) + QUANTISATION
    other = NoiseModel(top * scale.part(level), variance, noise.correlation, floor, ceiling, noise.repaired, noise.pattern)
    return np.asarray(table[np.minimum(film, scale.full)]), other


@dataclass(frozen=True, slots=True)
class _LogOdds:
    """Log odds of film values, from 0 to 1 as these go from 0 to the full scale."""

    full: int

    def _odds(self, values: Float) -> Float:
        return np.asarray(np.log1p(values) - np.log(_CLEAR * self.full - values))

    @property
    def _ends(self) -> Float:
        return self._odds(np.array([0.0, self.full]))

    def part(self, values: Float) -> Float:
        low, high = self._ends
        return np.asarray((self._odds(values) - low) / (high - low))

    def slope(self, values: Float) -> Float:
        return np.asarray((1 / (1 + values) + 1 / (_CLEAR * self.full - values)) / np.ptp(self._ends))

    def values(self, part: Float) -> Float:
        odds = np.exp(self._ends[0] + np.ptp(self._ends) * part)
        return np.asarray((_CLEAR * self.full * odds - 1) / (1 + odds))


def high_balls(looks: BallFits, noise: NoiseModel) -> BallFits:
    """Return clear balls of all heights; none where they are not so bright that log odds differ from values in more than a factor."""
    clear = looks.rows(look_clear(looks, noise) & (looks.depth > 0) & (looks.background > 0))
    high = clear.depth / clear.background
    over_noise = np.log1p(high) * clear.background / np.sqrt(noise.variance_at(clear.background))
    if len(high) < LEAST_KNOWN or np.median(high) <= _HIGH or np.median(over_noise) <= _OVER_NOISE:
        return clear.rows(slice(0))
    return clear.rows(np.argsort(high)[:: 1 + len(high) // _ASKED])


def is_straighter(
    film: NDArray[Any], noise: NoiseModel, other: NDArray[Any], other_noise: NoiseModel, balls: BallFits, optics: Optics
) -> bool:
    """Say whether the balls of a film are described better in another scale of its values.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    noise : NoiseModel
    other : ndarray of shape (rows, cols)
        The same film in the other scale.
    other_noise : NoiseModel
    balls : BallFits
        First looks at clear ones on ``film``.
    optics : Optics
        Of ``film``.

    Returns
    -------
    bool
        They leave less of their variance there.
    """
    here = fit_at(film, balls.position_px, balls.radius_px, optics, noise)
    # the brighter a ball against what is around it, the less of it shows in values
    seeds = [fit_at(other, balls.position_px, size * balls.radius_px, optics, other_noise) for size in _SIZES]
    closest = min(seeds, key=lambda fits: float(np.median(1 - fits.explained)))
    its_optics, _ = estimate_optics(other, closest, other_noise)
    there = fit_at(other, balls.position_px, closest.radius_px, its_optics, other_noise)
    less = (1 - here.explained) / np.maximum(1 - there.explained, 1e-9)
    surely = np.quantile(less, max(0.5 - _SURE / (2 * np.sqrt(len(less))), 0.0))  # as low as the median may be by chance
    return bool(np.median(less) > _STRAIGHTER and surely > 1)


def in_film_values(images: MarkerImages, bits: int) -> MarkerImages:
    """Return images measured on log odds with contrast and background as parts of the film's full scale, which no mark exceeds."""
    scale = _LogOdds(2**bits - 1)
    ends = (images.background, images.background + images.contrast)
    background, top = (scale.values(np.minimum(end, 1.0)) / scale.full for end in ends)
    return replace(images, contrast=top - background, background=background)
