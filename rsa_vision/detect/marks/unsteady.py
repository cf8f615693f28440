"""Scanners whose lines start early or late, or follow each other too soon: what that leaves of marks, and where it moves them.

A line that is displaced by ``j`` shows a mark ``j`` off, so that a fit leaves ``j`` times the slope of its image there. What one line
leaves and its neighbours do not is not of the mark, whose shape goes on from line to line, nor of bone; and of noise there is as much in
lines along the other axis, or as much more as at free places.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from rsa_vision.detect.balls.fits import BallFits, half_size
from rsa_vision.detect.balls.focal_spot import shapes_of
from rsa_vision.detect.balls.surroundings import Places
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.needles import NeedleFit, arm_images, needle_image
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import images_beside
from rsa_vision.types import Bool, Float, Int

_ASKED, _LEAST, _PLACES = 36, 6, 100  # balls that tell; free places of one size
_SLOPING = 0.1  # of the information that the line with most has, from which one tells where it is
_OUTLIER = 4.0  # times the median of what lines of marks leave
_BY_CHANCE = 3e-6  # of films with steady lines, that seem to have others: 4.5 standard deviations
_LEFT = 0.1  # of the variance of what a line tells, that the fit has to leave
_IN_A_ROW = 1.94  # sum of the squared correlations of such differences with each other
_TINY = 1e-12
_FADED = 3.0  # blur widths


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """Pixels around one mark.

    Attributes
    ----------
    left, weight : ndarray of shape (s, s)
        What the fit of the mark leaves; the inverse of its variance.
    images, estimator : ndarray of shape (k, s, s)
        Derivatives of the mark's image, by the column and the row of its centre first, with the surfaces beside it; and what makes their
        coefficients of values.
    """

    left: Float
    weight: Float
    images: Float
    estimator: Float

    def told_by(self, axis: int, way: int) -> _Told:
        """Return what tells how far lines along this axis (0: rows) are displaced by this coordinate."""
        images, estimator, weight = (of if axis == 0 else of.swapaxes(-1, -2) for of in (self.images, self.estimator, self.weight))
        slope, line = images[way], np.arange(len(weight))  # lines are rows now
        whole = np.maximum(weight.sum(1, keepdims=True), _TINY)
        tilt = slope - (slope * weight).sum(1, keepdims=True) / whole  # lines may be brighter or darker as well
        told = (tilt**2 * weight).sum(1)
        tells = told > _SLOPING * told.max(initial=0.0)
        middle = np.flatnonzero(tells[:-2] & tells[1:-1] & tells[2:]) + 1
        each, displaced = np.zeros((2, len(line), *weight.shape))
        each[line, line], displaced[line, line] = tilt * weight / np.where(tells, told, np.inf)[:, None], slope
        by = each[middle] - 0.5 * (each[middle - 1] + each[middle + 1])
        variance = 1 / np.where(weight > 0, weight, np.inf)
        before = (by**2 * variance).sum((1, 2))
        by = by - np.tensordot(np.tensordot(by, images, ((1, 2), (1, 2))), estimator, 1)  # what the fit takes up shows nowhere
        noise, shown = (by**2 * variance).sum((1, 2)), np.square(np.tensordot(by, displaced, ((1, 2), (1, 2)))).sum(1)
        left = noise > _LEFT * before
        return _Told(by[left] if axis == 0 else by[left].swapaxes(1, 2), noise[left], shown[left])

    def beside(self, values: NDArray[Any]) -> Float:
        """Return what the fit would leave of free places (k, s * s), shape (k, s, s)."""
        images, estimator = (of.reshape(len(of), -1) for of in (self.images, self.estimator))
        centred = values - values.mean(axis=1, keepdims=True)
        return np.asarray(centred - (centred @ estimator.T) @ images).reshape(-1, *self.left.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """How far lines seem displaced, each from its two neighbours.

    Attributes
    ----------
    by : ndarray of shape (lines, s, s)
        Products with what a fit leaves say how far.
    noise : ndarray of shape (lines,)
        Variance of that by noise.
    shown : ndarray of shape (lines,)
        Variance of that where lines are displaced by a variance of one.
    """

    by: Float
    noise: Float
    shown: Float

    def off(self, left: Float) -> Float:
        """How far lines seem displaced by what is left (..., s, s), shape (..., lines)."""
        return np.tensordot(left, self.by, ((-2, -1), (1, 2)))


@dataclass(frozen=True, slots=True)
class Unsteady:
    """Lines of a film that are displaced at random.

    Attributes
    ----------
    displaced : tuple of (int, int, float)
        The axis of the lines (0: rows), the coordinate of a pixel by which they are displaced (0: column), and the variance, px^2.
    noise : float
        Variance of the noise at the rims of marks in units of the stated one, as lines along the other axis tell it.
    """

    displaced: tuple[tuple[int, int, float], ...]
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of a film, and what is around them: ``painted`` are the images of the needles."""

    film: NDArray[Any]
    balls: BallFits
    needles: list[NeedleFit]
    painted: Images | None
    optics: Optics
    noise: NoiseModel

    def windows(self, which: list[int]) -> Iterator[_Window]:
        """Yield the windows of balls, by their numbers, and of needles, which follow them."""
        n = len(self.balls.depth)
        for i in which:
            yield _of_ball(self, i) if i < n else _of_needle(self, self.needles[i - n])


def unsteady_lines(marks: Marks, clear: Int, places: list[Places]) -> Unsteady | None:
    """Say which lines of a film are displaced.

    Parameters
    ----------
    marks : Marks
    clear : ndarray of int
        Balls with nothing on them or beside them.
    places : list of Places
        Around the balls.

    Returns
    -------
    Unsteady or None
        None where lines are steady, or too few balls tell: arms of needles are not alike along both axes, nor is what fits leave of them.
    """
    if len(clear) < _LEAST:
        return None
    # of all: the first are those that the model describes best
    windows = list(marks.windows(clear[:: 1 + (len(clear) - 1) // _ASKED].tolist()))
    free = {2 * these.half + 1: these.values[:: 1 + len(these.values) // _PLACES] for these in places if len(these.values)}
    found = [of for of in (_displaced(windows, way, free) for way in (0, 1)) if of]
    return Unsteady(tuple(of for of, _ in found), min(noise for _, noise in found)) if found else None


def by_lines(lines: Unsteady, marks: Marks) -> Float:
    """Return what displaced lines add to the covariances of marks.

    Parameters
    ----------
    lines : Unsteady
    marks : Marks

    Returns
    -------
    ndarray of shape (n + m, 2, 2)
        Of the centres (col, row) of the balls, then of the tips of the needles.
    """
    added = np.zeros((len(marks.balls.depth) + len(marks.needles), 2, 2))
    for i, window in enumerate(marks.windows(list(range(len(added))))):
        for axis, way, variance in lines.displaced:
            moved = (window.estimator[:2] * window.images[way]).sum(2 - axis)
            added[i] += variance * moved @ moved.T
    return added


def _displaced(windows: list[_Window], way: int, free: dict[int, NDArray[Any]]) -> tuple[tuple[int, int, float], float] | None:
    """Return which lines are displaced by a coordinate, and the noise, as of :class:`Unsteady`.

    Rows by one coordinate are compared with columns by the other: along lines, or across them. ``free`` are places of these sides.
    """
    kinds = ((0, way), (1, 1 - way))
    told = [[window.told_by(*kind) for window in windows] for kind in kinds]
    off = [[these.off(window.left) for these, window in zip(of, windows, strict=True)] for of in told]
    count = np.array([[len(these.noise) for these in of] for of in told])
    square = np.array(
        [[(by**2 / these.noise).sum() for by, these in zip(of, those, strict=True)] for of, those in zip(off, told, strict=True)]
    )
    mean = square / np.maximum(count, 1)
    keep = ((count > 0) & (mean <= _OUTLIER * np.median(mean, axis=1, keepdims=True))).all(axis=0)
    if np.count_nonzero(keep) < _LEAST:
        return None
    number = count[:, keep].sum(axis=1)
    of_each = square[:, keep].sum(axis=1) / number
    more, less = int(np.argmax(of_each)), int(np.argmin(of_each))
    freedom = number / _IN_A_ROW
    beside = _at_free_places([window for window, kept in zip(windows, keep, strict=True) if kept], kinds, free)
    if not beside.all():  # no noise at all
        return None
    of_noise = float(of_each[less] * max(beside[more] / beside[less], 1.0))
    if fdtrc(freedom[more], freedom[less], of_each[more] / of_noise) > _BY_CHANCE:
        return None
    by, noise, shown = (
        np.concatenate(of)
        for of in zip(
            *((by, these.noise, these.shown) for by, these, kept in zip(off[more], told[more], keep, strict=True) if kept), strict=True
        )
    )
    variance = (shown * (by**2 - of_noise * noise) / noise**2).sum() / (shown**2 / noise**2).sum()
    return (*kinds[more], float(variance)), float(of_each[less] * (1 + np.sqrt(2 / freedom[less])))


def _at_free_places(windows: list[_Window], kinds: tuple[tuple[int, int], ...], free: dict[int, NDArray[Any]]) -> Float:
    """Mean squares of what lines would seem displaced by where no marks are, for each kind, in units of those by white noise."""
    left = [(window, window.beside(free[len(window.left)])) for window in windows if len(window.left) in free][:_LEAST]
    if not left:
        return np.ones(len(kinds))
    out = []
    for kind in kinds:
        told = [window.told_by(*kind) for window, _ in left]
        square = [these.off(of) ** 2 / these.noise for these, (_, of) in zip(told, left, strict=True)]
        out.append(np.concatenate([of.ravel() for of in square]).mean())
    return np.array(out)


def _of_ball(marks: Marks, i: int) -> _Window:
    balls, optics = marks.balls, marks.optics
    half = half_size(float(balls.radius_px[i]), optics.sigma_px)
    patches = cut(marks.film, balls.position_px[[i]], half, marks.noise)
    cols, rows = patches.places(0)
    others, doubtful = images_beside(balls, np.array([i]), optics, marks.painted, cols, rows)
    dx, dy = ((of - at).reshape(1, -1) for of, at in zip((cols, rows), balls.position_px[i], strict=True))
    value, *by = (shape.astype(np.float64) for shape in shapes_of(optics, None, dx, dy, balls.radius_px[[i]]))
    depth, ground = balls.depth[i], others + balls.background[i]
    images = np.concatenate([-depth * by[0], -depth * by[1], depth * by[2], value])
    return _window(patches.values[0] - ground, patches.valid[0] & ~doubtful, depth * value[0], ground, images, marks.noise)


def _of_needle(marks: Marks, fit: NeedleFit) -> _Window:
    optics = marks.optics
    half = int(np.ceil(fit.shape.length_px + fit.shape.half_width_px + _FADED * optics.sigma_px)) + 1
    patches = cut(marks.film, fit.position_px[None], half, marks.noise)
    cols, rows = patches.places(0)
    others, doubtful = images_beside(marks.balls, np.zeros(0, np.intp), optics, marks.painted, cols, rows)
    dx, dy = ((of - at).ravel() for of, at in zip((cols, rows), fit.position_px, strict=True))
    mine = needle_image(dx, dy, fit, optics)
    ground = others - mine.reshape(cols.shape) + fit.background
    opacity, *by, by_angle = arm_images(dx, dy, fit.angles, fit.shape, fit.seen_by(optics))[:6]
    images = np.concatenate([np.einsum("a,kap->kp", fit.depths, by), fit.depths[:, None] * by_angle, opacity])
    return _window(patches.values[0] - ground, patches.valid[0] & ~doubtful, mine, ground, images, marks.noise)


def _window(values: Float, valid: Bool, mine: Float, ground: Float, images: Float, noise: NoiseModel) -> _Window:
    """Take from values over the ground (s, s) a mark's image (s * s,), and what its derivatives and a quadratic surface take up."""
    side = len(values)
    half = side // 2
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    images = np.concatenate([images, polynomial(half, cols, rows).T])
    weight = valid.ravel() / noise.variance_at(ground.ravel() + mine)
    weighted = images * weight
    estimator = invert((weighted @ images.T)[None])[0] @ weighted
    left = values.ravel() - mine
    left = left - (estimator @ left) @ images
    return _Window(*(of.reshape(*of.shape[:-1], side, side) for of in (left, weight, images, estimator)))
