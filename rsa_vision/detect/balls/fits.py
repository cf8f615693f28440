"""Fits of the blurred-ball model, many candidates at once: weighted Gauss-Newton on centre, radius, depth and a quadratic background."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from rsa_vision.detect.balls.cut_off import depths_cut_off, grounds_cut_off
from rsa_vision.detect.balls.equations import pixels_of, weighted
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import Patches
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.profiles import BallTable, Optics, ball_table
from rsa_vision.types import Bool, Float, Int

RADIUS_PX = (1.2, 16.0)  # fitted radii stay between; marks of 2.5 to 12 are what is looked for
_STEPS, _QUICK_STEPS = 12, 4
_REWEIGHTED = (1, 2)  # steps
_FADED = 4.0  # blur widths beyond the rim where nothing is left of a ball's image that noise would let be seen
_SPARSE_PX = 14  # pixels either way that a first look needs of a window
_CONVERGED_PX = 2e-4
_NEAR_PX = 5e-3  # enough for a first look
_MAX_STEP_PX = 0.7


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
        As ``chi2_core``, the noise made white, of the odd part of the residuals only: errors that are the same on opposite sides of the
        centre (film curve, focal spot, attenuation) do not move it.
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
        Depth over its standard deviation (by noise as beside it, where there is more under it) at the fitted centre and radius: radius and
        depth of a ball that is small against the blur can stand for each other, so that neither is sure alone; that something is there is.
        Of a sparse look, what all pixels promise.
    n_core : ndarray of shape (n,)
        Pixels under the ball that were looked at.
    converged : ndarray of bool, shape (n,)
    hidden : ndarray of int, shape (n,)
        Which end of the range hides the background, as of :func:`rsa_vision.detect.balls.cut_off.grounds_cut_off`: the ball's middle is all
        that is seen.
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
    hidden: Int

    def rows(self, index: Any) -> BallFits:
        """Return the fits that ``index`` selects."""
        return BallFits(*(getattr(self, f.name)[index] for f in fields(self)))


def join(parts: list[BallFits]) -> BallFits:
    """Concatenate batches."""
    return BallFits(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(BallFits)))


def radii(sigma_px: float) -> tuple[float, float]:
    """Return the smallest and the largest radius of a fit: less against the blur is any speck, and tables end."""
    return max(RADIUS_PX[0], 0.42 * sigma_px), min(RADIUS_PX[1], 20.0 * sigma_px)


def half_size(radius_px: float, sigma_px: float) -> int:
    """Return the half side of a window that holds a ball and enough background to tell it from its curvature."""
    return int(np.ceil(1.9 * radius_px + 3.0 * sigma_px + 2.0))


def ball_image(film_dx: Float, film_dy: Float, radius_px: Float, optics: Optics) -> Float:
    """Return the blurred opacity (0..1) of balls at these distances from their centres.

    Parameters
    ----------
    film_dx, film_dy : ndarray of shape (n, ...)
        Offsets of the pixels from the centres.
    radius_px : ndarray of shape (n,)
    optics : Optics

    Returns
    -------
    ndarray of shape (n, ...)
    """
    return ball_table(optics).evaluate(np.hypot(film_dx, film_dy) / optics.sigma_px, radius_px / optics.sigma_px)[0]


def fit_balls(
    patches: Patches,
    start_px: Float,
    start_radius_px: Float,
    halves: Int,
    optics: Optics,
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
        Of a size that holds all windows.
    start_px : ndarray of shape (n, 2)
        (col, row) on the film.
    start_radius_px : ndarray of shape (n,)
    halves : ndarray of int, shape (n,)
        Half sides of the windows.
    optics : Optics
        Of the film at hand.
    noise : NoiseModel
    extra : ndarray of shape (n, s, s), optional
        Images of neighbours, in film values, to be subtracted first.
    quick : bool
        For a first look: a third of the steps at most, and covariances as if the noise were white.
    sparse : bool
        For a first look at much that is nothing: of large windows only every second to fourth pixel either way.

    Returns
    -------
    BallFits
    """
    sigma_px = optics.sigma_px
    stride = max(patches.size // _SPARSE_PX, 1) if sparse else 1
    n, size = len(start_px), patches.size
    half = size // 2
    table = ball_table(optics)
    pixels = pixels_of(size, stride)
    values = patches.values.reshape(n, -1)
    level = values.mean(1)[:, None]
    beside = level if extra is None else level + extra.reshape(n, -1).take(pixels.place, axis=1)
    # single precision does once the level is off; what is summed up is summed up in double
    data = (values.take(pixels.place, axis=1) - beside).astype(np.float32)
    own = pixels.side <= halves[:, None]
    valid = (patches.valid.reshape(n, -1).take(pixels.place, axis=1) & own).astype(np.float32)
    local = start_px - patches.corner_px
    low, largest = radii(sigma_px)
    high = np.minimum(largest, halves - sigma_px)
    radius = np.clip(start_radius_px, low, high)
    depth = np.zeros(n)
    converged = np.zeros(n, bool)

    looked_at, beyond_rim = (values.take(pixels.place, axis=1), valid > 0), own & (pixels.distance > (radius + sigma_px)[:, None])
    known, expected = depths_cut_off(*looked_at, pixels.distance < radius[:, None], noise)
    even, hidden = grounds_cut_off(*looked_at, beyond_rim, noise)

    def images(of: Any) -> Float:
        far = np.hypot(*(local[of] - half).T) + radius[of] + _FADED * sigma_px
        reached = int(np.searchsorted(pixels.distance, far.max()))
        dx, dy = (axis[:reached] - at[:, None] for axis, at in zip((pixels.cols, pixels.rows), local[of].T.astype(np.float32), strict=True))
        value, *by = slopes(table, dx, dy, radius[of], sigma_px)
        return np.stack([*by, value], axis=1)

    equations = weighted(pixels, data, valid / noise.variance_at(level).astype(np.float32), even)
    busy: Any = slice(None)
    reweighted = _REWEIGHTED[:1] if quick else _REWEIGHTED
    for step in range(_QUICK_STEPS if quick else _STEPS):
        seen = images(busy)
        if step in reweighted:  # the variance follows the expected value once the model is near
            model = equations.model(seen, depth) + beside
            equations = weighted(pixels, data, valid / noise.variance_at(model).astype(np.float32), even)
        normal, right, _ = equations.normal(seen, busy, damping=1e-6)
        normal[:, 3, 3] += known[busy]
        right[:, 3] += (known * expected)[busy]
        if step == 0:  # depth and background at the starting centre first: Gauss-Newton on the centre needs a depth
            depth = right[:, 3] / normal[:, 3, 3]
        by = _by_depth(depth[busy])
        delta = np.linalg.solve(normal, right[:, :, None] - normal[:, :, 3:] * depth[busy, None, None])[:, :, 0] / by
        scale = np.minimum(1.0, _MAX_STEP_PX / np.maximum(np.abs(delta[:, :3]).max(1), 1e-12))[:, None]
        local[busy] = np.clip(local[busy] + scale * delta[:, :2], 1.0, size - 2.0)
        radius[busy] = np.clip(radius[busy] + (scale * delta[:, 2:3])[:, 0], low, high[busy])
        depth[busy] += (scale * delta[:, 3:])[:, 0]
        converged[busy] = np.abs(delta[:, :2]).max(1) < _CONVERGED_PX * 10
        moving = (np.abs(delta[:, :3]) >= (_NEAR_PX if quick else _CONVERGED_PX)).any(1)
        if step >= reweighted[-1]:
            busy = np.arange(n)[busy][moving]
            if len(busy) == 0:
                break
    seen = images(slice(None))
    normal, right, taken = equations.normal(seen, slice(None))
    normal[:, 3, 3] += known
    right[:, 3] += known * expected
    depth = right[:, 3] / normal[:, 3, 3]
    weight, reached = equations.weight, seen.shape[2]
    residual = data - equations.model(seen, depth)
    by = _by_depth(depth)
    whole = invert(normal) / by[:, :, None]
    covariance = whole / by[:, None]
    variance = 1 / normal[:, 3, 3] / stride**2
    core = _distance(pixels.cols[:reached] - local[:, :1], pixels.rows[:reached] - local[:, 1:]) < (radius + sigma_px)[:, None]
    core &= own[:, :reached]
    square = weight * residual**2
    counted = (core * valid[:, :reached]).sum(1)
    core_n = np.maximum(counted, 1.0)
    left, total = (s.sum(1, dtype=np.float64) for s in (square[:, :reached] * core, square))
    without = residual[:, :reached] + depth[:, None].astype(np.float32) * seen[:, 3]
    raised = (weight[:, :reached] * without**2 * core).sum(1, dtype=np.float64)
    chi2_ring = chi2_uneven = (total - left) / np.maximum(valid.sum(1) - counted - 10, 1.0)
    if not quick:
        of_all = np.concatenate([whole, np.pad(1 / normal[:, 3:, 3:], ((0, 0), (0, 0), (3, 0)))], axis=1)
        influence = np.matmul(of_all, -np.matmul(taken, pixels.surface.T))
        influence[:, :, :reached] += np.matmul(of_all, seen)
        influence *= np.sqrt(weight)[:, None]
        scatter = influence_covariance(influence.take(pixels.back, axis=2).reshape(n, 5, size, size), noise.correlation)
        covariance, variance = scatter[:, :4, :4], scatter[:, 4, 4]
        under = np.pad(core, ((0, 0), (0, size * size - reached))).take(pixels.back, axis=1)
        all_left, all_weight = residual.take(pixels.back, axis=1), weight.take(pixels.back, axis=1)
        chi2_ring = uneven(all_left, all_weight, local, size, ~under)
        chi2_uneven = uneven_white(all_left, all_weight, local, size, under, noise)
    # noise alone, which significance is against, is that of the background where there is more under a ball
    background = equations.background(seen, depth)[:, 0] + level[:, 0]
    told = np.square(seen[:, 3])
    alone = (told * valid[:, :reached]).sum(1) / noise.variance_at(background) / np.maximum((told * weight[:, :reached]).sum(1), 1e-30)
    return BallFits(
        position_px=local + patches.corner_px,
        radius_px=radius,
        depth=depth,
        covariance=covariance,
        chi2_core=left / core_n,
        chi2_ring=chi2_ring,
        chi2_uneven=chi2_uneven,
        explained=np.where(raised > 0, 1.0 - left / np.maximum(raised, 1e-12), 0.0),
        valid_fraction=counted / np.maximum(core.sum(1), 1),
        window_fraction=valid.sum(1, dtype=np.float64) / own.sum(1),
        log_likelihood=-0.5 * total,
        background=background,
        significance=np.abs(depth) / np.sqrt(np.maximum(variance / np.maximum(alone, 1.0), 1e-30)),
        n_core=core_n,
        converged=converged,
        hidden=hidden,
    )


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
    opposite = mirrored(local, size)
    pairs = core & (weight > 0) & (np.take_along_axis(weight, opposite, 1) > 0)
    odd = residual - np.take_along_axis(residual, opposite, 1)
    out: Float = (0.5 * pairs * weight * odd**2).sum(1) / np.maximum(pairs.sum(1) - 4, 1.0)
    return out


def mirrored(local: Float, size: int) -> Int:
    """Return the index of the pixel opposite to each about a centre, shape (n, size * size)."""
    twice = np.rint(2 * local).astype(np.intp)
    axis = np.arange(size)
    cols, rows = np.clip(twice[:, :1] - axis, 0, size - 1), np.clip(twice[:, 1:] - axis, 0, size - 1)
    return np.asarray((rows[:, :, None] * size + cols[:, None, :]).reshape(len(local), size * size))


def uneven_white(residual: Float, weight: Float, local: Float, size: int, core: Bool, noise: NoiseModel) -> Float:
    """Return the same of residuals whose noise is made white first, as fits of centres weigh them."""
    white = whiten_rows(residual * np.sqrt(weight), size, noise)
    return uneven(white, (weight > 0).astype(np.float64), local, size, core)


def _distance(dx: Float, dy: Float) -> Float:
    return np.asarray(np.sqrt(dx * dx + dy * dy))  # a fifth of the time of hypot, which minds overflow


def slopes(table: BallTable, dx: Float, dy: Float, radius: Float, sigma_px: float) -> tuple[Float, Float, Float, Float]:
    """Return the images of balls and their derivatives.

    Parameters
    ----------
    table : BallTable
    dx, dy : ndarray of shape (n, p)
        Pixels from the centres; their kind is that of the result.
    radius : ndarray of shape (n,)
    sigma_px : float

    Returns
    -------
    value, by_dx, by_dy, by_radius : ndarrays of shape (n, p)
    """
    kind = dx.dtype.type
    rho = _distance(dx, dy)
    value, slope, slope_r = table.evaluate(rho / kind(sigma_px), radius / sigma_px)
    slope /= kind(sigma_px) * np.maximum(rho, kind(1e-9))
    return value, slope * dx, slope * dy, slope_r / kind(sigma_px)


def derivatives(radius: Float, half: int, optics: Optics) -> Float:
    """Return what windows of ``2 half + 1`` pixels around balls of depth one say of them.

    Parameters
    ----------
    radius : ndarray of shape (n,)
    half : int
    optics : Optics

    Returns
    -------
    ndarray of shape (n, 10, pixels)
        By dx, dy (minus those by the centre) and radius, the images themselves, and the background's six coefficients.
    """
    rows, cols = (
        np.repeat(axis.reshape(1, -1), len(radius), 0) for axis in np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    )
    value, *by = slopes(ball_table(optics), cols, rows, radius, optics.sigma_px)
    surface = polynomial(half, cols[0], rows[0]).T
    return np.concatenate([np.stack([*by, value], axis=1), np.broadcast_to(surface, (len(radius), *surface.shape))], axis=1)


def _by_depth(depth: Float) -> Float:
    """What the derivatives of balls of depth one are to be multiplied by, shape (n, 4)."""
    depth = np.where(depth == 0, 1e-30, depth)
    return np.asarray(depth[:, None] * [-1.0, -1.0, 1.0, 0.0] + [0.0, 0.0, 0.0, 1.0])
