"""Balls whose images touch: one fit for all of them, so that their errors stay honest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.equations import invert, polynomial
from rsa_vision.detect.balls.fits import BallFits, half_size, radii, uneven, uneven_white
from rsa_vision.detect.balls.focal_spot import Spot, shapes_of
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import columns, cut, damped_solution, weighted_least_squares
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.edge import edge_profile
from rsa_vision.detect.models.lapping import LEAST, lapping, product_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Float

_STEPS = 25
_CONVERGED_PX = 1e-3
_MOST_PX, _LAST_PX = 0.5, 1.0  # of a step; of the last one, which is not held near: from farther off no straight line leads there
_MOST_RADII = 0.12  # of a step, of large balls
_ARRIVED = 12  # steps after which what still takes the longest ones is lost
_LOOKED_AGAIN = (2, 5, 9)  # steps after which an edge is seen more clearly


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
    taken: bool = False,
    bent: bool = False,
    blurrier: float = 0.0,
    spot: Spot | None = None,
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
    taken : bool
        Balls take away their part of it.
    bent : bool
        It may be curved.
    blurrier : float
        Logarithm of the blur of these balls over the film's, in the same window.
    spot : Spot, optional
        That draws them, if it is no Gaussian; they do not lap, then.

    Returns
    -------
    BallFits
        One row a ball; figures of merit are taken under the ball, with all balls modelled. Nothing is seen of one that got lost
        (``valid_fraction`` 0).
    """
    k = len(start_px)
    window = window_around(film, start_px, start_radius_px, sigma_px, noise, others)
    size, cols, rows, valid, data = window.size, window.cols, window.rows, window.valid, window.raw - window.neighbours
    sigma_px *= float(np.exp(blurrier))
    low, high = radii(sigma_px)
    local, radius = start_px - window.corner_px, np.clip(start_radius_px, low, high).astype(np.float64)
    surface = window.surface
    weight = valid / noise.variance_at(window.raw)
    images = images_in(window, surface, local, radius, sigma_px, mu_px, spot=spot)
    theta = weighted_least_squares(images.linear, weight, data, 1e-6)
    if edge:
        surface = columns([surface.T, window.edge(data - images.value.T @ theta[:k], sigma_px)])
        images = images_in(window, surface, local, radius, sigma_px, mu_px, spot=spot)
        theta = weighted_least_squares(images.linear, weight, data, 1e-6)
    ground: Float | None = None
    converged, lost, before = False, np.zeros(k, bool), np.zeros((3, k))
    most = max(_MOST_PX, _MOST_RADII * float(radius.min()))
    for step in range(_STEPS + 1):
        value, linear, jac = images.value, images.linear, images.jacobian(theta)
        residual = data - linear @ theta
        if step == _STEPS or converged or lost.any():
            break
        if step in (4, 10):
            weight = valid / noise.variance_at(linear @ theta + window.neighbours)
        delta = weighted_least_squares(jac, weight, residual, 1e-3 if step < 6 else 1e-7)
        move = delta[: 3 * k].reshape(3, k)
        farthest = float(np.abs(move).max())
        scale = min(1.0, most / max(farthest, 1e-9))
        if (move * before).sum() < 0:  # too far: without this faint pairs go to and fro for ever
            scale *= 0.5
        before = move
        local = local + scale * move[:2].T
        radius = np.clip(radius + scale * move[2], low, high)
        converged, lost = step > 2 and farthest < _CONVERGED_PX, (np.abs(move).max(axis=0) > most) & (step >= _ARRIVED)
        if edge:
            if taken:
                ground = _under(images.value, surface @ theta[k : k + surface.shape[1]])
            if step in _LOOKED_AGAIN:
                bare = data - images.linear[:, :k] @ theta[:k] - images.of_ground(theta)
                surface = columns([window.surface.T, window.edge(bare, sigma_px, bent=bent)])
        images = images_in(window, surface, local, radius, sigma_px, mu_px, ground, spot)
        theta = weighted_least_squares(images.linear, weight, data, 1e-9)
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
    )


def _estimator(weighted: Float, size: int, noise: NoiseModel) -> Float:
    """Linear estimator (p, n) of the parameters whose derivatives are (n, p), in units of the noise as the values are."""
    white = whiten_rows(weighted.T, size, noise)
    return whiten_rows(invert((white @ white.T)[None])[0] @ white, size, noise)


def edge_gain(
    film: NDArray[Any], fits: BallFits, sigma_px: float, mu_px: float, noise: NoiseModel, others: Any = None, spot: Spot | None = None
) -> float:
    """Return twice the log-likelihood that an edge in the background would gain, to first order (the score test of Rao, 1948).

    No fit is needed for it: what is left of the window by balls that were fitted without an edge says how far one more step would get with
    an edge and without.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        One group, as fitted without an edge.
    sigma_px, mu_px : float
    noise : NoiseModel
    others : callable, optional
    spot : Spot, optional
        As of :func:`fit_group`.

    Returns
    -------
    float
        As if the noise were white.
    """
    window = window_around(film, fits.position_px, fits.radius_px, sigma_px, noise, others)
    weight = window.valid / noise.variance_at(window.raw)
    data = window.raw - window.neighbours
    images = images_in(window, window.surface, fits.position_px - window.corner_px, fits.radius_px, sigma_px, mu_px, spot=spot)
    theta = weighted_least_squares(images.linear, weight, data)
    edge = window.edge(data - images.value.T @ theta[: len(fits.depth)], sigma_px)
    residual, jac = data - images.linear @ theta, columns([images.jacobian(theta).T, edge])
    weighted = jac * np.sqrt(weight)[:, None]
    normal, right = weighted.T @ weighted, jac.T @ (weight * residual)
    plain = slice(jac.shape[1] - len(edge))
    with_edge, without = (right[part] @ damped_solution(normal[part, part], right[part], 1e-9) for part in (slice(None), plain))
    return float(with_edge - without)


@dataclass(frozen=True, slots=True, eq=False)
class GroupWindow:
    """The pixels around a group, in one row each: (n,) unless said otherwise."""

    size: int
    corner_px: Float  # (col, row) on the film
    cols: Float  # in the window, as rows
    rows: Float
    raw: Float
    neighbours: Float
    valid: Float
    surface: Float  # (n, 6)

    def edge(self, bare: Float, sigma_px: float, *, bent: bool = False) -> Float:
        """Return profiles of the edge that the window shows without its marks (n,), shape (p, n)."""
        box = (self.size, self.size)
        return edge_profile(bare.reshape(box), self.valid.reshape(box), sigma_px, bent=bent)

    def left_by(self, basis: Float, noise: NoiseModel) -> tuple[Float, Float]:
        """Return what the best combination of the columns of ``basis`` leaves, and the weights of the pixels."""
        weight, data = self.valid / noise.variance_at(self.raw), self.raw - self.neighbours
        return data - basis @ weighted_least_squares(basis, weight, data), weight


def window_around(film: NDArray[Any], at_px: Float, radius_px: Float, sigma_px: float, noise: NoiseModel, others: Any) -> GroupWindow:
    """Cut the window that balls at these places need, with the images of neighbours as of :func:`fit_group`."""
    middle = at_px.mean(0)
    half = half_size(float(radius_px.max()), sigma_px) + int(np.ceil(float(np.abs(at_px - middle).max())))
    patch = cut(film, middle[None], half, noise)
    corner = patch.corner_px[0].astype(np.float64)
    cols, rows, surface = square(half)
    raw = patch.values[0].ravel()
    neighbours = np.zeros_like(raw) if others is None else others(cols + corner[0], rows + corner[1])
    valid = patch.valid[0].ravel().astype(np.float64)
    return GroupWindow(patch.size, corner, cols, rows, raw, neighbours, valid, surface)


@lru_cache(maxsize=64)
def square(half: int) -> tuple[Float, Float, Float]:
    """Return the columns and rows (n,) of the pixels of a window of this half side, and a quadratic surface on it (n, 6)."""
    rows, cols = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].reshape(2, -1).astype(np.float64)
    surface = polynomial(half, cols - half, rows - half)
    for shared in (cols, rows, surface):
        shared.setflags(write=False)
    return cols, rows, surface


@dataclass(frozen=True, slots=True, eq=False)
class GroupImages:
    """What balls at given places look like in a window, with all that enters it linearly."""

    value: Float  # (k, n)
    slopes: Float  # (3, k, n), of each ball by its col, row and radius
    linear: Float  # (n, p): balls, background, products of balls with an edge under them, of two balls
    ground: Float | None  # (k, n), the edge under each
    pairs: list[tuple[int, int]]
    of_pairs: list[Float]  # slopes of the products

    def jacobian(self, theta: Float) -> Float:
        """Return the derivatives by all cols, rows and radii, then by the linear parameters; shape (n, 3 k + p)."""
        k = len(self.value)
        by_shape = theta[:k, None] * self.slopes
        if self.ground is not None:
            by_shape += theta[self.of_grounds, None] * self.ground * self.slopes
        for of_product, pair, by in zip(theta[len(theta) - len(self.pairs) :], self.pairs, self.of_pairs, strict=True):
            by_shape[:, list(pair)] += of_product * by.transpose(1, 0, 2)
        return columns([by_shape.reshape(3 * k, -1), self.linear.T])

    def of_ground(self, theta: Float) -> Float:
        """Return what balls take away of the edge under them, shape (n,)."""
        return np.zeros(self.value.shape[1]) if self.ground is None else theta[self.of_grounds] @ (self.ground * self.value)

    @property
    def of_grounds(self) -> range:
        """Which of the linear columns those are."""
        end = self.linear.shape[1] - len(self.pairs)
        return range(end - (0 if self.ground is None else len(self.value)), end)


def _under(value: Float, background: Float) -> Float:
    """Return by how much the background differs from its mean under each ball, at most by one; shape (k, n)."""
    mean = (value @ background) / np.maximum(value.sum(axis=1), 1e-9)
    apart = background - mean[:, None]
    return np.asarray(apart / max(float(np.abs(apart).max()), 1e-9))


def images_in(
    window: GroupWindow,
    surface: Float,
    local: Float,
    radius: Float,
    sigma_px: float,
    mu_px: float,
    ground: Float | None = None,
    spot: Spot | None = None,
) -> GroupImages:
    """Draw balls at places (k, 2) in a window; ``ground``: what is under them and they take their part of."""
    dx, dy = window.cols - local[:, :1], window.rows - local[:, 1:]
    value, by_dx, by_dy, by_radius = shapes_of(Optics(sigma_px, mu_px), spot, dx, dy, radius)
    # two exposures on one film add up, and a film curve bends the sum: how much of the product of two images is there, the film tells
    pairs: list[tuple[int, int]] = []
    products: list[Float] = []
    of_pairs: list[Float] = []
    for pair in lapping(local, radius):
        product, by = product_image(local[list(pair)], radius[list(pair)], sigma_px, mu_px, window.size)
        if product.max() > LEAST:
            pairs, products, of_pairs = [*pairs, pair], [*products, product[None]], [*of_pairs, by]
    # a mark takes away its part of what is there: on linear films more beside an implant than behind it, on films of density as much
    linear = columns([value, surface.T, *([] if ground is None else [ground * value]), *products])
    return GroupImages(value, np.stack([-by_dx, -by_dy, by_radius]), linear, ground, pairs, of_pairs)
