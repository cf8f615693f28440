"""Fits of pointed pins and of tees (three pins whose tips meet): a blurred cone seen from the side, or three of them with one common tip.

The tip of a tapering pin fades out: the opacity near it grows with the square of the distance, so any threshold lies pixels away from it.
The model is the opacity along the chord through a cone, blurred; the tip is a parameter of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from rsa_vision.detect.balls import polynomial
from rsa_vision.detect.noise import NoiseModel, influence_covariance
from rsa_vision.detect.patches import columns, cut, weighted_least_squares
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Bool, Float

Images = Callable[[Float, Float], Float]
"""Images of some marks at pixels (cols, rows), in film values over the background."""
CELL = 0.3  # pixels between the nodes of a needle table
GRID_W, GRID_L = 0.25, 1.0  # pixels between the shapes that have tables of their own
FINE_L, FINE_Q = 0.2, 0.06  # pixels of the length, and the slant, between those of the last fit
SKEW = 0.1  # for the derivative
_OF_TABLE = CELL**2 / 4  # variance that the mean over a cell and linear interpolation between nodes add to the blur
_PAD = 6.0  # blur widths around the needle that a table covers
_STEPS = 14
_CONVERGED_PX = 5e-4
_CLOSE_PX = 0.03
STANDS_OUT = 15.0  # significance from which noise may hide the form: what is chosen of a film's places stands out less


@dataclass(frozen=True, slots=True)
class NeedleShape:
    """Outline of a pointed pin in pixels.

    Attributes
    ----------
    half_width_px, length_px : float
        At the thick end; from the tip to the thick end.
    taper : float
        Part of the length over which it tapers (1: a full cone).
    """

    half_width_px: float
    length_px: float
    taper: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class NeedleFit:
    """One fitted pin or tee.

    Attributes
    ----------
    position_px : ndarray of shape (2,)
        (col, row) of the tip, or of the point where the tips meet.
    angles : ndarray of shape (k,)
        Directions from the tip along each arm, radians, ``atan2(-drow, dcol)``.
    shape : NeedleShape
    depths : ndarray of shape (k,)
        Film values, for each arm (rays cross the arms at different angles); negative: darker than the background.
    depth, background : float
        Their mean; film value of the background at the tip.
    covariance_px2 : ndarray of shape (2, 2)
    n_core : int
        Pixels under the arms.
    chi2_core, chi2_ring, explained, valid_fraction, misfit : float
        As in :class:`rsa_vision.detect.balls.BallFits`; ``misfit`` is the RMS residual beyond the noise as a fraction of the depth.
    significance : float
        Depth over its standard deviation at the fitted shape: depth and width of a thin needle can stand for each other, so that neither is
        sure alone; that something is there is.
    converged : bool
    slants : ndarray of shape (2, k), optional
        How the rays cross each thick end, once it has been asked for: the square of their slope along the arm, and the skew of the end.
    """

    position_px: Float
    angles: Float
    shape: NeedleShape
    depths: Float
    depth: float
    background: float
    covariance_px2: Float
    n_core: int
    chi2_core: float
    chi2_ring: float
    explained: float
    valid_fraction: float
    misfit: float
    significance: float
    converged: bool
    slants: Float | None = None


@lru_cache(maxsize=1024)
def _opacity(
    half_width: float, length: float, taper: float, sigma: float, mu: float, bend: float, slant: float = 0.0, skew: float = 0.0
) -> tuple[Float, float, float]:
    """Blurred opacity on a grid along and across a needle, and where that begins.

    A ray in depth ``z`` of the needle crosses it at the distance ``s + sqrt(slant) z`` from the tip; of its chord only the part before the
    flat end counts. The middle of the chord lies the further behind the further it is from the axis: ``skew`` times the distance.
    """
    pad = _PAD * sigma
    s = np.arange(-pad, length + pad + CELL, CELL)
    p = np.arange(0.0, half_width + pad + CELL, CELL)
    if skew:
        p = np.concatenate([-p[:0:-1], p])  # else one half; the other is its mirror image
    fine_s = (s[:, None] + CELL * (np.arange(2) - 0.5) / 2).reshape(-1, 1)
    fine_p = (p[:, None] + CELL * (np.arange(2) - 0.5) / 2).ravel()
    width = half_width * np.clip(fine_s / (taper * length), 0.0, 1.0)
    chord = 2 * np.sqrt(np.maximum(width**2 - fine_p**2, 0.0))
    before = length - fine_s - skew * fine_p
    if slant:
        chord *= np.clip(0.5 + before / (np.sqrt(slant) * np.maximum(chord, 1e-9)), 0.0, 1.0)
    opacity = -np.expm1(-mu * chord) * (1.0 if slant else np.clip(0.5 + before / (CELL / 2), 0.0, 1.0))
    opacity = opacity.reshape(len(s), 2, len(p), 2).mean((1, 3))
    blur = np.sqrt(max(sigma**2 - _OF_TABLE, 0.01)) / CELL
    along = gaussian_filter1d(opacity, blur, axis=0, mode="constant", truncate=4.5)
    half = gaussian_filter1d(along, blur, axis=1, mode="constant" if skew else "mirror", truncate=4.5)
    if bend:
        half = np.log1p(-bend * half) / np.log1p(-bend)
    return half if skew else np.concatenate([half[:, :0:-1], half], axis=1), float(s[0]), -float(p[-1])


@lru_cache(maxsize=256)
def _table(
    half_width: float, length: float, taper: float, sigma: float, mu: float, bend: float, slant: float | None = None
) -> tuple[Float, tuple[int, int], float, float]:
    """Opacity, its slopes along and across the needle, by half width and length, and unless that is None by slant and skew: the last axis.

    One look-up finds them all.
    """
    film = sigma, mu, bend, slant or 0.0
    step_l = GRID_L if slant is None else FINE_L
    base, s0, p0 = _opacity(half_width, length, taper, *film)
    wide, *_, p1 = _opacity(round(half_width + GRID_W, 4), length, taper, *film)
    long, *_ = _opacity(half_width, round(length + step_l, 4), taper, *film)
    side = round((p0 - p1) / CELL)
    by_width = (wide[: base.shape[0], side : side + base.shape[1]] - base) / GRID_W
    by_length = (long[: base.shape[0]] - base) / step_l
    nodes = [base, np.gradient(base, CELL, axis=0), np.gradient(base, CELL, axis=1), by_width, by_length]
    if slant is not None:
        more = _opacity(half_width, length, taper, sigma, mu, bend, round(slant + FINE_Q, 4))[0]
        skew = _opacity(half_width, length, taper, *film, SKEW)[0]
        nodes += [(more - base) / FINE_Q, (skew - base) / SKEW]
    return np.stack(nodes, axis=-1).reshape(-1, len(nodes)), base.shape, s0, p0


def _look_up(table: tuple[Float, tuple[int, int], float, float], s: Float, p: Float) -> Float:
    """Interpolate all columns of a table bilinearly; 0 beyond it."""
    nodes, (n_s, n_p), s0, p0 = table
    at_s, at_p = (s - s0) / CELL, (p - p0) / CELL
    out = np.zeros((nodes.shape[1], len(s)))
    inside = np.nonzero((at_s >= 0) & (at_s < n_s - 1) & (at_p >= 0) & (at_p < n_p - 1))[0]
    at_s, at_p = at_s[inside], at_p[inside]
    low_s, low_p = at_s.astype(np.intp), at_p.astype(np.intp)
    part_s, part_p = (at_s - low_s)[:, None], (at_p - low_p)[:, None]
    first = low_s * n_p + low_p
    near = nodes.take(first, axis=0)
    near += part_p * (nodes.take(first + 1, axis=0) - near)
    far = nodes.take(first + n_p, axis=0)
    far += part_p * (nodes.take(first + n_p + 1, axis=0) - far)
    near += part_s * (far - near)
    out[:, inside] = near.T
    return out


def needle_image(dx: Float, dy: Float, fit: NeedleFit, optics: Optics) -> Float:
    """Return the image of a fitted pin or tee, in film values over the background.

    Parameters
    ----------
    dx, dy : ndarray
        Offsets (col, row) of the pixels from the common tip.
    fit : NeedleFit
    optics : Optics

    Returns
    -------
    ndarray of the shape of ``dx``
    """
    values = arm_images(dx.ravel(), dy.ravel(), fit.angles, fit.shape, optics, fit.slants)[0]
    image: Float = (fit.depths @ values).reshape(dx.shape)
    return image


def arm_images(dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics, slants: Float | None = None) -> Float:
    """Opacity of every arm, its derivatives by (tip col, tip row, half width, length), and by its angle; arms along the second axis.

    With slants, those by the slant and by the skew of each arm follow.
    """
    # tables stand on a grid of shapes, shared by all needles of a film; in between the image is linear in the shape
    off_w, off_l = shape.half_width_px % GRID_W, shape.length_px % (GRID_L if slants is None else FINE_L)
    film = round(optics.sigma_px, 3), round(optics.mu_px, 4), round(optics.bend, 4)
    key = round(shape.half_width_px - off_w, 4), round(shape.length_px - off_l, 4), round(shape.taper, 3), *film
    c, s = np.cos(angles)[:, None], -np.sin(angles)[:, None]
    along, across = dx * c + dy * s, dy * c - dx * s
    ends: list[Float] = []
    if slants is None:
        base, g_s, g_p, more_w, more_l = _look_up(_table(*key), along.ravel(), across.ravel()).reshape(5, *along.shape)
    else:
        slant, skew = slants
        off_q = np.where(slant > 0, slant % FINE_Q, slant)
        arms = [_look_up(_table(*key, round(q, 4)), a, b) for q, a, b in zip(slant - off_q, along, across, strict=True)]
        base, g_s, g_p, more_w, more_l, *ends = np.stack(arms, axis=1)
        base = base + off_q[:, None] * ends[0] + skew[:, None] * ends[1]
    d_angle = g_p * along - g_s * across  # counter-clockwise as displayed, the row axis pointing down
    value = base + off_w * more_w + off_l * more_l
    return np.array([value, g_p * s - g_s * c, -g_s * s - g_p * c, more_w, more_l, d_angle, *ends])


def support(dx: Float, dy: Float, angles: Float, shape: NeedleShape, margin: float) -> Bool:
    """Pixels within ``margin`` of an arm's axis rectangle."""
    inside = np.hypot(dx, dy) < margin
    for angle in angles:
        c, s = np.cos(angle), -np.sin(angle)
        along, across = dx * c + dy * s, -dx * s + dy * c
        inside |= (along > -margin) & (along < shape.length_px + margin) & (np.abs(across) < shape.half_width_px + margin)
    return inside


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
    depth = float(depths.mean())
    image = depths @ value
    core = image / depth > 0.08 * max((image / depth).max(), 1e-9) if depth else np.zeros(len(image), bool)
    square = weight * residual**2
    n_core = max(int(core.sum()), 1)
    chi2_core = float(square[core].sum() / n_core)
    ring = ~core
    chi2_ring = float(square[ring].sum() / max(int(ring.sum()) - len(delta), 1))
    raised = float((weight * (residual + image) ** 2)[core].sum())
    background = float(theta[n_depth])
    variance = float(noise.variance_at(np.array([background]))[0])
    full = core_pixels(tip, angles, shape, optics.sigma_px)
    return NeedleFit(
        position_px=tip,
        angles=angles,
        shape=shape,
        depths=depths,
        depth=depth,
        background=background,
        covariance_px2=covariance[:2, :2] if quick else influence_covariance(influence, noise.correlation),
        n_core=n_core,
        chi2_core=chi2_core,
        chi2_ring=chi2_ring,
        explained=1.0 - float(square[core].sum()) / max(raised, 1e-12),
        valid_fraction=min(1.0, n_core / max(full, 1)),
        misfit=float(np.sqrt(max(chi2_core - 1.0, 0.0) * variance) / max(abs(depth), 1e-9)),
        significance=significance_of(image, surface, weight),
        converged=converged,
    )


def significance_of(image: Float, surface: Float, weight: Float) -> float:
    """Return how many standard deviations an image (n,) stands out of any background (n, p), its shape being given."""
    over, under = np.sqrt(weight) * image, np.sqrt(weight)[:, None] * surface
    return float(np.linalg.norm(over - under @ np.linalg.lstsq(under, over, rcond=None)[0]))


def explains(fit: NeedleFit, least: float) -> bool:
    """Say whether a fit explains a part of what is under it: of all, or, where it stands out, of what is more than the noise."""
    left = fit.chi2_core
    raised = left / max(1.0 - fit.explained, 1e-9)
    over_noise = 1.0 - max(left - 1.0, 0.0) / max(raised - 1.0, 1e-9)
    stands_out = fit.significance / np.sqrt(max(fit.chi2_ring, 1.0)) > STANDS_OUT
    return bool(fit.explained > least or (raised > 1.0 and over_noise > least and stands_out))


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
