"""Linearised fits of the pins or tees of one window, for :mod:`rsa_vision.detect.shared`: each one's own parameters and the common ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rsa_vision.detect.crossing import Window, gain_at, lapping
from rsa_vision.detect.needle_images import NeedleFit, arm_images
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.patches import columns, weighted_least_squares
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float, Int

OPTICS, SHARED = 3, 5  # common to all: attenuation, blur, taper; then logarithms of half width and length; then directions
_STEP = 0.05  # of the logarithms of attenuation and blur, and of the taper, for derivatives
SLANT, SKEW = 0.11, 0.08  # root mean squares, of a square and a product of slopes: rays cross a film at slopes of up to a half
# slants and skews of the arms by what one ray does at all of them: squares of its slopes along the first arm and across, and their product
OF_SLANTS = {
    1: np.eye(2),
    3: np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0, -1]]),
}
_RIDGE = 1e-4  # relative: keeps what the pixels do not determine where it is


@dataclass(frozen=True, eq=False)
class Equations:
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
        each = own_parameters(len(self.members[0].angles), self.parallel)
        return np.add.outer(each * np.arange(len(self.members)), [0, 1]).ravel()

    @property
    def variance_of_sizes(self) -> Float:
        """Variances of half widths and lengths, shape (members, 2)."""
        each = own_parameters(len(self.members[0].angles), self.parallel)
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


def linearise(
    window: Window,
    members: list[NeedleFit],
    slopes: list[Float],
    optics: Optics,
    noise: NoiseModel,
    parallel: bool,
    typical: Float,
    spread: Float,
) -> Equations:
    """Linearise the fit of the needles of a window where they are.

    Parameters
    ----------
    window : Window
    members : list of NeedleFit
    slopes : list of ndarrays of shape (3, k, n)
        As of :func:`by_optics`, one for each.
    optics : Optics
    noise : NoiseModel
    parallel : bool
        The arms of all needles have the same directions against their first.
    typical : ndarray of shape (2,)
        Logarithms of half width and length that are usual on the film.
    spread : ndarray of shape (members, 2)
        How far each may differ from them (standard deviations); infinite where nothing is known.

    Returns
    -------
    Equations
    """
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
    of_slants = OF_SLANTS[arms]
    expected = np.array([*[SLANT] * (of_slants.shape[1] - 1), SKEW])
    moves, common, priors, known = [], np.zeros((SHARED + (arms - 1) * parallel, len(weight))), [], []
    for f, (_, d_col, d_row, d_w, d_l, d_angle, d_slant, d_skew), slope, differs in zip(now, blocks, slopes, spread, strict=True):
        size = np.array([f.shape.half_width_px, f.shape.length_px])
        turns = f.depths[:, None] * d_angle
        slants = np.zeros((2, arms)) if f.slants is None else f.slants
        by_ends = (f.depths[:, None] * np.array([d_slant, d_skew])).reshape(2 * arms, -1)
        moves += [(f.depths @ d)[None] for d in (d_col, d_row, d_w, d_l)]
        moves += [turns.sum(0, keepdims=True) if parallel else turns, of_slants.T @ by_ends]
        common[:OPTICS] += f.depths @ slope
        common[OPTICS:SHARED] += [size[0] * (f.depths @ d_w), size[1] * (f.depths @ d_l)]
        if parallel:
            common[SHARED:] += turns[1:]
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
    return Equations(
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


def own_parameters(arms: int, parallel: bool) -> int:
    """Count tip (2), half width, length, one or all directions and what the ends have; the depths are linear."""
    return 4 + (1 if parallel else arms) + int(OF_SLANTS[arms].shape[1])


def _arms(window: Window, fit: NeedleFit, optics: Optics) -> Float:
    slants = np.zeros((2, len(fit.angles))) if fit.slants is None else fit.slants
    return arm_images(window.cols - fit.position_px[0], window.rows - fit.position_px[1], fit.angles, fit.shape, optics, slants)


def by_optics(window: Window, members: list[NeedleFit], optics: Optics) -> list[Float]:
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
