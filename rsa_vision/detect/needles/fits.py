"""Fits of one pointed pin or one tee: its tip, directions, outline and depths, on a background of a few terms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import CHANCE
from rsa_vision.detect.film.least_squares import damped_solution, polynomial
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import apart_from_repairs, cut
from rsa_vision.detect.film.progress import WEIGHED, in_vain
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape, arm_images, needle_image, support
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float

LEAST_HALF_WIDTH_PX = 0.6  # a needle that comes out as thin as that has no width of its own
LINE_PX = 1.01 * LEAST_HALF_WIDTH_PX  # half width of one that has come out so
_STEPS = 14
_DEEPER = 2.0  # times the height of an image: a depth beyond that is what thin opacity would come to, and no measure
_CONVERGED_PX = 5e-3  # a step's change: what is left after it is far less
_CLOSE_PX = 0.1
_SPARE_PX = 4.0  # beyond which a start's surroundings are not looked at
_GROWS, _WORTH = 3, 0.8  # times that a fit which has grown out of these begins again, and what it must explain of what it saw
_MOVES = 5  # tip, half width, length, direction
_UNDER = 0.08  # of the height of an image, from which a pixel lies under it
PROMISING = 0.4  # of what lies under a start, that it must explain for a quick fit to go on
STANDS_OUT = 15.0  # significance from which noise may hide the form: what is chosen of a film's places stands out less


def fit_needles(
    film: NDArray[Any],
    tip_px: Float,
    angles: Float,
    shape: NeedleShape,
    optics: Optics,
    noise: NoiseModel,
    *,
    quick: bool = False,
    sized: bool = False,
) -> NeedleFit:
    """Fit one pin (one angle) or tee (three, that turn together and are equally deep).

    :func:`rsa_vision.detect.needles.shared.fit_shared` states the covariance of its tip.

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
    quick : bool
        While others still move: fewer steps, fewer pixels around.
    sized : bool
        Its size is known.

    Returns
    -------
    NeedleFit
    """
    for _ in range(1 + _GROWS):
        fit = _fitted(film, tip_px, angles, shape, optics, noise, quick=quick, sized=sized)
        if quick or fit.explained < _WORTH or not _outgrown(fit, tip_px, shape):
            break
        tip_px, angles, shape = fit.position_px, fit.angles, fit.shape
    return fit


def _outgrown(fit: NeedleFit, tip_px: Float, shape: NeedleShape) -> bool:
    """Say whether a fit ends where the pixels around its start no longer show what lies beyond."""
    at_tip = (fit.position_px - tip_px) @ np.array([np.cos(fit.angles), -np.sin(fit.angles)])
    return bool(max(-at_tip.min(), at_tip.max() + fit.shape.length_px - shape.length_px) > _SPARE_PX / 2)


def _fitted(
    film: NDArray[Any],
    tip_px: Float,
    angles: Float,
    shape: NeedleShape,
    optics: Optics,
    noise: NoiseModel,
    *,
    quick: bool,
    sized: bool,
) -> NeedleFit:
    """Fit to the pixels around the start."""
    half = int(np.ceil(shape.length_px * 1.15 + shape.half_width_px + 3 * optics.sigma_px + 3))
    whole = cut(film, tip_px[None], half, noise)
    patch = apart_from_repairs(whole, noise)
    corner = patch.corner_px[0].astype(np.float64)
    axis = np.arange(float(patch.size))
    margin = 3 * optics.sigma_px + (1.0 if quick else _SPARE_PX)
    near = support(axis + (corner[0] - tip_px[0]), axis + (corner[1] - tip_px[1]), angles, shape, margin)
    rows, cols = np.nonzero(near & patch.valid[0])
    data = patch.values[0][rows, cols]
    cols, rows = cols + corner[0], rows + corner[1]
    tip, angles = tip_px.astype(np.float64).copy(), angles.astype(np.float64).copy()
    if len(data) < 30 + 6 + 2 * len(angles):
        return unfit(tip, angles, shape)
    surface = polynomial(half, cols - tip_px[0], rows - tip_px[1]).T
    weight = np.full(len(data), 1.0 / float(noise.variance_at(np.array([data.mean()]))[0]))
    converged, free = False, [1, 2, 5] if sized else [1, 2, 3, 4, 5]
    steps, close, far = (6, _CLOSE_PX, 3.0) if quick else (_STEPS, _CONVERGED_PX, 1.5)
    left: list[float] = []
    for step in range(steps + 1):
        last = step == steps or converged or in_vain(left, len(data))  # nobody asks where to go next
        images = arm_images(cols - tip[0], rows - tip[1], angles, shape, optics, slopes=not last).sum(1)
        moves, linear = images[[] if last else free], np.concatenate([images[:1], surface])
        weighted = np.concatenate([moves, linear, data[None]]) * np.sqrt(weight)
        gram = weighted @ weighted.T
        theta = damped_solution(gram[len(moves) : -1, len(moves) : -1], gram[len(moves) : -1, -1], 1e-9)
        if last:
            break
        if step > WEIGHED:
            left.append(float(gram[-1, -1] - theta @ gram[len(moves) : -1, -1]))
        delta = np.zeros(1 + _MOVES)
        delta[free] = step_of(gram, theta, len(moves), 1e-4 if step < 4 else 1e-7)
        delta = delta[1:]
        if step in (0, WEIGHED):
            weight = 1.0 / noise.variance_at(theta @ linear)
        scale = min(1.0, far / max(np.abs(delta[:2]).max(), 1e-9), 0.15 / max(abs(delta[4]), 1e-9))
        tip += scale * delta[:2]
        width = between(shape.half_width_px + between(scale * delta[2], -0.5, 0.5), LEAST_HALF_WIDTH_PX, 0.3 * shape.length_px)
        longer = between(scale * delta[3], -2.0, 2.0)
        shape = replace(shape, half_width_px=width, length_px=between(shape.length_px + longer, 3.0, half / 1.05))
        angles += scale * delta[4]
        converged = step > 0 and bool(np.abs(delta[:2]).max() < close)
        if np.hypot(*(tip - tip_px)) > 0.6 * half:
            return unfit(tip, angles, shape)
    image, residual = theta[0] * linear[0], data - theta @ linear
    ring = ~under(image)
    background = float(theta[1])
    fit = replace(
        unfit(tip, angles, shape),
        depths=np.full(len(angles), theta[0]),
        chi2_ring=float((weight * residual**2)[ring].sum() / max(int(ring.sum()) - _MOVES - len(linear), 1)),
        converged=converged,
    )
    variance = float(noise.variance_at(np.array([background]))[0])
    hidden = np.array(np.nonzero(near & ~whole.valid[0])[::-1]) + corner[:, None]
    return scored(fit, image, residual, weight, surface, background, variance, hidden, optics)


def step_of(gram: Float, theta: Float, each: int, damping: float) -> Float:
    """Return the Gauss-Newton step of what moves needles, from the normal equations of all at depth one.

    Parameters
    ----------
    gram : ndarray of shape (m + p + 1, m + p + 1)
        Products of the images' derivatives (for depths of one), of what enters linearly (depths first), and of the data.
    theta : ndarray of shape (p,)
        Solution for what enters linearly.
    each : int
        Derivatives of each needle's image.
    damping : float

    Returns
    -------
    ndarray of shape (m,)
    """
    moves = len(gram) - 1 - len(theta)
    unit = np.append(np.repeat(theta[: moves // each], each), np.ones(len(theta)))
    right = unit * (gram[:-1, -1] - gram[:-1, moves:-1] @ theta)
    return damped_solution(gram[:-1, :-1] * np.outer(unit, unit), right, damping)[:moves]


def between(value: float, low: float, high: float) -> float:
    """Return a value, or the bound that it exceeds."""
    return min(max(float(value), low), high)


def scored(
    fit: NeedleFit,
    image: Float,
    residual: Float,
    weight: Float,
    surface: Float,
    background: float,
    variance: float,
    hidden: Float,
    optics: Optics,
) -> NeedleFit:
    """Return a fit with its figures of merit, taken under its own arms.

    Parameters
    ----------
    fit : NeedleFit
    image, residual, weight : ndarray of shape (n,)
        Its image, what the fit leaves, one over the variance of a pixel.
    surface : ndarray of shape (p, n)
        Parts of the background.
    background, variance : float
        Film value, and of the noise there.
    hidden : ndarray of shape (2, m)
        (col, row) of pixels beside and under its arms that are saturated, or off the film.
    optics : Optics

    Returns
    -------
    NeedleFit
    """
    square = weight * residual**2
    depth = float(fit.depths.mean())
    core = under(image)
    n_core = int(core.sum())
    peak = float(np.abs(image).max(initial=0.0))
    high = min(abs(depth), _DEEPER * peak)
    left = float(square[core].sum())
    raised = float((weight * (residual + image) ** 2)[core].sum())
    chi2_core = left / n_core if n_core else np.inf
    outlines = len(fit.angles) * fit.shape.half_width_px * fit.shape.length_px * (2 - fit.shape.taper)
    behind = 0
    if hidden.size:
        dx, dy = hidden - fit.position_px[:, None]
        behind = int((np.abs(needle_image(dx, dy, fit, optics)) > _UNDER * peak).sum())
    whole = min(outlines, n_core + behind)  # were nothing hidden; on steep curves outlines vanish
    return replace(
        fit,
        depth=depth,
        background=background,
        n_core=n_core,
        valid_fraction=min(1.0, n_core / max(whole, 1.0)),
        chi2_core=chi2_core,
        explained=1.0 - left / max(raised, 1e-12),
        misfit=float(np.sqrt(max(chi2_core - 1.0, 0.0) * variance) / max(high, 1e-9)),
        significance=significance_of(image, surface, weight),
        height=peak,
    )


def under(image: Float) -> Bool:
    """Pixels (n,) under the arms of an image."""
    return np.asarray(np.abs(image) > _UNDER * max(float(np.abs(image).max(initial=0.0)), 1e-9))


def significance_of(image: Float, surface: Float, weight: Float) -> float:
    """Return how many standard deviations an image (n,) stands out of any background (p, n), its shape being given."""
    rows = np.concatenate([surface, image[None]]) * np.sqrt(weight)
    gram = rows @ rows.T
    alike = gram[:-1, -1] @ damped_solution(gram[:-1, :-1], gram[:-1, -1], 1e-9)
    return float(np.sqrt(max(gram[-1, -1] - alike, 0.0)))


def explains(fit: NeedleFit, least: float, stands_out: float = STANDS_OUT, by_chance: float = 0.0) -> bool:
    """Say whether a fit explains a part of what is under it: of all, or, where it stands out so far, of what is more than the noise.

    ``by_chance``: part of the variance that noise may leave more than usual.
    """
    left = fit.chi2_core
    raised = left / max(1.0 - fit.explained, 1e-9)
    over_noise = 1.0 - max(left - 1.0 - by_chance, 0.0) / max(raised - 1.0, 1e-9)
    significance = fit.significance / np.sqrt(max(fit.chi2_ring, 1.0))
    return bool(fit.explained > least or (raised > 1.0 and over_noise > least and significance > stands_out))


def unfit(tip: Float, angles: Float, shape: NeedleShape) -> NeedleFit:
    """Return a pin or tee that no fit has seen: without depth, explaining nothing."""
    nan = float("nan")
    return NeedleFit(
        tip, angles, shape, np.zeros(len(angles)), 0.0, nan, np.full((2, 2), nan), 0, np.inf, np.inf, 0.0, 0.0, np.inf, 0.0, False
    )


def excess_of(fit: NeedleFit, noise: NoiseModel) -> float:
    """Chi2 under a needle where it is more than chance makes it."""
    return fit.chi2_core if fit.chi2_core > 1 + CHANCE * noise.scatter(np.array(fit.n_core)) else 1.0


def significant_misfit(fit: NeedleFit, noise: NoiseModel) -> float:
    """Misfit of a needle that chance does not explain."""
    return fit.misfit if excess_of(fit, noise) > 1.0 else 0.0
