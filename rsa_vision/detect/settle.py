"""The last fit of balls: on a background that goes on under them as the film goes on beside them.

With noise alone a fit on a quadratic background is the best there is. Bone bends further under a ball, where no residual shows it,
and pulls at the centre. How much of it there is, and how fine, free places around the ball tell (`surroundings.py`); with that as
their variance the coefficients of further surfaces are fitted as well (least squares with random effects: Henderson, Biometrics 31,
1975). A mark takes away its part of that background, on a linear film more where there is more: left out, the slope of a bone pulls
at the centres of large balls. The radius is held near what the balls of the film have in common, as far as they do. The same
estimator, held over the free places, shows what errors are left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.alike import true_spread
from rsa_vision.detect.ball_equations import invert, polynomial
from rsa_vision.detect.balls import RADIUS_PX, BallFits, slopes, uneven
from rsa_vision.detect.decide import EDGE
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import Patches, cut
from rsa_vision.detect.profiles import Optics, ball_table
from rsa_vision.detect.surroundings import Modes, around_each, free_places, mean_beside, modes, texture
from rsa_vision.types import Bool, Float, Int

Beside = Callable[[int, Float, Float], tuple[Float, Bool]]
"""Images of all marks but one ball at pixels (cols, rows) around it, in film values, and the pixels where they are not to be trusted."""

STRUCTURE = 2.0  # variance around a ball, in units of the noise, from which there is more than noise
_NONE = 1e-3  # of the noise: what is not there
_STEPS = 3  # from where the fit on a quadratic background came to rest
_MAX_STEP_PX = 0.7
_ANYTHING = 9.0  # spread of logarithms: no two balls need be alike
_FAST = 1e6  # of a radius
_OUTLIER = 3.0  # standard deviations from which a ball has a size of its own
_QUIETEST = 0.6  # less than that is chance
_QUARTILE, _OF_CHANCE = 0.75, 2.773  # the upper one, of chi2 with two degrees of freedom: errors by bone have longer tails than it
_PER_BALL = 10  # centre, radius, depth, and the six coefficients of a quadratic surface
_BATCH = 20
_LEAST_BALLS = 5  # whose depths tell how they go with the background
_SD_OF_MAD = 1.4826
_SHARES = np.exp(np.linspace(-3.0, 6.0, 28))  # of structure in a window, of that at the places around it


def settle(
    film: NDArray[Any],
    balls: BallFits,
    under: float,
    free: Bool,
    edged: Bool,
    others_px: Float,
    reach_px: Float,
    beside: Beside,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[BallFits, Float]:
    """Fit the centres of balls once more.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    under : float
        Variance of the noise under balls, in units of that beside them.
    free : ndarray of bool, shape (n,)
        Not fitted together with a neighbour: those stay as they are.
    edged : ndarray of bool, shape (n,)
        Fitted together with an edge: those stay if they are beside one, of which bending surfaces leave much.
    others_px : ndarray of shape (m, 2)
        (col, row) of pins and tees.
    reach_px : ndarray of shape (m,)
        How far their images go.
    beside : callable
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    balls : BallFits
        With new centres, their covariances, and what is left of the odd part.
    ratio : ndarray of shape (n,)
        Squared errors that free places would make of these centres over those that the covariances promise.
    """
    if len(balls.depth) == 0:
        return balls, np.ones(0)
    places = free_places(film, balls, others_px, reach_px, optics, noise)
    around = texture(places, len(free), noise)
    structure = np.where(free[:, None], around.structure, 0.0)
    alone = free & ~edged & (balls.chi2_ring < EDGE)
    usual = _Usual(*_size(balls.rows(alone)), *_proportion(balls, alone, mean_beside(places, len(free))), around.differ)
    out, ratios = replace(balls, covariance=under * balls.covariance), []
    for these in places:
        known, errors = modes(these.half, noise), np.zeros((len(these.near), 1))
        for begin in range(0, len(these.balls), _BATCH):
            part = these.balls[begin : begin + _BATCH]
            fits, estimator = _fit(film, balls, part, under, these.half, known, structure[part], usual, beside, optics, noise)
            out = _put(out, part, fits, free[part] & ~(edged[part] & (fits.chi2_ring > STRUCTURE)))
            mine = (these.near >= begin) & (these.near < begin + _BATCH)
            errors[mine, 0] = _held_over(these.values[mine], these.near[mine] - begin, estimator, known, structure[part], noise)
        ratios.append(errors)
    return out, around_each(ratios, places, len(free), _QUIETEST, _QUARTILE)[:, 0]


@dataclass(frozen=True, slots=True)
class _Usual:
    """What the balls of a film have in common."""

    log_radius: float
    spread: float  # of that
    proportion: float  # by which depth goes with the background
    proportion_sd: float
    differ: float  # of structure from window to window: standard deviation of its logarithm

    @property
    def radius_px(self) -> float:
        return float(np.exp(self.log_radius))

    @property
    def radius_sd_px(self) -> float:
        return self.spread * self.radius_px


def _size(alone: BallFits) -> tuple[float, float]:
    clear = alone.rows(alone.chi2_ring < STRUCTURE)
    centre, spread, _ = true_spread(np.log(clear.radius_px), clear.covariance[:, 2, 2] / clear.radius_px**2)
    return centre, min(spread, _ANYTHING)


def _proportion(balls: BallFits, alone: Bool, beside: Float) -> tuple[float, float]:
    """Tell how the depth goes with the background: not at all on logarithmic films, like it on linear ones; with the error of that.

    The fits' own backgrounds have errors that are those of the depths with the other sign. Values farther off have not, and go with the
    backgrounds all the same: they are the instrument of the regression (Wright, 1928), by their ranks.
    """
    use = alone & np.isfinite(beside)
    if np.count_nonzero(use) < _LEAST_BALLS:
        return 0.0, 0.0
    depth, background, rank = (
        balls.depth[use],
        balls.background[use],
        np.argsort(np.argsort(beside[use])) - 0.5 * (np.count_nonzero(use) - 1),
    )
    middle = np.median(depth)
    far = _OUTLIER * _SD_OF_MAD * np.median(np.abs(depth - middle))
    depth = np.clip(depth, middle - far, middle + far)
    shared = rank @ background
    of_linear = middle / np.median(background)
    if shared <= 0:
        return 0.0, abs(of_linear)
    slope = (rank @ depth) / shared
    left = depth - depth.mean() - slope * (background - background.mean())
    error = np.sqrt(left @ left / (len(left) - 2) * (rank @ rank)) / shared
    drawn = 1 + (error / of_linear) ** 2
    return float(slope / drawn), float(error / np.sqrt(drawn))


def _fit(
    film: NDArray[Any],
    balls: BallFits,
    part: Int,
    under: float,
    half: int,
    known: Modes,
    structure: Float,
    usual: _Usual,
    beside: Beside,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[BallFits, Float]:
    """Fit those of one window size; return them with what their centres make of the background, shape (n, 2, pixels)."""
    fits = balls.rows(part)
    patches = cut(film, fits.position_px, half, noise)
    n, side, table = len(part), patches.size, ball_table(round(optics.mu_px * optics.sigma_px, 3))
    cols, rows = (g.ravel().astype(np.float64) for g in np.meshgrid(np.arange(side), np.arange(side)))
    surface = np.concatenate([polynomial(half, cols - half, rows - half), known.surface], axis=1)
    extra, valid = _around(fits.position_px, part, patches, beside)
    added = extra + fits.background[:, None]
    data = patches.values.reshape(n, -1) - added
    local, radius, depth, theta = fits.position_px - patches.corner_px, fits.radius_px, fits.depth, np.zeros((n, surface.shape[1]))
    at_ease = noise.variance_at(fits.background)
    target, held = _hold(fits, usual, optics, noise)
    precision = np.zeros((n, 4 + surface.shape[1]))
    precision[:, 2] = held
    precision[:, _PER_BALL:] = _precision(known, structure, at_ease)
    for step in range(_STEPS):
        shapes = slopes(table, cols - local[:, :1], rows - local[:, 1:], radius, optics.sigma_px)
        value, *by = (shape.astype(np.float64) for shape in shapes)
        images = np.stack([-depth[:, None] * by[0], -depth[:, None] * by[1], depth[:, None] * by[2], value], axis=1)
        left = data - depth[:, None] * value
        # a mark takes away its part of what is there: on linear films more where there is more
        shade = 1 + usual.proportion * value[:, None]
        curves = surface.T * shade
        curves[:, 0] = surface[:, 0]
        everything = np.concatenate([images, curves], axis=1)
        weight = valid / noise.variance_at(data - left + np.matmul(theta[:, None], curves)[:, 0] + added)
        weighted = everything * weight[:, None]
        normal, right = np.matmul(weighted, everything.swapaxes(1, 2)), np.matmul(weighted, left[:, :, None])[:, :, 0]
        if step == 1:  # once the background is known roughly
            own = _own_share(normal, right, precision[:, _PER_BALL:], noise.gain(np.array(float(half))), usual.differ)
            structure = structure * own[:, None]
            precision[:, _PER_BALL:] = _precision(known, structure, at_ease)
        normal[:, np.arange(normal.shape[1]), np.arange(normal.shape[1])] += precision
        right[:, 2] += held * (target - radius)
        inverse = invert(normal)
        change = np.matmul(inverse, right[:, :, None])[:, :, 0]
        theta = change[:, 4:]
        scale = np.minimum(1.0, _MAX_STEP_PX / np.maximum(np.abs(change[:, :3]).max(axis=1), 1e-12))
        local = local + scale[:, None] * change[:, :2]
        radius = np.clip(radius + scale * change[:, 2], *RADIUS_PX)
        depth = depth + scale * change[:, 3]
    estimator = np.matmul(inverse[:, :2], weighted)
    by_noise = (estimator / np.sqrt(np.where(weight > 0, weight, 1.0))[:, None]).reshape(n, 2, side, side)
    covariance = fits.covariance.copy()
    covariance[:, :2, :2] = under * influence_covariance(by_noise, noise.correlation) + at_ease[:, None, None] * _by(
        (estimator * shade) @ known.surface, _variance(known, structure)
    )
    # what holding the radius at the usual one does where it is not
    covariance[:, :2, :2] += _by(inverse[:, :2, 2:3] * held[:, None, None], np.full((n, 1), usual.radius_sd_px**2))
    # and what a wrong proportion does
    ground = value * (theta[:, 1:] @ surface[:, 1:].T)
    covariance[:, :2, :2] += _by(np.matmul(estimator, ground[:, :, None]), np.full((n, 1), usual.proportion_sd**2))
    residual = left - np.matmul(change[:, None], everything)[:, 0]
    core = np.hypot(cols - local[:, :1], rows - local[:, 1:]) < (radius + optics.sigma_px)[:, None]
    rest = [uneven(residual, weight, local, side, where) for where in (core, ~core)]
    position = local + patches.corner_px
    return replace(fits, position_px=position, covariance=covariance, chi2_uneven=rest[0], chi2_ring=rest[1]), estimator * shade


def _precision(known: Modes, structure: Float, at_ease: Float) -> Float:
    return np.asarray(1 / (np.maximum(structure[:, known.degree], _NONE) * at_ease[:, None]))


def _own_share(normal: Float, right: Float, precision: Float, gain: Float, differ: float) -> Float:
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
    square = (np.matmul(axes.swapaxes(1, 2), left[:, :, None])[:, None, :, 0]) ** 2 / gain
    share = _SHARES[:, None]
    likelihood = 0.5 * (square * share / (1 + share * value) - np.log1p(share * value)).sum(axis=2) - 0.5 * (np.log(_SHARES) / differ) ** 2
    weight = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    return np.asarray((weight * _SHARES).sum(axis=1) / weight.sum(axis=1))


def _hold(fits: BallFits, usual: _Usual, optics: Optics, noise: NoiseModel) -> tuple[Float, Float]:
    """Return where the radius of each is held and how strongly, the inverse of a variance; not at all where it has a size of its own."""
    apart = np.abs(np.log(fits.radius_px) - usual.log_radius)
    own = apart > _OUTLIER * np.hypot(usual.spread, np.sqrt(fits.covariance[:, 2, 2]) / fits.radius_px)
    # correlated noise makes a fit surer than it is
    gain = noise.gain(np.hypot(optics.sigma_px, 0.5 * fits.radius_px))
    at_limit = (fits.radius_px <= RADIUS_PX[0]) | (fits.radius_px >= RADIUS_PX[1])
    held = np.where(own, 0.0, gain / usual.radius_sd_px**2)
    return np.where(at_limit, fits.radius_px, usual.radius_px), np.where(at_limit, _FAST, held)


def _around(position_px: Float, part: Int, patches: Patches, beside: Beside) -> tuple[Float, Bool]:
    """Images of the neighbours in windows, and the pixels that are to be trusted, shape (n, pixels)."""
    grid = np.arange(patches.size)
    near = [beside(int(i), *np.meshgrid(grid + c[0], grid + c[1])) for i, c in zip(part, patches.corner_px.astype(np.float64), strict=True)]
    extra = np.stack([image for image, _ in near])
    doubtful = np.stack([there for _, there in near])
    return extra.reshape(len(part), -1), (patches.valid & ~doubtful).reshape(len(part), -1)


def _held_over(values: NDArray[Any], near: Int, estimator: Float, known: Modes, structure: Float, noise: NoiseModel) -> Float:
    """Squared errors that free places make of centres, over what is stated for noise and structure as they are there, shape (k,)."""
    side = round(np.sqrt(values.shape[1]))
    mean = values.mean(axis=1)
    stated = influence_covariance(estimator.reshape(-1, 2, side, side), noise.correlation)
    stated = stated + _by(estimator @ known.surface, _variance(known, structure))
    error = np.einsum("kip,kp->ki", estimator[near], values - mean[:, None])
    square = np.einsum("ki,ki->k", error, np.linalg.solve(stated[near], error[:, :, None])[:, :, 0])
    return np.asarray(square / noise.variance_at(mean) / _OF_CHANCE)


def _variance(known: Modes, structure: Float) -> Float:
    """Of the coefficients of the surfaces beyond the quadratic one, in units of the noise of a pixel, shape (n, k)."""
    return np.asarray(known.noise * np.maximum(structure[:, known.degree], 0.0))


def _by(response: Float, variance: Float) -> Float:
    """Covariance of what responds (n, 2, k) to independent figures of these variances (n, k)."""
    return np.asarray(np.matmul(response * variance[:, None], response.swapaxes(1, 2)))


def _put(balls: BallFits, part: Int, fits: BallFits, moved: Bool) -> BallFits:
    """Put the new centres in the place of the old ones."""
    changed = {}
    for name in ("position_px", "covariance", "chi2_uneven", "chi2_ring"):
        changed[name] = getattr(balls, name).copy()
        changed[name][part[moved]] = getattr(fits, name)[moved]
    return replace(balls, **changed)
