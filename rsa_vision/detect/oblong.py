"""Images longer one way than the other: two balls nearly in one beam, that one ball fits in noise but for their outline.

What is the same on opposite sides of the centre does not move it, and is not asked for elsewhere; two in one leave just that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.ball_equations import invert, polynomial
from rsa_vision.detect.balls import BallFits, half_size, slopes
from rsa_vision.detect.beside import Beside
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.patches import cut
from rsa_vision.detect.profiles import Optics, ball_table
from rsa_vision.detect.whitening import whiten_rows
from rsa_vision.types import Bool, Float

_LEAST = 0.06  # of the radius, half the difference of the axes; two balls 0.4 diameters apart make more
_SURE = 14.0  # chi2 with two degrees of freedom: one image in a thousand, if noise makes that much of an outline at all
_MEDIAN = 1.386  # of that


def are_oblong(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> Bool:
    """Say which images are longer one way than the other, beyond what images of the film are and beyond noise and structure around.

    To first order: with axes ``r + q`` and ``r - q`` the image of a ball changes by ``q cos(2 (phi - phi0))`` times its derivative by the
    radius.

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
    apart, covariance = _outlines(film, balls, beside, optics, noise)
    apart = apart - np.median(apart, axis=0)  # a focal spot draws all images alike
    covariance = covariance * np.maximum(balls.chi2_ring, 1.0)[:, None, None]
    chance = np.einsum("ni,ni->n", apart, np.linalg.solve(covariance, apart[:, :, None])[:, :, 0])
    chance /= max(1.0, float(np.median(chance)) / _MEDIAN)
    return np.asarray((chance > _SURE) & (np.hypot(*apart.T) > _LEAST * balls.radius_px))


def _outlines(film: NDArray[Any], balls: BallFits, beside: Beside, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """Half the differences of the axes, ``q cos(2 phi0)`` and ``q sin(2 phi0)`` in px (n, 2), and their covariances."""
    halves = np.array([half_size(r, optics.sigma_px) for r in balls.radius_px])
    table = ball_table(round(optics.mu_px * optics.sigma_px, 3))
    out, covariance = np.zeros((len(halves), 2)), np.zeros((len(halves), 2, 2))
    for half in np.unique(halves):
        index = np.flatnonzero(halves == half)
        fits, side = balls.rows(index), 2 * int(half) + 1
        patches = cut(film, fits.position_px, int(half), noise)
        rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1).astype(np.float64)
        near = [beside(int(i), cols + c, rows + r) for i, (c, r) in zip(index, patches.corner_px, strict=True)]
        data = patches.values.reshape(len(index), -1) - np.stack([image for image, _ in near])
        valid = patches.valid.reshape(len(index), -1) & ~np.stack([doubtful for _, doubtful in near])
        dx, dy = (axis - at[:, None] for axis, at in zip((cols, rows), (fits.position_px - patches.corner_px).T, strict=True))
        value, *by = slopes(table, dx, dy, fits.radius_px, optics.sigma_px)
        square = np.maximum(dx**2 + dy**2, 1e-9)
        outline = by[2][:, None] * np.stack([(dx**2 - dy**2) / square, 2 * dx * dy / square], axis=1)
        surface = np.broadcast_to(polynomial(int(half), cols - half, rows - half).T, (len(index), 6, side**2))
        moves = fits.depth[:, None, None] * np.concatenate([np.stack(by, axis=1), outline], axis=1)
        images = np.concatenate([moves, value[:, None], surface], axis=1)
        root = np.sqrt(valid / noise.variance_at(fits.background[:, None] + fits.depth[:, None] * value))
        white = whiten_rows(images * root[:, None], side, noise)
        left = whiten_rows((data - fits.background[:, None] - fits.depth[:, None] * value) * root, side, noise)
        inverse = invert(np.matmul(white, white.swapaxes(1, 2)))
        change = np.matmul(inverse, np.matmul(white, left[:, :, None]))[:, :, 0]
        out[index], covariance[index] = change[:, 3:5], inverse[:, 3:5, 3:5]
    return out, covariance
