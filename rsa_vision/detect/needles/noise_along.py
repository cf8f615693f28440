"""The noise under needles, which no tile of a film tells: what a fit leaves of one hardly bends along it, what does is noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter, shift

from rsa_vision.detect.balls.leftover import beyond_curve, carried_to, worth_it
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.needles import NeedleFit, arm_images
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Float

_STEP_PX = 2.0  # of second differences
_BODY = 0.2, 0.85  # of the length of an arm: neither the tip nor the thick end, where its image bends
_HIGH = 0.4  # of the height of an arm's image: what is under it
_GAP_PX, _STRIP_PX = 3.0, 8.0  # from an arm to what is beside it; how wide that is
_LEAST_PIXELS = 12  # under an arm, and beside it
_NORMAL = 0.4549  # median of the square of a normal deviate


@dataclass(frozen=True, slots=True, eq=False)
class _Arm:
    """What a fit leaves under one arm.

    Attributes
    ----------
    bent, level : ndarray of shape (n,)
        Second differences along the arm, and expected film values.
    beside : float
        Mean square of second differences in the same direction beside the arm, in units of the variance.
    """

    bent: Float
    level: Float
    beside: float


def noise_under_needles(film: NDArray[Any], fits: list[NeedleFit], optics: Optics, noise: NoiseModel) -> NoiseModel:
    """Return the noise with its curve carried on to the values under needles.

    As :func:`rsa_vision.detect.balls.leftover.noise_at_marks`, of which a film without balls has none. A wrong blur or taper leaves
    stripes along an arm, and these have no second differences in that direction.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : list of NeedleFit
        First looks at pins or tees of one polarity.
    optics : Optics
        Of those looks.
    noise : NoiseModel

    Returns
    -------
    NoiseModel
        The same where too few tell, and where there is no more noise.
    """
    if not fits:
        return noise
    sign = float(np.sign(fits[0].depth))
    background, height = np.array([(f.background, f.height) for f in fits]).T
    known, farthest, tell = beyond_curve(noise, sign, background, height)
    arms = [arm for f, of in zip(fits, tell, strict=True) if of for arm in _arms(film, f, optics, known)]

    def under(trial: NoiseModel) -> float:
        return float(np.median([np.mean(a.bent**2 / trial.variance_at(a.level)) / a.beside for a in arms]))

    if arms and worth_it(under(known), 1.0, sum(len(a.bent) for a in arms)):
        known = carried_to(known, farthest, under, 1.0)
    return known.and_beyond(farthest, sign, noise)


def _arms(film: NDArray[Any], fit: NeedleFit, optics: Optics, noise: NoiseModel) -> list[_Arm]:
    half = int(np.ceil(fit.shape.length_px + fit.shape.half_width_px + _GAP_PX + _STRIP_PX))
    patches = cut(film, fit.position_px[None], half, noise)
    values = patches.values[0]
    dx, dy = (of.astype(np.float64) for of in np.meshgrid(*(np.arange(patches.size) + (patches.corner_px[0] - fit.position_px)[:, None])))
    images = fit.depths[:, None, None] * arm_images(dx.ravel(), dy.ravel(), fit.angles, fit.shape, optics, slopes=False)[0].reshape(
        -1, *values.shape
    )
    level = fit.background + images.sum(0)
    left = values - images.sum(0)
    whole = minimum_filter(patches.valid[0], 2 * int(_STEP_PX) + 1, mode="nearest")
    arms = []
    for angle, image in zip(fit.angles.tolist(), np.abs(images), strict=True):
        c, s = np.cos(angle), -np.sin(angle)
        step = _STEP_PX * np.array([s, c])
        bent = 2 * left - shift(left, step, mode="nearest") - shift(left, -step, mode="nearest")
        along, across = (dx * c + dy * s) / fit.shape.length_px, np.abs(dy * c - dx * s) - fit.shape.half_width_px - optics.sigma_px
        body = whole & (along > _BODY[0]) & (along < _BODY[1])
        on, off = body & (image > _HIGH * image.max()), body & (across > _GAP_PX) & (across < _GAP_PX + _STRIP_PX)
        if min(np.count_nonzero(on), np.count_nonzero(off)) >= _LEAST_PIXELS:
            beside = float(np.median(bent[off] ** 2 / noise.variance_at(level[off]))) / _NORMAL
            arms.append(_Arm(bent[on], level[on], max(beside, 1e-9)))
    return arms
