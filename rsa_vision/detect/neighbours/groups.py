"""Balls whose images touch: one fit for all of them, so that their errors stay honest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import BallFits, radii, uneven, uneven_white
from rsa_vision.detect.balls.focal_spot import Spot
from rsa_vision.detect.film.least_squares import columns, damped_solution, invert, weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.progress import WEIGHED, in_vain
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.group_images import GroupImages, GroupWindow, images_in, window_around
from rsa_vision.types import Float

STEPS = 25
_CONVERGED_PX = 1e-3
_MOST_PX, _LAST_PX = 0.5, 1.0  # of a step; of the last one, which is not held near: from farther off no straight line leads there
_MOST_RADII = 0.12  # of a step, of large balls
_ARRIVED = 12  # steps after which what still takes the longest ones is lost
_STILL_PX = 0.05  # what hardly goes any farther where steps are in vain is there
_REWEIGHTED = (4, 10)  # steps at which the variance is taken where the model is by then
_LOOKED_AGAIN = (2, 5, 9)  # steps after which an edge is seen more clearly


def fit_group(
    film: NDArray[Any],
    start_px: Float,
    start_radius_px: Float,
    optics: Optics,
    noise: NoiseModel,
    others: Images | None = None,
    *,
    edge: bool = False,
    taken: bool = False,
    bent: bool = False,
    blurrier: float = 0.0,
    spot: Spot | None = None,
    steps: int = STEPS,
    images: Callable[[GroupWindow, Float, Float, Float], GroupImages] | None = None,
) -> BallFits:
    """Fit several balls in one window on one background.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    start_px : ndarray of shape (k, 2)
        (col, row).
    start_radius_px : ndarray of shape (k,)
    optics : Optics
    noise : NoiseModel
    others : callable, optional
        ``others(cols, rows)``: images of neighbours outside the group, subtracted first.
    edge : bool
        The background also holds an edge: any profile across the direction in which the window changes most (:func:`edge_profile`).
    taken : bool
        Balls take away their part of it.
    bent : bool
        It may be curved.
    blurrier : float
        Logarithm of the blur of these balls over the film's, in the same window.
    spot : Spot, optional
        That draws them, if it is no Gaussian; they do not lap, then.
    steps : int
        At the most.
    images : callable, optional
        ``images(window, surface, local, radius)``: what draws them instead, on a background without an edge.

    Returns
    -------
    BallFits
        One row a ball; figures of merit are taken under the ball, with all balls modelled. Nothing is seen of one that got lost
        (``valid_fraction`` 0).
    """
    k = len(start_px)
    window = window_around(film, start_px, start_radius_px, optics.sigma_px, noise, others)
    size, cols, rows, valid, data = window.size, window.cols, window.rows, window.valid, window.raw - window.neighbours
    optics = replace(optics, sigma_px=optics.sigma_px * float(np.exp(blurrier)))
    sigma_px = optics.sigma_px
    low, high = radii(sigma_px)
    local, radius = start_px - window.corner_px, np.clip(start_radius_px, low, high).astype(np.float64)
    surface = window.surface
    weight = valid / noise.variance_at(window.raw)
    ground: Float | None = None

    def draw(local: Float, radius: Float) -> GroupImages:
        if images:
            return images(window, surface, local, radius)
        return images_in(window, surface, local, radius, optics, ground, spot)

    seen = draw(local, radius)
    theta = weighted_least_squares(seen.linear, weight, data, 1e-6)
    if edge:
        surface = columns([surface.T, window.edge(data - seen.value.T @ theta[:k], sigma_px)])
        seen = draw(local, radius)
        theta = weighted_least_squares(seen.linear, weight, data, 1e-6)
    converged, lost, before = False, np.zeros(k, bool), np.zeros((3, k))
    left, ends = list[float](), False
    most = max(_MOST_PX, _MOST_RADII * float(radius.min()))
    for step in range(steps + 1):
        value, linear, jac = seen.value, seen.linear, seen.jacobian(theta)
        residual = data - linear @ theta
        if step == steps or converged or ends:
            break
        if step in _REWEIGHTED:
            weight = valid / noise.variance_at(linear @ theta + window.neighbours)
            left.clear()  # of other weights
        if step > WEIGHED and k > 1 and not edge:  # what is compared with a fit beside an edge is to get there
            left.append(float(weight @ residual**2))
        vain = in_vain(left, float(valid.sum()))
        delta = weighted_least_squares(jac, weight, residual, 1e-3 if step < 6 else 1e-7)
        move = delta[: 3 * k].reshape(3, k)
        farthest = float(np.abs(move).max())
        scale = min(1.0, most / max(farthest, 1e-9))
        if (move * before).sum() < 0:  # too far: without this faint pairs go to and fro for ever
            scale *= 0.5
        before = move
        local = local + scale * move[:2].T
        radius = np.clip(radius + scale * move[2], low, high)
        converged = step > 2 and farthest < (_STILL_PX if vain else _CONVERGED_PX)
        lost = (np.abs(move).max(axis=0) > most) & (vain or step >= _ARRIVED)
        ends = vain or bool(lost.any())
        if edge:
            if taken:
                ground = _under(seen.value, surface @ theta[k : k + surface.shape[1]])
            if step in _LOOKED_AGAIN:
                bare = data - seen.linear[:, :k] @ theta[:k] - seen.of_ground(theta)
                surface = columns([window.surface.T, window.edge(bare, sigma_px, bent=bent)])
        seen = draw(local, radius)
        theta = weighted_least_squares(seen.linear, weight, data, 1e-9)
    root = np.sqrt(weight)[:, None]
    estimator = _estimator(jac * root, size, noise)[: 4 * k]
    last = (estimator @ (residual * root[:, 0])).reshape(4, k)
    last *= min(1.0, _LAST_PX / max(float(np.abs(last[:3]).max()), 1e-9))
    influence = np.concatenate([estimator, _estimator(linear * root, size, noise)[:k]]).reshape(5 * k, size, size)
    whole = influence_covariance(influence, noise.correlation)
    distance = np.hypot(cols - local[:, :1], rows - local[:, 1:])
    core = distance < (radius + sigma_px + (spot.reach_px if spot else 0.0))[:, None]
    square = weight * residual**2
    ring = valid * ~core.any(0)
    inside = np.maximum((core * valid).sum(1), 1.0)
    of_all = np.broadcast_to(residual, distance.shape)
    raised = weight * (residual + theta[:k, None] * value) ** 2
    own = [[i, k + i, 2 * k + i, 3 * k + i] for i in range(k)]
    return BallFits(
        position_px=local + last[:2].T + window.corner_px,
        radius_px=np.clip(radius + last[2], low, high),
        depth=theta[:k] + last[3],
        covariance=np.stack([whole[np.ix_(index, index)] for index in own]),
        chi2_core=(square * core).sum(1) / inside,
        chi2_ring=uneven(of_all, np.broadcast_to(weight * ring, of_all.shape), local, size, ~core),
        chi2_uneven=uneven_white(of_all, np.broadcast_to(weight, of_all.shape), local, size, core, noise),
        explained=1 - (square * core).sum(1) / np.maximum((raised * core).sum(1), 1e-12),
        valid_fraction=np.where(lost, 0.0, (core * valid).sum(1) / np.maximum(core.sum(1), 1)),
        window_fraction=np.full(k, valid.mean()),
        log_likelihood=np.full(k, -0.5 * square.sum()),
        background=(surface @ theta[k : k + surface.shape[1]])[distance.argmin(1)],
        significance=np.abs(theta[:k]) / np.sqrt(np.maximum(np.diag(whole)[4 * k :], 1e-30)),
        n_core=inside,
        converged=np.full(k, converged),
        hidden=np.zeros(k, np.int64),
    )


def _under(value: Float, background: Float) -> Float:
    """Return by how much the background differs from its mean under each ball, at most by one; shape (k, n)."""
    mean = (value @ background) / np.maximum(value.sum(axis=1), 1e-9)
    apart = background - mean[:, None]
    return np.asarray(apart / max(float(np.abs(apart).max()), 1e-9))


def _estimator(weighted: Float, size: int, noise: NoiseModel) -> Float:
    """Linear estimator (p, n) of the parameters whose derivatives are (n, p), in units of the noise as the values are."""
    white = whiten_rows(weighted.T, size, noise)
    return whiten_rows(invert((white @ white.T)[None])[0] @ white, size, noise)


def edge_gain(
    film: NDArray[Any],
    fits: BallFits,
    optics: Optics,
    noise: NoiseModel,
    others: Images | None,
    spot: Spot | None,
) -> float:
    """Return twice the log-likelihood that an edge in the background would gain, to first order (the score test of Rao, 1948).

    No fit is needed for it: what is left of the window by balls that were fitted without an edge says how far one more step would get with
    an edge and without.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        One group, as fitted without an edge.
    optics : Optics
    noise : NoiseModel
    others : callable, optional
    spot : Spot, optional
        As of :func:`fit_group`.

    Returns
    -------
    float
        As if the noise were white.
    """
    window = window_around(film, fits.position_px, fits.radius_px, optics.sigma_px, noise, others)
    weight = window.valid / noise.variance_at(window.raw)
    data = window.raw - window.neighbours
    images = images_in(window, window.surface, fits.position_px - window.corner_px, fits.radius_px, optics, spot=spot)
    theta = weighted_least_squares(images.linear, weight, data)
    edge = window.edge(data - images.value.T @ theta[: len(fits.depth)], optics.sigma_px)
    residual, jac = data - images.linear @ theta, columns([images.jacobian(theta).T, edge])
    weighted = jac * np.sqrt(weight)[:, None]
    normal, right = weighted.T @ weighted, jac.T @ (weight * residual)
    plain = slice(jac.shape[1] - len(edge))
    with_edge, without = (right[part] @ damped_solution(normal[part, part], right[part], 1e-9) for part in (slice(None), plain))
    return float(with_edge - without)
