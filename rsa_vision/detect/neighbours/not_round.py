"""Images that are not round: two balls nearly in one beam, that one ball fits in noise but for their outline, and dots of burnt-in text.

What is the same on opposite sides of the centre does not move it, and is not asked for elsewhere; two in one leave just that, and squares.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.cut_off import grounds_cut_off
from rsa_vision.detect.balls.find import BATCH
from rsa_vision.detect.balls.fits import BallFits, half_size, slopes
from rsa_vision.detect.balls.usual import over_kinds
from rsa_vision.detect.film.least_squares import chi2, invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.profiles import Optics, ball_table
from rsa_vision.detect.models.shown import Beside, beside_each
from rsa_vision.types import Bool, Float

_LEAST = 0.08  # of the squared radius, the difference of second moments; two balls 0.4 diameters apart make twice that
_LEAST_OF_LARGER, _SURE_OF_LARGER = 0.02, 7.0  # the same of balls larger than the others of the film: that speaks for two as well
_OF_A_KIND = 3  # balls
_LARGER, _OF_SPREAD = 0.05, 3.0  # of the logarithm of the radius; of what radii of the film differ by
_SURE = 14.0  # chi2 with two degrees of freedom: one image in a thousand, if noise makes that much of an outline at all
_BEYOND_DOUBT, _OF_USUAL = 50.0, 3.0  # the same of smaller ones; times the usual outline of the film
_AMONG_OTHERS = 3.2  # the same where most images are oblong: one in five
_MEDIAN = 1.386  # of that
# what an image leaves over what those leave that fit best; chi2 beyond the usual outline of those, for the latter
_MUCH_LEFT, _MORE_LEFT, _SURE_OF_MORE = 3.0, 1.6, 28.0
_CLEAR = 0.25  # of the usual squared depth over noise, from which an error of the model would show
# times the errors of the model that those have which have least; part of the depth: larger ones are none of a model of balls
_OF_MODEL, _MOST_OF_MODEL = 3.0, 0.03
_QUIET = 0.5  # chi2 beside balls: filters that leave less noise there than under them make outlines as well
_LEAST_KNOWN = 6  # images that tell how a focal spot draws all
# of images that are asked together: how few, the most that one's chi2 counts, and standard deviations beyond chance
_LEAST_TOGETHER, _MOST_OF_ONE, _SURE_TOGETHER = 5, 20.0, 3.0
_MUCH = 0.12  # of the squared radius: twice what a focal spot makes of the smallest balls
_CORNERS = 0.06  # of the radius, by which outlines go in and out four times: blurred squares by 0.08, what a median filter leaves by 0.05
_BENDS = np.arange(9, 14)  # of what is fitted: slopes and bends of the background
_STEP_PX = 0.1  # for derivatives


def are_not_round(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> Bool:
    """Say which images are longer one way than the other, or square, beyond what images of the film are, noise and structure around.

    To first order: with second moments that differ by ``m`` between the long axis and the short one, as two images ``d`` apart have
    ``m = d^2 / 4``, an image ``f(s)`` changes by ``m / 4 cos(2 (phi - phi0)) (f'' - f' / s)``; by ``-e cos(4 (phi - phi0)) f'``
    where its outline goes out and in by ``e`` four times.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    beside : callable
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    if len(balls.depth) == 0:
        return np.zeros(0, bool)
    outlines, covariance = _outlines_over_usual(film, balls, beside, optics, noise)
    apart, chance = outlines[:, :2], chi2(outlines[:, :2], covariance[:, :2, :2])
    length = np.hypot(*apart.T) / balls.radius_px**2
    usual = max(1.0, float(np.median(chance)) / _MEDIAN)
    told = (chance > _SURE) & (length > _LEAST)
    much = told & (length > _MUCH)
    most = np.count_nonzero(much) > len(much) / 2  # where most images are two balls there is no usual one
    told &= chance > _SURE * usual
    if len(told) >= _LEAST_KNOWN:
        told |= _larger(balls.radius_px) & (chance > _SURE_OF_LARGER * usual) & (length > _LEAST_OF_LARGER)
        odd = (chance > _BEYOND_DOUBT * usual) & (length > _OF_USUAL * np.median(length))  # where hardly any noise hides an outline
        told |= odd & (length > _LEAST_OF_LARGER)
        # where many are two balls no outline is usual, but those that fit best are single ones, or resolved
        best = np.argsort(balls.chi2_core)[: max(_LEAST_KNOWN // 2, len(told) // 4)]
        usually = np.maximum(balls.chi2_ring, 1.0) * np.median(balls.chi2_core[best])
        beyond = chance / max(1.0, float(np.median(chance[best])) / _MEDIAN)
        over = balls.chi2_core - _model_error(balls, noise)
        much_left, more_left = (over > times * usually for times in (_MUCH_LEFT, _MORE_LEFT))
        left = (much_left & (chance > _SURE)) | (more_left & (beyond > _SURE_OF_MORE))
        told |= left & (length > _LEAST_OF_LARGER) & (np.median(balls.chi2_ring) > _QUIET)
    if np.count_nonzero(hidden := balls.hidden != 0) >= _OF_A_KIND:  # backgrounds that are not seen bend as an outline would have them
        left = balls.chi2_core > _MUCH_LEFT * np.median(balls.chi2_core[hidden])
        told = np.where(hidden, (left | (length > _LEAST)) & (chance > _BEYOND_DOUBT * usual), told)
    if most or len(told) < _LEAST_KNOWN:
        told |= much
    if most:
        told |= (chance > _AMONG_OTHERS) & (length > _MUCH)
    square = chi2(outlines[:, 2:], covariance[:, 2:, 2:]) > _BEYOND_DOUBT
    return np.asarray(told | (square & (np.hypot(*outlines[:, 2:].T) > _CORNERS * balls.radius_px)))


def are_long(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> bool:
    """Say whether images of which noise hides what each is like are longer one way than the other as a whole: short strokes pass for balls.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    beside : callable
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    bool
        The mean of their chi2, each of two degrees of freedom, is beyond chance.
    """
    if len(balls.depth) < _LEAST_TOGETHER:
        return False
    outlines, covariance = _outlines_over_usual(film, balls, beside, optics, noise)
    each = np.minimum(chi2(outlines[:, :2], covariance[:, :2, :2]), _MOST_OF_ONE)
    return bool(each.mean() > 2 + _SURE_TOGETHER * 2 / np.sqrt(len(each)))


def _outlines_over_usual(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """Outlines as of :func:`_outlines`, over what a focal spot makes of all; what lies around balls adds to their covariances."""
    outlines, covariance = _outlines(film, balls, beside, optics, noise)
    if len(outlines) >= _LEAST_KNOWN:
        outlines[:, :2] -= np.median(outlines[:, :2], axis=0)
    return outlines, covariance * np.maximum(balls.chi2_ring, 1.0)[:, None, None]


def _model_error(balls: BallFits, noise: NoiseModel) -> Float:
    """What beams and blurs that the model does not know may leave under balls, in units of the noise, as it goes with their depth.

    The quarter of the clear ones that leaves least of its depth tells it: those are single ones, or resolved.
    """
    clear = balls.depth**2 / noise.variance_at(balls.background)
    share = np.maximum(balls.chi2_core - 1, 0.0) / clear
    usual = float(np.quantile(share[clear > _CLEAR * np.median(clear)], 0.25))
    return np.asarray(min(_OF_MODEL**2 * usual, _MOST_OF_MODEL**2) * clear)


def _larger(radius_px: Float) -> Bool:
    """Say which balls are larger than those of a kind, and not of a larger one, by more than radii of the kind differ by."""
    over, spread = over_kinds(radius_px, radius_px, _OF_A_KIND)
    return np.asarray(over > np.maximum(_LARGER, _OF_SPREAD * spread))


def _outlines(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """``m cos(2 phi0)`` and ``m sin(2 phi0)``, px^2, and ``e cos(4 phi0)`` and ``e sin(4 phi0)``, px (n, 4), and their covariances."""
    halves = np.array([half_size(r, optics.sigma_px) for r in balls.radius_px])
    table = ball_table(optics)
    out, covariance = np.zeros((len(halves), 4)), np.zeros((len(halves), 4, 4))
    of_one_size = [np.flatnonzero(halves == half) for half in np.unique(halves)]
    for index in (same[k : k + BATCH] for same in of_one_size for k in range(0, len(same), BATCH)):
        fits, half = balls.rows(index), int(halves[index[0]])
        patches, side = cut(film, fits.position_px, half, noise), 2 * half + 1
        rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1).astype(np.float64)
        near, doubtful = beside_each(patches, index, beside)
        data, valid = (patches.values - near).reshape(len(index), -1), (patches.valid & ~doubtful).reshape(len(index), -1)
        dx, dy = (axis - at[:, None] for axis, at in zip((cols, rows), (fits.position_px - patches.corner_px).T, strict=True))
        value, *by = slopes(table, dx, dy, fits.radius_px, optics.sigma_px)
        square = np.maximum(dx**2 + dy**2, 1e-9)
        reach = np.sqrt(square)
        longer = 1 + _STEP_PX / reach
        farther = slopes(table, dx * longer, dy * longer, fits.radius_px, optics.sigma_px)[1:3]
        falls, then = ((of[0] * dx + of[1] * dy) / reach for of in (by, farther))
        bend = (then - falls) / _STEP_PX - falls / reach
        cos, sin = (dx**2 - dy**2) / square, 2 * dx * dy / square  # of twice the angle
        twofold = 0.25 * bend[:, None] * np.stack([cos, sin], axis=1)
        fourfold = falls[:, None] * np.stack([cos**2 - sin**2, 2 * cos * sin], axis=1)
        surface = np.broadcast_to(polynomial(half, cols - half, rows - half).T, (len(index), 6, side**2))
        moves = fits.depth[:, None, None] * np.concatenate([np.stack(by, axis=1), twofold, fourfold], axis=1)
        images = np.concatenate([moves, value[:, None], surface], axis=1)
        root = np.sqrt(valid / noise.variance_at(fits.background[:, None] + fits.depth[:, None] * value))
        white = whiten_rows(images * root[:, None], side, noise)
        left = whiten_rows((data - fits.background[:, None] - fits.depth[:, None] * value) * root, side, noise)
        normal = np.matmul(white, white.swapaxes(1, 2))
        outside = reach > (fits.radius_px + optics.sigma_px)[:, None]
        normal[:, _BENDS, _BENDS] += grounds_cut_off(patches.values.reshape(len(index), -1), valid, outside, noise)[0]
        inverse = invert(normal)
        change = np.matmul(inverse, np.matmul(white, left[:, :, None]))[:, :, 0]
        out[index], covariance[index] = change[:, 3:7], inverse[:, 3:7, 3:7]
    return out, covariance
