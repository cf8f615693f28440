"""Images of pointed pins and of tees (three pins whose tips meet): the opacity along the chord through a cone, blurred.

The tip of a tapering pin fades out: the opacity near it grows with the square of the distance, so any threshold lies pixels away from it.
Here the tip is a parameter of the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

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
