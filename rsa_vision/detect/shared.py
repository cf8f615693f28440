"""The last fit of a film's pins or tees: all at once, with what they have in common estimated beside what is each one's own.

Errors of attenuation, blur and the directions of parallel arms move every tip the same way and do not average out over a cage. Estimated
from one needle these are poor, from all of them they are good. Each needle's own parameters are eliminated from the normal equations
(variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973), so that the work goes with the number of needles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.alike import true_spread
from rsa_vision.detect.crossing import Window, between, gain_at, lapping, window_of
from rsa_vision.detect.needle_images import NeedleFit, NeedleShape, arm_images
from rsa_vision.detect.needle_sets import clusters, others_beside
from rsa_vision.detect.needles import core_pixels, scored
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import columns, weighted_least_squares
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float, Int

_STEPS = 8
_CONVERGED = 0.1  # standard deviations of a tip, where those are not below
_FINEST_PX = 0.02  # for the tables are interpolated
_STEP = 0.05  # of the logarithms of attenuation and blur, and of the taper, for derivatives
_ATTENUATION_ERROR, _BLUR_ERROR = 0.7, 0.3  # of the logarithms, before the needles are asked: they know better than balls
_TAPER_ERROR, _LEAST_TAPER = 0.1, 0.1
_OPTICS, _SHARED = 3, 5  # attenuation, blur, taper; then logarithms of half width and length
_SIZE_ERROR = 1.0  # of those, before
_SIZES_AFTER = 2  # steps, from which sizes are near enough to tell how much they differ
_DIRECTION_ERROR = 0.2  # radians, of the directions of arms against the first, before
_SETTLED = 0.1  # conditional standard deviations of all that is common
_MUCH = 0.15  # of the logarithms, from which derivatives by them are taken anew
_MOST_BY_STEP = 0.6  # of all these
_SLANT, _SKEW = 0.11, 0.08  # root mean squares, of a square and a product of slopes: rays cross a film at slopes of up to a half
_MOST_SLANT, _MOST_SKEW = 0.6, 0.3
# slants and skews of the arms by what one ray does at all of them: squares of its slopes along the first arm and across, and their product
_OF_SLANTS = {
    1: np.eye(2),
    3: np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0, -1]]),
}
_RIDGE = 1e-4  # relative: keeps what the pixels do not determine where it is


@dataclass(frozen=True, eq=False)
class _Equations:
    """Linearised fit of the needles of a window, by needles' own parameters and by the common ones.

    ``own`` (n, p), ``common`` (n, c) and ``residual`` (n,) are weighted to a variance of one; ``own`` in units of ``scale``. ``prior`` (p,)
    is one over what an own parameter is expected to be, ``known`` (p,) how much of that it is off.
    """

    members: list[NeedleFit]
    images: list[Float]
    weight: Float
    left: Float
    background: float
    own: Float
    common: Float
    residual: Float
    scale: Float
    prior: Float
    known: Float
    parallel: bool

    @cached_property
    def inverse(self) -> Float:
        """Inverse of the normal matrix of the own parameters, in units of their scale."""
        normal = self.own.T @ self.own + np.diag(self.prior**2 + _RIDGE**2)
        return np.asarray(np.linalg.inv(normal), np.float64)

    @cached_property
    def own_by_common(self) -> Float:
        """Change of the own parameters that takes up one of the common ones, shape (p, c), in units of their scale."""
        return np.asarray(self.inverse @ (self.own.T @ self.common), np.float64)

    @cached_property
    def own_alone(self) -> Float:
        """Change of the own parameters, shape (p,), in units of their scale, were the common ones right."""
        return np.asarray(self.inverse @ (self.own.T @ self.residual + self.prior * self.known), np.float64)

    def information(self) -> tuple[Float, Float]:
        """Normal matrix (c, c) and right-hand side (c,) of the common parameters, the own ones eliminated, their priors counted."""
        by_own = self.common.T @ self.own
        matrix, target = self.common.T @ self.common - by_own @ self.own_by_common, self.common.T @ self.residual - by_own @ self.own_alone
        return matrix / self.excess, target / self.excess

    def step(self, change: Float) -> Float:
        """Change of the own parameters, shape (p,), that goes with one of the common ones."""
        return np.asarray((self.own_alone - self.own_by_common @ change) / self.scale, np.float64)

    @property
    def tips(self) -> Int:
        """Places of the coordinates of the tips among the own parameters."""
        each = _own_parameters(len(self.members[0].angles), self.parallel)
        return np.add.outer(each * np.arange(len(self.members)), [0, 1]).ravel()

    @property
    def variance_of_sizes(self) -> Float:
        """Variances of half widths and lengths, shape (members, 2)."""
        each = _own_parameters(len(self.members[0].angles), self.parallel)
        at = np.add.outer(each * np.arange(len(self.members)), [2, 3])
        return np.asarray(self.excess * (self.inverse.diagonal() / self.scale**2)[at], np.float64)

    @property
    def sharpest_px(self) -> float:
        """Least standard deviation of a tip's coordinate."""
        return float((np.sqrt(self.inverse.diagonal()) / self.scale)[self.tips].min())

    @cached_property
    def excess(self) -> float:
        """Chi2 over what noise leaves, at least one."""
        return max(1.0, float(np.mean(self.weight * self.left**2)))


def fit_shared(
    film: NDArray[Any],
    needles: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    *,
    parallel: bool,
    alike: bool = False,
    steps: int = _STEPS,
) -> tuple[list[NeedleFit], Optics]:
    """Fit all needles of a film and their common attenuation, blur and directions.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
        Starts, all pins or all tees.
    optics : Optics
        Start.
    noise : NoiseModel
    parallel : bool
        The arms of all needles have the same directions against their first; else each arm its own.
    alike : bool
        Their sizes differ as little as fits with free sizes show: for pins, whose tips depend on where they end.
    steps : int
        At the most.

    Returns
    -------
    needles : list of NeedleFit
        In another order. The covariance of a tip holds the errors of what is common.
    optics : Optics
    """
    if not needles:
        return [], optics
    parallel = parallel and len(needles[0].angles) > 1
    sets = clusters(needles)
    windows = [_window(film, members, needles, optics, noise) for members in sets]
    before = [_ATTENUATION_ERROR, _BLUR_ERROR, _TAPER_ERROR, _SIZE_ERROR, _SIZE_ERROR]
    precision = np.diag(np.array(before + [_DIRECTION_ERROR] * ((len(needles[0].angles) - 1) * parallel)) ** -2.0)
    moved = np.zeros(len(precision))
    start, taper = optics, needles[0].shape.taper
    slopes: list[list[Float]] = []
    since = np.full(_OPTICS, np.inf)
    sizes = _Sizes(np.zeros(2), [np.full((len(m), 2), np.inf) for m in sets])
    converged = False
    for step in range(steps + 1):
        if np.abs(moved[:_OPTICS] - since).max() > _MUCH:
            slopes, since = [_by_optics(w, m, optics) for w, m in zip(windows, sets, strict=True)], moved[:_OPTICS].copy()
        systems = [
            _linearise(w, m, k, optics, noise, parallel, sizes.typical, spread)
            for w, m, k, spread in zip(windows, sets, slopes, sizes.spread, strict=True)
        ]
        told = [e.information() for e in systems]
        normal = precision + sum(matrix for matrix, _ in told)
        if step == steps or converged:
            break
        change = _step(normal, sum(target for _, target in told) - precision @ moved, taper)
        if np.abs(change[:_OPTICS]).max() > 0 and (np.abs(change) < _SETTLED / np.sqrt(normal.diagonal())).all():
            change[:_OPTICS] = 0.0  # new tables for so little are not worth their time
        moved += change
        taper += change[2]
        optics = replace(start, mu_px=start.mu_px * float(np.exp(moved[0])), sigma_px=start.sigma_px * float(np.exp(moved[1])))
        furthest = 0.0
        for i, e in enumerate(systems):
            sets[i], shift = _moved(e.members, e.step(change), change, taper, parallel)
            furthest = max(furthest, shift / max(e.sharpest_px, _FINEST_PX))
        converged = step > 0 and furthest < _CONVERGED
        sizes = replace(sizes, typical=sizes.typical + change[_OPTICS:_SHARED])
        if alike and step + 1 == _SIZES_AFTER:
            sizes, converged = _sizes(systems, sets), False
    errors = _common_errors(windows, systems, normal, precision, noise)
    out = []
    for window, e in zip(windows, systems, strict=True):
        out += _finished(window, e, errors, optics, noise, converged)
    return out, optics


def _window(film: NDArray[Any], members: list[NeedleFit], needles: list[NeedleFit], optics: Optics, noise: NoiseModel) -> Window:
    others = others_beside(members, [t for t in needles if all(t is not m for m in members)], optics)
    return window_of(film, members, optics, noise, others)


def _step(normal: Float, target: Float, taper: float) -> Float:
    """Change of the common parameters, not too far at once; the taper stays within its bounds, the others follow."""
    change = np.linalg.solve(normal, target).astype(np.float64)
    change *= min(1.0, _MOST_BY_STEP / max(float(np.abs(change).max()), 1e-9))
    held = between(change[2], _LEAST_TAPER - taper, 1.0 - taper)
    if held != change[2]:
        others = np.arange(len(change)) != 2
        change[others] = np.linalg.solve(normal[np.ix_(others, others)], target[others] - normal[others, 2] * held)
        change[others] *= min(1.0, _MOST_BY_STEP / max(float(np.abs(change[others]).max()), 1e-9))
        change[2] = held
    return change


def _arms(window: Window, fit: NeedleFit, optics: Optics) -> Float:
    slants = np.zeros((2, len(fit.angles))) if fit.slants is None else fit.slants
    return arm_images(window.cols - fit.position_px[0], window.rows - fit.position_px[1], fit.angles, fit.shape, optics, slants)


def _by_optics(window: Window, members: list[NeedleFit], optics: Optics) -> list[Float]:
    """Derivatives of each member's arms by log attenuation, log blur and taper, shape (3, k, n); how the ends slant hardly matters."""
    factor = np.exp(_STEP)
    denser, wider = replace(optics, mu_px=optics.mu_px * factor), replace(optics, sigma_px=optics.sigma_px * factor)
    out = []
    for f in members:
        offsets = window.cols - f.position_px[0], window.rows - f.position_px[1]
        shorter = replace(f.shape, taper=f.shape.taper - _STEP)
        here, dense, wide = (arm_images(*offsets, f.angles, f.shape, o)[0] for o in (optics, denser, wider))
        short = arm_images(*offsets, f.angles, shorter, optics)[0]
        out.append(np.array([dense - here, wide - here, here - short]) / _STEP)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Sizes:
    """Logarithms of half width and length that are usual on a film, and what each needle may differ from them, by sets (m, 2)."""

    typical: Float
    spread: list[Float]


def _sizes(systems: list[_Equations], sets: list[list[NeedleFit]]) -> _Sizes:
    """What fits with sizes of their own tell of the sizes: pins of one cage are alike, but for how the rays meet them."""
    size = np.array([[f.shape.half_width_px, f.shape.length_px] for members in sets for f in members])
    variance = np.concatenate([e.variance_of_sizes for e in systems]) / size**2
    values = np.log(size)
    told = [true_spread(values[:, k], variance[:, k]) for k in range(2)]
    spread = np.stack([np.where(belongs, sd, np.inf) for _, sd, belongs in told], axis=1)
    return _Sizes(np.array([centre for centre, _, _ in told]), np.split(spread, np.cumsum([len(m) for m in sets])[:-1]))


def _linearise(
    window: Window,
    members: list[NeedleFit],
    slopes: list[Float],
    optics: Optics,
    noise: NoiseModel,
    parallel: bool,
    typical: Float,
    spread: Float,
) -> _Equations:
    blocks = [_arms(window, f, optics) for f in members]
    # a first background for the gain; the next round has a better one
    linear = columns([*(b[0] for b in blocks), *lapping([b[0].sum(0) for b in blocks]), window.surface.T])
    level = np.full(len(window.data), float(window.data.mean()))
    weight = 1.0 / noise.variance_at(level + window.beside)
    for _ in range(2):
        theta = weighted_least_squares(linear, weight, window.data, 1e-6)
        weight = 1.0 / noise.variance_at(linear @ theta + window.beside)
    ground = window.surface[:, 1:] @ theta[-window.surface.shape[1] + 1 :]
    if optics.proportion:
        gains = [gain_at(f, ground, optics) for f in members]
        blocks = [b * g for b, g in zip(blocks, gains, strict=True)]
        slopes = [s * g for s, g in zip(slopes, gains, strict=True)]
        linear = columns([*(b[0] for b in blocks), *lapping([b[0].sum(0) for b in blocks]), window.surface.T])
        theta = weighted_least_squares(linear, weight, window.data, 1e-6)
    arms = len(members[0].angles)
    now = [replace(f, depths=theta[arms * i : arms * (i + 1)].copy()) for i, f in enumerate(members)]
    of_slants = _OF_SLANTS[arms]
    expected = np.array([*[_SLANT] * (of_slants.shape[1] - 1), _SKEW])
    moves, common, priors, known = [], np.zeros((_SHARED + (arms - 1) * parallel, len(weight))), [], []
    for f, (_, d_col, d_row, d_w, d_l, d_angle, d_slant, d_skew), slope, differs in zip(now, blocks, slopes, spread, strict=True):
        size = np.array([f.shape.half_width_px, f.shape.length_px])
        turns = f.depths[:, None] * d_angle
        slants = np.zeros((2, arms)) if f.slants is None else f.slants
        by_ends = (f.depths[:, None] * np.array([d_slant, d_skew])).reshape(2 * arms, -1)
        moves += [(f.depths @ d)[None] for d in (d_col, d_row, d_w, d_l)]
        moves += [turns.sum(0, keepdims=True) if parallel else turns, of_slants.T @ by_ends]
        common[:_OPTICS] += f.depths @ slope
        common[_OPTICS:_SHARED] += [size[0] * (f.depths @ d_w), size[1] * (f.depths @ d_l)]
        if parallel:
            common[_SHARED:] += turns[1:]
        turning = np.zeros(1 if parallel else arms)
        priors += [np.zeros(2), 1 / (differs * size), turning, 1 / expected]
        known += [
            np.zeros(2),
            (typical - np.log(size)) / differs,
            turning,
            -(slants.ravel() @ of_slants) / (of_slants**2).sum(0) / expected,
        ]
    root = np.sqrt(weight)
    jac = np.concatenate([*moves, linear.T]).T * root[:, None]
    scale = np.maximum(np.linalg.norm(jac, axis=0), 1e-12)
    jac /= scale
    left = window.data - linear @ theta
    rest = np.zeros(linear.shape[1])
    return _Equations(
        members=now,
        images=[f.depths @ b[0] for f, b in zip(now, blocks, strict=True)],
        weight=weight,
        left=left,
        background=float(theta[-window.surface.shape[1]]),
        own=jac,
        common=common.T * root[:, None],
        residual=left * root,
        scale=scale,
        prior=np.concatenate([*priors, rest]) / scale,
        known=np.concatenate([*known, rest]),
        parallel=parallel,
    )


def _own_parameters(arms: int, parallel: bool) -> int:
    """Count tip (2), half width, length, one or all directions and what the ends have; the depths are linear."""
    return 4 + (1 if parallel else arms) + int(_OF_SLANTS[arms].shape[1])


def _moved(members: Sequence[NeedleFit], delta: Float, change: Float, taper: float, parallel: bool) -> tuple[list[NeedleFit], float]:
    """Needles after a step of their own parameters and of the common ones, and how far the furthest tip went."""
    arms = len(members[0].angles)
    wider, longer, turns = *change[_OPTICS:_SHARED], change[_SHARED:]
    turning = 1 if parallel else arms
    each = 4 + turning + _OF_SLANTS[arms].shape[1]
    parts = delta[: each * len(members)].reshape(len(members), each)
    shift, turn = float(np.abs(parts[:, :2]).max()), float(np.abs(parts[:, 4 : 4 + turning]).max())
    scale = min(1.0, 1.0 / max(shift, 1e-9), 0.1 / max(turn, 1e-9))
    out = []
    for f, part in zip(members, scale * parts, strict=True):
        width, length = f.shape.half_width_px, f.shape.length_px
        width = between(width + between(part[2] + width * wider, -0.5, 0.5), 0.6, 0.3 * length)
        shape = NeedleShape(width, max(length + between(part[3] + length * longer, -2.0, 2.0), 3.0), taper)
        angles = f.angles + part[4 : 4 + turning] + (np.concatenate([[0.0], turns]) if parallel else 0.0)
        slants = (np.zeros((2, arms)) if f.slants is None else f.slants) + (_OF_SLANTS[arms] @ part[4 + turning :]).reshape(2, arms)
        slants = np.clip(slants, [[-_SLANT], [-_MOST_SKEW]], [[_MOST_SLANT], [_MOST_SKEW]])
        out.append(replace(f, position_px=f.position_px + part[:2], shape=shape, angles=angles, slants=slants))
    return out, shift


def _common_errors(windows: list[Window], systems: list[_Equations], normal: Float, precision: Float, noise: NoiseModel) -> Float:
    """Covariance of the common parameters, for noise that neighbouring pixels share."""
    spread = precision.copy()
    for window, e in zip(windows, systems, strict=True):
        unexplained = e.common - e.own @ e.own_by_common
        spread += (
            influence_covariance(window.square(unexplained.T), noise.correlation)
            + e.own_by_common.T @ (e.prior[:, None] ** 2 * e.own_by_common)
        ) / e.excess
    inverse = np.linalg.inv(normal)
    covariance: Float = inverse @ spread @ inverse
    return covariance


def _finished(window: Window, e: _Equations, errors: Float, optics: Optics, noise: NoiseModel, converged: bool) -> list[NeedleFit]:
    to_tips = (e.inverse @ e.own.T)[e.tips] / e.scale[e.tips, None]
    by_common = (e.own_by_common / e.scale[:, None])[e.tips]
    covariance = influence_covariance(window.square(to_tips), noise.correlation) + by_common @ errors @ by_common.T
    of_prior = (e.inverse[e.tips] * e.prior) / e.scale[e.tips, None]  # what is held near to the expected is not exactly there
    covariance = covariance + of_prior @ of_prior.T
    variance = float(noise.variance_at(np.array([e.background]))[0])
    out = []
    for i, (fit, image) in enumerate(zip(e.members, e.images, strict=True)):
        at = slice(2 * i, 2 * i + 2)
        fit = replace(fit, covariance_px2=covariance[at, at], converged=converged)
        whole = core_pixels(fit.position_px, fit.angles, fit.shape, optics.sigma_px)
        out.append(scored(fit, image, e.left, e.weight, window.surface, e.background, variance, whole))
    return out
