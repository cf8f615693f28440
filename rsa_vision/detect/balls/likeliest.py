"""Blur and attenuation, and where balls are small the bend of the film curve, with which all balls of a film are the most likely.

Each ball's own numbers are eliminated first (variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973). Its say is divided by
what the model leaves of it, as if the variance of each were unknown: bone under it and errors of the model are no noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, look_clear
from rsa_vision.detect.balls.find import fit_at
from rsa_vision.detect.balls.fits import BallFits, ball_image, radii, slopes
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.profiles import Optics, ball_table
from rsa_vision.types import Float

# what is expected before the balls are asked, tantalum of 0.5 to 1 mm at 8 per mm and blurs of 0.1 to 0.3 mm: blur over radius,
# attenuation along a radius (less where film curve or scatter hide it), and the errors of their logarithms and of a bend of the film curve
_BLUR, _ATTENUATION, _EXPECTED = 0.4, 2.5, np.array([0.6, 0.8, 0.7])
_BY_STEP = np.array([[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # of what is expected, by steps
_PLAIN, _BENT = 2, 3  # numbers of the optics: without a bend of the film curve and with it
_SURELY_BENT, _MOST_BENT = 9.0, 2.0  # twice the log-likelihood that it must gain; as bent as that
_BENDS = 0.0, -0.75  # from where it is looked for: the other that of logarithms, of a ball that lets a fifth of the light pass
_SMALL, _SURELY_LARGER = 1.2, 2.5  # blur widths, of a radius, and of one that is guessed with another blur
_SIGMA_PX, _KAPPA = (0.4, 4.0), (0.03, 4.0)
_ROUNDS = 8
_STEP = 0.05  # of the logarithms and the bend, for derivatives
_MOST_BY_STEP = 0.5
_SHORTER = 3  # attempts at a step that gains
_ODD = 6.0  # three times what the two numbers of the optics gain by chance
_SETTLED = 0.3  # standard deviations
_WHOLE, _INSIDE, _MOST_ASKED = 0.98, 0.8, 40  # of the pixels under a ball that tells of a bend, and of its window; of those


def most_likely(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel) -> tuple[Optics, BallFits]:
    """Find the most likely blur and attenuation.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        Balls, of one polarity.
    optics : Optics
        From where to begin.
    noise : NoiseModel

    Returns
    -------
    optics : Optics
    fits : BallFits
        With these.
    """
    asked, fits = _ask(film, fits, optics, noise)
    return _uphill(asked, fits, optics, _PLAIN)


def with_bend(film: NDArray[Any], looks: BallFits, optics: Optics, noise: NoiseModel) -> Optics:
    """Return the optics of small balls with the bend of the film curve, if the likelihood of all gains more by that than by chance.

    Where film shows the logarithm of the light, a blurred ball is higher in its middle than on any other, and passes for a smaller one
    that is blurred more. Of larger ones the attenuation takes up the bend.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    looks : BallFits
        First looks at balls, of one polarity.
    optics : Optics
        As balls have told them.
    noise : NoiseModel

    Returns
    -------
    Optics
    """
    looks = looks.rows(np.argsort(-looks.significance, kind="stable")[:_MOST_ASKED])
    if len(looks.depth) < LEAST_KNOWN or np.median(looks.radius_px) > _SURELY_LARGER * optics.sigma_px:
        return optics
    fits = fit_at(film, looks.position_px, looks.radius_px, optics, noise, quick=True)
    clear = fits.rows(look_clear(fits, noise) & (fits.valid_fraction > _WHOLE) & (fits.window_fraction > _INSIDE))
    if len(clear.depth) < LEAST_KNOWN or np.median(clear.radius_px) > _SMALL * optics.sigma_px:
        return optics
    asked, fits = _ask(film, clear, optics, noise)
    now = asked.equations(fits, optics, _BENT)
    say, best, most = _summed(fits, optics, now)[0], optics, _SURELY_BENT
    for bend in _BENDS:
        start = replace(optics, bend=bend)
        bent, found = _uphill(asked, asked.fit(fits, start), start, _BENT)
        gain = _gain(say, now, asked.equations(found, bent, _BENT)) + unexpected(optics, fits) - unexpected(bent, found)
        if gain > most and not _are_specks(found, bent):
            best, most = bent, gain
    return best


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """What balls say of the logarithms of blur and of attenuation along it, and of the bend, each ball's own numbers eliminated."""

    normal: Float  # (n, k, k), of the first k of these
    right: Float  # (n, k)
    left: Float  # (n,): squared residuals over the variance
    spread: Float  # (n,): variance of ``right`` over that of white noise


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """Balls that are asked, and which pixels of them with which weight: the same all the time, or likelihoods could not be compared."""

    film: NDArray[Any]
    noise: NoiseModel
    first: BallFits
    halves: Float  # (n,), half sides of their windows

    def fit(self, fits: BallFits, optics: Optics) -> BallFits:
        """Fit the balls again with other optics."""
        return fit_at(self.film, fits.position_px, fits.radius_px, optics, self.noise, quick=True)

    def equations(self, fits: BallFits, optics: Optics, numbers: int) -> _Equations:
        """Return what the balls say of the first numbers of the optics."""
        n, sigma = len(fits.depth), optics.sigma_px
        either = [[_stepped(optics, way) for way in (step, -step)] for step in _STEP * np.eye(_BENT)[:numbers]]
        out = _Equations(np.zeros((n, numbers, numbers)), np.zeros((n, numbers)), np.zeros(n), np.ones(n))
        for half in np.unique(self.halves):
            index = np.nonzero(self.halves == half)[0]
            one = fits.rows(index)
            patches = cut(self.film, self.first.position_px[index], int(half), self.noise)
            rows, cols = np.mgrid[0 : patches.size, 0 : patches.size].reshape(2, 1, -1).astype(np.float64)
            dx, dy = (axis - at[:, None] for axis, at in zip((cols, rows), (one.position_px - patches.corner_px).T, strict=True))
            images = [[ball_image(dx, dy, one.radius_px, of) for of in ways] for ways in either]
            shared = np.stack([more - less for more, less in images], 1) / (2 * _STEP)
            value, by_dx, by_dy, by_radius = slopes(ball_table(optics), dx, dy, one.radius_px, sigma)
            surface = polynomial(half, cols[0] - half, rows[0] - half).T
            depth, background = one.depth[:, None], one.background[:, None]
            of_ball = np.stack([value, depth * by_dx, depth * by_dy, depth * by_radius], 1)
            own = np.concatenate([of_ball, np.broadcast_to(surface, (len(index), *surface.shape))], 1)
            root = np.sqrt(patches.valid.reshape(len(index), -1) / self.noise.variance_at(self.first.background[index, None]))
            target = (root * (patches.values.reshape(len(index), -1) - background - depth * value))[:, :, None]
            own, shared = own * root[:, None], shared * (depth * root)[:, None]
            # what a step of its own numbers alone still takes away is none of the others' business
            inverse = invert(np.matmul(own, own.transpose(0, 2, 1)))
            target = target - np.matmul(own.transpose(0, 2, 1), np.matmul(inverse, np.matmul(own, target)))
            of_own = np.matmul(inverse, np.matmul(own, shared.transpose(0, 2, 1)))
            rest = shared - np.matmul(of_own.transpose(0, 2, 1), own)
            out.normal[index] = np.matmul(rest, rest.transpose(0, 2, 1))
            out.right[index] = np.matmul(rest, target)[:, :, 0]
            out.left[index] = np.square(target).sum((1, 2))
            windows = rest.reshape(len(index), numbers, patches.size, patches.size)
            scatter = influence_covariance(windows, self.noise.correlation)
            spread = np.einsum("nij,nji->n", invert(out.normal[index]), scatter) / numbers
            out.spread[index] = np.where(spread > 0, spread, 1.0)  # a fit that has left the film says nothing
        return out


def _ask(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel) -> tuple[_Asked, BallFits]:
    """Fit balls with the optics to begin with."""
    halves = np.ceil(fits.radius_px + 2.5 * optics.sigma_px + 1)
    fits = fit_at(film, fits.position_px, fits.radius_px, optics, noise, quick=True)
    return _Asked(film, noise, fits, halves), fits


def _are_specks(fits: BallFits, optics: Optics) -> bool:
    """Say whether most are as small as a fit lets them be."""
    return bool(np.median(fits.radius_px) <= radii(optics.sigma_px)[0])


def _uphill(asked: _Asked, fits: BallFits, optics: Optics, numbers: int) -> tuple[Optics, BallFits]:
    """Go to the most likely values of the first numbers of the optics."""
    now = asked.equations(fits, optics, numbers)
    for _ in range(_ROUNDS):
        say, normal, right = _summed(fits, optics, now)
        step = np.asarray(np.linalg.solve(normal, right), np.float64)
        if (np.abs(step) < _SETTLED * np.sqrt(np.diag(np.linalg.inv(normal)))).all():
            optics = _stepped(optics, step)  # so little is gained for certain
            break
        step *= min(1.0, _MOST_BY_STEP / float(np.abs(step).max()))
        expected_before = unexpected(optics, fits)
        for _ in range(_SHORTER):
            trial = _stepped(optics, step)
            moved = asked.fit(fits, trial)
            then = asked.equations(moved, trial, numbers)
            if _gain(say, now, then) + expected_before > unexpected(trial, moved):
                optics, fits, now = trial, moved, then
                break
            step = step / 3
        else:
            break
    return optics, fits


def _gain(say: Float, now: _Equations, then: _Equations) -> float:
    """Return twice the log-likelihood that all balls gain; a fit that has gone elsewhere does not decide."""
    return float(np.clip(say * (now.left - then.left), -_ODD, _ODD).sum())


def _summed(fits: BallFits, optics: Optics, now: _Equations) -> tuple[Float, Float, Float]:
    """Return the say of each ball, and the equations of all with what is expected."""
    say = 1 / (np.maximum.reduce([fits.chi2_core, fits.chi2_ring, np.ones(len(now.left))]) * now.spread)
    # Student's weights: what would gain much by optics of its own is none of the film's balls
    own = np.einsum("ni,nij,nj->n", now.right, invert(now.normal), now.right)
    say /= 1 + say * own / _ODD
    numbers = now.right.shape[1]
    expected = (_BY_STEP / _EXPECTED[:, None])[:numbers, :numbers]
    normal = np.einsum("n,nij->ij", say, now.normal) + expected.T @ expected
    return say, normal, say @ now.right - expected.T @ _unexpected(optics, fits)[:numbers]


def _stepped(optics: Optics, step: Float) -> Optics:
    """Optics after a step of the logarithms of blur and of attenuation along it, and perhaps of the bend."""
    sigma = float(np.clip(optics.sigma_px * np.exp(step[0]), *_SIGMA_PX))
    kappa = float(np.clip(optics.mu_px * optics.sigma_px * np.exp(step[1]), *_KAPPA))
    bend = float(np.clip(optics.bend + step[_PLAIN:].sum(), -_MOST_BENT, _MOST_BENT))
    return Optics(sigma, kappa / sigma, bend=bend)


def unexpected(optics: Optics, fits: BallFits) -> float:
    """Return minus twice the logarithm of the prior of blur and attenuation, but for a constant, given the sizes of balls.

    Parameters
    ----------
    optics : Optics
    fits : BallFits

    Returns
    -------
    float
    """
    return float(np.square(_unexpected(optics, fits)).sum())


def _unexpected(optics: Optics, fits: BallFits) -> Float:
    """Logarithms of blur and attenuation over the expected ones, and the bend, in units of what is expected of them."""
    radius = float(np.median(fits.radius_px))
    logs = np.log([optics.sigma_px / (_BLUR * radius), optics.mu_px * radius / _ATTENUATION])
    return np.asarray(np.append(logs, optics.bend) / _EXPECTED)
