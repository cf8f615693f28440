"""Images of pointed pins and of tees (three pins whose tips meet): the opacity along the chord through a cone, blurred.

The tip of a tapering pin fades out: the opacity near it grows with the square of the distance, so any threshold lies pixels away from it.
Here the tip is a parameter of the image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rsa_vision.detect.models.needle_tables import FINE_Q, LOG_GRID, Key, cell_of, look_up, table, table_for
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float, Int

# between what has tables of its own: logarithms of a needle's own attenuation and blur, and what is uneven of the blur of an arm; an image
# is linear in between, to a thousandth of the depth
_OWN_GRID, _UNEVEN_GRID = 0.05, 0.1


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
    denser : float
        Logarithm of its attenuation over that of the film: pins of several widths may be of several metals.
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
    denser: float = 0.0
    edged: bool = False

    @property
    def way(self) -> Float:
        """Step (col, row) of one pixel from the tip along the first arm."""
        return np.array([np.cos(self.angles[0]), -np.sin(self.angles[0])])

    def seen_by(self, optics: Optics) -> Optics:
        """Return a film's optics with the attenuation and the blur of this needle: on a grid that has tables of its own, and off it."""
        denser, blurrier = (_OWN_GRID * round(own / _OWN_GRID) for own in (self.denser, self.blurrier))
        if not (self.denser or self.blurrier):
            return optics
        mu, sigma = optics.mu_px * math.exp(denser), optics.sigma_px * math.exp(blurrier)
        return replace(optics, mu_px=mu, sigma_px=sigma, own=(self.denser - denser, self.blurrier - blurrier))


def unexplained(fit: NeedleFit) -> float:
    """Return what the model leaves."""
    return fit.misfit + 1 - fit.explained


def middle(fit: NeedleFit) -> Float:
    """Return the middle of a pin, (col, row)."""
    half, angle = 0.5 * fit.shape.length_px, float(fit.angles[0])
    return np.asarray(fit.position_px + half * np.array([math.cos(angle), -math.sin(angle)]))


def turned(fit: NeedleFit) -> tuple[Float, Float]:
    """Tip and direction of the same pin the other way round."""
    return fit.position_px + fit.shape.length_px * fit.way, fit.angles + np.pi


def either_way(fit: NeedleFit) -> list[NeedleFit]:
    """Return a pin, and the same the other way round."""
    tip, angles = turned(fit)
    return [fit, replace(fit, position_px=tip, angles=angles)]


def wrapped(angles: Float) -> Float:
    """Return angles, or what they differ by, as turns of half a circle at the most either way, radians."""
    return np.asarray(np.angle(np.exp(1j * angles)))


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
    dx: Float,
    dy: Float,
    angles: Float,
    shape: NeedleShape,
    optics: Optics,
    slants: Float | None = None,
    *,
    slopes: bool = True,
    exact: bool = False,
) -> Float:
    """Opacity of every arm, its derivatives by (tip col, tip row, half width, length), and by its angle; arms along the second axis.

    With slants, those by the slant and by the skew of each arm follow; without slopes, the opacity is all. Derivatives by tip and angle are
    of the next smaller size that has a table, up to a fifth too flat, if they are not to be exact, as with slants they can be.
    """
    seen = _Seen.of(dx, dy, angles, shape, optics)
    value, more = seen.values(shape, slants, slopes=slopes, exact=exact)
    if not slopes:
        return seen.spread([value])
    more_w, more_l, *more, g_s, g_p = more
    cell = cell_of(seen.key[3].sigma_px)
    cell_s = seen.cell_s * seen.of_arms(shape.arms)
    along, across = (seen.at_s + seen.first[0] / cell) * cell_s, (seen.at_p + seen.first[1] / cell) * seen.cell_p
    c, s = np.cos(angles)[seen.arm], -np.sin(angles)[seen.arm]
    g_s, g_p = g_s * (cell / cell_s), g_p * (cell / seen.cell_p)
    d_angle = g_p * along - g_s * across  # counter-clockwise as displayed, the row axis pointing down
    stretch = seen.of_arms(shape.arms)
    by_size = [more_w - g_p * across / shape.half_width_px, more_l * stretch - g_s * along / shape.length_px]
    return seen.spread([value, g_p * s - g_s * c, -g_s * s - g_p * c, *by_size, d_angle, *more])


def arms_by_optics(dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics, *, nearest: bool = False) -> Float:
    """Derivatives of every arm by all of an :class:`Optics`, on the first axis; how the ends slant hardly matters.

    In order: logarithms of attenuation and blur, taper, the two of the curve, tail, late, logged, the two of what is uneven. They are those
    of the nearest size that has a table, or of the next smaller one.
    """
    seen = _Seen.of(dx, dy, angles, shape, optics, nearest=nearest)
    *rows, by_along, by_oblique = seen.looked_up("optics", [0.0] * len(angles))
    c, s = np.cos(2 * angles)[seen.arm], np.sin(2 * angles)[seen.arm]
    return seen.spread([*rows, c * by_along + s * by_oblique, s * by_along - c * by_oblique])


def _of_arm(uneven: tuple[float, float], angle: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """What is uneven of a film's blur along an arm against across, and the covariance of both: on the grid of tables, and off it."""
    c, s = math.cos(2 * angle), math.sin(2 * angle)
    along, oblique = uneven[0] * c + uneven[1] * s, uneven[0] * s - uneven[1] * c
    near = (round(_UNEVEN_GRID * round(along / _UNEVEN_GRID), 4), round(_UNEVEN_GRID * round(oblique / _UNEVEN_GRID), 4))
    return near, (along - near[0], oblique - near[1])


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Pixels at which an arm is seen: most see one at the most.

    Tables stand on a grid of shapes, shared by all needles of a film, and are stretched; what else a size changes is linear in between.
    """

    key: Key
    keys: list[Key]  # of each arm: of blur that is not even they see different parts
    own: tuple[float, float]  # attenuation and blur off those of the tables
    off: list[tuple[float, float]]  # what the blur of each is uneven by off its table, along and oblique; empty where it is even
    first: tuple[float, float]
    cell_s: float  # stretched, for an arm of the common length
    cell_p: float
    arm: Int
    at_s: Float
    at_p: Float
    index: Int  # of arm and pixel
    shape: tuple[int, ...]  # arms and pixels

    @staticmethod
    def of(dx: Float, dy: Float, angles: Float, shape: NeedleShape, optics: Optics, *, nearest: bool = False) -> _Seen:
        """``nearest``: with tables of the nearest size, for what is not corrected for it; else with those of the next smaller one."""
        step = round if nearest else math.floor
        steps = (step(math.log(size) / LOG_GRID) for size in (shape.half_width_px, shape.length_px))
        key, first, middle, reach = table_for(*steps, shape.taper, optics)
        cell = cell_of(key[3].sigma_px)
        cell_s, cell_p = cell * shape.length_px / key[1], cell * shape.half_width_px / key[0]
        c, s = np.cos(angles)[:, None], -np.sin(angles)[:, None]
        of_s = cell_s * np.array(shape.arms)[:, None]
        at_s = dx * (c / of_s) + (dy * (s / of_s) - first[0] / cell)
        at_p = dy * (c / cell_p) - (dx * (s / cell_p) + first[1] / cell)
        within = (np.abs(at_s - middle[0]) < reach[0]) & (np.abs(at_p - middle[1]) < reach[1])
        index = np.flatnonzero(within)
        at = at_s.ravel().take(index), at_p.ravel().take(index)
        keys, off = [key] * len(angles), list[tuple[float, float]]()
        if any(optics.uneven):
            near, off = map(list, zip(*(_of_arm(optics.uneven, angle) for angle in angles.tolist()), strict=True))
            keys = [(*key[:3], replace(key[3], uneven=of)) for of in near]
        return _Seen(key, keys, optics.own, off, first, cell_s, cell_p, index // len(dx), *at, index, within.shape)

    def looked_up(self, more: str, slants: list[float], last: int | None = None) -> list[Float]:
        """Interpolate the tables of the arms; most share one with the arm before."""
        asked = list(zip(self.keys, slants, strict=True))
        first = [0, *(k for k in range(1, len(asked)) if asked[k] != asked[k - 1])]
        parts = pairwise([*np.searchsorted(self.arm, first).tolist(), len(self.arm)])
        own, uneven = (any(self.own), bool(self.off)) if more != "optics" else (False, False)
        tables = [table(*asked[k][0], asked[k][1], more, own, uneven)[:last] for k in first]
        found = [look_up(nodes, self.at_s[i:end], self.at_p[i:end]) for nodes, (i, end) in zip(tables, parts, strict=True)]
        value, *rows = found[0] if len(found) == 1 else np.concatenate(found, axis=1)
        off = [*(self.own if own else ()), *(map(self.of_arms, zip(*self.off, strict=True)) if uneven else ())]
        for by, row in zip(off, rows, strict=False):
            value += by * row
        return [value, *rows[len(off) :]]

    def values(self, shape: NeedleShape, slants: Float | None, *, slopes: bool, exact: bool = False) -> tuple[Float, list[Float]]:
        """Return the opacity and what else the tables hold."""
        wider, longer = shape.half_width_px - self.key[0], shape.length_px * self.of_arms(shape.arms) - self.key[1]
        if slants is None:
            value, *more = self.looked_up("", [0.0] * len(self.keys), None if slopes else -2)
        else:
            of_table, last = ("exact", -6) if exact else ("ends", -2)
            off_q = np.where(slants[0] > 0, slants[0] % FINE_Q, slants[0])
            value, *more = self.looked_up(of_table, np.round(slants[0] - off_q, 4).tolist(), None if slopes else last)
            value += off_q[self.arm] * more[2] + slants[1][self.arm] * more[3]
            if slopes and exact:
                steeper = zip(more[-6:-4], more[-4:-2], more[-2:], strict=True)
                more[-6:] = [of + wider * by_width + longer * by_length for of, by_width, by_length in steeper]
        value += wider * more[0] + longer * more[1]
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
