"""Balls whose images touch: one fit for all of them, so that their errors stay honest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.balls import RADIUS_PX, BallFits, half_size, polynomial, uneven
from rsa_vision.detect.lapping import LEAST, lapping, product_image
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import columns, cut, weighted_least_squares
from rsa_vision.detect.profiles import ball_table
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
        The background also holds an edge: any profile across the direction in which the window changes most (:func:`edge_profile`).

    Returns
    -------
    BallFits
        One row a ball; figures of merit are taken under the ball, with all balls modelled.
    """
    k = len(start_px)
    middle = start_px.mean(0)
    spread = float(np.abs(start_px - middle).max())
    half = half_size(float(start_radius_px.max()), sigma_px) + int(np.ceil(spread))
    patch = cut(film, middle[None], half, noise)
    corner = patch.corner_px[0].astype(np.float64)
    rows, cols = np.mgrid[0 : patch.size, 0 : patch.size].reshape(2, -1).astype(np.float64)
    valid = patch.valid[0].ravel().astype(np.float64)
    raw = patch.values[0].ravel()
    neighbours = np.zeros_like(raw) if others is None else others(cols + corner[0], rows + corner[1])
    data = raw - neighbours
    local, radius = start_px - corner, np.clip(start_radius_px, RADIUS_PX[0], RADIUS_PX[1]).astype(np.float64)
    low, high = max(RADIUS_PX[0], 0.42 * sigma_px), min(RADIUS_PX[1], 20 * sigma_px)
    surface = polynomial(half, cols - half, rows - half)
    table = ball_table(round(mu_px * sigma_px, 3))
    weight = valid / noise.variance_at(raw)

    def model() -> tuple[Float, Float, Float, Float]:
        dx, dy = cols - local[:, :1], rows - local[:, 1:]
        rho = np.hypot(dx, dy)
        value, slope, slope_r = table.evaluate(rho / sigma_px, radius / sigma_px)
        slope = slope / (sigma_px * np.maximum(rho, 1e-9))
        return value, -slope * dx, -slope * dy, slope_r / sigma_px

    def linear_part(value: Float) -> tuple[Float, list[tuple[int, int]], list[Float]]:
        # two exposures on one film add up, and a film curve bends the sum: how much of the product of two images is there, the film tells
        pairs: list[tuple[int, int]] = []
        products: list[Float] = []
        slopes: list[Float] = []
        for pair in lapping(local, radius):
            product, by = product_image(local[list(pair)], radius[list(pair)], sigma_px, mu_px, patch.size)
            if product.max() > LEAST:
                pairs, products, slopes = [*pairs, pair], [*products, product[None]], [*slopes, by]
        return columns([value, surface.T, *products]), pairs, slopes

    value, d_col, d_row, d_radius = model()
    linear, pairs, slopes = linear_part(value)
    theta = weighted_least_squares(linear, weight, data, 1e-6)
    if edge:
        bare = (data - value.T @ theta[:k]).reshape(patch.size, patch.size)
        surface = np.column_stack([surface, edge_profile(bare, valid.reshape(bare.shape), sigma_px)])
        linear, pairs, slopes = linear_part(value)
        theta = weighted_least_squares(linear, weight, data, 1e-6)
    converged = False
    for step in range(_STEPS + 1):
        depth = theta[:k, None]
        by_shape = depth * np.stack([d_col, d_row, d_radius])
        for of_product, pair, by in zip(theta[linear.shape[1] - len(pairs) :], pairs, slopes, strict=True):
            by_shape[:, list(pair)] += of_product * by.transpose(1, 0, 2)
        jac = columns([by_shape.reshape(3 * k, -1), linear.T])
        residual = data - linear @ theta
        if step == _STEPS or converged:
            break
        if step in (4, 10):
            weight = valid / noise.variance_at(linear @ theta + neighbours)
        delta = weighted_least_squares(jac, weight, residual, 1e-3 if step < 6 else 1e-7)
        move = delta[: 3 * k].reshape(3, k)
        scale = min(1.0, 0.5 / max(float(np.abs(move).max()), 1e-9))
        local = local + scale * move[:2].T
        radius = np.clip(radius + scale * move[2], low, high)
        converged = step > 2 and float(np.abs(move).max()) < _CONVERGED_PX
        value, d_col, d_row, d_radius = model()
        linear, pairs, slopes = linear_part(value)
        theta = weighted_least_squares(linear, weight, data, 1e-9)
    covariance = np.linalg.pinv((jac * weight[:, None]).T @ jac, hermitian=True)
    influence = (covariance[: 4 * k] @ (jac * np.sqrt(weight)[:, None]).T).reshape(4 * k, patch.size, patch.size)
    whole = influence_covariance(influence, noise.correlation)
    distance = np.hypot(cols - local[:, :1], rows - local[:, 1:])
    core = distance < (radius + sigma_px)[:, None]
    square = weight * residual**2
    ring = valid * ~core.any(0)
    inside = np.maximum((core * valid).sum(1), 1.0)
    raised = weight * (residual + theta[:k, None] * value) ** 2
    own = [[i, k + i, 2 * k + i, 3 * k + i] for i in range(k)]
    return BallFits(
        position_px=local + corner,
        radius_px=radius,
        depth=theta[:k],
        covariance=np.stack([whole[np.ix_(index, index)] for index in own]),
        chi2_core=(square * core).sum(1) / inside,
        chi2_ring=uneven(
            np.broadcast_to(residual, distance.shape), np.broadcast_to(weight * ring, distance.shape), local, patch.size, ~core
        ),
        chi2_uneven=uneven(np.broadcast_to(residual, distance.shape), np.broadcast_to(weight, distance.shape), local, patch.size, core),
        explained=1 - (square * core).sum(1) / np.maximum((raised * core).sum(1), 1e-12),
        valid_fraction=(core * valid).sum(1) / np.maximum(core.sum(1), 1),
        window_fraction=np.full(k, valid.mean()),
        log_likelihood=np.full(k, -0.5 * square.sum()),
        background=np.full(k, theta[k]),
        converged=np.full(k, converged),
    )


def edge_profile(bare: Float, valid: Float, sigma_px: float) -> Float:
    """Return functions that together make any smooth profile across the strongest edge of a window.

    The edge of a bone or an implant is straight over the width of a ball: it changes across, not along. A ball changes both ways, so its
    centre stays determined, if less well across the edge; the covariance knows.

    Parameters
    ----------
    bare : ndarray of shape (s, s)
        The window without its balls.
    valid : ndarray of shape (s, s)
        1, or 0 where masked.
    sigma_px : float
        Blur of the film: nothing changes faster.

    Returns
    -------
    ndarray of shape (s * s, p)
        Cubic B-splines of the coordinate across the edge.
    """
    weight = gaussian_filter(valid, 1.0)
    smooth = gaussian_filter(bare * valid, 1.0) / np.maximum(weight, 1e-6)
    by_row, by_col = np.gradient(smooth)
    inside = valid * (weight > 0.9)
    tensor = np.array([[(inside * a * b).sum() for b in (by_col, by_row)] for a in (by_col, by_row)])
    across = np.linalg.eigh(tensor)[1][:, 1]
    rows, cols = np.mgrid[0 : len(bare), 0 : len(bare)] - (len(bare) - 1) / 2
    t = (cols * across[0] + rows * across[1]).ravel()
    step = max(KNOTS * sigma_px, (t.max() - t.min()) / 14)
    distance = np.abs(t[:, None] - np.arange(t.min(), t.max() + step, step)) / step
    near, far = 2 / 3 - distance**2 + distance**3 / 2, np.maximum(2 - distance, 0) ** 3 / 6
    splines: Float = np.where(distance < 1, near, far)
    return splines
