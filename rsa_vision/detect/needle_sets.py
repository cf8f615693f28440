"""The pins and tees of a film fitted beside each other: those whose arms cross in one go, the others subtracted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rsa_vision.detect.crossing import fit_crossing
from rsa_vision.detect.find import refine
from rsa_vision.detect.needles import NeedleFit, needle_image, thick_ends
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Bool, Float

TAPERS = (1.0, 0.5, 0.25)  # part of a pin's length that is its point: a full cone, or a cylinder with a point
_MOST_TOGETHER = 4  # in one fit; larger sets are cut where they overlap least
_ATTENUATIONS = (0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.2)  # of the arms, relative to the balls
_NEAR = (0.7, 0.85, 1.0, 1.2, 1.4)
_BLURS, _NEAR_BLURS = (0.72, 0.85, 1.0, 1.18, 1.4), (0.85, 0.92, 1.0, 1.09, 1.18)
_BENDS = (0.6, 0.85, 0.95, 0.985, 0.999)
_BENT_ATTENUATIONS = (0.35, 0.8)  # per pixel
_STEP = 0.1  # of the logarithms of attenuation and blur, for derivatives
_WORST = 5.0  # steps that attenuation and blur may be off at the worst
_SAMPLE = 18  # arms that are asked for their optics
_ROUNDS = 2


def fit_all(
    film: NDArray[Any], needles: list[NeedleFit], optics: Optics, noise: NoiseModel, *, ends: bool, again: bool = False
) -> list[NeedleFit]:
    """Fit every set whose arms cross in one go, with the images of the others subtracted.

    ``again``: they were fitted in the same way before, so that what has come to rest and has no neighbours stays as it is.
    """
    out: list[NeedleFit] = []
    for members in clusters(needles):
        rest = [t for t in needles if all(t is not m for m in members)]
        others = others_beside(members, rest, optics, ends=ends)
        at_rest = again and others is None and all(m.converged for m in members)
        out += members if at_rest else fit_crossing(film, members, optics, noise, others=others, ends=ends)
    return out


def clusters(needles: list[NeedleFit]) -> list[list[NeedleFit]]:
    """Return the sets whose arms may cross, as far as one fit can hold them."""
    if not needles:
        return []
    position = np.array([t.position_px for t in needles])
    gap = np.hypot(*(position[:, None] - position[None]).transpose(2, 0, 1))
    length = np.array([t.shape.length_px for t in needles])
    reach = (length[:, None] + length[None]) * 1.02
    while True:  # arms that only just touch can do with subtraction, if joining them all would make too large a fit
        n, label = connected_components(csr_array(gap < reach), directed=False)
        if n == len(needles) or np.bincount(label).max() <= _MOST_TOGETHER:
            return [[needles[i] for i in np.nonzero(label == k)[0]] for k in range(n)]
        reach = reach * 0.85


def others_beside(members: NeedleFit | list[NeedleFit], rest: list[NeedleFit], optics: Optics, *, ends: bool) -> Any:
    """Return the images of those beside the members, for the fits to subtract; None where there are none."""
    mine = members if isinstance(members, list) else [members]
    near = []
    for t in rest:
        gaps = [np.hypot(*(t.position_px - m.position_px)) - 1.3 * (t.shape.length_px + m.shape.length_px) for m in mine]
        if min(gaps) < 10:
            near.append(t)
    if not near:
        return None

    def images(cols: Float, rows: Float) -> tuple[Float, Bool]:
        total, doubtful = np.zeros_like(cols), np.zeros(cols.shape, bool)
        for t in near:
            dx, dy = cols - t.position_px[0], rows - t.position_px[1]
            total += needle_image(dx, dy, t, optics)
            if not ends:
                doubtful |= thick_ends(dx, dy, t.angles, t.shape, optics.sigma_px)
        return total, doubtful

    return images


def common_optics(film: NDArray[Any], needles: list[NeedleFit], optics: Optics, noise: NoiseModel) -> Optics:
    """Estimate the attenuation along the arms, and a blur that is only a guess, from the cleanest needles, by maximum likelihood.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
    optics : Optics
        Start; its blur is kept unless it is rough.
    noise : NoiseModel

    Returns
    -------
    Optics
    """
    cost = _cost(film, needles, noise)
    optics = _best(cost, optics, "mu_px", _ATTENUATIONS)
    if not optics.rough:
        return optics
    straight = _best(cost, optics, "sigma_px", _BLURS)
    bent = [replace(start, bend=bend, mu_px=mu) for start in (optics, straight) for bend in _BENDS for mu in _BENT_ATTENUATIONS]
    optics = min([straight, *bent], key=cost)
    for _ in range(_ROUNDS):  # lengths are held while optics are compared: they have to follow
        needles = fit_all(film, needles, optics, noise, ends=True)
        cost = _cost(film, needles, noise)
        optics = min([optics, *(replace(optics, bend=bend) for bend in _BENDS if optics.bend)], key=cost)
        optics = _best(cost, optics, "mu_px", _NEAR)
        optics = _best(cost, optics, "sigma_px", _NEAR_BLURS)
    return optics


def with_error_of_optics(film: NDArray[Any], needles: list[NeedleFit], optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Add to the covariance of tips what the errors of blur and attenuation, estimated from these needles, do to them.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
    optics : Optics
        That they were fitted with, thick ends left out.
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        The errors of the optics by the curvature of their likelihood, the shifts of the tips by numerical differentiation.
    """
    cost = _cost(film, needles, noise)

    def at(mu: float, sigma: float) -> Optics:
        return replace(optics, mu_px=optics.mu_px * np.exp(mu * _STEP), sigma_px=optics.sigma_px * np.exp(sigma * _STEP))

    mid, curvature = cost(optics), np.zeros((2, 2))
    for k, unit in enumerate(np.eye(2)):
        curvature[k, k] = (cost(at(*unit)) + cost(at(*-unit)) - 2 * mid) / 2
    curvature[0, 1] = curvature[1, 0] = (cost(at(1, 1)) + mid - cost(at(1, 0)) - cost(at(0, 1))) / 2
    least = np.eye(2) / _WORST**2  # a likelihood that is flat says nothing: then what is physically possible bounds the optics
    value, vector = np.linalg.eigh(curvature + least)
    errors = vector @ np.diag(1 / np.maximum(value, 1 / _WORST**2)) @ vector.T
    if optics.rough is False:  # the blur comes from the balls
        errors = np.diag([1 / max(curvature[0, 0], 1 / _WORST**2), 0.0])
    out = []
    for needle in needles:
        others = others_beside(needle, [o for o in needles if o is not needle], optics, ends=False)
        shifts = [
            fit_crossing(film, [needle], at(*unit), noise, others=others, ends=False)[0].position_px - needle.position_px
            for unit in np.eye(2)
        ]
        move = np.stack(shifts, axis=1)
        out.append(replace(needle, covariance_px2=needle.covariance_px2 + move @ errors @ move.T))
    return out


def _cost(film: NDArray[Any], needles: list[NeedleFit], noise: NoiseModel) -> Callable[[Optics], float]:
    alone = [c[0] for c in clusters(needles) if len(c) == 1] or needles
    sample = sorted(alone, key=lambda f: f.misfit)
    sample = sample[: _SAMPLE // len(sample[0].angles)]

    def cost(trial: Optics) -> float:
        beside = [others_beside(t, [o for o in needles if o is not t], trial, ends=False) for t in sample]
        fits = [fit_crossing(film, [t], trial, noise, others=o, ends=False)[0] for t, o in zip(sample, beside, strict=True)]
        # the same number of pixels for every trial: a model that calls more of them its own is none the better
        return float(sum(t.n_core * np.log(max(f.chi2_core, 0.05)) for t, f in zip(sample, fits, strict=True)))

    return cost


def _best(cost: Callable[[Optics], float], optics: Optics, name: str, factors: tuple[float, ...]) -> Optics:
    values = tuple(getattr(optics, name) * f for f in factors)
    found = refine(values, [cost(replace(optics, **{name: value})) for value in values])
    return replace(optics, **{name: found})  # type: ignore[arg-type]  # names of floats
