"""Where marker images may be: a cheap multi-scale filter over the film in bands, recall first.

Differences of Gaussians on a pyramid that starts at half resolution, in units of the local spread of the same filter (so that
trabeculae raise the threshold where they are, and nowhere else). Both polarities come out of one pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.tiles import medians
from rsa_vision.detect.search.junctions import find_junctions
from rsa_vision.detect.search.strokes import COLUMNS, find_strokes, where_three_meet
from rsa_vision.types import Float, Int

BAND = 1024  # rows at full resolution that are in memory as float32 at once
MARGIN = 128  # overlap of bands; more than the reach of the coarsest filter
BLOCK = 32  # side of the blocks of one pyramid level over which the spread is measured
# (pyramid level, inner sigma, outer sigma in pixels of that level, radius in film pixels that answers best)
SCALES = ((1, 0.85, 1.4, 2.6), (1, 1.4, 2.2, 4.4), (2, 1.2, 1.9, 7.5), (3, 1.0, 1.6, 12.0))
REACH = 3.0  # blur widths to which kernels go
LARGEST = 25  # pixels at half resolution: wider areas at an end of the range are none of a mark
SMOOTH, FROM_FILM = 5, 4.0  # of such pixels: over which a film is averaged before it is carried on into them; where centres may be
STRENGTH = 4.5  # local spreads by which candidates answer the filter; real beads on bone start at about 5
FAINT = 0.86  # of what counts as significant: extrema of so much are listed too, for looks that know what they look for
ROUNDING = 0.5  # variance, in stored values, that rounding counts for: neighbours round the same way, so it does not average out
JUNCTION_SCALE = (1, 4.4)  # the filter on whose answer the arms of tees are looked for
STROKE_SCALES = ((1, 2.6), (1, 4.4))  # those for single pins


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Local extrema of the filters.

    Attributes
    ----------
    position_px : ndarray of shape (n, 2)
        (col, row).
    radius_px : ndarray of shape (n,)
        Radius that the answering filter suits best.
    strength : ndarray of shape (n,)
        Filter answer in units of its local spread; positive for marks darker than their surroundings, negative for brighter ones.
    roundness : ndarray of shape (n,)
        Ratio of the smaller to the larger curvature at the extremum: 1 round, 0 a ridge.
    junctions : ndarray of shape (m, 5)
        Points where three arms may meet, as :func:`rsa_vision.detect.search.junctions.find_junctions`.
    strokes : ndarray of shape (k, 6)
        What may be single pins, strongest first, as :func:`rsa_vision.detect.search.strokes.find_strokes`.
    """

    position_px: Float
    radius_px: Float
    strength: Float
    roundness: Float
    junctions: Float
    strokes: Float

    def rows(self, index: Any) -> Candidates:
        """Return the extrema that ``index`` selects, with all junctions and strokes."""
        chosen = (self.position_px[index], self.radius_px[index], self.strength[index], self.roundness[index])
        return Candidates(*chosen, self.junctions, self.strokes)


def find_candidates(film: NDArray[Any], noise: NoiseModel) -> Candidates:
    """Find local extrema of the multi-scale filter.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    noise : NoiseModel
        Its smallest variance is what the spread is at least taken for: saturated and blank areas have none of their own.

    Returns
    -------
    Candidates
        Those down to ``FAINT`` of the strength that counts, strongest of neighbouring ones first; both polarities.
    """
    found: list[Float] = []
    junctions: list[Float] = []
    strokes: list[Float] = []
    rows = film.shape[0]
    # kept from band to band: the first touch of new memory costs as much as a filter
    work = np.empty((5, (min(rows, BAND + 2 * MARGIN) + 16) * (film.shape[1] + 16) // 4), np.float32)
    for start in range(0, rows, BAND):
        top, bottom = max(0, start - MARGIN), min(rows, start + BAND + MARGIN)
        top -= top % 8
        band = film[top:bottom]
        stop = start + BAND if start + BAND < rows else rows + BAND
        for into, table in zip((found, junctions, strokes), _band_extrema(band, noise, work), strict=True):
            table[:, 1] += top
            into.append(table[(table[:, 1] >= start) & (table[:, 1] < stop)])
    table = np.concatenate(found)
    table = table[np.argsort(-np.abs(table[:, 3]))]
    strokes_found = np.concatenate(strokes)
    strokes_found = strokes_found[np.argsort(-np.abs(strokes_found[:, 5]))]
    joined = np.concatenate(junctions)
    joined = np.concatenate([joined, where_three_meet(strokes_found, joined)])
    return Candidates(table[:, :2], table[:, 2], table[:, 3], table[:, 4], joined, strokes_found)


def _band_extrema(band: NDArray[Any], noise: NoiseModel, work: NDArray[np.float32]) -> tuple[Float, Float, Float]:
    """``work``: rows with room for the band at half resolution."""
    pad = (-band.shape[0] % 8, -band.shape[1] % 8)
    if any(pad):
        band = cv2.copyMakeBorder(band, 0, pad[0], 0, pad[1], cv2.BORDER_REPLICATE)
    half = cv2.resize(band, (band.shape[1] // 2, band.shape[0] // 2), interpolation=cv2.INTER_AREA)
    image, limit, *others = (row[: half.size].reshape(half.shape) for row in work)
    image[:], distance = _carried_on(half, noise)
    room = cycle(others)  # three in turn: none is written to from itself
    at, blurred = (1, 0.0), image
    out = [np.zeros((0, 5))]
    junctions, strokes = np.zeros((0, 5)), [np.zeros((0, COLUMNS))]
    for level, inner, outer, radius in SCALES:
        if level > at[0]:
            image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
            limit, *others = (row[: image.size].reshape(image.shape) for row in work[1:])
            room = cycle(others)
            at, blurred = (level, 0.0), image
        # outer minus inner: positive where the mark is darker than its surroundings
        begun = _blurred(blurred, at[1], inner, next(room))
        blurred = _blurred(begun, inner, outer, next(room))  # the next scale may begin with it
        at = (level, outer)
        answer = cv2.subtract(blurred, begun, dst=begun)
        spread = _local_spread(answer, _white_spread(noise, level, inner, outer))
        limit = _over_blocks(STRENGTH * spread, limit)
        significance = cv2.divide(answer, limit, dst=limit)
        place = np.flatnonzero((significance > FAINT) | (significance < -FAINT))
        strength = np.asarray(significance.ravel()[place], np.float64)
        out.append(_extrema(answer, place, STRENGTH * strength, level, radius))
        clear = np.abs(strength) > 1
        if (level, radius) == JUNCTION_SCALE:
            junctions = find_junctions(significance, place[clear], strength[clear], level)
        if (level, radius) in STROKE_SCALES:
            strokes.append(find_strokes(answer, place[clear], strength[clear], level))
    return _near_film(np.concatenate(out), distance), _near_film(junctions, distance), _near_film(np.concatenate(strokes), distance)


def _carried_on(image: NDArray[Any], noise: NoiseModel) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Carry a film on into large areas at an end of the range: margins of scans, shutters. Their edges hide what lies beside them.

    The second is how far pixels are from the film; nothing where there is no such area.
    """
    if np.isinf(noise.floor) and np.isinf(noise.ceiling):
        return image, None
    beyond = np.asarray((image <= noise.floor) | (image >= noise.ceiling)).view(np.uint8)
    if np.count_nonzero(beyond) < LARGEST**2:
        return image, None
    square = np.ones((LARGEST, LARGEST), np.uint8)  # the cores of marks have no room for it; pixels beside what has lie half in it
    opened = cv2.morphologyEx(beyond, cv2.MORPH_OPEN, square)
    # marks on a background that is saturated are islands in it, and no film; of some no more is seen than four such pixels
    lands = cv2.erode(1 - opened, np.ones((2, 2), np.uint8))
    count, part = cv2.connectedComponents(lands)
    if lands.all() or len(np.unique(part[cv2.erode(lands, square) > 0])) < count - 1:
        return image, None
    area = cv2.dilate(opened, np.ones((3, 3), np.uint8))
    film = area == 0
    distance, nearest = cv2.distanceTransformWithLabels(area, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    weight = cv2.blur(film.astype(np.float32), (SMOOTH, SMOOTH))
    smooth = cv2.blur(np.where(film, image, 0).astype(np.float32), (SMOOTH, SMOOTH))
    values = np.zeros(int(nearest.max()) + 1, np.float32)
    values[nearest[film]] = smooth[film] / weight[film]
    return np.where(film, image, values[nearest]), distance


def _near_film(table: Float, distance: NDArray[Any] | None) -> Float:
    """Leave out what lies farther from the film than an image reaches from its centre."""
    if distance is None:
        return table
    col, row = (np.clip(table[:, k] / 2, 0, distance.shape[1 - k] - 1).astype(np.intp) for k in (0, 1))
    return np.asarray(table[distance[row, col] < FROM_FILM])


def _blurred(image: NDArray[Any], by: float, sigma: float, into: NDArray[Any]) -> NDArray[Any]:
    """Blur further what is blurred: shorter kernels than from the start."""
    more = float(np.sqrt(sigma**2 - by**2))
    if more == 0:
        return image
    side = 2 * round(REACH * more) + 1
    return cv2.GaussianBlur(image, (side, side), more, dst=into)


def _extrema(answer: NDArray[Any], place: Int, strength: Float, level: int, radius: float) -> Float:
    row, col = np.divmod(place, answer.shape[1])
    last_r, last_c = answer.shape[0] - 1, answer.shape[1] - 1

    def at(dr: int, dc: int) -> NDArray[Any]:
        """Beyond the border is its mirror image, as the filter has it: balls cut off there have their extremum on it."""
        beside: NDArray[Any] = answer[last_r - np.abs(last_r - np.abs(row + dr)), last_c - np.abs(last_c - np.abs(col + dc))]
        return beside

    # few pixels answer: to look around those costs less than filters of rank over all
    for dr, dc in ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)):
        here = answer[row, col]
        peak = np.copysign(1, here) * (here - at(dr, dc)) >= 0
        row, col, strength = row[peak], col[peak], strength[peak]
    if len(row) == 0:
        return np.zeros((0, 5))
    centre = answer[row, col].astype(np.float64)
    left, right, up, down = (at(*step) for step in ((0, -1), (0, 1), (-1, 0), (1, 0)))
    dxx, dyy = left + right - 2 * centre, up + down - 2 * centre
    dxy = (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1)) / 4
    mean, spread_xy = (dxx + dyy) / 2, np.hypot((dxx - dyy) / 2, dxy)
    roundness = (np.abs(mean) - spread_xy) / np.maximum(np.abs(mean) + spread_xy, 1e-12)
    shift_c = np.clip((left - right) / (2 * np.where(dxx == 0, 1, dxx)), -0.5, 0.5)
    shift_r = np.clip((up - down) / (2 * np.where(dyy == 0, 1, dyy)), -0.5, 0.5)
    size = 2**level
    position_c = (col + shift_c + 0.5) * size - 0.5
    position_r = (row + shift_r + 0.5) * size - 0.5
    return np.stack([position_c, position_r, np.full(len(row), radius), strength, roundness], axis=1)


def _white_spread(noise: NoiseModel, level: int, inner: float, outer: float) -> float:
    """Spread of a filter's answer to white noise of the film's smallest variance."""
    gain = 1 / (4 * np.pi * inner**2) + 1 / (4 * np.pi * outer**2) - 1 / (np.pi * (inner**2 + outer**2))
    return float(np.sqrt((noise.variance.min() + ROUNDING) * gain) / 2**level)


def _local_spread(answer: NDArray[Any], least: float) -> NDArray[Any]:
    """Median absolute deviation in blocks, as a standard deviation, on the grid of the blocks; the last may stand over."""
    over = [-n % BLOCK for n in answer.shape]
    if any(over):
        answer = cv2.copyMakeBorder(answer, 0, over[0], 0, over[1], cv2.BORDER_REFLECT)
    n_rows, n_cols = (n // BLOCK for n in answer.shape)
    # every third pixel in either direction: the filter's own correlation makes the others nearly copies
    part = np.abs(answer.reshape(n_rows, BLOCK, n_cols, BLOCK)[:, 1::3, :, 1::3])
    middle = medians(part.swapaxes(1, 2).reshape(n_rows, n_cols, -1)) / 0.6745
    spread: NDArray[Any] = np.maximum(middle, least).astype(np.float32)
    return spread


def _over_blocks(grid: NDArray[Any], into: NDArray[Any]) -> NDArray[Any]:
    """Interpolate what is known of blocks between their middles."""
    size = (grid.shape[1] * BLOCK, grid.shape[0] * BLOCK)
    if size == into.shape[::-1]:
        return cv2.resize(grid, size, dst=into, interpolation=cv2.INTER_LINEAR)
    into[:] = cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[: into.shape[0], : into.shape[1]]
    return into
