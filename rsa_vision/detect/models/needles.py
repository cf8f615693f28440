"""Images of pointed pins and of tees (three pins whose tips meet): the opacity along the chord through a cone, blurred.

The tip of a tapering pin fades out: the opacity near it grows with the square of the distance, so any threshold lies pixels away from it.
Here the tip is a parameter of the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from rsa_vision.detect.models.profiles import TAIL, Optics
from rsa_vision.types import Bool, Float, Int

Images = Callable[[Float, Float], Float]
"""Images of some marks at pixels (cols, rows), in film values over the background."""
_Key = tuple[float, float, float, Optics]  # of a table: half width, length, taper
CELL, CELL_OF_BLUR = 0.3, 0.2  # pixels between the nodes of a needle table, and part of the blur where that is more
GRID, FINE_Q = 1.1, 0.06  # ratio of the half widths and lengths, and steps of the slant, that have tables of their own
SKEW, STEP = 0.1, 0.05  # for derivatives: by the skew; by the logarithms of attenuation and blur, and by the taper
_LOG_GRID = math.log(GRID)
_OF_TABLE = 1 / 4  # variance, in cells, that the mean over a cell and linear interpolation between nodes add to the blur
_BLUR_GRID = 0.002  # of the logarithm of a needle's own blur
_UNEVEN_GRID = 0.02  # between what is uneven, of the blur of an arm, that has tables of its own
_KERNEL, _UNBLURRED = 4.5, np.ones(1)  # standard deviations to which a kernel goes; one of none
_PAD, _FADED = 5.0, 4.0  # blur widths around the needle that a table covers; beyond which noise lets nothing be seen


@dataclass(frozen=True, slots=True)
class NeedleShape:
    """Outline of a pointed pin in pixels.

    Attributes
    ----------
    half_width_px, length_px : float
        At the thick end; from the tip to the thick end.
    taper : float
        Part of the length over which it tapers (1: a full cone).
    arms : tuple of float
        Lengths of the arms of a tee in units of that, if not one for all.
    """

    half_width_px: float
    length_px: float
    taper: float = 1.0
    arms: tuple[float, ...] = (1.0,)


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
        As in :class:`rsa_vision.detect.balls.fits.BallFits`; ``misfit`` is the RMS residual beyond the noise as a fraction of the depth.
    significance : float
        Depth over its standard deviation at the fitted shape: depth and width of a thin needle can stand for each other, so that neither is
        sure alone; that something is there is.
    converged : bool
    slants : ndarray of shape (2, k), optional
        How the rays cross each thick end, once it has been asked for: the square of their slope along the arm, and the skew of the end.
    height : float
        Largest difference from the background in its image; the depth is what full opacity would come to.
    blurrier : float
        Logarithm of its blur over that of the film: the penumbra grows with the distance from the film.
    edged : bool
        There is an edge in its background.
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
    height: float = 0.0
    blurrier: float = 0.0
    edged: bool = False

    def seen_by(self, optics: Optics) -> Optics:
        """Return a film's optics with the blur of this needle, on a grid that has tables of its own."""
        if abs(self.blurrier) < _BLUR_GRID / 2:
            return optics
        return replace(optics, sigma_px=optics.sigma_px * math.exp(_BLUR_GRID * round(self.blurrier / _BLUR_GRID)))


@lru_cache(maxsize=1024)
def _opacity(
    half_width: float,
    length: float,
    taper: float,
    optics: Optics,
    slant: float,
    wider: float = 1.0,
    longer: float = 1.0,
    blurrier: float = 1.0,
    skew: float = 0.0,
) -> Float:
    """Blurred opacity of a needle so many times wider and longer, on the grid for one of this half width and length stretched with it.

    A ray in depth ``z`` of the needle crosses it at the distance ``s + sqrt(slant) z`` from the tip; of its chord only the part before the
    flat end counts. The middle of the chord lies the further behind the further it is from the axis: ``skew`` times the distance.
    What is uneven of the blur is that along the needle against across, and the covariance of both.
    """
    cell = _cell(optics.sigma_px)
    first, (n_s, n_p) = _grid(half_width, length, optics.sigma_px)
    cell_s, cell_p = cell * longer, cell * wider
    s = first[0] * longer + cell_s * np.arange(n_s)
    along, oblique = optics.uneven
    mirrored = not (skew or oblique)  # one half is enough
    p = cell_p * np.arange(n_p // 2 + 1) if mirrored else first[1] * wider + cell_p * np.arange(n_p)
    half_width, length = half_width * wider, length * longer
    # where the needle is, with what rays that cross its end aslant see of it; only blur comes to the other nodes
    far = length + (math.sqrt(slant) + abs(skew)) * half_width
    rows, cols = (
        slice(*np.searchsorted(at, (low - step, high + step)))
        for at, step, low, high in ((s, cell_s, 0, far), (p, cell_p, -half_width, half_width))
    )
    fine_s, fine_p = ((at[:, None] + step * (np.arange(2) - 0.5) / 2).ravel() for at, step in ((s[rows], cell_s), (p[cols], cell_p)))
    width = half_width * np.clip(fine_s[:, None] / (taper * length), 0.0, 1.0)
    chord = 2 * np.sqrt(np.maximum(width**2 - fine_p**2, 0.0))
    before = length - fine_s[:, None] - skew * fine_p
    if slant:
        chord *= np.clip(0.5 + before / (np.sqrt(slant) * np.maximum(chord, 1e-9)), 0.0, 1.0)
    fine = -np.expm1(-optics.mu_px * chord) * (1.0 if slant else np.clip(0.5 + before / (cell_s / 2), 0.0, 1.0))
    opacity = np.zeros((n_s, len(p)))
    opacity[rows, cols] = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]) / 4

    def blurred(sigma: float) -> Float:
        parts = (1 + along, cell_s), (1 - along, cell_p)
        var_s, var_p = (max(part * sigma**2 / cell**2 - _OF_TABLE, 0.1) for part, cell in parts)
        if oblique:
            return _obliquely_blurred(opacity, var_s, var_p, oblique * sigma**2 / (cell_s * cell_p))
        lengthwise = cv2.sepFilter2D(opacity, -1, _UNBLURRED, _kernel(var_s), borderType=cv2.BORDER_CONSTANT)
        border = cv2.BORDER_REFLECT_101 if mirrored else cv2.BORDER_CONSTANT
        return np.asarray(cv2.sepFilter2D(lengthwise, -1, _kernel(var_p), _UNBLURRED, borderType=border), np.float64)

    seen = blurred(blurrier * optics.sigma_px)
    if optics.tail:
        seen += optics.tail * (blurred(TAIL * blurrier * optics.sigma_px) - seen)
    if any(optics.curve):
        seen = film_curve(seen, optics.curve)[0]
    return np.concatenate([seen[:, :0:-1], seen], axis=1) if mirrored else seen


def _kernel(variance: float) -> Float:
    sigma = math.sqrt(variance)
    return np.asarray(cv2.getGaussianKernel(2 * int(_KERNEL * sigma + 0.5) + 1, sigma), np.float64)


def _obliquely_blurred(image: Float, var_s: float, var_p: float, covariance: float) -> Float:
    """Blur by a Gaussian of this covariance matrix, in cells; what leaves one end comes in at the other, where the image has faded."""
    at_s, at_p = 2 * np.pi * np.fft.fftfreq(image.shape[0])[:, None], 2 * np.pi * np.fft.rfftfreq(image.shape[1])
    passed = np.exp(-0.5 * (var_s * at_s**2 + 2 * covariance * at_s * at_p + var_p * at_p**2))
    return np.asarray(irfft2(rfft2(image) * passed, s=image.shape), np.float64)


def film_curve(opacity: Float, curve: tuple[float, float]) -> Float:
    """What film shows of blurred opacities, and its derivatives by the two coefficients of :attr:`Optics.curve`: on a new first axis."""
    shifted = opacity / (opacity + math.exp(-curve[0]) * (1 - opacity))
    bow = shifted * (1 - shifted)
    skewed = bow * (1 - 2 * shifted)
    return np.stack([shifted + curve[1] * skewed, bow * (1 + curve[1] * (1 - 6 * bow)), skewed])


def _grid(half_width: float, length: float, sigma: float) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return where the grid of a table begins along and across the needle, and how many nodes it has."""
    pad, cell = _PAD * sigma, _cell(sigma)
    half = math.ceil((half_width + pad) / cell)
    return (-pad, -half * cell), (math.ceil((length + 2 * pad) / cell) + 1, 2 * half + 1)


def _cell(sigma: float) -> float:
    """Return the pixels between the nodes of a table: nothing changes within a part of the blur."""
    return max(CELL, CELL_OF_BLUR * sigma)


@lru_cache(maxsize=1024)
def _table_for(
    width_step: int, length_step: int, taper: float, optics: Optics
) -> tuple[_Key, tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Return the key of the table for about this size, where its grid begins and, in cells, its middle and how far it is seen."""
    half_width, length, sigma = round(GRID**width_step, 4), round(GRID**length_step, 4), round(optics.sigma_px, 3)
    first, (n_s, n_p) = _grid(half_width, length, sigma)
    middle, rim = ((n_s - 1) / 2, (n_p - 1) / 2), (_PAD - _FADED) * sigma / _cell(sigma)
    curve = round(optics.curve[0], 3), round(optics.curve[1], 3)
    near = Optics(sigma, round(optics.mu_px, 4), curve, round(optics.tail, 3))
    return (half_width, length, round(taper, 3), near), first, middle, (middle[0] - rim, middle[1] - rim)


@lru_cache(maxsize=256)
def _table(half_width: float, length: float, taper: float, optics: Optics, slant: float, more: str) -> NDArray[np.float32]:
    """Opacity and its derivatives by half width and length as the grid stretches with them; then its slopes along and across: first axis.

    ``more``: "ends" for derivatives by slant and skew between the two; "optics" for those by the logarithms of attenuation and blur, by
    the taper, by the curve, by the tail and by what is uneven, alone.
    """
    one = half_width, length, taper, optics, slant
    base = _opacity(*one)
    nodes = [
        base,
        (_opacity(*one, wider=GRID) - base) / ((GRID - 1) * half_width),
        (_opacity(*one, longer=GRID) - base) / ((GRID - 1) * length),
    ]
    if more == "ends":
        nodes += [(_opacity(*one[:-1], round(slant + FINE_Q, 4)) - base) / FINE_Q, (_opacity(*one, skew=SKEW) - base) / SKEW]
    nodes += np.gradient(base, _cell(optics.sigma_px))
    if more == "optics":
        factor = float(np.exp(STEP))
        dense = _opacity(half_width, length, taper, replace(optics, mu_px=optics.mu_px * factor), slant)
        wide, short = _opacity(*one, blurrier=factor), _opacity(half_width, length, taper - STEP, optics, slant)
        straight = _opacity(half_width, length, taper, replace(optics, curve=(0.0, 0.0)), slant)
        spread = _opacity(half_width, length, taper, replace(optics, tail=optics.tail + STEP), slant)
        _, *by_curve = film_curve(straight, optics.curve)
        uneven = [
            _opacity(half_width, length, taper, replace(optics, uneven=(optics.uneven[0] + along, optics.uneven[1] + oblique)), slant)
            for along, oblique in ((STEP, 0.0), (0.0, STEP))
        ]
        nodes = [(dense - base) / STEP, (wide - base) / STEP, (base - short) / STEP, *by_curve]
        nodes += [(more - base) / STEP for more in (spread, *uneven)]
    table = np.array(nodes, np.float32)
    table[:, [0, -1]] = table[:, :, [0, -1]] = 0.0  # the rim stands for all that is beyond
    return table


def _look_up(table: NDArray[np.float32], at_s: Float, at_p: Float) -> Float:
    """Interpolate all columns of a table bilinearly at these places in units of its cells, within it; single precision is far finer."""
    n_p = table.shape[2]
    low_s, low_p = at_s.astype(np.intp), at_p.astype(np.intp)
    part_s, part_p = (at_s - low_s).astype(np.float32), (at_p - low_p).astype(np.float32)
    node = low_s * n_p + low_p
    nodes = table.reshape(len(table), -1)
    near: NDArray[np.float32] = nodes.take(node, axis=1, mode="wrap")
    beside, far, across = (nodes.take(node + step, axis=1, mode="wrap") for step in (1, n_p, n_p + 1))  # within: spares the check
    for low, high in ((near, beside), (far, across)):
        high -= low
        high *= part_p
        low += high
    far -= near
    far *= part_s
    near += far
    return near.astype(np.float64)


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
    seen = _Seen.of(dx.ravel(), dy.ravel(), fit.angles, fit.shape, fit.seen_by(optics))
    values, _ = seen.values(fit.shape, fit.slants, slopes=False)
    return np.asarray((fit.depths @ seen.spread([values])[0]).reshape(dx.shape))


def arm_images(
    dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics, slants: Float | None = None, *, slopes: bool = True
) -> Float:
    """Opacity of every arm, its derivatives by (tip col, tip row, half width, length), and by its angle; arms along the second axis.

    With slants, those by the slant and by the skew of each arm follow; without slopes, the opacity is all.
    """
    seen = _Seen.of(dx, dy, angles, shape, optics)
    value, more = seen.values(shape, slants, slopes=slopes)
    if not slopes:
        return seen.spread([value])
    more_w, more_l, *more, g_s, g_p = more
    cell = _cell(seen.key[3].sigma_px)
    cell_s = seen.cell_s * seen.of_arms(shape.arms)
    along, across = (seen.at_s + seen.first[0] / cell) * cell_s, (seen.at_p + seen.first[1] / cell) * seen.cell_p
    c, s = np.cos(angles)[seen.arm], -np.sin(angles)[seen.arm]
    g_s, g_p = g_s * (cell / cell_s), g_p * (cell / seen.cell_p)
    d_angle = g_p * along - g_s * across  # counter-clockwise as displayed, the row axis pointing down
    stretch = seen.of_arms(shape.arms)
    by_size = [more_w - g_p * across / shape.half_width_px, more_l * stretch - g_s * along / shape.length_px]
    return seen.spread([value, g_p * s - g_s * c, -g_s * s - g_p * c, *by_size, d_angle, *more])


def arms_by_optics(dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics) -> Float:
    """Derivatives of every arm by all of an :class:`Optics`, on the first axis; how the ends slant hardly matters.

    In order: logarithms of attenuation and blur, taper, the two of the curve, tail, the two of what is uneven.
    """
    seen = _Seen.of(dx, dy, angles, shape, optics)
    *rows, by_along, by_oblique = seen.looked_up("optics", [0.0] * len(angles))
    c, s = np.cos(2 * angles)[seen.arm], np.sin(2 * angles)[seen.arm]
    return seen.spread([*rows, c * by_along + s * by_oblique, s * by_along - c * by_oblique])


def _of_arm(uneven: tuple[float, float], angle: float) -> tuple[float, float]:
    """What is uneven of a film's blur along an arm against across, and the covariance of both, on the grid of tables."""
    c, s = math.cos(2 * angle), math.sin(2 * angle)
    seen = uneven[0] * c + uneven[1] * s, uneven[0] * s - uneven[1] * c
    return round(_UNEVEN_GRID * round(seen[0] / _UNEVEN_GRID), 4), round(_UNEVEN_GRID * round(seen[1] / _UNEVEN_GRID), 4)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Pixels at which an arm is seen: most see one at the most.

    Tables stand on a grid of shapes, shared by all needles of a film, and are stretched; what else a size changes is linear in between.
    """

    key: _Key
    keys: list[_Key]  # of each arm: of blur that is not even they see different parts
    first: tuple[float, float]
    cell_s: float  # stretched, for an arm of the common length
    cell_p: float
    arm: Int
    at_s: Float
    at_p: Float
    index: Int  # of arm and pixel
    shape: tuple[int, ...]  # arms and pixels

    @staticmethod
    def of(dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics) -> _Seen:
        steps = (math.floor(math.log(size) / _LOG_GRID) for size in (shape.half_width_px, shape.length_px))
        key, first, middle, reach = _table_for(*steps, shape.taper, optics)
        cell = _cell(key[3].sigma_px)
        cell_s, cell_p = cell * shape.length_px / key[1], cell * shape.half_width_px / key[0]
        c, s = np.cos(angles)[:, None], -np.sin(angles)[:, None]
        of_s = cell_s * np.array(shape.arms)[:, None]
        at_s = dx * (c / of_s) + (dy * (s / of_s) - first[0] / cell)
        at_p = dy * (c / cell_p) - (dx * (s / cell_p) + first[1] / cell)
        within = (np.abs(at_s - middle[0]) < reach[0]) & (np.abs(at_p - middle[1]) < reach[1])
        index = np.flatnonzero(within)
        at = at_s.ravel().take(index), at_p.ravel().take(index)
        keys = [key] * len(angles)
        if max(map(abs, optics.uneven)) > _UNEVEN_GRID / 2:
            keys = [(*key[:3], replace(key[3], uneven=_of_arm(optics.uneven, angle))) for angle in angles.tolist()]
        return _Seen(key, keys, first, cell_s, cell_p, index // len(dx), *at, index, within.shape)

    def looked_up(self, more: str, slants: list[float], last: int | None = None) -> Float:
        """Interpolate the tables of the arms; most share one with the arm before."""
        asked = list(zip(self.keys, slants, strict=True))
        first = [0, *(k for k in range(1, len(asked)) if asked[k] != asked[k - 1])]
        parts = pairwise([*np.searchsorted(self.arm, first).tolist(), len(self.arm)])
        tables = [_table(*asked[k][0], asked[k][1], more)[:last] for k in first]
        found = [_look_up(table, self.at_s[i:end], self.at_p[i:end]) for table, (i, end) in zip(tables, parts, strict=True)]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def values(self, shape: NeedleShape, slants: Float | None, *, slopes: bool) -> tuple[Float, list[Float]]:
        """Return the opacity and what else the tables hold."""
        last = None if slopes else -2
        if slants is None:
            value, *more = self.looked_up("", [0.0] * len(self.keys), last)
        else:
            off_q = np.where(slants[0] > 0, slants[0] % FINE_Q, slants[0])
            value, *more = self.looked_up("ends", np.round(slants[0] - off_q, 4).tolist(), last)
            value += off_q[self.arm] * more[2] + slants[1][self.arm] * more[3]
        value += (shape.half_width_px - self.key[0]) * more[0] + (shape.length_px * self.of_arms(shape.arms) - self.key[1]) * more[1]
        return value, more

    def of_arms(self, arms: tuple[float, ...]) -> Float | float:
        """Return at each pixel the number of its arm."""
        return arms[0] if len(arms) == 1 else np.array(arms)[self.arm]

    def spread(self, rows: Sequence[Float] | Float) -> Float:
        """Put rows of what is seen to arms and pixels, zero elsewhere."""
        out = np.zeros((len(rows), self.shape[0] * self.shape[1]))
        for into, row in zip(out, rows, strict=True):
            into[self.index] = row
        return out.reshape(len(rows), *self.shape)


def support(dx: Float, dy: Float, angles: Float, shape: NeedleShape, margin: float) -> Bool:
    """Pixels (rows, columns) within ``margin`` of an arm's axis rectangle, by the offsets of columns and rows from the tip."""
    x, y = dx.astype(np.float32), dy.astype(np.float32)[:, None]
    inside: Bool = x**2 + y**2 < margin**2
    middle = shape.length_px / 2
    for c, s in zip(np.cos(angles).tolist(), (-np.sin(angles)).tolist(), strict=True):
        along, across = (x * c - middle) + y * s, y * c - x * s
        inside |= (np.abs(along) < middle + margin) & (np.abs(across) < shape.half_width_px + margin)
    return inside
