"""One batch of windows around balls fitted with random effects: surfaces that bend as far as the film does beside the balls.

Least squares with random effects (Henderson, Biometrics 31, 1975), generalised where neighbouring pixels share their noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.cut_off import grounds_cut_off
from rsa_vision.detect.balls.fits import RADIUS_PX, BallFits
from rsa_vision.detect.balls.focal_spot import Spot, shapes_of
from rsa_vision.detect.balls.surroundings import Modes
from rsa_vision.detect.balls.usual import Proportion, Size
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float

_NONE = 1e-3  # of the noise: what is not there
_STEPS = 4  # from where the fit on a quadratic background came to rest
_AFRESH, _FAR_PX = (0, 1, 3), 0.1  # those with new derivatives, besides those after steps so far
_MAX_STEP_PX = 0.7
_FIXED = 1e6  # inverse variance of a radius that is not fitted
_OUTLIER = 3.0  # standard deviations from which a ball has a size of its own
_BENDS = slice(5, 10)  # of what is fitted of a ball: slopes and bends of its background
_PER_BALL = 10  # centre, radius, depth, and the six coefficients of a quadratic surface
_SHARES = np.exp(np.linspace(-3.0, 6.0, 28))  # of structure in a window, of that at the places around it


@dataclass(frozen=True, slots=True)
class Common:
    """What all balls of a film share."""

    optics: Optics
    noise: NoiseModel
    under: float
    size: Size
    differ: float  # of structure from window to window: standard deviation of its logarithm
    spot: Spot | None = None  # that draws them, if it is no Gaussian
    more: float = 0.0  # variance of noise that a screen has spread, which is not stated, in units of that under balls
    rough: float = 1.0  # variance that specks have by noise under balls, in units of that by noise as stated

    @property
    def rim_px(self) -> float:
        """How far beyond their radius balls are seen."""
        return self.optics.sigma_px + (self.spot.reach_px if self.spot else 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of one size around balls."""

    fits: BallFits
    half: int
    corner_px: Float  # (n, 2)
    data: Float  # (n, pixels), less neighbours and the background at the centre
    added: Float  # (n, pixels), those
    valid: Bool  # (n, pixels)
    covered: Float  # (n,), part of the ball on which something else lies
    proportion: Proportion


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the fits of some windows came to rest, linear there."""

    local_px: Float  # (n, 2), centres in the windows
    radius_px: Float
    estimator: Float  # (n, 2, pixels), what makes centres of values
    plain: Float  # (n, 2, pixels), the same by weights alone
    apart: Float  # (n, 2), what that makes of the centres, from here
    shade: Float  # (n, 1, pixels), what the ball leaves of structure in the background
    weight: Float  # (n, pixels)
    inverse: Float  # (n, 10 + k, 10 + k), of the normal matrices
    held: Float  # (n,), how strongly radii are
    residual: Float  # (n, pixels)
    back: Float  # (n, pixels), background over its value at the centre
    ground: Float  # (n, pixels), that times the ball's image
    structure: Float  # (n, degrees), of the windows themselves
    images: Float  # (n, 10 + k, pixels), what was added up to them
    white: Float  # (n, 10 + k, pixels), those in units of noise made white


def solve(windows: Windows, known: Modes, structure: Float, common: Common) -> Solution:
    """Fit the balls of some windows.

    Parameters
    ----------
    windows : Windows
        Of one size.
    known : Modes
        The surfaces of that size.
    structure : ndarray of shape (n, degrees)
        Variances of their coefficients at the places around each ball, in units of what noise makes of them.
    common : Common

    Returns
    -------
    Solution
    """
    fits, half, noise, sigma_px = windows.fits, windows.half, common.noise, common.optics.sigma_px
    rows, cols = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].reshape(2, -1).astype(np.float64)
    surface = np.concatenate([polynomial(half, cols - half, rows - half), known.surface], axis=1).T
    local, radius, depth = fits.position_px - windows.corner_px, fits.radius_px, fits.depth
    theta, side = np.zeros((len(depth), len(surface))), 2 * half + 1
    target, held = hold(fits, common)
    precision = np.zeros((len(depth), 4 + len(surface)))
    precision[:, 2], precision[:, _PER_BALL:] = held, _precision(known, structure, fits, noise)
    beside = np.hypot(cols - local[:, :1], rows - local[:, 1:]) > (radius + common.rim_px)[:, None]
    precision[:, _BENDS] = grounds_cut_off(windows.data + windows.added, windows.valid, beside, noise)[0]
    each, far = np.arange(precision.shape[1]), True
    for step in range(_STEPS):
        shapes = shapes_of(common.optics, common.spot, cols - local[:, :1], rows - local[:, 1:], radius)
        value, *by = (shape.astype(np.float64) for shape in shapes)
        ball = depth[:, None] * value
        left = windows.data - ball
        if step in _AFRESH or far:
            # a mark takes away its part of what is there: on linear films more where there is more
            shade = 1 + windows.proportion.slope[:, None, None] * value[:, None]
            curves = surface * shade
            curves[:, 0] = surface[0]
            moves = [-depth[:, None] * by[0], -depth[:, None] * by[1], depth[:, None] * by[2], value]
            images = np.concatenate([np.stack(moves, axis=1), curves], axis=1)
            weight = windows.valid / noise.variance_at(ball + np.matmul(theta[:, None], curves)[:, 0] + windows.added)
            root = np.sqrt(weight)[:, None]
            # filtered in single precision, added up in double
            seen = whiten_rows((images * root).astype(np.float32), side, noise).astype(np.float64)
            products = np.matmul(seen, seen.swapaxes(1, 2))
        white = whiten_rows(left * root[:, 0], side, noise)
        normal, right = products.copy(), np.matmul(seen, white[:, :, None])[:, :, 0]
        if step == 1:  # once the background is known roughly
            own = _own_share(normal, right, precision[:, _PER_BALL:], common.differ)
            structure = structure * own[:, None]
            precision[:, _PER_BALL:] = _precision(known, structure, fits, noise)
        normal[:, each, each] += precision
        right[:, 2] += held * (target - radius)
        inverse = invert(normal)
        change = np.matmul(inverse, right[:, :, None])[:, :, 0]
        scale = np.minimum(1.0, _MAX_STEP_PX / np.maximum(np.abs(change[:, :3]).max(axis=1), 1e-12))
        local, before = local + scale[:, None] * change[:, :2], radius
        radius = np.clip(radius + scale * change[:, 2], *RADIUS_PX)
        far = bool((np.abs(change[:, :3]) > _FAR_PX).any())
        depth, theta = depth + scale * change[:, 3], change[:, 4:]
        residual = left - np.matmul(change[:, None], images)[:, 0]
    estimator = whiten_rows(np.matmul(inverse[:, :2], seen), side, noise) * root
    plain, apart = estimator, np.zeros((len(depth), 2))
    if not noise.is_white:  # by weights alone, the surfaces held in the same proportion
        precision[:, _PER_BALL:] *= known.noise
        precision[:, 2] *= noise.gain(np.hypot(sigma_px, 0.5 * fits.radius_px))
        weighted = images * root
        normal = np.matmul(weighted, weighted.swapaxes(1, 2))
        normal[:, each, each] += precision
        right = np.matmul(weighted, (left * root[:, 0])[:, :, None])[:, :, 0]
        right[:, 2] += precision[:, 2] * (target - before)
        by_weights = invert(normal)[:, :2]
        plain = np.matmul(by_weights, weighted) * root
        apart = np.matmul(by_weights, right[:, :, None])[:, :, 0] - change[:, :2]
    back = theta[:, 1:] @ surface[1:]
    return Solution(
        local,
        radius,
        estimator,
        plain,
        apart,
        shade,
        weight,
        inverse,
        held,
        residual,
        back,
        value * back,
        structure,
        images,
        seen,
    )


def _precision(known: Modes, structure: Float, fits: BallFits, noise: NoiseModel) -> Float:
    variance = variance_of(known, np.maximum(structure, _NONE))
    return np.asarray(1 / (variance * noise.variance_at(fits.background)[:, None]))


def _own_share(normal: Float, right: Float, precision: Float, differ: float) -> Float:
    """How many times as much structure as beside them there is in the windows of balls themselves, shape (n,).

    The mean over the marginal likelihood of the window, with all else fitted, times a prior by which places of a film differ.
    """
    rest, modes = slice(0, _PER_BALL), slice(_PER_BALL, None)
    fitted = np.matmul(normal[:, modes, rest], invert(normal[:, rest, rest]))
    root = 1 / np.sqrt(precision)
    told = (normal[:, modes, modes] - np.matmul(fitted, normal[:, rest, modes])) * root[:, :, None] * root[:, None]
    value, axes = np.linalg.eigh(told)
    value = np.maximum(value, 0.0)[:, None]
    left = root * (right[:, modes] - np.matmul(fitted, right[:, rest, None])[:, :, 0])
    square = (np.matmul(axes.swapaxes(1, 2), left[:, :, None])[:, None, :, 0]) ** 2
    share = _SHARES[:, None]
    likelihood = 0.5 * (square * share / (1 + share * value) - np.log1p(share * value)).sum(axis=2) - 0.5 * (np.log(_SHARES) / differ) ** 2
    weight = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    return np.asarray((weight * _SHARES).sum(axis=1) / weight.sum(axis=1))


def hold(fits: BallFits, common: Common) -> tuple[Float, Float]:
    """Return where the radius of each is held and how strongly, the inverse of a variance; not at all where it has a size of its own."""
    apart = np.abs(np.log(fits.radius_px) - common.size.log_radius)
    own = apart > _OUTLIER * np.hypot(common.size.spread, np.sqrt(fits.covariance[:, 2, 2]) / fits.radius_px)
    at_limit = (fits.radius_px <= RADIUS_PX[0]) | (fits.radius_px >= RADIUS_PX[1])
    held = np.where(own, 0.0, 1 / common.size.radius_sd_px**2)
    return np.where(at_limit, fits.radius_px, common.size.radius_px), np.where(at_limit, _FIXED, held)


def variance_of(known: Modes, structure: Float) -> Float:
    """Of the coefficients of the surfaces beyond the quadratic one, in units of the noise of a pixel, shape (n, k)."""
    return np.asarray(known.noise * np.maximum(structure[:, known.degree], 0.0))
