"""Tables of the opacity of pointed pins and of its derivatives, on a grid of shapes that the needles of a film share."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from rsa_vision.detect.models.film_curve import by_film_curve, film_curve
from rsa_vision.detect.models.profiles import TAIL, Optics
from rsa_vision.types import Float

Key = tuple[float, float, float, Optics]  # of a table: half width, length, taper
Single = NDArray[np.float32]  # a millionth of the opacity: derivatives by differences stand it
CELL, CELL_OF_BLUR = 0.3, 0.2  # pixels between the nodes of a needle table, and part of the blur where that is more
GRID, FINE_Q = 1.1, 0.06  # ratio of the half widths and lengths, and steps of the slant, that have tables of their own
SKEW, STEP = 0.1, 0.05  # for derivatives: by the skew; by the logarithms of attenuation and blur, and by the taper
LOG_GRID = math.log(GRID)
_OF_TABLE = 1 / 4  # variance, in cells, that the mean over a cell and linear interpolation between nodes add to the blur
_KERNEL, _UNBLURRED = 4.5, np.ones(1, np.float32)  # standard deviations to which a kernel goes; one of none
_KEPT = 96  # tables: as many as the needles of a film ask for at once; of long ones 256 took three times the memory of the film
_PAD, _FADED = 5.0, 4.0  # blur widths around the needle that a table covers; beyond which noise lets nothing be seen


@lru_cache(maxsize=_KEPT)
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
) -> Single:
    """Blurred opacity of a needle so many times wider and longer, on the grid for one of this half width and length stretched with it.

    What is uneven of the blur is that along the needle against across, and the covariance of both.
    """
    cell = cell_of(optics.sigma_px)
    cell_s, cell_p = cell * longer, cell * wider
    if slant or skew:
        opacity = _unblurred(half_width, length, taper, optics.sigma_px, optics.mu_px, slant, skew, wider, longer)
    else:  # stretched with its grid a needle is the same, but for how thick it is
        opacity = _unblurred(half_width, length, taper, optics.sigma_px, optics.mu_px * wider)
    along, oblique = optics.uneven
    mirrored = not (skew or oblique)
    if oblique and not skew:
        opacity = _unfolded(opacity)

    bends = any((*optics.curve, optics.logged))  # if not, it does not matter when it is blurred
    late = optics.late * (blurrier * optics.sigma_px) ** 2 if bends else 0.0
    if oblique:  # waves do not draw what is as sharp as a cell
        late = max(min(late, (1 - math.hypot(along, oblique)) * (blurrier * optics.sigma_px) ** 2 - cell**2), 0.0)
    lights = []  # part of the light, and the variances and covariance of its blur in cells
    for part, sigma in ((1 - optics.tail, blurrier * optics.sigma_px), (optics.tail, TAIL * blurrier * optics.sigma_px)):
        if part:
            before_s, before_p = ((1 + along) * sigma**2 - late, (1 - along) * sigma**2 - late)
            var_s, var_p = (max(of / step**2 - _OF_TABLE, 0.1) for of, step in ((before_s, cell_s), (before_p, cell_p)))
            lights.append((part, var_s, var_p, oblique * sigma**2 / (cell_s * cell_p)))
    seen = _obliquely_blurred(opacity, lights) if oblique else _blurred(opacity, lights, mirrored=mirrored)
    if any(optics.curve):
        seen = film_curve(seen, optics.curve).astype(np.float32)
    if late:
        seen = _blurred_late(seen, optics.logged, (1.0, late / cell_s**2, late / cell_p**2, 0.0), mirrored=mirrored)
    return _unfolded(seen) if mirrored else seen


def _unfolded(half: Single) -> Single:
    """Return both halves of what is the same on either side of the axis, which is the first column."""
    return np.concatenate([half[:, :0:-1], half], axis=1)


@lru_cache(maxsize=_KEPT)
def _unblurred(
    half_width: float,
    length: float,
    taper: float,
    sigma: float,
    mu: float,
    slant: float = 0.0,
    skew: float = 0.0,
    wider: float = 1.0,
    longer: float = 1.0,
) -> Single:
    """Opacity on the grid for this blur, before it; of what is the same on either side of the axis one half.

    A ray in depth ``z`` of the needle crosses it at the distance ``s + sqrt(slant) z`` from the tip; of its chord only the part before the
    flat end counts. The middle of the chord lies the further behind the further it is from the axis: ``skew`` times the distance.
    """
    cell = cell_of(sigma)
    first, (n_s, n_p) = _grid(half_width, length, sigma)
    cell_s, cell_p = cell * longer, cell * wider
    s = first[0] * longer + cell_s * np.arange(n_s)
    p = first[1] * wider + cell_p * np.arange(n_p) if skew else cell_p * np.arange(n_p // 2 + 1)
    s, p = s.astype(np.float32), p.astype(np.float32)
    half_width, length = half_width * wider, length * longer
    # where the needle is, with what rays that cross its end aslant see of it; only blur comes to the other nodes
    far = length + (math.sqrt(slant) + abs(skew)) * half_width
    rows, cols = (
        slice(*np.searchsorted(at, (low - step, high + step)))
        for at, step, low, high in ((s, cell_s, 0, far), (p, cell_p, -half_width, half_width))
    )
    fine_s, fine_p = ((at[:, None] + step * (np.arange(2) - 0.5) / 2).ravel() for at, step in ((s[rows], cell_s), (p[cols], cell_p)))
    width = half_width * np.clip(fine_s[:, None] / (taper * length), 0.0, 1.0)
    chord = _mean_chord(width, np.append(fine_p, fine_p[-1] + cell_p / 2) - cell_p / 4)
    before = length - fine_s[:, None] - skew * fine_p
    if slant:
        chord *= np.clip(0.5 + before / (np.sqrt(slant) * np.maximum(chord, 1e-9)), 0.0, 1.0)
    fine = -np.expm1(-mu * chord) * (1.0 if slant else np.clip(0.5 + before / (cell_s / 2), 0.0, 1.0))
    opacity = np.zeros((n_s, len(p)), np.float32)
    opacity[rows, cols] = (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]) / 4
    return opacity


def _mean_chord(width: Float, edges: Float) -> Float:
    """Mean chord between these places across circles: one in the middle, where the rim lies between, is too long or none."""
    within = np.clip(edges, -width, width)
    area = within * np.sqrt(width**2 - within**2) + width**2 * np.arcsin(within / np.maximum(width, 1e-9))
    return np.asarray(np.diff(area, axis=1) / np.diff(edges))


def _blurred_late(shown: Single, logged: float, light: tuple[float, float, float, float], *, mirrored: bool) -> Single:
    """What film shows after more blur: of itself, or of the light of which it is the logarithm."""
    if not logged:
        return _blurred(shown, [light], mirrored=mirrored)
    blurred = _blurred(np.expm1(np.float32(logged) * shown), [light], mirrored=mirrored)
    return np.asarray(np.log1p(blurred) / np.float32(logged), np.float32)


@lru_cache(maxsize=1024)
def _kernel(variance: float) -> Single:
    sigma = math.sqrt(variance)
    return np.asarray(cv2.getGaussianKernel(2 * int(_KERNEL * sigma + 0.5) + 1, sigma, cv2.CV_32F), np.float32)


def _blurred(image: Single, lights: list[tuple[float, float, float, float]], *, mirrored: bool) -> Single:
    """Blur lengthwise and across; ``mirrored``: what lies before the first column is as what lies behind it."""
    border = cv2.BORDER_REFLECT_101 if mirrored else cv2.BORDER_CONSTANT
    out = np.zeros_like(image)
    for part, var_s, var_p, _ in lights:
        lengthwise = cv2.sepFilter2D(image, -1, _UNBLURRED, _kernel(var_s), borderType=cv2.BORDER_CONSTANT)
        out += part * cv2.sepFilter2D(lengthwise, -1, _kernel(var_p), _UNBLURRED, borderType=border)
    return out


def _obliquely_blurred(image: Single, lights: list[tuple[float, float, float, float]]) -> Single:
    """Blur by Gaussians with covariances; what leaves one end comes in at the other, beyond which it has faded."""
    (rows, cols), widest = image.shape, lights[-1]
    beyond_s, beyond_p = (int(_KERNEL / 2 * math.sqrt(variance)) for variance in widest[1:3])
    padded = next_fast_len(rows + beyond_s), next_fast_len(cols + beyond_p, real=True)
    at_s, at_p = 2 * np.pi * np.fft.fftfreq(padded[0])[:, None], 2 * np.pi * np.fft.rfftfreq(padded[1])
    square_s, both, square_p = at_s**2, at_s * at_p, at_p**2
    passed = sum(part * np.exp(-0.5 * (var_s * square_s + var_p * square_p) - by_both * both) for part, var_s, var_p, by_both in lights)
    return np.asarray(irfft2(rfft2(image, s=padded) * passed, s=padded)[:rows, :cols], np.float32)


def _grid(half_width: float, length: float, sigma: float) -> tuple[tuple[float, float], tuple[int, int]]:
    """Return where the grid of a table begins along and across the needle, and how many nodes it has."""
    pad, cell = _PAD * sigma, cell_of(sigma)
    half = math.ceil((half_width + pad) / cell)
    return (-pad, -half * cell), (math.ceil((length + 2 * pad) / cell) + 1, 2 * half + 1)


def cell_of(sigma: float) -> float:
    """Return the pixels between the nodes of a table for a blur of this standard deviation: nothing changes within a part of it."""
    return max(CELL, CELL_OF_BLUR * sigma)


@lru_cache(maxsize=1024)
def table_for(
    width_step: int, length_step: int, taper: float, optics: Optics
) -> tuple[Key, tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Return the key of the table for about this size, where its grid begins and, in cells, its middle and how far it is seen."""
    half_width, length, sigma = round(GRID**width_step, 4), round(GRID**length_step, 4), round(optics.sigma_px, 3)
    first, (n_s, n_p) = _grid(half_width, length, sigma)
    middle, rim = ((n_s - 1) / 2, (n_p - 1) / 2), (_PAD - _FADED) * sigma / cell_of(sigma)
    curve = round(optics.curve[0], 3), round(optics.curve[1], 3)
    near = Optics(sigma, round(optics.mu_px, 4), curve, round(optics.tail, 3), round(optics.late, 3), round(optics.logged, 2))
    return (half_width, length, round(taper, 3), near), first, middle, (middle[0] - rim, middle[1] - rim)


@lru_cache(maxsize=_KEPT)
def table(
    half_width: float, length: float, taper: float, optics: Optics, slant: float, more: str, own: bool = False, uneven: bool = False
) -> Single:
    """Opacity and its derivatives by half width and length as the grid stretches with them; then its slopes along and across: first axis.

    ``more``: "ends" for derivatives by slant and skew between the two; "exact" for those, and last the slopes of the derivatives by size;
    "optics" for those by the logarithms of attenuation and blur, by the taper, by the curve, by the tail, by what is late and logged and by
    what is uneven, alone. ``own``, ``uneven``: those by the first two of these, and by the last two, follow the opacity.
    """
    one = half_width, length, taper, optics, slant
    base = _opacity(*one)
    if more == "optics":
        nodes = _by_optics(base, *one)
    else:
        wider, longer = _opacity(*one, wider=GRID), _opacity(*one, longer=GRID)
        by_size = [(wider - base) / ((GRID - 1) * half_width), (longer - base) / ((GRID - 1) * length)]
        nodes = [base, *(_by_own(base, *one) if own else []), *(_by_uneven(base, *one) if uneven else []), *by_size]
        if more:
            nodes += [(_opacity(*one[:-1], round(slant + FINE_Q, 4)) - base) / FINE_Q, (_opacity(*one, skew=SKEW) - base) / SKEW]
        for of in [base, *by_size] if more == "exact" else [base]:
            nodes += np.gradient(of, cell_of(optics.sigma_px))
    values = np.array(nodes, np.float32)
    values[:, [0, -1]] = values[:, :, [0, -1]] = 0.0  # the rim stands for all that is beyond
    return values


def _by_optics(base: Single, half_width: float, length: float, taper: float, optics: Optics, slant: float) -> list[Single]:
    short = _opacity(half_width, length, taper - STEP, optics, slant)
    others = [
        replace(optics, tail=optics.tail + STEP),
        replace(optics, late=optics.late + STEP),
        replace(optics, logged=optics.logged + STEP),
    ]
    steps = [*_by_own(base, half_width, length, taper, optics, slant), (base - short) / STEP]
    bow, skewness = optics.curve
    if optics.late:
        others = [replace(optics, curve=(bow + STEP, skewness)), replace(optics, curve=(bow, skewness + STEP)), *others]
    else:  # nothing is blurred after it
        straight = _opacity(half_width, length, taper, replace(optics, curve=(0.0, 0.0), logged=0.0), slant)
        steps += [np.asarray(of, np.float32) for of in by_film_curve(straight, optics.curve)]
    steps += [(_opacity(half_width, length, taper, other, slant) - base) / STEP for other in others]
    return [*steps, *_by_uneven(base, half_width, length, taper, optics, slant)]


def _by_own(base: Single, half_width: float, length: float, taper: float, optics: Optics, slant: float) -> list[Single]:
    factor = float(np.exp(STEP))
    dense = _opacity(half_width, length, taper, replace(optics, mu_px=optics.mu_px * factor), slant)
    wide = _opacity(half_width, length, taper, optics, slant, blurrier=factor)
    return [(dense - base) / STEP, (wide - base) / STEP]


def _by_uneven(base: Single, half_width: float, length: float, taper: float, optics: Optics, slant: float) -> list[Single]:
    along, oblique = optics.uneven
    others = (replace(optics, uneven=(along + STEP, oblique)), replace(optics, uneven=(along, oblique + STEP)))
    return [(_opacity(half_width, length, taper, other, slant) - base) / STEP for other in others]


def look_up(values: Single, at_s: Float, at_p: Float) -> Float:
    """Interpolate all columns of a table bilinearly at these places in units of its cells, within it; single precision is far finer."""
    n_p = values.shape[2]
    low_s, low_p = at_s.astype(np.intp), at_p.astype(np.intp)
    part_s, part_p = (at_s - low_s).astype(np.float32), (at_p - low_p).astype(np.float32)
    node = low_s * n_p + low_p
    nodes = values.reshape(len(values), -1)
    near: Single = nodes.take(node, axis=1, mode="wrap")
    beside, far, across = (nodes.take(node + step, axis=1, mode="wrap") for step in (1, n_p, n_p + 1))  # within: spares the check
    for low, high in ((near, beside), (far, across)):
        high -= low
        high *= part_p
        low += high
    far -= near
    far *= part_s
    near += far
    return near.astype(np.float64)
