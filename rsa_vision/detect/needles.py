"""Fits of one pointed pin or one tee: its tip, directions, outline and depths, on a background of a few terms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.ball_equations import polynomial
from rsa_vision.detect.needle_images import NeedleFit, NeedleShape, arm_images, support
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import columns, cut, weighted_least_squares
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Bool, Float

_STEPS = 14
_CONVERGED_PX = 5e-4
_CLOSE_PX = 0.03
STANDS_OUT = 15.0  # significance from which noise may hide the form: what is chosen of a film's places stands out less


def fit_needles(
    film: NDArray[Any],
    tip_px: Float,
    angles: Float,
    shape: NeedleShape,
    optics: Optics,
    noise: NoiseModel,
    *,
    rigid: bool = False,
    quick: bool = False,
) -> NeedleFit:
    """Fit one pin (one angle) or tee (three).

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    tip_px : ndarray of shape (2,)
        Start, (col, row).
    angles : ndarray of shape (k,)
        Start, radians.
    shape : NeedleShape
        Start; its taper is kept.
    optics : Optics
    noise : NoiseModel
    rigid : bool
        The arms turn together and are equally deep, for a first look, while neighbours still disturb; else each has its own direction and
        depth.
    quick : bool
        While others still move: fewer steps, and a covariance as if the noise were white.

    Returns
    -------
    NeedleFit
    """
    half = int(np.ceil(shape.length_px * 1.15 + shape.half_width_px + 3 * optics.sigma_px + 3))
    patch = cut(film, tip_px[None], half, noise)
    corner = patch.corner_px[0]
    rows, cols = np.mgrid[0 : patch.size, 0 : patch.size]
    cols, rows = cols + float(corner[0]), rows + float(corner[1])
    keep = patch.valid[0] & support(cols - tip_px[0], rows - tip_px[1], angles, shape, 3 * optics.sigma_px + (1.0 if quick else 4.0))
    cols, rows, data = cols[keep], rows[keep], patch.values[0][keep]
    surface = polynomial(half, cols - tip_px[0], rows - tip_px[1])
    weight = np.full(len(data), 1.0 / float(noise.variance_at(np.array([data.mean()]))[0])) if len(data) else np.zeros(0)
    k = len(angles)
    tip, angles = tip_px.astype(np.float64).copy(), angles.astype(np.float64).copy()
    if len(data) < 30 + 6 + 2 * k:
        return _unfit(tip, angles, shape)
    n_depth = 1 if rigid else k
    theta = np.zeros(n_depth + 6)
    converged = False
    n_turn = 1 if rigid else k
    n_free = 4 + n_turn
    steps, close = (6, _CLOSE_PX) if quick else (_STEPS, _CONVERGED_PX)
    for step in range(steps + 1):
        value, d_col, d_row, d_w, d_l, d_angle = arm_images(cols - tip[0], rows - tip[1], angles, shape, optics)
        linear = columns([value.sum(0, keepdims=True) if n_depth < k else value, surface.T])
        if step == 0 or step == steps or converged:
            theta = weighted_least_squares(linear, weight, data)
        depths = np.broadcast_to(theta[:n_depth], (k,)).copy()
        residual = data - linear @ theta
        common = [(depths @ d)[None] for d in (d_col, d_row, d_w, d_l)]
        turns = depths[:, None] * d_angle
        jac = columns([*common, turns.sum(0, keepdims=True) if rigid else turns, linear.T])
        if step == steps or converged:
            break
        if step in (1, 4):
            weight = 1.0 / noise.variance_at(linear @ theta)
        delta = weighted_least_squares(jac, weight, residual, damping=1e-4 if step < 4 else 1e-7)
        scale = min(1.0, 1.5 / max(np.abs(delta[:2]).max(), 1e-9), 0.15 / max(np.abs(delta[n_free - n_turn : n_free]).max(), 1e-9))
        tip += scale * delta[:2]
        width = float(np.clip(shape.half_width_px + np.clip(scale * delta[2], -0.5, 0.5), 0.6, 0.3 * shape.length_px))
        longer = float(np.clip(scale * delta[3], -2.0, 2.0))
        shape = NeedleShape(width, float(np.clip(shape.length_px + longer, 3.0, half / 1.05)), shape.taper)
        angles += scale * delta[n_free - n_turn : n_free]
        theta = theta + scale * delta[n_free:]
        converged = step > 0 and bool(np.abs(delta[:2]).max() < close)
        if np.hypot(*(tip - tip_px)) > 0.6 * half:
            return _unfit(tip, angles, shape)
    weighted = jac * weight[:, None]
    covariance = np.asarray(np.linalg.pinv(weighted.T @ jac, hermitian=True), np.float64)
    influence = np.zeros((2, patch.size, patch.size))
    influence[:, (rows - corner[1]).astype(np.intp), (cols - corner[0]).astype(np.intp)] = (
        covariance[:2] @ (weighted / np.sqrt(weight)[:, None]).T
    )
    image = depths @ value
    ring = ~_under(image)
    background = float(theta[n_depth])
    fit = replace(
        _unfit(tip, angles, shape),
        depths=depths,
        covariance_px2=covariance[:2, :2] if quick else influence_covariance(influence, noise.correlation),
        chi2_ring=float((weight * residual**2)[ring].sum() / max(int(ring.sum()) - len(delta), 1)),
        converged=converged,
    )
    variance = float(noise.variance_at(np.array([background]))[0])
    whole = core_pixels(tip, angles, shape, optics.sigma_px)
    return scored(fit, image, residual, weight, surface, background, variance, whole)


def scored(
    fit: NeedleFit, image: Float, residual: Float, weight: Float, surface: Float, background: float, variance: float, whole: int
) -> NeedleFit:
    """Return a fit with its figures of merit, taken under its own arms.

    Parameters
    ----------
    fit : NeedleFit
    image, residual, weight : ndarray of shape (n,)
        Its image, what the fit leaves, one over the variance of a pixel.
    surface : ndarray of shape (n, p)
        Columns of the background.
    background, variance : float
        Film value, and of the noise there.
    whole : int
        Pixels under the arms, were nothing hidden.

    Returns
    -------
    NeedleFit
    """
    square = weight * residual**2
    depth = float(fit.depths.mean())
    core = _under(image)
    chi2_core = float(square[core].mean()) if core.any() else np.inf
    raised = float((weight * (residual + image) ** 2)[core].sum())
    return replace(
        fit,
        depth=depth,
        background=background,
        n_core=int(core.sum()),
        valid_fraction=min(1.0, int(core.sum()) / max(whole, 1)),
        chi2_core=chi2_core,
        explained=1.0 - float(square[core].sum()) / max(raised, 1e-12),
        misfit=float(np.sqrt(max(chi2_core - 1.0, 0.0) * variance) / max(abs(depth), 1e-9)),
        significance=significance_of(image, surface, weight),
    )


def _under(image: Float) -> Bool:
    """Pixels (n,) under the arms of an image."""
    return np.asarray(np.abs(image) > 0.08 * max(float(np.abs(image).max(initial=0.0)), 1e-9))


def significance_of(image: Float, surface: Float, weight: Float) -> float:
    """Return how many standard deviations an image (n,) stands out of any background (n, p), its shape being given."""
    over, under = np.sqrt(weight) * image, np.sqrt(weight)[:, None] * surface
    return float(np.linalg.norm(over - under @ np.linalg.lstsq(under, over, rcond=None)[0]))


def explains(fit: NeedleFit, least: float, stands_out: float = STANDS_OUT) -> bool:
    """Say whether a fit explains a part of what is under it: of all, or, where it stands out so far, of what is more than the noise."""
    left = fit.chi2_core
    raised = left / max(1.0 - fit.explained, 1e-9)
    over_noise = 1.0 - max(left - 1.0, 0.0) / max(raised - 1.0, 1e-9)
    significance = fit.significance / np.sqrt(max(fit.chi2_ring, 1.0))
    return bool(fit.explained > least or (raised > 1.0 and over_noise > least and significance > stands_out))


def core_pixels(tip: Float, angles: Float, shape: NeedleShape, sigma: float) -> int:
    """Pixels that the core of the model would have, were nothing masked or outside the film."""
    half = int(np.ceil(shape.length_px + shape.half_width_px + 2 * sigma))
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1]
    frac = tip - np.rint(tip)
    inside = np.zeros(rows.shape, bool)
    for angle in angles:
        c, s = np.cos(angle), -np.sin(angle)
        along = (cols - frac[0]) * c + (rows - frac[1]) * s
        across = -(cols - frac[0]) * s + (rows - frac[1]) * c
        width = shape.half_width_px * np.minimum(along / (shape.taper * shape.length_px), 1.0)
        inside |= (along > 0) & (along < shape.length_px) & (np.abs(across) < width)
    return int(inside.sum())


def _unfit(tip: Float, angles: Float, shape: NeedleShape) -> NeedleFit:
    nan = float("nan")
    return NeedleFit(
        tip, angles, shape, np.zeros(len(angles)), 0.0, nan, np.full((2, 2), nan), 0, np.inf, np.inf, 0.0, 0.0, np.inf, 0.0, False
    )
