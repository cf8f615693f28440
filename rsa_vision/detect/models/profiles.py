"""Blurred images of tantalum balls: attenuation along the chord, then a Gaussian blur, as tables that depend on dimensionless numbers only.

A ball of radius ``r`` with attenuation coefficient ``mu`` (per pixel of chord) has, at distance ``t`` from its centre, the opacity
``1 - exp(-2 mu sqrt(r^2 - t^2))``. Blurred by a Gaussian of standard deviation ``sigma`` (screen, focal spot and pixel together) it is
a function ``f(rho/sigma, r/sigma; mu sigma)`` of the distance ``rho`` alone, so one table serves every ball of a film.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e

from rsa_vision.detect.models.film_curve import curve_of_bend, film_curve
from rsa_vision.types import Bool, Float, Int

TAIL = 2.4  # times the blur, of the wider part of the light
REACH = 6.0  # blur widths beyond the rim at which the image has faded (exp(-18))
_Y_MIN, _Y_MAX = 0.4, 22.0  # r / sigma covered by the tables
_X_STEP, _Y_STEP = 0.04, 0.02  # of rho / sigma, and of log(r / sigma), in the fine tables
_ROWS = 16  # of a fine table that are made at once: the balls of a film need few, and a film has attenuations of its own
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)


@dataclass(frozen=True, slots=True)
class Optics:
    """What is common to all marks of a film.

    Attributes
    ----------
    sigma_px : float
        Blur: standard deviation of screen, focal spot and pixel together.
    mu_px : float
        Attenuation per pixel of chord. It takes part of the bend of the film curve: flatter tops, more attenuation.
    curve : tuple of float
        The rest of it, which pins tell, and balls that lie over each other: of the blurred opacity ``o`` film shows ``g``, the log odds of
        which are those of ``o`` plus ``curve[0]``, and ``curve[1]`` times a skew, ``g (1 - g) (1 - 2 g)`` where that is negative; where it
        is not, one with which ``curve[0] ** 2 / 6`` makes the logarithm of ``1 - (1 - exp(2 curve[0])) o``. Negative bends where film
        answers more the more of its light is gone, as density does.
    tail : float
        Part of the light that is spread ``TAIL`` times as far as the rest: of screens, scanners and scatter nearby.
    late : float
        Part of the variance of the blur that comes after the film curve: of the scanner's pixel, where there is a scanner. Pins and tees.
    logged : float
        Logarithm of the light at full opacity over that of the background, where a film shows the logarithm of the light that is blurred
        late, as density is; zero where it shows the light. Pins and tees.
    proportion : float
        Change of a needle's depth with the background along it, both in film values: on a film that is linear in exposure a mark takes away
        a part of what is there, on a logarithmic one always the same.
    uneven : tuple of float
        Blur that differs by direction, of a focal spot that is no square or a scanner that reads lines: at the angle ``a`` its variance is
        ``1 + uneven[0] cos 2a + uneven[1] sin 2a`` times the mean one. Tips of pins and tees ask for it; it moves no centre of a ball.
    bend : float
        Of the film curve, as ``curve[0]``, with the skewness of a logarithm where it is negative: what single balls show of it beside
        attenuation. Balls only.
    own : tuple of float
        Logarithms of the attenuation and the blur of one pin or tee over these: so near to them that its image is linear in both.
    rough : bool
        The blur is a guess to improve upon.
    """

    sigma_px: float
    mu_px: float
    curve: tuple[float, float] = (0.0, 0.0)
    tail: float = 0.0
    late: float = 0.0
    logged: float = 0.0
    proportion: float = 0.0
    uneven: tuple[float, float] = (0.0, 0.0)
    bend: float = 0.0
    own: tuple[float, float] = (0.0, 0.0)
    rough: bool = False

    def pooled(self, side: int) -> Optics:
        """Return those of the film of which each pixel is the mean of a square of so many a side, which blurs it more."""
        return replace(self, sigma_px=float(np.hypot(self.sigma_px, side / np.sqrt(12))))


@dataclass(frozen=True, slots=True, eq=False)
class BallTable:
    """Blurred opacity of a ball and its derivatives on a grid of (log(r/sigma), rho/sigma).

    Attributes
    ----------
    coarse : ndarray of shape (k, m)
        Opacity (0..1) on the coarse grid.
    nodes : ndarray of shape (3, ny, nx), single precision
        Opacity, and its derivatives by rho/sigma and by r/sigma, where they have been asked for.
    made : ndarray of bool, shape (ny // _ROWS + 1,)
        Which rows that is.
    """

    coarse: Float
    nodes: NDArray[np.float32]
    made: Bool

    def evaluate(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Interpolate the table bilinearly.

        Parameters
        ----------
        x : ndarray of shape (n, ...)
            Distances rho / sigma, >= 0.
        y : ndarray of shape (n,)
            Radii r / sigma, one for each first index of ``x``.

        Returns
        -------
        value, d_rho, d_radius : ndarrays of the shape of ``x``
        """
        _, ny, nx = self.nodes.shape
        kind = x.dtype
        row = np.clip((np.log(y) - np.log(_Y_MIN)) / _Y_STEP, 0, ny - 1.001)
        top = row.astype(np.intp)
        frac = (row - top).astype(self.nodes.dtype)[:, None]
        if not self.made[top // _ROWS].all():
            self._make(np.unique(top // _ROWS))
        # one blended row for every ball, then a look-up along rho only: half the work of a two-dimensional look-up for each pixel
        col = np.minimum(x * kind.type(1 / _X_STEP), kind.type(nx - 1.001))
        left = col.astype(np.intp)
        part = col - left.astype(kind)
        reach = int(left.max(initial=0)) + 2
        low, high = self.nodes[:, top, :reach], self.nodes[:, top + 1, :reach]
        line = np.subtract(high, low, out=np.empty(low.shape, low.dtype))  # in one piece, as fancy indices do not leave it
        line *= frac
        line += low
        line = line.reshape(3, -1)
        index = left + (np.arange(len(y)) * reach).reshape((-1,) + (1,) * (x.ndim - 1))
        near, rise = (line.take(index + step, axis=1, mode="wrap") for step in (0, 1))  # none is beyond: "wrap" only spares the check
        rise -= near
        value, d_rho, d_radius = near + part * rise
        return value, d_rho, d_radius

    def _make(self, blocks: Int) -> None:
        of_y, by_y = _blur().along_y
        of_x, by_x = _blur().along_x
        for block in blocks[~self.made[blocks]].tolist():
            rows = slice(block * _ROWS, (block + 1) * _ROWS + 1)
            seen = of_y[rows] @ self.coarse
            self.nodes[:, rows] = seen @ of_x.T, seen @ by_x.T, by_y[rows] @ self.coarse @ of_x.T
            self.made[block] = True


def ball_table(optics: Optics) -> BallTable:
    """Return the table of balls on a film, which those of about as much attenuation along one blur width share.

    Parameters
    ----------
    optics : Optics

    Returns
    -------
    BallTable
    """
    return _table(round(optics.mu_px * optics.sigma_px, 3), round(optics.bend, 3))


@lru_cache(maxsize=12)  # a fit asks for nine
def _table(mu_sigma: float, bend: float) -> BallTable:
    """Build a table; much attenuation along one blur width makes a disc, little half an ellipse, and film bends either."""
    blur = _blur()
    opacity = -np.expm1(-2 * mu_sigma * blur.half_chord)
    coarse = np.matmul(blur.kernel, (opacity * blur.weight)[:, :, None])[:, :, 0]
    if bend:
        coarse = film_curve(coarse, curve_of_bend(bend))
    n_y, n_x = (len(of) for of, _ in (blur.along_y, blur.along_x))
    return BallTable(coarse, np.zeros((3, n_y, n_x), np.float32), np.zeros(n_y // _ROWS + 1, bool))


@dataclass(frozen=True, slots=True, eq=False)
class _Blur:
    """What the tables of all attenuations share.

    Attributes
    ----------
    half_chord, weight : ndarray of shape (k, 40)
        Half the chord at the nodes of a quadrature, and their weights in it, for ``k`` radii.
    kernel : ndarray of shape (k, m, 40)
        Blurred image of a ring, at ``m`` distances.
    along_y, along_x : tuple of two ndarrays, of shapes (ny, k) and (nx, m)
        Cubic spline from the coarse to the fine grid, and its derivative.
    """

    half_chord: Float
    weight: Float
    kernel: Float
    along_y: tuple[Float, Float]
    along_x: tuple[Float, Float]


@lru_cache(maxsize=1)
def _blur() -> _Blur:
    log_y = np.arange(np.log(_Y_MIN), np.log(_Y_MAX) + _Y_STEP, _Y_STEP)
    coarse_log_y = np.linspace(log_y[0], log_y[-1], 100)
    x = np.arange(0.0, _Y_MAX + REACH, _X_STEP)
    coarse_x = np.linspace(0.0, x[-1], 180)
    y = np.exp(coarse_log_y)
    # t = y sin(a): the square root at the rim becomes smooth, so that few nodes suffice
    angle = (_NODES + 1) * np.pi / 4
    t, half_chord = y[:, None] * np.sin(angle), y[:, None] * np.cos(angle)
    rho = coarse_x[None, :, None]
    kernel = np.exp(-0.5 * (rho - t[:, None, :]) ** 2) * i0e(rho * t[:, None, :])
    of_y, by_log_y = _interpolation(coarse_log_y, log_y)
    by_y = by_log_y / np.exp(log_y)[:, None]
    return _Blur(half_chord, t * half_chord * _WEIGHTS * np.pi / 4, kernel, (of_y, by_y), _interpolation(coarse_x, x))


def _interpolation(nodes: Float, at: Float) -> tuple[Float, Float]:
    """Return the matrices that make, of values at evenly spaced nodes (n,), those of their cubic spline and its slopes, shape (m, n).

    No knots at the second node and the last but one, as no slopes at the ends are known (de Boor, A Practical Guide to Splines, 1978).
    """
    n, step = len(nodes), nodes[1] - nodes[0]
    centre = np.arange(-1, n + 1)

    def basis(t: Float) -> tuple[Float, Float]:
        apart = t[:, None] - centre
        far = np.maximum(2 - np.abs(apart), 0.0)
        near = np.maximum(1 - np.abs(apart), 0.0)
        return far**3 / 6 - 4 * near**3 / 6, np.sign(apart) * (2 * near**2 - far**2 / 2)

    conditions = np.zeros((n + 2, n + 2))
    conditions[:n] = basis(np.arange(float(n)))[0]
    conditions[n, :5] = conditions[n + 1, -5:] = 1, -4, 6, -4, 1  # the third derivative does not jump
    coefficients = np.linalg.inv(conditions)[:, :n]
    value, slope = basis((at - nodes[0]) / step)
    return value @ coefficients, slope @ coefficients / step
