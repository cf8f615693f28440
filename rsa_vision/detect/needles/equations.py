"""Linearised fits of the pins or tees of one window, for the fit of all: each one's own parameters and the common ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.least_squares import damped_solution
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit, arm_images, arms_by_optics
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import Window, gain_at, lapping
from rsa_vision.detect.needles.irregular import ARMS, OF_STRETCH, WAYS, Regularity, ways_of
from rsa_vision.types import Float, Int

# common to all: attenuation, blur, taper, curve (2), tail, late, logged, uneven (2); logarithms of half width and length; directions
BENT, UNEVEN = slice(3, 10), slice(8, 10)
OPTICS, SHARED = 10, 12
OWN = 5  # tip (2), half width, length, blur; then directions, slants, and how arms differ, or the attenuation and the taper of a pin
ATTENUATION, BLUR, TAPER, LATE, LOGGED = 0, 1, 2, 6, 7  # places of these in what is common
SLANT, SKEW = 0.11, 0.08  # root mean squares, of a square and a product of slopes: rays cross a film at slopes of up to a half
# slants and skews of the arms by what one ray does at all of them: squares of its slopes along the first arm and across, and their product
OF_SLANTS = {
    1: np.eye(2),
    3: np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0, -1]]),
}
_OF_PRODUCT = 0.1  # of the depth: error of the product of two shadows where they lie over each other
_CORE = 0.3  # of the largest depth, from which the noise is that under a needle
_RIDGE = 1e-4  # relative: keeps what the pixels do not determine where it is


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What is expected of the needles of a window.

    Attributes
    ----------
    sizes : ndarray of shape (2,)
        Logarithms of half width and length that are usual on the film.
    of_sizes : ndarray of shape (members, 2)
        How far each may differ from them (standard deviations); infinite where nothing is known.
    blur : float
        What is usual of the logarithm of a needle's blur over the film's.
    of_blur : ndarray of shape (members,)
        How far each may differ from that.
    taper : float
        What is usual.
    of_taper : ndarray of shape (members,)
        How far each pin may differ from that.
    density : float
        What is usual of the logarithm of a pin's attenuation over the film's.
    of_density : ndarray of shape (members,)
        How far each may differ from that.
    regularity : Regularity, optional
        Of the arms of tees.
    of_ways : ndarray of shape (members, 4)
        Of that, the spread of these.
    """

    sizes: Float
    of_sizes: Float
    blur: float
    of_blur: Float
    taper: float
    of_taper: Float
    density: float
    of_density: Float
    regularity: Regularity | None
    of_ways: Float


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What a window has shown of its needles: all that another step asks of the one before."""

    members: list[NeedleFit]
    model: Float
    ground: Float
    background: float


@dataclass(frozen=True, eq=False)
class Equations:
    """Linearised fit of the needles of a window, by needles' own parameters and by the common ones.

    ``own`` (p, n), ``common`` (c, n) and ``residual`` (n,) are weighted to a variance of one; ``normal`` (p + c, p + c) holds the products
    of the former two, ``right`` (p + c,) those with the residual. The former two are kept as fine as their tables are. ``prior`` (p,) is
    one over what an own parameter is expected to be, ``known`` (p,) how much of that it is off.
    """

    shown: Shown
    images: list[Float]
    weight: Float
    left: Float
    own: NDArray[np.float32]
    common: NDArray[np.float32]
    normal: Float
    right: Float
    residual: Float
    prior: Float
    known: Float
    parallel: bool

    @property
    def members(self) -> list[NeedleFit]:
        """Needles, where the equations hold."""
        return self.shown.members

    @cached_property
    def inverse(self) -> Float:
        """Inverse of the normal matrix of the own parameters."""
        normal = self.normal[: len(self.own), : len(self.own)]
        scale = np.maximum(np.sqrt(normal.diagonal()), 1e-12)
        both = scale[:, None] * scale
        return np.asarray(np.linalg.inv(normal / both + np.diag((self.prior / scale) ** 2 + _RIDGE**2)) / both, np.float64)

    @cached_property
    def own_by_common(self) -> Float:
        """Change of the own parameters that takes up one of the common ones, shape (p, c)."""
        return np.asarray(self.inverse @ self.normal[: len(self.own), len(self.own) :], np.float64)

    @cached_property
    def own_alone(self) -> Float:
        """Change of the own parameters, shape (p,), were the common ones right."""
        return np.asarray(self.inverse @ (self.right[: len(self.own)] + self.prior * self.known), np.float64)

    def information(self) -> tuple[Float, Float]:
        """Normal matrix (c, c) and right-hand side (c,) of the common parameters, the own ones eliminated, their priors counted."""
        by_own, alone = self.normal[len(self.own) :, : len(self.own)], self.normal[len(self.own) :, len(self.own) :]
        matrix, target = alone - by_own @ self.own_by_common, self.right[len(self.own) :] - by_own @ self.own_alone
        return matrix / self.excess, target / self.excess

    def step(self, change: Float) -> Float:
        """Change of the own parameters, shape (p,), that goes with one of the common ones."""
        return np.asarray(self.own_alone - self.own_by_common @ change, np.float64)

    def filtered(self, window: Window, through: Filter) -> Equations:
        """Return the same by generalised least squares."""
        white = window.filtered(np.concatenate([self.own, self.common, self.residual[None]]), through)
        residual = white[-1].copy()
        kept = white[:-1].astype(np.float32)
        own, common = kept[: len(self.own)], kept[len(self.own) :]
        return replace(self, own=own, common=common, normal=white[:-1] @ white[:-1].T, right=white[:-1] @ residual, residual=residual)

    def noise_under(self, own: Float, common: Float) -> float:
        """Mean square of what is left under the needles once these changes are made over that beside them, each over what a fit leaves.

        NaN where one of the two has no pixels: in film that is saturated around a needle.
        """
        square = np.square(self.residual - own @ self.own - common @ self.common)
        leverage = (self.own * (self.inverse @ self.own)).sum(axis=0)
        image = np.abs(np.sum(self.images, axis=0))
        core = image > _CORE * image.max()
        if core.all() or not core.any():
            return float("nan")
        under, beside = (square[where].sum() / (1 - leverage[where]).sum() for where in (core, ~core))
        return float(under / beside)

    @property
    def tips(self) -> Int:
        """Places of the coordinates of the tips among the own parameters."""
        each = own_parameters(len(self.members[0].angles), self.parallel)
        return np.add.outer(each * np.arange(len(self.members)), [0, 1]).ravel()

    def surprise(self, change: Float, error_px: float) -> Float:
        """Squared standard deviations by which a change of the own parameters moves each tip (members,), this error added to its own."""
        at = self.tips.reshape(-1, 2)
        covariance = self.inverse[at[:, :, None], at[:, None]] + error_px**2 * np.eye(2)
        return np.asarray(np.einsum("mi,mi->m", change[at], np.linalg.solve(covariance, change[at][:, :, None])[:, :, 0]) / 2)

    def free_ways(self, common: Float) -> tuple[Float, Float]:
        """How far the arms of each tee differ were nothing expected of that, and the squares of the errors, shape (members, 4)."""
        each = own_parameters(ARMS, self.parallel)
        change, variance = self._free(np.arange(each - WAYS, each))
        return np.array([ways_of(f, common) for f in self.members]) + change, variance

    def free_blurs(self) -> tuple[Float, Float]:
        """How far the blur of each differs were nothing expected of that, and the squares of the errors, shape (members,)."""
        change, variance = self._free(np.array([OWN - 1]))
        return np.array([f.blurrier for f in self.members]) + change[:, 0], variance[:, 0]

    def free_tapers(self) -> tuple[Float, Float]:
        """Taper of each pin were nothing expected of that, and the squares of the errors, shape (members,)."""
        change, variance = self._free(np.array([own_parameters(1, self.parallel) - 1]))
        return np.array([f.shape.taper for f in self.members]) + change[:, 0], variance[:, 0]

    def free_densities(self) -> tuple[Float, Float]:
        """How far the attenuation of each pin differs were nothing expected of that, and the squares of the errors, shape (members,)."""
        change, variance = self._free(np.array([own_parameters(1, self.parallel) - 2]))
        return np.array([f.denser for f in self.members]) + change[:, 0], variance[:, 0]

    def free_sizes(self) -> tuple[Float, Float]:
        """Logarithms of half width and length of each were nothing expected of them, and the squares of the errors, shape (members, 2)."""
        change, variance = self._free(np.array([2, 3]))
        size = np.array([[f.shape.half_width_px, f.shape.length_px] for f in self.members])
        return np.log(np.maximum(size + change, 0.5 * size)), variance / size**2

    def _free(self, which: Int) -> tuple[Float, Float]:
        """Changes of these own parameters of each needle were nothing expected of them, and their variances, shape (members, k).

        Of equations that are filtered, in which noise is white.
        """
        each = own_parameters(len(self.members[0].angles), self.parallel)
        at = np.add.outer(each * np.arange(len(self.members)), which)
        prior = self.prior.copy()
        prior[at] = 0.0
        free = replace(self, prior=prior, known=np.where(prior > 0, self.known, 0.0))
        return free.own_alone[at], self.excess * free.inverse.diagonal()[at]

    @cached_property
    def cost(self) -> float:
        """Minus twice the logarithm of likelihood and prior, but for a constant, were the variance unknown: bone is no noise."""
        return len(self.residual) * float(np.log(np.mean(self.residual**2))) + float(self.known @ self.known)

    @cached_property
    def excess(self) -> float:
        """Chi2 over what noise leaves, at least one."""
        return max(1.0, float(np.mean(self.weight * self.left**2)))


def linearise(
    window: Window,
    members: list[NeedleFit],
    slopes: list[NDArray[np.float32]],
    optics: Optics,
    noise: NoiseModel,
    parallel: bool,
    expected: Expected,
    before: Shown | None,
) -> Equations:
    """Linearise the fit of the needles of a window where they are.

    Parameters
    ----------
    window : Window
    members : list of NeedleFit
    slopes : list of ndarrays of shape (10, k, n)
        As of :func:`by_optics`, one for each.
    optics : Optics
    noise : NoiseModel
    parallel : bool
        The arms of all needles have the same directions against their first.
    expected : Expected
    before : Shown, optional
        At the step before: noise and gain go with their background and depths.

    Returns
    -------
    Equations
    """
    surface = window.surface
    weight = 1.0 / noise.variance_at((window.data if before is None else before.model) + window.beside)
    blocks = [_arms(window, f, optics) for f in members]
    if optics.proportion and before is not None:
        gains = [gain_at(f, before.ground, optics) for f in members]
        blocks = [b * g for b, g in zip(blocks, gains, strict=True)]
        slopes = [(s * g).astype(np.float32) for s, g in zip(slopes, gains, strict=True)]
    arms = len(members[0].angles)
    of_slants = OF_SLANTS[arms]
    of_ends = np.array([*[SLANT] * (of_slants.shape[1] - 1), SKEW])
    lapped = lapping([b[0].sum(0) for b in blocks])
    linear = np.concatenate([*(b[0] for b in blocks), *lapped, surface])
    root = np.sqrt(weight)
    if lapped:  # the product of two blurred shadows is not quite what the film shows of both
        deepest = max(abs(f.depth) for f in members)
        root = 1 / np.hypot(1 / root, _OF_PRODUCT * deepest * lapped[0][0])
    seen = linear * root
    theta = damped_solution(seen @ seen.T, seen @ (root * window.data), 1e-6)
    model = theta @ linear
    left = window.data - model
    now = [replace(f, depths=theta[arms * i : arms * (i + 1)].copy()) for i, f in enumerate(members)]
    moves, common, priors, known = [], np.zeros((SHARED + (arms - 1) * parallel, len(weight))), [], []
    spreads = expected.of_sizes, expected.of_blur, expected.of_taper, expected.of_density, expected.of_ways
    for f, block, slope, of_size, of_blur, of_taper, of_density, of_ways in zip(now, blocks, slopes, *spreads, strict=True):
        size = np.array([f.shape.half_width_px, f.shape.length_px])
        by_tip_and_size, by_common = f.depths @ block[1:5], f.depths @ slope
        turns = f.depths[:, None] * block[5]
        slants = np.zeros((2, arms)) if f.slants is None else f.slants
        by_ends = (f.depths[:, None] * block[6:]).reshape(2 * arms, -1)
        moves += [by_tip_and_size, by_common[BLUR, None], turns.sum(0, keepdims=True) if parallel else turns, of_slants.T @ by_ends]
        common[:OPTICS] += by_common
        common[OPTICS:SHARED] += size[:, None] * by_tip_and_size[2:]
        if parallel:
            common[SHARED:] += turns[1:]
        turning = np.zeros(1 if parallel else arms)
        priors += [np.zeros(2), 1 / (of_size * size), np.array([1 / of_blur]), turning, 1 / of_ends]
        known += [
            np.zeros(2),
            (expected.sizes - np.log(size)) / of_size,
            np.array([(expected.blur - f.blurrier) / of_blur]),
            turning,
            -(slants.ravel() @ of_slants) / (of_slants**2).sum(0) / of_ends,
        ]
        if arms == 1:
            moves.append(by_common[[ATTENUATION, TAPER]])
            priors.append(np.array([1 / of_density, 1 / of_taper]))
            known.append(np.array([(expected.density - f.denser) / of_density, (expected.taper - f.shape.taper) / of_taper]))
        if expected.regularity is not None:
            ways = slice(0 if parallel else 2, None)
            moves += [turns[1:]] * parallel + [OF_STRETCH.T @ (size[1] * f.depths[:, None] * block[4])]
            priors.append(1 / of_ways[ways])
            known.append((expected.regularity.typical - ways_of(f, expected.regularity.common))[ways] / of_ways[ways])
    rows = np.concatenate([*moves, linear, common]) * root
    kept, residual = rows.astype(np.float32), left * root
    p, rest = len(rows) - len(common), np.zeros(len(linear))
    return Equations(
        shown=Shown(now, model, theta[1 - len(surface) :] @ surface[1:], float(theta[-len(surface)])),
        images=[f.depths @ b[0] for f, b in zip(now, blocks, strict=True)],
        weight=weight,
        left=left,
        own=kept[:p],
        common=kept[p:],
        normal=rows @ rows.T,
        right=rows @ residual,
        residual=residual,
        prior=np.concatenate([*priors, rest]),
        known=np.concatenate([*known, rest]),
        parallel=parallel,
    )


def own_parameters(arms: int, parallel: bool) -> int:
    """Count tip, size and blur, one or all directions, what ends have, how arms differ, or attenuation, taper; the depths are linear."""
    return OWN + (1 if parallel else arms) + int(OF_SLANTS[arms].shape[1]) + (2 if arms == 1 else WAYS if parallel else WAYS - 2)


def _arms(window: Window, fit: NeedleFit, optics: Optics) -> Float:
    slants = np.zeros((2, len(fit.angles))) if fit.slants is None else fit.slants
    at = window.cols - fit.position_px[0], window.rows - fit.position_px[1]
    return arm_images(*at, fit.angles, fit.shape, fit.seen_by(optics), slants, exact=_is_exact(fit))


def _is_exact(fit: NeedleFit) -> bool:
    """Say whether slopes are to be exact: where light is uneven, errors of tees are more than noise makes, and nothing else states them."""
    return len(fit.angles) == 1


def by_optics(window: Window, members: list[NeedleFit], optics: Optics) -> list[NDArray[np.float32]]:
    """Derivatives of each member's arms by what is common, shape (10, k, n), as of :func:`arms_by_optics`; as fine as its tables."""
    offsets = [(window.cols - f.position_px[0], window.rows - f.position_px[1]) for f in members]
    return [
        arms_by_optics(*at, f.angles, f.shape, f.seen_by(optics), nearest=_is_exact(f)).astype(np.float32)
        for at, f in zip(offsets, members, strict=True)
    ]
