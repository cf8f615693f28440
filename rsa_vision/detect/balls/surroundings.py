"""What the film is like around balls: how it goes on at free places beside them, beyond noise and beyond a quadratic surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, polygamma

from rsa_vision.detect.balls.alike import robust_sd
from rsa_vision.detect.balls.fits import BallFits, half_size
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.places import pairs_within
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Float, Int

_WAYS = (2 * np.pi * np.arange(8) / 8 + np.arange(3)[:, None] * np.pi / 8).ravel()
# three rings of places, in units of the nearest distance that is free of the mark in their middle, (col, row)
ROUND_ABOUT = np.repeat([1.0, 1.5, 2.2], 8)[:, None] * np.stack([np.cos(_WAYS), np.sin(_WAYS)], axis=1)
_DEGREES = range(3, 7)  # of surfaces beyond the quadratic one; finer ones do not look like a shift of the ball
_LEAST_DIFFER = 0.2  # of structure from window to window
_LEAST = 4  # free places from which a ball's surroundings tell something
_SURE = 2.0  # standard deviations
_DIAGONAL = 1.5  # of a square, and more than that, over its side


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Free windows of one size.

    Attributes
    ----------
    half : int
        Half their side.
    balls : ndarray of int, shape (m,)
        The balls whose windows are of that size.
    near : ndarray of int, shape (k,)
        Which of those ``m`` each window is near.
    cell : ndarray of int, shape (k, 2)
        (col, row) of the window in which it begins, were the film paved with such: windows of one cell show much the same.
    values : ndarray of shape (k, pixels)
        Of the film.
    """

    half: int
    balls: Int
    near: Int
    cell: Int
    values: NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Modes:
    """Orthonormal surfaces over a window, beyond the quadratic one.

    Attributes
    ----------
    surface : ndarray of shape (pixels, k)
    degree : ndarray of int, shape (k,)
        Counted from the lowest.
    noise : ndarray of shape (k,)
        Variance of each in noise of variance one.
    """

    surface: Float
    degree: Int
    noise: Float


def free_places(film: NDArray[Any], balls: BallFits, others_px: Float, reach_px: Float, optics: Optics, noise: NoiseModel) -> list[Places]:
    """Return windows around balls in which no mark is and nothing is saturated.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    balls : BallFits
    others_px : ndarray of shape (m, 2)
        (col, row) of pins and tees.
    reach_px : ndarray of shape (m,)
        How far their images go.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    list of Places
        One for every size, all balls in one of them.
    """
    marks = np.concatenate([balls.position_px, others_px])
    reach = np.concatenate([balls.radius_px + 3 * optics.sigma_px, reach_px])
    halves = np.array([half_size(r, optics.sigma_px) for r in balls.radius_px])
    out = []
    for half in np.unique(halves):
        index = np.nonzero(halves == half)[0]
        nearest = half + balls.radius_px[index] + 3 * optics.sigma_px
        place = (balls.position_px[index, None] + nearest[:, None, None] * ROUND_ABOUT).reshape(-1, 2)
        one, mark = pairs_within(place, marks, _DIAGONAL * (half + reach))
        taken = one[np.abs(place[one] - marks[mark]).max(axis=1) <= half + reach[mark]]
        free = np.setdiff1d(np.arange(len(place)), taken)
        ball = free // len(ROUND_ABOUT)
        patches = cut(film, place[free], int(half), noise)
        whole = patches.valid.all(axis=(1, 2))
        values = patches.values[whole].reshape(-1, patches.size**2).astype(film.dtype)
        out.append(Places(int(half), index, ball[whole], patches.corner_px[whole] // patches.size, values))
    return out


def modes(half: int, noise: NoiseModel) -> Modes:
    """Return the surfaces of the third to the sixth degree over windows of ``2 half + 1`` pixels."""
    surface, degree = _surfaces(half)
    windows = surface.T.reshape(-1, 2 * half + 1, 2 * half + 1)
    return Modes(surface, degree, np.asarray(influence_covariance(windows, noise.correlation).diagonal()))


@lru_cache(maxsize=32)
def _surfaces(half: int) -> tuple[Float, Int]:
    axis = np.linspace(-1, 1, 2 * half + 1)
    powers = np.polynomial.legendre.legvander(axis, max(_DEGREES)).T
    pairs = [(d, k) for d in range(max(_DEGREES) + 1) for k in range(d + 1)]
    columns = np.stack([np.outer(powers[k], powers[d - k]).ravel() for d, k in pairs], axis=1)
    degree = np.array([d for d, _ in pairs]) - min(_DEGREES)
    return np.linalg.qr(columns)[0][:, degree >= 0], degree[degree >= 0]


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """How the film around balls goes on, beyond noise.

    Attributes
    ----------
    structure : ndarray of shape (n, degrees)
        Variances of the coefficients of :func:`modes` around each ball, in units of what noise makes of them: 0 where noise is all.
    differ : float
        Standard deviation of the logarithm of that from window to window.
    """

    structure: Float
    differ: float


def texture(places: list[Places], count: int, noise: NoiseModel) -> Texture:
    """Tell how much more than noise there is around balls, of each degree of :func:`modes`.

    Parameters
    ----------
    places : list of Places
    count : int
        Of balls.
    noise : NoiseModel

    Returns
    -------
    Texture
    """
    freedom = np.array(_DEGREES) + 1.0
    energies = []
    for these in places:
        known = modes(these.half, noise)
        square = ((these.values - these.values.mean(axis=1, keepdims=True)) @ known.surface) ** 2 / known.noise
        members = known.degree == np.arange(len(freedom))[:, None]
        energies.append(square @ members.T / freedom / noise.variance_at(these.values.mean(axis=1))[:, None])
    structure = around_each([e / (chdtri(freedom, 0.5) / freedom) for e in energies], places, count, 1.0) - 1.0
    both = [(e / (1 + structure[these.balls[these.near]])) @ freedom / freedom.sum() for e, these in zip(energies, places, strict=True)]
    logs = np.log(np.maximum(np.concatenate([np.ones(1), *both]), 1e-9))
    return Texture(structure, float(np.sqrt(max(robust_sd(logs) ** 2 - polygamma(1, 0.5 * freedom.sum()), _LEAST_DIFFER**2))))


def mean_beside(places: list[Places], count: int) -> Float:
    """Return the mean value of the places around each ball, shape (count,); NaN where there are none."""
    out = np.full(count, np.nan)
    for these in places:
        for k, ball in enumerate(these.balls):
            if (these.near == k).any():
                out[ball] = these.values[these.near == k].mean()
    return out


def around_each(figures: list[Float], places: list[Places], count: int, least: float, quantile: float = 0.5) -> Float:
    """Return the median of a figure over the places around each ball, drawn towards that over all of the film as far as balls are alike.

    Parameters
    ----------
    figures : list of ndarrays of shape (k, d)
        One row for every window.
    places : list of Places
    count : int
        Of balls.
    least : float
        Smaller figures are none.
    quantile : float
        0.5: the median.

    Returns
    -------
    ndarray of shape (count, d)
        1 where no ball has enough places.
    """
    width = figures[0].shape[1] if figures else 1
    own, error = np.full((count, width), np.nan), np.full((count, width), np.inf)
    logs = [np.log(np.maximum(values, least)) for values in figures]
    for these, values in zip(places, logs, strict=True):
        for k, ball in enumerate(these.balls):
            here = values[these.near == k]
            if len(here) >= _LEAST:
                chance = np.sqrt(quantile * (1 - quantile) / len(here))  # free of any distribution (Woodruff, JASA 47, 1952)
                low, own[ball], high = np.quantile(here, quantile + chance * np.array([-1, 0, 1]), axis=0)
                error[ball] = 0.25 * (high - low) ** 2
    enough = np.isfinite(error[:, 0])
    if not enough.any():
        return np.ones((count, width))
    together = np.concatenate(logs)
    apart = sum(len(np.unique(these.cell, axis=0)) for these in places)
    chance = np.sqrt(quantile * (1 - quantile) / apart)
    sure = quantile + _SURE * chance
    usual, high = np.quantile(together, [quantile, min(sure, 1.0)], axis=0)
    around = np.quantile(together, np.clip(quantile + chance * np.array([-1, 1]), 0.0, 1.0), axis=0)
    # more than was promised is believed as far as it is not chance (James and Stein, Fourth Berkeley Symposium, 1961)
    by_chance = np.square(0.5 * (around[1] - around[0]))
    usual = np.where(usual > 0, usual * np.maximum(1 - by_chance / np.maximum(usual, 1e-9) ** 2, 0.0), usual)
    # less than was promised is believed as far as it cannot be chance
    caution = np.maximum((np.minimum(high, 0.0) if sure < 1 else 0.0) - usual, 0.0)
    usual_error = error[enough].mean(axis=0)
    between = np.maximum(np.square(own[enough] - usual).mean(axis=0) - usual_error, 0.0)
    weight = between / np.maximum(between + usual_error, 1e-30) * enough[:, None]
    own = np.maximum(own, np.minimum(usual, 0.0))  # an area of one value says nothing of a ball in it
    return np.asarray(np.exp(usual + caution + weight * (np.where(enough[:, None], own, usual) - usual)))
