"""What balls whose images touch look like in one window, with what enters it linearly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import half_size
from rsa_vision.detect.balls.focal_spot import Spot, shapes_of
from rsa_vision.detect.film.least_squares import columns, polynomial, weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.edge import edge_profile
from rsa_vision.detect.models.film_curve import film_curve, slope_of_film_curve
from rsa_vision.detect.models.lapping import LEAST, lapping, product_image, product_with
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.types import Float

_BESIDE = 2.0  # blur widths between two rims, within which their images lie over each other


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


def window_around(
    film: NDArray[Any], at_px: Float, radius_px: Float, sigma_px: float, noise: NoiseModel, others: Images | None
) -> GroupWindow:
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
        for of_product, pair, by in zip(self.of_products(theta), self.pairs, self.of_pairs, strict=True):
            by_shape[:, list(pair)] += of_product * by.transpose(1, 0, 2)
        return columns([by_shape.reshape(3 * k, -1), self.linear.T])

    def of_products(self, theta: Float) -> Float:
        """Return by how much the products of two are to be multiplied, one for each pair."""
        return theta[len(theta) - len(self.pairs) :]

    def of_ground(self, theta: Float) -> Float:
        """Return what balls take away of the edge under them, shape (n,)."""
        return np.zeros(self.value.shape[1]) if self.ground is None else theta[self.of_grounds] @ (self.ground * self.value)

    @property
    def of_grounds(self) -> range:
        """Which of the linear columns those are."""
        end = self.linear.shape[1] - len(self.pairs)
        return range(end - (0 if self.ground is None else len(self.value)), end)


def images_in(
    window: GroupWindow,
    surface: Float,
    local: Float,
    radius: Float,
    optics: Optics,
    ground: Float | None = None,
    spot: Spot | None = None,
) -> GroupImages:
    """Draw balls at places (k, 2) in a window; ``ground``: what is under them and they take their part of."""
    value, slopes = _alone(window, local, radius, optics, spot)
    # two exposures on one film add up, and a film curve bends the sum: how much of the product of two images is there, the film tells
    pairs: list[tuple[int, int]] = []
    products: list[Float] = []
    of_pairs: list[Float] = []
    for pair in lapping(local, radius):
        product, by = product_image(local[list(pair)], radius[list(pair)], optics, window.size)
        if product.max() > LEAST:
            pairs, products, of_pairs = [*pairs, pair], [*products, product[None]], [*of_pairs, by]
    # a mark takes away its part of what is there: on linear films more beside an implant than behind it, on films of density as much
    linear = columns([value, surface.T, *([] if ground is None else [ground * value]), *products])
    return GroupImages(value, slopes, linear, ground, pairs, of_pairs)


@dataclass(frozen=True, slots=True, eq=False)
class ImagesOver(GroupImages):
    """The same on something else, of which each ball takes away its part."""

    by_taken: Float  # (3, k, n), slopes of what it takes

    def jacobian(self, theta: Float) -> Float:
        """Return the derivatives by all cols, rows and radii, then by the linear parameters; shape (n, 3 k + p)."""
        k = len(self.value)
        by_shape = theta[:k, None] * self.slopes + theta[len(theta) - k :, None] * self.by_taken
        return columns([by_shape.reshape(3 * k, -1), self.linear.T])


def images_over(other: Float, window: GroupWindow, surface: Float, local: Float, radius: Float, optics: Optics) -> ImagesOver:
    """Draw balls at places (k, 2) on something else, whose opacity (m, m) is given as of :func:`product_with`."""
    value, slopes = _alone(window, local, radius, optics, None)
    taken, by_taken = zip(*(product_with(other, at, float(r), optics) for at, r in zip(local, radius, strict=True)), strict=True)
    linear = columns([value, surface.T, np.array(taken)])
    return ImagesOver(value, slopes, linear, None, [], [], np.stack(by_taken, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Opacities:
    """Blurred opacities of balls in a window, and of those together that lie over each other."""

    alone: Float  # (k, n)
    pairs: list[tuple[int, int]]
    products: list[Float]  # (n,), by which the opacity of both is less than their sum

    @property
    def together(self) -> list[Float]:
        """Of both balls of each pair, (n,)."""
        return [self.alone[list(p)].sum(axis=0) - product for p, product in zip(self.pairs, self.products, strict=True)]

    def under(self, curve: Callable[[Float], Float]) -> Float:
        """Return what a curve makes of each, shape (k, n); of what it makes of two beyond that, either has half."""
        each = curve(self.alone)
        out = each.copy()
        for pair, together in zip(self.pairs, self.together, strict=True):
            out[list(pair)] += 0.5 * (curve(together) - each[list(pair)].sum(axis=0))
        return out


@dataclass(frozen=True, slots=True, eq=False)
class ImagesUnderCurve(GroupImages):
    """The same where a film curve tells the products: they are in the images of their balls, half in each."""

    light: Opacities

    def of_products(self, theta: Float) -> Float:
        """Return the means of the depths of both balls."""
        return np.array([theta[list(pair)].mean() for pair in self.pairs])


def images_under_curve(
    window: GroupWindow, surface: Float, local: Float, radius: Float, optics: Optics, *, one_light: bool
) -> ImagesUnderCurve:
    """Draw balls at places (k, 2) as a film shows them whose curve is known: what it shows of two together is known as well.

    ``one_light``: they lie in one beam, and the second takes from what the first has left; those of two exposures add up.
    """
    opacity, by = _alone(window, local, radius, optics, None)
    pairs = lapping(local, radius, _BESIDE * optics.sigma_px)
    products = [_shared(window, local, radius, optics, pair, one_light=one_light) for pair in pairs]
    shown = Opacities(opacity, pairs, [product for product, _ in products])
    slopes = slope_of_film_curve(opacity, optics.curve) * by
    of_pairs = [
        slope_of_film_curve(together, optics.curve) * (by[:, pair].swapaxes(0, 1) - by_product) - slopes[:, pair].swapaxes(0, 1)
        for pair, together, (_, by_product) in zip(map(list, pairs), shown.together, products, strict=True)
    ]
    value = shown.under(partial(film_curve, curve=optics.curve))
    return ImagesUnderCurve(value, slopes, columns([value, surface.T]), None, pairs, of_pairs, shown)


def _shared(
    window: GroupWindow, local: Float, radius: Float, optics: Optics, pair: tuple[int, int], *, one_light: bool
) -> tuple[Float, Float]:
    """By how much the opacity of both is less than the sum, (n,), and its slopes (2, 3, n)."""
    if not one_light:
        return np.zeros(len(window.cols)), np.zeros((2, 3, len(window.cols)))
    both = list(pair)
    return product_image(local[both], radius[both], optics, window.size)


def opacities_in(window: GroupWindow, local: Float, radius: Float, optics: Optics, *, one_light: bool) -> Opacities:
    """Draw balls as for :func:`images_under_curve`, without a curve and without slopes."""
    alone, _ = _alone(window, local, radius, optics, None)
    pairs = lapping(local, radius, _BESIDE * optics.sigma_px)
    return Opacities(alone, pairs, [_shared(window, local, radius, optics, pair, one_light=one_light)[0] for pair in pairs])


def _alone(window: GroupWindow, local: Float, radius: Float, optics: Optics, spot: Spot | None) -> tuple[Float, Float]:
    """Images (k, n) of single balls, and their slopes by col, row and radius (3, k, n)."""
    dx, dy = window.cols - local[:, :1], window.rows - local[:, 1:]
    value, by_dx, by_dy, by_radius = shapes_of(optics, spot, dx, dy, radius)
    return value, np.stack([-by_dx, -by_dy, by_radius])
