"""Balls whose images touch: one fit for all of them, so that their errors stay honest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.balls import RADIUS_PX, BallFits, half_size, invert, polynomial, slopes, uneven
from rsa_vision.detect.lapping import LEAST, lapping, product_image
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import columns, cut, weighted_least_squares
from rsa_vision.detect.profiles import Optics, ball_table
from rsa_vision.types import Float

_STEPS = 25
_CONVERGED_PX = 1e-3
KNOTS = 1.5  # blur widths between the knots of a profile across an edge


def fit_group(
    film: NDArray[Any],
    start_px: Float,
    start_radius_px: Float,
    sigma_px: float,
    mu_px: float,
    noise: NoiseModel,
    others: Any = None,
    *,
    edge: bool = False,
) -> BallFits:
    """Fit several balls in one window on one background.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    start_px : ndarray of shape (k, 2)
        (col, row).
    start_radius_px : ndarray of shape (k,)
    sigma_px, mu_px : float
    noise : NoiseModel
    others : callable, optional
        ``others(cols, rows)``: images of neighbours outside the group, subtracted first.
    edge : bool
        The background also holds an edge: any profile across the direction in which the window changes most (:func:`edge_profiles`).

    Returns
    -------
    BallFits
        One row a ball; figures of merit are taken under the ball, with all balls modelled.
    """
    k = len(start_px)
    window = _window(film, start_px, start_radius_px, sigma_px, noise, others)
    size, cols, rows, valid, data = window.size, window.cols, window.rows, window.valid, window.raw - window.neighbours
    local, radius = start_px - window.corner_px, np.clip(start_radius_px, RADIUS_PX[0], RADIUS_PX[1]).astype(np.float64)
    low, high = max(RADIUS_PX[0], 0.42 * sigma_px), min(RADIUS_PX[1], 20 * sigma_px)
    surface = window.surface
    weight = valid / noise.variance_at(window.raw)
    images = _images(window, surface, local, radius, sigma_px, mu_px)
    theta = weighted_least_squares(images.linear, weight, data, 1e-6)
    if edge:
        bare = data - images.value.T @ theta[:k]
        surface = np.column_stack([surface, edge_profiles(bare[None], valid[None], sigma_px)[0].T])
        images = _images(window, surface, local, radius, sigma_px, mu_px)
        theta = weighted_least_squares(images.linear, weight, data, 1e-6)
    converged = False
    for step in range(_STEPS + 1):
        value, linear, jac = images.value, images.linear, images.jacobian(theta)
        residual = data - linear @ theta
        if step == _STEPS or converged:
            break
        if step in (4, 10):
            weight = valid / noise.variance_at(linear @ theta + window.neighbours)
        delta = weighted_least_squares(jac, weight, residual, 1e-3 if step < 6 else 1e-7)
        move = delta[: 3 * k].reshape(3, k)
        scale = min(1.0, 0.5 / max(float(np.abs(move).max()), 1e-9))
        local = local + scale * move[:2].T
        radius = np.clip(radius + scale * move[2], low, high)
        converged = step > 2 and float(np.abs(move).max()) < _CONVERGED_PX
        images = _images(window, surface, local, radius, sigma_px, mu_px)
        theta = weighted_least_squares(images.linear, weight, data, 1e-9)
    root = np.sqrt(weight)[:, None]
    influence = np.concatenate([_estimator(jac * root)[: 4 * k], _estimator(linear * root)[:k]]).reshape(5 * k, size, size)
    whole = influence_covariance(influence, noise.correlation)
    distance = np.hypot(cols - local[:, :1], rows - local[:, 1:])
    core = distance < (radius + sigma_px)[:, None]
    square = weight * residual**2
    ring = valid * ~core.any(0)
    inside = np.maximum((core * valid).sum(1), 1.0)
    raised = weight * (residual + theta[:k, None] * value) ** 2
    own = [[i, k + i, 2 * k + i, 3 * k + i] for i in range(k)]
    return BallFits(
        position_px=local + window.corner_px,
        radius_px=radius,
        depth=theta[:k],
        covariance=np.stack([whole[np.ix_(index, index)] for index in own]),
        chi2_core=(square * core).sum(1) / inside,
        chi2_ring=uneven(np.broadcast_to(residual, distance.shape), np.broadcast_to(weight * ring, distance.shape), local, size, ~core),
        chi2_uneven=uneven(np.broadcast_to(residual, distance.shape), np.broadcast_to(weight, distance.shape), local, size, core),
        explained=1 - (square * core).sum(1) / np.maximum((raised * core).sum(1), 1e-12),
        valid_fraction=(core * valid).sum(1) / np.maximum(core.sum(1), 1),
        window_fraction=np.full(k, valid.mean()),
        log_likelihood=np.full(k, -0.5 * square.sum()),
        background=np.full(k, theta[k]),
        significance=np.abs(theta[:k]) / np.sqrt(np.maximum(np.diag(whole)[4 * k :], 1e-30)),
        n_core=inside,
        converged=np.full(k, converged),
    )


def _estimator(weighted: Float) -> Float:
    """Linear estimator (p, n) of the parameters whose weighted derivatives are (n, p)."""
    return np.asarray(invert((weighted.T @ weighted)[None])[0] @ weighted.T)


def edge_gain(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel, others: Any) -> Float:
    """Return twice the log-likelihoods that edges in the background would gain, to first order (the score test of Rao, 1948).

    No fit is needed for it: what is left of a window by a ball that was fitted without an edge says how far one more step would get with
    an edge and without. Neighbours are held as they are.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        As fitted without an edge.
    optics : Optics
    noise : NoiseModel
    others : callable
        ``others(i, cols, rows)``: images of the neighbours of ball ``i``.

    Returns
    -------
    ndarray of shape (n,)
        As if the noise were white.
    """
    out = np.zeros(len(fits.depth))
    halves = np.array([half_size(r, optics.sigma_px) for r in fits.radius_px])
    for half in np.unique(halves):
        index = np.flatnonzero(halves == half)
        patches = cut(film, fits.position_px[index], int(half), noise)
        grid = np.mgrid[0 : patches.size, 0 : patches.size].reshape(2, -1).astype(np.float64)
        cols, rows = (grid[::-1, None] + patches.corner_px.T[:, :, None]).astype(np.float64)
        raw, valid = (a.reshape(len(index), -1) for a in (patches.values, patches.valid.astype(np.float64)))
        weight = valid / noise.variance_at(raw)
        dx, dy = cols - fits.position_px[index, :1], rows - fits.position_px[index, 1:]
        table = ball_table(round(optics.mu_px * optics.sigma_px, 3))
        own = np.stack(slopes(table, dx, dy, fits.radius_px[index], optics.sigma_px), axis=1)
        surface = polynomial(half, grid[1] - half, grid[0] - half).T
        own = np.concatenate([own, np.broadcast_to(surface, (len(index), *surface.shape))], axis=1)
        data = raw - np.stack([others(i, *at) for i, *at in zip(index, cols, rows, strict=True)])
        fixed = np.delete(own, (1, 2, 3), axis=1)
        theta = _least_squares(fixed, weight, data)[:, :, None]
        edge = edge_profiles(data - theta[:, 0] * own[:, 0], valid, optics.sigma_px)
        residual = data - (theta * fixed).sum(1)
        each = np.concatenate([own, edge], axis=1)
        explained = [np.einsum("np,nk,nkp->n", weight * residual, _least_squares(j, weight, residual), j) for j in (each, own)]
        out[index] = explained[0] - explained[1]
    return out


def _least_squares(jac: Float, weight: Float, target: Float) -> Float:
    """Solutions (n, k) of weighted least squares with derivatives (n, k, p)."""
    weighted = jac * weight[:, None]
    return np.matmul(invert(np.matmul(weighted, jac.transpose(0, 2, 1))), np.matmul(weighted, target[:, :, None]))[:, :, 0]


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The pixels around a group, in one row each: (n,) unless said otherwise."""

    size: int
    corner_px: Float  # (col, row) on the film
    cols: Float  # in the window, as rows
    rows: Float
    raw: Float
    neighbours: Float
    valid: Float
    surface: Float  # (n, 6)


def _window(film: NDArray[Any], at_px: Float, radius_px: Float, sigma_px: float, noise: NoiseModel, others: Any) -> _Window:
    middle = at_px.mean(0)
    half = half_size(float(radius_px.max()), sigma_px) + int(np.ceil(float(np.abs(at_px - middle).max())))
    patch = cut(film, middle[None], half, noise)
    corner = patch.corner_px[0].astype(np.float64)
    rows, cols = np.mgrid[0 : patch.size, 0 : patch.size].reshape(2, -1).astype(np.float64)
    raw = patch.values[0].ravel()
    neighbours = np.zeros_like(raw) if others is None else others(cols + corner[0], rows + corner[1])
    valid = patch.valid[0].ravel().astype(np.float64)
    return _Window(patch.size, corner, cols, rows, raw, neighbours, valid, polynomial(half, cols - half, rows - half))


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """What balls at given places look like in a window, with all that enters it linearly."""

    value: Float  # (k, n)
    slopes: Float  # (3, k, n), of each ball by its col, row and radius
    linear: Float  # (n, p): balls, background, products of two
    pairs: list[tuple[int, int]]
    of_pairs: list[Float]  # slopes of the products

    def jacobian(self, theta: Float) -> Float:
        """Return the derivatives by all cols, rows and radii, then by the linear parameters; shape (n, 3 k + p)."""
        k = len(self.value)
        by_shape = theta[:k, None] * self.slopes
        for of_product, pair, by in zip(theta[len(theta) - len(self.pairs) :], self.pairs, self.of_pairs, strict=True):
            by_shape[:, list(pair)] += of_product * by.transpose(1, 0, 2)
        return columns([by_shape.reshape(3 * k, -1), self.linear.T])


def _images(window: _Window, surface: Float, local: Float, radius: Float, sigma_px: float, mu_px: float) -> _Images:
    dx, dy = window.cols - local[:, :1], window.rows - local[:, 1:]
    rho = np.hypot(dx, dy)
    value, slope, slope_r = ball_table(round(mu_px * sigma_px, 3)).evaluate(rho / sigma_px, radius / sigma_px)
    slope = slope / (sigma_px * np.maximum(rho, 1e-9))
    # two exposures on one film add up, and a film curve bends the sum: how much of the product of two images is there, the film tells
    pairs: list[tuple[int, int]] = []
    products: list[Float] = []
    of_pairs: list[Float] = []
    for pair in lapping(local, radius):
        product, by = product_image(local[list(pair)], radius[list(pair)], sigma_px, mu_px, window.size)
        if product.max() > LEAST:
            pairs, products, of_pairs = [*pairs, pair], [*products, product[None]], [*of_pairs, by]
    linear = columns([value, surface.T, *products])
    return _Images(value, np.stack([-slope * dx, -slope * dy, slope_r / sigma_px]), linear, pairs, of_pairs)


def edge_profiles(bare: Float, valid: Float, sigma_px: float) -> Float:
    """Return functions that together make any smooth profile across the strongest edge of each window.

    The edge of a bone or an implant is straight over the width of a ball: it changes across, not along. A ball changes both ways, so its
    centre stays determined, if less well across the edge; the covariance knows.

    Parameters
    ----------
    bare : ndarray of shape (n, s * s)
        The windows without their balls.
    valid : ndarray of shape (n, s * s)
        1, or 0 where masked.
    sigma_px : float
        Blur of the film: nothing changes faster.

    Returns
    -------
    ndarray of shape (n, k, s * s)
        Cubic B-splines of the coordinate across the edge; 0 where a window needs fewer.
    """
    n, pixels = bare.shape
    size = math.isqrt(pixels)
    bare, valid = bare.reshape(n, size, size), valid.reshape(n, size, size)
    weight = gaussian_filter(valid, (0, 1, 1))
    smooth = gaussian_filter(bare * valid, (0, 1, 1)) / np.maximum(weight, 1e-6)
    by = np.stack(np.gradient(smooth, axis=(2, 1)), axis=1)
    tensor = np.matmul((by * (valid * (weight > 0.9))[:, None]).reshape(n, 2, -1), by.reshape(n, 2, -1).transpose(0, 2, 1))
    across = np.linalg.eigh(tensor)[1][:, :, 1]
    steps = np.arange(size) - (size - 1) / 2
    t = (steps * across[:, :1, None] + (steps * across[:, 1:])[:, :, None]).reshape(n, -1)
    first, span = t.min(1, keepdims=True), np.ptp(t, axis=1, keepdims=True)
    place = (t - first) / np.maximum(KNOTS * sigma_px, span / 14)
    knot = place.astype(np.intp)
    part = place - knot
    # a spline reaches two knots to either side; those centred off the window are left out
    splines = np.zeros((n, int(knot.max()) + 4, pixels))
    of_four = ((1 - part) ** 3 / 6, 2 / 3 - part**2 + part**3 / 2, 2 / 3 - (1 - part) ** 2 + (1 - part) ** 3 / 2, part**3 / 6)
    for k, basis in enumerate(of_four):
        splines[np.arange(n)[:, None], knot + k, np.arange(pixels)] = basis
    needed = np.ceil(place.max(1) - 1e-9).astype(np.intp) + 2
    splines[np.arange(splines.shape[1]) >= needed[:, None]] = 0.0
    return splines[:, 1 : needed.max()]
