"""Fits of the blurred-ball model, many candidates at once: weighted Gauss-Newton on centre, radius, depth and a quadratic background."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import Patches
from rsa_vision.detect.profiles import BallTable, ball_table
from rsa_vision.types import Bool, Float

RADIUS_PX = (1.2, 16.0)  # fitted radii stay between; marks of 2.5 to 12 are what is looked for
_STEPS = 12
_REWEIGHTED = (2, 5)  # steps
_BATCH = 40  # windows that stay in the cache
_LARGE_PX = 27  # side of a window of which a first look does not need every pixel
_CONVERGED_PX = 2e-4
_MAX_STEP_PX = 0.7
_RIDGE = 1e-10  # relative


@dataclass(frozen=True, slots=True, eq=False)
class BallFits:
    """Fits of one batch of candidates.

    Attributes
    ----------
    position_px : ndarray of shape (n, 2)
        (col, row) on the film.
    radius_px, depth : ndarray of shape (n,)
        Depth in film values; the sign tells the polarity (negative: darker than the background).
    covariance : ndarray of shape (n, 4, 4)
        Of col, row, radius and depth, for the film's noise with its correlation between pixels.
    chi2_core, chi2_ring : ndarray of shape (n,)
        Mean squared residual in units of the noise variance, under the ball (to one blur beyond the rim) and around it; the latter of the
        odd part only, as below.
    chi2_uneven : ndarray of shape (n,)
        As ``chi2_core``, of the odd part of the residuals only: errors that are the same on opposite sides of the centre (film curve, focal
        spot, attenuation) do not move it.
    explained : ndarray of shape (n,)
        Fraction of the excess variance under the ball, over a background without ball, that the ball explains (1: all).
    valid_fraction : ndarray of shape (n,)
        Part of the pixels under the ball that were neither masked nor outside the film.
    window_fraction : ndarray of shape (n,)
        The same for the whole window.
    log_likelihood : ndarray of shape (n,)
        Of the whole window, but for a constant: minus half the weighted sum of squared residuals.
    background : ndarray of shape (n,)
        Background value at the centre.
    significance : ndarray of shape (n,)
        Depth over its standard deviation at the fitted centre and radius: radius and depth of a ball that is small against the blur can
        stand for each other, so that neither is sure alone; that something is there is. Of a sparse look, what all pixels promise.
    n_core : ndarray of shape (n,)
        Pixels under the ball that were looked at.
    converged : ndarray of bool, shape (n,)
    """

    position_px: Float
    radius_px: Float
    depth: Float
    covariance: Float
    chi2_core: Float
    chi2_ring: Float
    chi2_uneven: Float
    explained: Float
    valid_fraction: Float
    window_fraction: Float
    log_likelihood: Float
    background: Float
    significance: Float
    n_core: Float
    converged: Bool

    def rows(self, index: Any) -> BallFits:
        """Return the fits that ``index`` selects."""
        return BallFits(*(getattr(self, f.name)[index] for f in fields(self)))


def join(parts: list[BallFits]) -> BallFits:
    """Concatenate batches."""
    return BallFits(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(BallFits)))


def half_size(radius_px: float, sigma_px: float) -> int:
    """Return the half side of a window that holds a ball and enough background to tell it from its curvature."""
    return int(np.ceil(1.9 * radius_px + 3.0 * sigma_px + 2.0))


def polynomial(axis_scale: float, dx: Float, dy: Float) -> Float:
    """Return the six monomials of a quadratic surface on a new last axis, scaled to about one at the rim of the window."""
    u, v = dx / axis_scale, dy / axis_scale
    return np.moveaxis(np.array([np.ones_like(u), u, v, u * u, u * v, v * v]), 0, -1)  # each in one piece in memory


def ball_image(film_dx: Float, film_dy: Float, radius_px: Float, sigma_px: float, mu_px: float) -> Float:
    """Return the blurred opacity (0..1) of balls at these distances from their centres.

    Parameters
    ----------
    film_dx, film_dy : ndarray of shape (n, ...)
        Offsets of the pixels from the centres.
    radius_px : ndarray of shape (n,)
    sigma_px, mu_px : float
        Blur and attenuation.

    Returns
    -------
    ndarray of shape (n, ...)
    """
    table = ball_table(round(mu_px * sigma_px, 3))
    return table.evaluate(np.hypot(film_dx, film_dy) / sigma_px, radius_px / sigma_px)[0]


def fit_balls(
    patches: Patches,
    start_px: Float,
    start_radius_px: Float,
    sigma_px: float,
    mu_px: float,
    noise: NoiseModel,
    extra: Float | None = None,
    *,
    quick: bool = False,
    sparse: bool = False,
) -> BallFits:
    """Fit a ball in every window.

    Parameters
    ----------
    patches : Patches
    start_px : ndarray of shape (n, 2)
        (col, row) on the film.
    start_radius_px : ndarray of shape (n,)
    sigma_px, mu_px : float
        Blur (standard deviation) and attenuation of the film at hand.
    noise : NoiseModel
    extra : ndarray of shape (n, s, s), optional
        Images of neighbours, in film values, to be subtracted first.
    quick : bool
        For a first look: a third of the steps, and covariances as if the noise were white.
    sparse : bool
        For a first look at much that is nothing: of large windows only every second pixel either way.

    Returns
    -------
    BallFits
    """
    parts = []
    for begin in range(0, len(start_px), _BATCH):
        part = slice(begin, begin + _BATCH)
        chunk = Patches(patches.values[part], patches.valid[part], patches.corner_px[part])
        more = None if extra is None else extra[part]
        stride = 2 if sparse and patches.size > _LARGE_PX else 1
        parts.append(_fit_batch(chunk, start_px[part], start_radius_px[part], sigma_px, mu_px, noise, more, quick, stride))
    return join(parts)


def _fit_batch(
    patches: Patches,
    start_px: Float,
    start_radius_px: Float,
    sigma_px: float,
    mu_px: float,
    noise: NoiseModel,
    extra: Float | None,
    quick: bool,
    stride: int,
) -> BallFits:
    n, size = len(start_px), patches.size
    kind = np.float32 if quick else np.float64  # a first look does with half the memory
    half = size // 2
    table = ball_table(round(mu_px * sigma_px, 3))
    data = patches.values if extra is None else patches.values - extra
    data = data.reshape(n, -1)
    valid = patches.valid.reshape(n, -1)
    axis = np.arange(half % stride, size, stride, dtype=np.float64)
    grid_c, grid_r = (g.ravel() for g in np.meshgrid(axis, axis))
    looked_at = (grid_r * size + grid_c).astype(np.intp)
    if stride > 1:
        data, valid = data[:, looked_at], valid[:, looked_at]
    level = patches.values.reshape(n, -1).mean(1)[:, None]  # what is small can be added up in single precision
    data, valid = (data - level).astype(kind), valid.astype(kind)
    added = level if extra is None else level + extra.reshape(n, -1)[:, looked_at]
    surface = polynomial(half, grid_c - half, grid_r - half)
    local = start_px - patches.corner_px
    low, high = np.maximum(RADIUS_PX[0], 0.42 * sigma_px), min(RADIUS_PX[1], 20.0 * sigma_px, half - sigma_px)
    radius = np.clip(start_radius_px, low, high)
    weight = valid / noise.variance_at(level).astype(kind)
    squares = (surface[:, :, None] * surface[:, None]).reshape(len(surface), -1)
    equations = _Equations(table, sigma_px, grid_c.astype(kind), grid_r.astype(kind), surface, squares)
    theta = np.zeros((n, 7))
    converged = np.zeros(n, bool)
    busy = np.arange(n)
    for step in range(4 if quick else _STEPS):
        now, seen = weight[busy], data[busy]
        images = equations.images(local[busy], radius[busy])
        if step in _REWEIGHTED:  # the variance follows the expected value once the model is near
            model = _model(images, surface, theta[busy])
            now = weight[busy] = valid[busy] / noise.variance_at(model + added[busy]).astype(kind)
        normal, right = equations.normal(images, now, seen)
        if step == 0:  # depth and background at the starting centre first: Gauss-Newton on the centre needs a depth
            theta = _solve(normal[:, 3:, 3:], right[:, 3:])
        right = right - np.matmul(normal[:, :, 3:], theta[busy, :, None])[:, :, 0]  # of what the model leaves
        delta = _solve(normal, right, damping=1e-6) / _by_depth(theta[busy])
        scale = np.minimum(1.0, _MAX_STEP_PX / np.maximum(np.abs(delta[:, :3]).max(1), 1e-12))[:, None]
        local[busy] = np.clip(local[busy] + scale * delta[:, :2], 1.0, size - 2.0)
        radius[busy] = np.clip(radius[busy] + (scale * delta[:, 2:3])[:, 0], low, high)
        theta[busy] += scale * delta[:, 3:]
        converged[busy] = np.abs(delta[:, :2]).max(1) < _CONVERGED_PX * 10
        moving = (np.abs(delta[:, :3]) >= _CONVERGED_PX).any(1)
        if not moving.any():
            break
        if step >= _REWEIGHTED[-1]:
            busy = busy[moving]
    images = equations.images(local, radius)
    normal, right = equations.normal(images, weight, data)
    # the rest is added to what is known: no digits are lost in it
    theta = theta + _solve(normal[:, 3:, 3:], right[:, 3:] - np.matmul(normal[:, 3:, 3:], theta[:, :, None])[:, :, 0])
    residual = data - _model(images, surface, theta)
    whole, of_depth = invert(normal)[:, :4], invert(normal[:, 3:, 3:])[:, :1]
    by = _by_depth(theta)
    covariance = whole / (by[:, :4, None] * by[:, None])
    variance = of_depth[:, 0, 0] / stride**2
    if not quick:
        of_all = np.concatenate([whole / by[:, :4, None], np.pad(of_depth, ((0, 0), (0, 0), (3, 0)))], axis=1)
        influence = (np.matmul(of_all[:, :, :4], images) + of_all[:, :, 4:] @ surface.T) * np.sqrt(weight, dtype=np.float64)[:, None]
        scatter = influence_covariance(influence.reshape(n, 5, size, size), noise.correlation)
        covariance, variance = scatter[:, :4], scatter[:, 4, 4]
    core = _distance(grid_c - local[:, :1], grid_r - local[:, 1:]) < (radius + sigma_px)[:, None]
    square = weight * residual**2
    core_n = np.maximum((core * valid).sum(1), 1.0)
    chi2_core = (square * core).sum(1) / core_n
    chi2_ring = chi2_uneven = (square * ~core).sum(1) / np.maximum((~core * valid).sum(1) - 10, 1.0)
    if not quick:
        chi2_ring, chi2_uneven = (uneven(residual, weight, local, size, part) for part in (~core, core))
    raised = weight * (residual + theta[:, :1] * images[:, 3]) ** 2  # over the fitted background, as if there were no ball
    return BallFits(
        position_px=local + patches.corner_px,
        radius_px=radius,
        depth=theta[:, 0],
        covariance=covariance[:, :, :4],
        chi2_core=chi2_core,
        chi2_ring=chi2_ring,
        chi2_uneven=chi2_uneven,
        explained=1.0 - (square * core).sum(1) / np.maximum((raised * core).sum(1), 1e-12),
        valid_fraction=(core * valid).sum(1) / np.maximum(core.sum(1), 1),
        window_fraction=valid.mean(1),
        log_likelihood=-0.5 * square.sum(1),
        background=theta[:, 1] + level[:, 0],
        significance=np.abs(theta[:, 0]) / np.sqrt(np.maximum(variance, 1e-30)),
        n_core=core_n,
        converged=converged,
    )


def invert(normal: Float) -> Float:
    """Return the inverses of normal matrices (n, p, p); what they do not determine has a variance that is large, not infinite."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", normal), 1e-30))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.inv(normal / both + _RIDGE * np.eye(normal.shape[1])) / both)


def uneven(residual: Float, weight: Float, local: Float, size: int, core: Bool) -> Float:
    """Return the mean square of the odd part of the residuals under balls, in units of the noise; shape (n,).

    Parameters
    ----------
    residual, weight : ndarray of shape (n, size * size)
        Residuals of square windows, 1 / variance (0 where masked).
    local : ndarray of shape (n, 2)
        Centres in the windows, (col, row).
    size : int
    core : ndarray of bool, shape (n, size * size)
        Pixels under the ball.
    """
    twice = np.rint(2 * local).astype(np.intp)
    axis = np.arange(size)
    cols, rows = np.clip(twice[:, :1] - axis, 0, size - 1), np.clip(twice[:, 1:] - axis, 0, size - 1)
    opposite = (rows[:, :, None] * size + cols[:, None, :]).reshape(len(local), -1)
    pairs = core & (weight > 0) & (np.take_along_axis(weight, opposite, 1) > 0)
    odd = residual - np.take_along_axis(residual, opposite, 1)
    out: Float = (0.5 * pairs * weight * odd**2).sum(1) / np.maximum(pairs.sum(1) - 4, 1.0)
    return out


def _distance(dx: Float, dy: Float) -> Float:
    return np.asarray(np.sqrt(dx * dx + dy * dy))  # a fifth of the time of hypot, which minds overflow


def slopes(
    table: BallTable, dx: Float, dy: Float, radius: Float, sigma_px: float, kind: Any = np.float64
) -> tuple[Float, Float, Float, Float]:
    """Return the images of balls and their derivatives.

    Parameters
    ----------
    table : BallTable
    dx, dy : ndarray of shape (n, p)
        Pixels from the centres.
    radius : ndarray of shape (n,)
    sigma_px : float
    kind : dtype, optional
        Of the result.

    Returns
    -------
    value, by_dx, by_dy, by_radius : ndarrays of shape (n, p)
    """
    dx, dy = dx.astype(kind), dy.astype(kind)
    rho = _distance(dx, dy)
    value, slope, slope_r = table.evaluate(rho / kind(sigma_px), radius / sigma_px)
    slope /= kind(sigma_px) * np.maximum(rho, kind(1e-9))
    return value, slope * dx, slope * dy, slope_r / kind(sigma_px)


def derivatives(radius: Float, half: int, sigma_px: float, mu_px: float) -> Float:
    """Return what windows of ``2 half + 1`` pixels around balls of depth one say of them.

    Parameters
    ----------
    radius : ndarray of shape (n,)
    half : int
    sigma_px, mu_px : float

    Returns
    -------
    ndarray of shape (n, 10, pixels)
        By dx, dy (minus those by the centre) and radius, the images themselves, and the background's six coefficients.
    """
    rows, cols = (
        np.repeat(axis.reshape(1, -1), len(radius), 0) for axis in np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    )
    value, *by = slopes(ball_table(round(mu_px * sigma_px, 3)), cols, rows, radius, sigma_px)
    surface = polynomial(half, cols[0], rows[0]).T
    return np.concatenate([np.stack([*by, value], axis=1), np.broadcast_to(surface, (len(radius), *surface.shape))], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Least squares in windows: balls of depth one, their derivatives, and the background that the windows have in common."""

    table: BallTable
    sigma_px: float
    cols: Float  # (p,), of the kind to calculate with
    rows: Float
    surface: Float  # (p, k)
    squares: Float  # (p, k * k), products of its columns

    def images(self, local: Float, radius: Float) -> Float:
        """Return derivatives by col (negative), row (negative) and radius, and the images themselves, shape (n, 4, p)."""
        value, *by = slopes(self.table, self.cols - local[:, :1], self.rows - local[:, 1:], radius, self.sigma_px, self.cols.dtype.type)
        return np.stack([*by, value], axis=1)

    def normal(self, images: Float, weight: Float, target: Float) -> tuple[Float, Float]:
        """Return normal matrices (n, 10, 10) and right sides (n, 10)."""
        # added up in double precision: radius and depth of a ball that is small against the blur can all but stand for each other
        n, k = len(images), self.surface.shape[1]
        weight, images = weight.astype(np.float64), images.astype(np.float64)
        weighted = images * weight[:, None]
        mixed = (weighted.reshape(4 * n, -1) @ self.surface).reshape(n, 4, k)
        own = np.matmul(weighted, images.transpose(0, 2, 1))
        normal = np.block([[own, mixed], [mixed.transpose(0, 2, 1), (weight @ self.squares).reshape(n, k, k)]])
        return normal, np.concatenate([np.matmul(weighted, target[:, :, None])[:, :, 0], (weight * target) @ self.surface], axis=1)


def _model(images: Float, surface: Float, theta: Float) -> Float:
    kind = images.dtype
    return np.asarray(theta[:, :1].astype(kind) * images[:, 3] + theta[:, 1:].astype(kind) @ surface.T.astype(kind))


def _by_depth(theta: Float) -> Float:
    """What the derivatives of balls of depth one are to be multiplied by, shape (n, 10)."""
    depth = np.where(theta[:, :1] == 0, 1e-30, theta[:, :1])
    return np.concatenate([-depth, -depth, depth, np.ones_like(theta)], axis=1)


def _solve(normal: Float, right: Float, damping: float = 1e-9) -> Float:
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", normal), 1e-30))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    scaled[:, np.arange(scaled.shape[1]), np.arange(scaled.shape[1])] += damping
    solution: Float = np.linalg.solve(scaled, (right / scale)[:, :, None])[:, :, 0] / scale
    return solution
