"""The noise under balls by the values that film has there, from what all leave: between toe and shoulder it is highest at their rims."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import BallFits, mirrored
from rsa_vision.detect.balls.focal_spot import shapes_of
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.whitening import variance_left, whiten_rows
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Beside
from rsa_vision.types import Float

_LEAST = 8  # balls that tell something
_QUIET = 1.25  # less variance than this around a ball, in units of the noise, is noise
_PARTS, _PAIRS = (5, 24), (100, 250)  # of the values under balls, and pairs of pixels in each of so few and of more
_ALONE = 5  # parts; of more, neighbours are looked at together, lest one is high by chance
_UNDER = 0.1  # of full opacity, from which a pixel is under a ball
_OUTLIER = 25.0  # times the median of the squares, of which noise makes none
_MORE = 1.5  # times the variance beside them, which is worth a curve
_NEXT_PX = 2.0  # from the centre, within which a pixel and its opposite share correlated noise


def noise_by_value(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> NoiseModel | None:
    """Return the noise with the values under balls as these tell it.

    Of what fits leave only the odd part counts, which errors of the model do not have, less what the fit of a centre takes up.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
        Clear ones, of one polarity.
    beside : callable
        ``beside(i, cols, rows)``: images of the neighbours of ball ``i`` at these pixels, and where they are not to be trusted.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    NoiseModel or None
        None where too few tell, and where there is hardly more noise than beside them.
    """
    quiet = np.flatnonzero(balls.chi2_ring < _QUIET)
    if len(quiet) < _LEAST:
        return None
    told = [_squares(film, balls, i, beside, optics, noise) for i in quiet.tolist()]
    value, square = (np.concatenate(of) for of in zip(*told, strict=True))
    parts = max(min(most, len(value) // (2 * pairs)) for most, pairs in zip(_PARTS, _PAIRS, strict=True))
    if parts < 2:
        return None
    order = np.array_split(np.argsort(value), parts)
    level = np.array([value[these].mean() for these in order])
    left = [of[of <= _OUTLIER * np.median(of)].mean() for of in (square[these] for these in order)]
    variance = noise.variance_at(level) * left / variance_left(noise)
    beside_them = float(noise.variance_at(balls.background).min())
    together = -(-parts // _ALONE)
    if np.convolve(variance, np.full(together, 1 / together), "valid").max() < _MORE * beside_them:
        return None
    # middles that are quieter would decide where a ball is, by what its model is not exactly
    return _with_levels(noise, level, np.maximum(variance, beside_them), balls)


def _with_levels(noise: NoiseModel, level: Float, variance: Float, balls: BallFits) -> NoiseModel:
    """Put levels in the place of all on the marks' side of the backgrounds."""
    sign = np.sign(balls.depth[0])
    kept = sign * (noise.level - sign * (sign * balls.background).max()) <= 0
    kept &= sign * (level[0 if sign > 0 else -1] - noise.level) > 0
    levels, variances = np.append(noise.level[kept], level), np.append(noise.variance[kept], variance)
    order = np.argsort(levels)
    return replace(noise, level=levels[order], variance=variances[order])


def _squares(film: NDArray[Any], balls: BallFits, i: int, beside: Beside, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """Film values expected under a ball, and squares of noise, made white, over what is taken for it; where opposites are seen too."""
    half = int(np.ceil(balls.radius_px[i] + 3 * optics.sigma_px)) + 1
    patches = cut(film, balls.position_px[[i]], half, noise)
    cols, rows = patches.places(0)
    images, doubtful = beside(i, cols, rows)
    valid = (patches.valid[0] & ~doubtful).reshape(1, -1)
    dx, dy = (of.reshape(1, -1) - at for of, at in zip((cols, rows), balls.position_px[i], strict=True))
    opacity, by_x, by_y, _ = shapes_of(optics, None, dx, dy, balls.radius_px[[i]])
    left = (patches.values[0] - images).reshape(1, -1) - balls.depth[i] * opacity
    expected = balls.background[i] + balls.depth[i] * opacity
    opposite = mirrored(balls.position_px[[i]] - patches.corner_px, patches.size)
    pairs = valid & np.take_along_axis(valid, opposite, 1)
    odd = (left - np.take_along_axis(left, opposite, 1)) / np.sqrt(2)
    root = pairs / np.sqrt(noise.variance_at(expected))
    # a slope shows more or less under a ball than beside it
    taken = [dx, dy, dx * opacity, dy * opacity, by_x, by_y]
    white = whiten_rows(np.concatenate([odd, *taken]) * root, patches.size, noise)
    basis, _ = np.linalg.qr(white[1:].T)
    rest = white[0] - basis @ (basis.T @ white[0])
    under = pairs[0] & (opacity[0] > _UNDER)
    if not noise.is_white:
        under &= np.hypot(dx, dy)[0] > _NEXT_PX
    # of a pair either half counts; what a fit takes up of one it takes up of the other
    free = np.maximum(1 - 2 * np.square(basis).sum(axis=1), 0.2)
    return expected[0, under], (np.square(rest) / free)[under]
