"""The last fit of balls: on a background that goes on under them as the film goes on beside them.

With noise alone a fit on a quadratic background is the best there is. Bone bends further under a ball, where no residual shows it,
and pulls at the centre. How much of it there is, and how fine, free places around the ball tell (`surroundings.py`); with that as
their variance the coefficients of further surfaces are fitted as well (least squares with random effects: Henderson, Biometrics 31,
1975). A mark takes away its part of that background, on a linear film more where there is more: left out, the slope of a bone pulls
at the centres of large balls. The radius is held near what the balls of the film have in common, as far as they do. The same
estimator, held over the free places, shows what errors are left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.ball_equations import invert, polynomial
from rsa_vision.detect.balls import RADIUS_PX, BallFits, slopes, uneven_white
from rsa_vision.detect.decide import EDGE
from rsa_vision.detect.find import CHANCE
from rsa_vision.detect.foreign import foreign, in_line, robust_residual
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import cut
from rsa_vision.detect.profiles import Optics, ball_table
from rsa_vision.detect.resolve import OF_SHIFT, Beside
from rsa_vision.detect.surroundings import Modes, Places, around_each, mean_beside, modes, texture
from rsa_vision.detect.usual import Proportion, Size, proportion, usual_size
from rsa_vision.detect.whitening import whiten
from rsa_vision.types import Bool, Float, Int

STRUCTURE = 2.0  # variance around a ball, in units of the noise, from which there is more than noise
_UNEVEN = 1.25  # the same, from which something may lie there
MOST_COVERED = 0.85  # of a ball: from less it cannot be measured
_TINY = 1e-12
_NONE = 1e-3  # of the noise, or of a promised error: what is not there
_QUIETEST = 0.6  # of a promised squared error
_ROUNDED = 1.0  # variance of noise up to which areas have one value
_STEPS = 4  # from where the fit on a quadratic background came to rest
_AFRESH = (0, 1, 3)  # those with new derivatives
_MAX_STEP_PX = 0.7
_FIXED = 1e6  # inverse variance of a radius that is not fitted
_OUTLIER = 3.0  # standard deviations from which a ball has a size of its own
_QUARTILE, _OF_CHANCE = 0.75, 2.773  # the upper one, of chi2 with two degrees of freedom: errors by bone have longer tails than it
_PER_BALL = 10  # centre, radius, depth, and the six coefficients of a quadratic surface
_BATCH = 20
_USUAL = 6.0  # of chi2 with two degrees of freedom: 95 of 100 are less
_LEAST_CHANCE = 0.2  # of the variance by weights alone
_SHARES = np.exp(np.linspace(-3.0, 6.0, 28))  # of structure in a window, of that at the places around it


def settle(
    film: NDArray[Any],
    balls: BallFits,
    places: list[Places],
    under: float,
    free: Bool,
    edged: Bool,
    beside: Beside,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[BallFits, Float, Bool]:
    """Fit the centres of balls once more.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    places : list of Places
        Around them.
    under : float
        Variance of the noise under balls, in units of that beside them.
    free : ndarray of bool, shape (n,)
        Not fitted together with a neighbour: those stay as they are.
    edged : ndarray of bool, shape (n,)
        Fitted together with an edge: those stay if bending surfaces leave more of it.
    beside : callable
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    balls : BallFits
        With new centres, their covariances, and what is left of the windows.
    ratio : ndarray of shape (n,)
        Squared errors that free places would make of these centres over those that the covariances promise.
    covered : ndarray of bool, shape (n,)
        Something else lies on nearly all of it.
    """
    if len(balls.depth) == 0:
        return balls, np.ones(0), np.zeros(0, bool)
    around = texture(places, len(free), noise)
    structure = np.where(free[:, None], around.structure, 0.0)
    alone, level = free & ~edged & (balls.chi2_ring < EDGE), mean_beside(places, len(free))
    told = alone & np.isfinite(level)
    common = _Common(
        optics,
        noise,
        under,
        usual_size(balls.rows(alone & (balls.chi2_ring < STRUCTURE))),
        proportion(balls.depth[told], balls.background[told], level[told]),
        around.differ,
    )
    out, ratios, covered = replace(balls, covariance=under * balls.covariance), [], np.zeros(len(free))
    for these in places:
        known, errors = modes(these.half, noise), np.zeros((len(these.near), 1))
        for begin in range(0, len(these.balls), _BATCH):
            part = these.balls[begin : begin + _BATCH]
            windows = _without_others(_windows(film, balls, part, these.half, beside, noise), edged[part], common)
            solution = _solve(windows, known, structure[part], common)
            fits = _fits(windows, solution, known, common)
            left = fits.chi2_uneven - balls.chi2_uneven[part] > CHANCE * noise.scatter(fits.n_core)
            covered[part] = windows.covered
            crossed, apart = (windows.covered > 0) & (windows.covered <= MOST_COVERED), fits.position_px - balls.position_px[part]
            both = OF_SHIFT * apart[:, :, None] * apart[:, None] * edged[part, None, None]  # both models could be right
            both += OF_SHIFT * ((apart**2).sum(axis=1) * crossed)[:, None, None] * np.eye(2)  # what lies on a ball has any profile
            fits.covariance[:, :2, :2] += both
            moved = free[part] & ~(edged[part] & ((fits.chi2_ring > STRUCTURE) | left))
            out = _put(out, part, fits, moved)
            stay = free[part] & crossed & ~moved
            out.covariance[part[stay], :2, :2] += both[stay]
            mine = (these.near >= begin) & (these.near < begin + _BATCH)
            by_background = solution.estimator * solution.shade
            errors[mine, 0] = _held_over(these.values[mine], these.near[mine] - begin, by_background, known, structure[part], noise)
        ratios.append(errors)
    return out, around_each(ratios, places, len(free), _least(noise), _QUARTILE)[:, 0], covered > MOST_COVERED


@dataclass(frozen=True, slots=True)
class _Common:
    """What all balls of a film share."""

    optics: Optics
    noise: NoiseModel
    under: float
    size: Size
    proportion: Proportion
    differ: float  # of structure from window to window: standard deviation of its logarithm


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Windows of one size around balls."""

    fits: BallFits
    half: int
    corner_px: Float  # (n, 2)
    data: Float  # (n, pixels), less neighbours and the background at the centre
    added: Float  # (n, pixels), those
    valid: Bool  # (n, pixels)
    covered: Float  # (n,), part of the ball on which something else lies


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
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
    ground: Float  # (n, pixels), background over its value at the centre, times the ball's image
    structure: Float  # (n, degrees), of the windows themselves


def _windows(film: NDArray[Any], balls: BallFits, part: Int, half: int, beside: Beside, noise: NoiseModel) -> _Windows:
    fits = balls.rows(part)
    patches = cut(film, fits.position_px, half, noise)
    corner = patches.corner_px.astype(np.float64)
    cols, rows = np.meshgrid(*[np.arange(float(patches.size))] * 2)
    near = [beside(int(i), cols + c[0], rows + c[1]) for i, c in zip(part, corner, strict=True)]
    doubtful = np.stack([there for _, there in near])
    added = np.stack([image for image, _ in near]) + fits.background[:, None, None]
    flat = (len(part), -1)
    return _Windows(
        fits,
        half,
        corner,
        (patches.values - added).reshape(flat),
        added.reshape(flat),
        (patches.valid & ~doubtful).reshape(flat),
        np.zeros(len(part)),
    )


def _without_others(windows: _Windows, edged: Bool, common: _Common) -> _Windows:
    """Mask the pixels of wires, dust and scratches, under the balls as well."""
    half, noise, sigma_px = windows.half, common.noise, common.optics.sigma_px
    some = np.flatnonzero((windows.fits.chi2_ring > _UNEVEN) | edged)
    fits, before = windows.fits.rows(some), windows.valid[some]
    rows, cols = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].reshape(2, -1).astype(np.float64)
    local, rim, depth = fits.position_px - windows.corner_px[some], fits.radius_px + sigma_px, fits.depth[:, None]
    table = ball_table(round(common.optics.mu_px * sigma_px, 3))
    value, *by = (shape.astype(np.float64) for shape in slopes(table, cols - local[:, :1], rows - local[:, 1:], fits.radius_px, sigma_px))
    surface = np.broadcast_to(polynomial(half, cols - half, rows - half).T, (len(some), 6, len(cols)))
    images = np.concatenate([np.stack([*(depth * slope for slope in by), value], axis=1), surface], axis=1)
    target, held = _hold(fits, common)
    precision = np.zeros(images.shape[:2])
    precision[:, 2] = held
    at_target = depth * (value + (target - fits.radius_px)[:, None] * by[2])
    weight = before / noise.variance_at(depth * value + windows.added[some])
    residual = robust_residual(images, windows.data[some] - at_target, weight, precision)
    under = np.hypot(cols - local[:, :1], rows - local[:, 1:]) < rim[:, None]
    found = foreign(residual, weight, before & ~under, float(noise.gain(np.array(1.0))))
    after = before & ~found & ~in_line(found, local, rim)
    part = (before & ~after & under).sum(axis=1) / np.maximum((before & under).sum(axis=1), 1)
    valid, covered = windows.valid.copy(), windows.covered.copy()
    valid[some], covered[some] = np.where((part > MOST_COVERED)[:, None], before, after), part
    return replace(windows, valid=valid, covered=covered)


def _solve(windows: _Windows, known: Modes, structure: Float, common: _Common) -> _Solution:
    fits, half, noise, sigma_px = windows.fits, windows.half, common.noise, common.optics.sigma_px
    table = ball_table(round(common.optics.mu_px * sigma_px, 3))
    rows, cols = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].reshape(2, -1).astype(np.float64)
    surface = np.concatenate([polynomial(half, cols - half, rows - half), known.surface], axis=1).T
    local, radius, depth = fits.position_px - windows.corner_px, fits.radius_px, fits.depth
    theta, side = np.zeros((len(depth), len(surface))), 2 * half + 1
    target, held = _hold(fits, common)
    precision = np.zeros((len(depth), 4 + len(surface)))
    precision[:, 2], precision[:, _PER_BALL:] = held, _precision(known, structure, fits, noise)
    each = np.arange(precision.shape[1])
    for step in range(_STEPS):
        shapes = slopes(table, cols - local[:, :1], rows - local[:, 1:], radius, sigma_px)
        value, *by = (shape.astype(np.float64) for shape in shapes)
        ball = depth[:, None] * value
        left = windows.data - ball
        if step in _AFRESH:
            # a mark takes away its part of what is there: on linear films more where there is more
            shade = 1 + common.proportion.slope * value[:, None]
            curves = surface * shade
            curves[:, 0] = surface[0]
            moves = [-depth[:, None] * by[0], -depth[:, None] * by[1], depth[:, None] * by[2], value]
            images = np.concatenate([np.stack(moves, axis=1), curves], axis=1)
            weight = windows.valid / noise.variance_at(ball + np.matmul(theta[:, None], curves)[:, 0] + windows.added)
            root = np.sqrt(weight)[:, None]
            seen = whiten((images * root).reshape(*images.shape[:2], side, side), noise).reshape(images.shape)
            plain = np.matmul(seen, seen.swapaxes(1, 2))
        white = whiten((left[:, None] * root).reshape(-1, side, side), noise).reshape(len(depth), -1, 1)
        normal, right = plain.copy(), np.matmul(seen, white)[:, :, 0]
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
        depth, theta = depth + scale * change[:, 3], change[:, 4:]
        residual = left - np.matmul(change[:, None], images)[:, 0]
    estimator = np.matmul(inverse[:, :2], seen).reshape(len(depth), 2, side, side)
    estimator = whiten(estimator, noise).reshape(len(depth), 2, -1) * root
    plain, apart = estimator, np.zeros((len(depth), 2))
    if not noise.is_white:  # by weights alone, the surfaces held in the same proportion
        precision[:, _PER_BALL:] *= known.noise
        precision[:, 2] *= noise.gain(np.hypot(sigma_px, 0.5 * fits.radius_px))
        weighted = images * root
        normal = np.matmul(weighted, weighted.swapaxes(1, 2))
        normal[:, each, each] += precision
        right = np.matmul(weighted, (left * root[:, 0])[:, :, None])[:, :, 0]
        right[:, 2] += precision[:, 2] * (target - before)
        by_weights = invert(normal)
        plain = np.matmul(by_weights[:, :2], weighted) * root
        apart = np.matmul(by_weights[:, :2], right[:, :, None])[:, :, 0] - change[:, :2]
    return _Solution(
        local, radius, estimator, plain, apart, shade, weight, inverse, held, residual, value * (theta[:, 1:] @ surface[1:]), structure
    )


def _fits(windows: _Windows, found: _Solution, known: Modes, common: _Common) -> BallFits:
    """Put centres, their covariances and what is left into a table."""
    fits, side, estimator = windows.fits, 2 * windows.half + 1, found.estimator
    at_ease = common.noise.variance_at(fits.background)[:, None]
    every = np.ones((len(at_ease), 1))
    covariance = fits.covariance.copy()
    of_noise, of_plain = (_of_noise(e, found.weight, side, common) for e in (estimator, found.plain))
    covariance[:, :2, :2] = (
        of_noise
        + _surprise(found.apart, of_noise, of_plain)
        + _by((estimator * found.shade) @ known.surface, at_ease * _variance(known, found.structure))
        # what holding the radius at the usual one does where it is not, and what a wrong proportion does
        + _by(found.inverse[:, :2, 2:3] * found.held[:, None, None], every * common.size.radius_sd_px**2)
        + _by(np.matmul(estimator, found.ground[:, :, None]), every * common.proportion.sd**2)
    )
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1)
    distance = np.hypot(cols - found.local_px[:, :1], rows - found.local_px[:, 1:])
    core = distance < (found.radius_px + common.optics.sigma_px)[:, None]
    under, ring = (uneven_white(found.residual, found.weight, found.local_px, side, where, common.noise) for where in (core, ~core))
    left = (found.weight * found.residual**2 * core).sum(axis=1) / np.maximum((core & (found.weight > 0)).sum(axis=1), 1)
    left = np.minimum(left, fits.chi2_core)  # a fit that is the best in correlated noise leaves more of slow changes
    position = found.local_px + windows.corner_px
    return replace(fits, position_px=position, covariance=covariance, chi2_core=left, chi2_uneven=under, chi2_ring=ring)


def _of_noise(estimator: Float, weight: Float, side: int, common: _Common) -> Float:
    """Covariance of what an estimator makes of noise."""
    by_noise = (estimator / np.sqrt(np.where(weight > 0, weight, 1.0))[:, None]).reshape(-1, 2, side, side)
    return np.asarray(common.under * influence_covariance(by_noise, common.noise.correlation))


def _surprise(apart: Float, efficient: Float, plain: Float) -> Float:
    """Square of what two estimators differ by, as far as noise does not explain it (Hausman, Econometrica 46, 1978); shape (n, 2, 2).

    Were all as described, the variance of the difference is the difference of the variances. If it is not, neither is known to be better.
    """
    size, of_plain = (np.maximum(np.trace(c, axis1=1, axis2=2), _TINY) for c in (efficient, plain))
    chance = np.maximum(1 - size / of_plain, _LEAST_CHANCE)[:, None, None] * plain + _TINY * np.eye(2)
    square = np.einsum("ni,ni->n", apart, np.linalg.solve(chance, apart[:, :, None])[:, :, 0])
    part = np.maximum(1 - _USUAL / np.maximum(square, _TINY), 0.0)
    return np.asarray(part[:, None, None] * apart[:, :, None] * apart[:, None])


def _precision(known: Modes, structure: Float, fits: BallFits, noise: NoiseModel) -> Float:
    variance = known.noise * np.maximum(structure[:, known.degree], _NONE)
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


def _hold(fits: BallFits, common: _Common) -> tuple[Float, Float]:
    """Return where the radius of each is held and how strongly, the inverse of a variance; not at all where it has a size of its own."""
    apart = np.abs(np.log(fits.radius_px) - common.size.log_radius)
    own = apart > _OUTLIER * np.hypot(common.size.spread, np.sqrt(fits.covariance[:, 2, 2]) / fits.radius_px)
    at_limit = (fits.radius_px <= RADIUS_PX[0]) | (fits.radius_px >= RADIUS_PX[1])
    held = np.where(own, 0.0, 1 / common.size.radius_sd_px**2)
    return np.where(at_limit, fits.radius_px, common.size.radius_px), np.where(at_limit, _FIXED, held)


def _held_over(values: NDArray[Any], near: Int, estimator: Float, known: Modes, structure: Float, noise: NoiseModel) -> Float:
    """Squared errors that free places make of centres, over what is stated for noise and structure as they are there, shape (k,)."""
    side = round(np.sqrt(values.shape[1]))
    mean = values.mean(axis=1)
    stated = influence_covariance(estimator.reshape(-1, 2, side, side), noise.correlation)
    stated = stated + _by(estimator @ known.surface, _variance(known, structure)) + _TINY * np.eye(2)  # a ball may lie wholly under others
    error = np.einsum("kip,kp->ki", estimator[near], values - mean[:, None])
    square = np.einsum("ki,ki->k", error, np.linalg.solve(stated[near], error[:, :, None])[:, :, 0])
    return np.asarray(square / noise.variance_at(mean) / _OF_CHANCE)


def _least(noise: NoiseModel) -> float:
    """Part of the promised squared errors that can be all there is: less is not believed of areas of one value, nor of white noise."""
    return _QUIETEST if noise.is_white or noise.typical_sd**2 < _ROUNDED else _NONE


def _variance(known: Modes, structure: Float) -> Float:
    """Of the coefficients of the surfaces beyond the quadratic one, in units of the noise of a pixel, shape (n, k)."""
    return np.asarray(known.noise * np.maximum(structure[:, known.degree], 0.0))


def _by(response: Float, variance: Float) -> Float:
    """Covariance of what responds (n, 2, k) to independent figures of these variances (n, k)."""
    return np.asarray(np.matmul(response * variance[:, None], response.swapaxes(1, 2)))


def _put(balls: BallFits, part: Int, fits: BallFits, moved: Bool) -> BallFits:
    """Put the new centres in the place of the old ones."""
    changed = {}
    for name in ("position_px", "covariance", "chi2_core", "chi2_uneven", "chi2_ring"):
        changed[name] = getattr(balls, name).copy()
        changed[name][part[moved]] = getattr(fits, name)[moved]
    return replace(balls, **changed)
