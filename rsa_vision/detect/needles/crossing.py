"""Tees whose arms cross or lie on each other: one fit for all of them on one background, so that their errors stay honest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.least_squares import damped_solution, polynomial, weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import apart_from_repairs, cut
from rsa_vision.detect.film.progress import WEIGHED, in_vain
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.edge import edge_profile
from rsa_vision.detect.models.needles import NeedleFit, arm_images, needle_image, support
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.fits import LEAST_HALF_WIDTH_PX, PROMISING, between, explains, scored, step_of
from rsa_vision.types import Bool, Float, Int

Unseen = Callable[[Float, Float], Bool]
"""Says at which pixels (cols, rows) something lies over needles that hides them."""

_STEPS, _QUICK_STEPS = 16, 5
_REWEIGHTED = (2, 6)  # steps after which the variance is taken where the model is by then
_CONVERGED_PX = 0.02  # a step's change: what is left after it is a tenth of that, and the last fit follows
_NEAR_PX = 0.1  # enough for a first look
_LOOKED_AGAIN = (2, 5, 9)  # steps after which an edge is seen more clearly
_AROUND_PX, _CLOSE_PX = 4.0, 1.0  # beyond three blurs from the arms, which tell the background; the same for a first look
_OF_SURFACE, _INTERVALS = 6, 40  # terms of a background without an edge; between the knots of the profile of one, at the most
_LEAST_SEEN = 1.0  # sum of squares, over the pixels, of a part of that
_LAPPING = 0.02  # of full opacity, from which the product of two shadows counts
_GAIN = (0.3, 3.0)  # bounds of the depth along a needle, relative to its middle
_FAINTEST = 0.02  # of the height of an image, from which it is one


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Pixels of pins or tees that are fitted together.

    Attributes
    ----------
    cols, rows, data, beside : ndarray of shape (n,)
        Places on the film; its values, the images of neighbours taken away; those images.
    surface : ndarray of shape (6, n), with an edge more
        Parts of a quadratic background, the first of which is its level.
    half : int
        Half the side of the square around them.
    place : ndarray of int, shape (n,)
        Where they lie in the smallest box around them.
    box : tuple of int
        Its rows and columns.
    hidden : ndarray of shape (2, m)
        (col, row) of pixels among these that are saturated, or off the film.
    """

    cols: Float
    rows: Float
    data: Float
    beside: Float
    surface: Float
    half: int
    place: Int
    box: tuple[int, int]
    hidden: Float

    def with_edge(self, needles: Sequence[NeedleFit], optics: Optics) -> Window:
        """Return the window with the profiles of the strongest edge in its background, which is what is left without these needles.

        They hold nothing of what the surface says already, so that its level stays the background's.
        """
        surface = self.surface[:_OF_SURFACE]
        bare = self.data.copy()
        for f in needles:
            bare -= needle_image(self.cols - f.position_px[0], self.rows - f.position_px[1], f, optics)
        box, seen = (self.boxes(values[None])[0].astype(np.float64) for values in (bare - bare.mean(), np.ones(len(bare))))
        edge = edge_profile(box, seen, optics.sigma_px, bent=True, intervals=_INTERVALS)[:, self.place]
        edge = edge[np.square(edge).sum(axis=1) > _LEAST_SEEN]
        edge -= np.linalg.lstsq(surface.T, edge.T, rcond=None)[0].T @ surface
        return replace(self, surface=np.concatenate([surface, edge]))

    def filtered(self, values: Float, through: Filter) -> Float:
        """Filter values at the pixels, in units of the noise, shape (p, n)."""
        return np.asarray(through(self.boxes(values)).reshape(len(values), -1).take(self.place, axis=1), np.float64)

    def covariance(self, influence: Float, noise: NoiseModel) -> Float:
        """Return the covariance of linear functions (p, n) of the film's noise at the pixels."""
        return influence_covariance(self.boxes(influence), noise.correlation)

    def boxes(self, values: Float | NDArray[np.float32]) -> NDArray[np.float32]:
        """Return values at the pixels (p, n) as images of the box around them, zero elsewhere."""
        out = np.zeros((len(values), self.box[0] * self.box[1]), np.float32)  # no needle's table is finer than that
        out[:, self.place] = values
        return out.reshape(len(values), *self.box)


def window_of(
    film: NDArray[Any],
    needles: Sequence[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    others: Images | None,
    around_px: float = _AROUND_PX,
    unseen: Unseen | None = None,
) -> Window:
    """Cut out the pixels around the arms of some needles, less those that are not to be seen, the images of others taken away."""
    middle = np.mean([f.position_px for f in needles], axis=0)
    spread = max(float(np.abs(f.position_px - middle).max()) for f in needles)
    half = int(np.ceil(spread + max(f.shape.length_px * 1.15 + f.shape.half_width_px for f in needles) + 3 * optics.sigma_px + 3))
    whole = cut(film, middle[None], half, noise)
    patch = apart_from_repairs(whole, noise)
    corner = patch.corner_px[0].astype(np.float64)
    axis = np.arange(float(patch.size))
    near = np.zeros((patch.size, patch.size), bool)
    for f in needles:
        dx, dy = (axis + (first - at) for first, at in zip(corner, f.position_px, strict=True))
        near |= support(dx, dy, f.angles, f.shape, 3 * optics.sigma_px + around_px)
    rows, cols = np.nonzero(near & patch.valid[0])
    if unseen is not None:
        seen = ~unseen(cols + corner[0], rows + corner[1])
        rows, cols = rows[seen], cols[seen]
    raw = patch.values[0][rows, cols]
    first, box = int(cols.min(initial=patch.size)), (int(np.ptp(rows)) + 1, int(np.ptp(cols)) + 1)
    place = (rows - rows[0]) * box[1] + cols - first
    cols, rows = cols + corner[0], rows + corner[1]
    beside = np.zeros_like(raw) if others is None else others(cols, rows)
    surface = polynomial(half, cols - middle[0], rows - middle[1]).T
    hidden = np.array(np.nonzero(near & ~whole.valid[0])[::-1]) + corner[:, None]
    return Window(cols, rows, raw - beside, beside, surface, half, place, box, hidden)


def chi2_of(window: Window, fit: NeedleFit, optics: Optics, noise: NoiseModel) -> float:
    """Return what a fit leaves of a window, depth and background being free: squared residuals over the variance of the noise."""
    image = needle_image(window.cols - fit.position_px[0], window.rows - fit.position_px[1], fit, optics)
    weight = 1.0 / noise.variance_at(np.full(len(window.data), float(np.median(window.data))))
    left, _ = _left_by(image, window, weight)
    return float(np.sum(weight * left**2))


def _left_by(image: Float, window: Window, weight: Float) -> tuple[Float, Float]:
    """Return what an image of any depth leaves of a window (n,), and the background over its mean."""
    linear = np.concatenate([image[None], window.surface])
    theta = weighted_least_squares(linear.T, weight, window.data)
    return np.asarray(window.data - theta @ linear), np.asarray(theta[2:] @ window.surface[1:])


def left_under(window: Window, fits: Sequence[NeedleFit], optics: Optics, noise: NoiseModel) -> tuple[Float, int]:
    """Compare fits of one thing by what each leaves of it, on the same pixels: those on which any of them has an image.

    Parameters
    ----------
    window : Window
        Around all of them.
    fits : sequence of NeedleFit
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    chi2 : ndarray of shape (n,)
        Squared residuals over the variance of the noise; depth and background of each are free.
    pixels : int
    """
    weight, seen, residuals = 1.0 / noise.variance_at(window.data + window.beside), np.zeros(len(window.data), bool), []
    for f in fits:
        image = needle_image(window.cols - f.position_px[0], window.rows - f.position_px[1], f, optics)
        seen |= np.abs(image) > _FAINTEST * np.abs(image).max(initial=0.0)
        left, background = _left_by(image, window, weight)
        if optics.proportion:
            left, _ = _left_by(image * gain_at(f, background, optics), window, weight)
        residuals.append(left)
    return np.square(np.array(residuals)[:, seen]) @ weight[seen], int(np.count_nonzero(seen))


def fit_crossing(
    film: NDArray[Any],
    needles: Sequence[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    *,
    others: Images | None = None,
    steps: int = _STEPS,
    unseen: Unseen | None = None,
    quick: bool = False,
    edge: bool = False,
) -> list[NeedleFit]:
    """Fit several pins or tees at once; the arms of each turn together.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : sequence of NeedleFit
        Starts.
    optics : Optics
    noise : NoiseModel
    others : callable, optional
        Images of neighbours, which are subtracted first.
    unseen : callable, optional
        Pixels that are left out.
    steps : int
        At the most.
    quick : bool
        For a first look: few steps, and no step at all from starts that explain little of what neighbours leave.
    edge : bool
        The background also holds an edge, as of :meth:`Window.with_edge`.

    Returns
    -------
    list of NeedleFit
        In the order of the starts, with the covariances of these; figures of merit are taken under each needle's own arms.
    """
    now = list(needles)
    window = window_of(film, now, optics, noise, others, _CLOSE_PX if quick else _AROUND_PX, unseen)
    steps, near = (min(steps, _QUICK_STEPS), _NEAR_PX) if quick else (steps, _CONVERGED_PX)
    cols, rows, data, surface, half = window.cols, window.rows, window.data, window.surface, window.half
    weight = 1.0 / noise.variance_at(data + window.beside)
    before, converged, left = now, False, list[float]()
    if edge:
        surface = window.with_edge(now, optics).surface
    tees: Float = np.zeros((len(now), 1, len(data)))  # needles, (image, its derivatives), pixels
    ground = np.zeros(len(data))  # background above its mean under each pixel

    def told() -> list[NeedleFit]:
        residual, background = data - theta @ linear, float(theta[-len(surface)])
        variance = float(noise.variance_at(np.array([background]))[0])
        fits = [replace(f, depths=np.full(f.angles.shape, depth), converged=converged) for f, depth in zip(now, theta, strict=False)]
        of_each = zip(fits, theta[: len(now), None] * tees[:, 0], strict=True)
        return [scored(f, image, residual, weight, surface, background, variance, window.hidden, optics) for f, image in of_each]

    for step in range(steps + 1):
        last = step == steps or converged or in_vain(left, len(data))  # nobody asks where to go next
        if converged:  # so small a step goes into the images linearly
            tees = tees[:, :1] + np.matmul(_change(before, now)[:, None], tees[:, 1:])
        else:
            offsets = [(cols - f.position_px[0], rows - f.position_px[1]) for f in now]
            blocks = [arm_images(*at, f.angles, f.shape, f.seen_by(optics), slopes=not last) for at, f in zip(offsets, now, strict=True)]
            if optics.proportion:
                blocks = [block * gain_at(f, ground, optics) for f, block in zip(now, blocks, strict=True)]
            tees = np.array([block.sum(1) for block in blocks])
        moves = tees[:, 1:].reshape(-1, len(data))
        linear = np.concatenate([tees[:, 0], *lapping(tees[:, 0]), surface])
        weighted = np.concatenate([moves, linear, data[None]]) * np.sqrt(weight)
        gram = weighted @ weighted.T  # holds the normal equations of depths and background alone as well as of all
        at = slice(len(moves), -1)
        theta = damped_solution(gram[at, at], gram[at, -1], 1e-6)
        ground = theta[1 - len(surface) :] @ surface[1:]
        if last:
            break
        if step == 0 and quick and others is not None and not any(explains(f, PROMISING, 0.0) for f in told()):
            break
        if step > WEIGHED and not edge:
            left.append(float(gram[-1, -1] - theta @ gram[at, -1]))
        delta = step_of(gram, theta, tees.shape[1] - 1, 1e-3 if step < 4 else 1e-6).reshape(len(now), -1)
        if edge and step in _LOOKED_AGAIN:
            deep = [replace(f, depths=np.full(f.angles.shape, depth)) for f, depth in zip(now, theta, strict=False)]
            surface = window.with_edge(deep, optics).surface
        if step in _REWEIGHTED:
            weight = 1.0 / noise.variance_at(theta @ linear + window.beside)
            left.clear()  # of other weights
        before, now = now, moved(now, delta, half)
        converged = (step > 0 or quick) and float(np.abs(delta[:, :2]).max()) < near
    return told()


def lapping(shadows: Sequence[Float] | Float) -> list[Float]:
    """Return the product of the shadows of two needles, summed over all pairs, as one row, if any lie on each other.

    There the film does not show their sum: its curve is bent, and those of two exposures take of each half the light. How much of the
    product it shows, the film tells; left out, it draws the two towards each other.
    """
    if len(shadows) < 2:
        return []
    product = (np.sum(shadows, axis=0) ** 2 - np.sum(np.square(shadows), axis=0)) / 2
    return [product[None]] if product.max(initial=0.0) > _LAPPING else []


def gain_at(fit: NeedleFit, ground: Float, optics: Optics) -> Float | float:
    """Return the depth at each pixel in units of the depth at the middle, where it goes with the background."""
    if not fit.depth:
        return 1.0
    gain: Float = np.clip(1.0 + optics.proportion * ground / fit.depth, *_GAIN)
    return gain


def _change(before: Sequence[NeedleFit], now: Sequence[NeedleFit]) -> Float:
    """By how much tips, half widths, lengths and directions have moved, shape (needles, 5)."""
    at, was = (np.array([[*f.position_px, f.shape.half_width_px, f.shape.length_px, f.angles[0]] for f in fits]) for fits in (now, before))
    return np.asarray(at - was)


def moved(needles: Sequence[NeedleFit], by: Float, half: int) -> list[NeedleFit]:
    """Return needles after a step, or after the part of it that is not too far at once.

    Parameters
    ----------
    needles : sequence of NeedleFit
    by : ndarray of shape (needles, 5)
        Steps of tip (col, row), half width, length and direction.
    half : int
        Half the side of their window.

    Returns
    -------
    list of NeedleFit
    """
    scale = min(1.0, 1.0 / max(float(np.abs(by[:, :2]).max()), 1e-9), 0.1 / max(float(np.abs(by[:, -1]).max()), 1e-9))
    return [_moved(f, scale * d, half) for f, d in zip(needles, by, strict=True)]


def _moved(fit: NeedleFit, delta: Float, half: int) -> NeedleFit:
    wider, longer = between(delta[2], -0.5, 0.5), between(delta[3], -2.0, 2.0)
    width = between(fit.shape.half_width_px + wider, LEAST_HALF_WIDTH_PX, 0.3 * fit.shape.length_px)
    shape = replace(fit.shape, half_width_px=width, length_px=between(fit.shape.length_px + longer, 3.0, half / 1.05))
    return replace(fit, position_px=fit.position_px + delta[:2], shape=shape, angles=fit.angles + delta[-1])
