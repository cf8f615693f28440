"""The noise of lossy compression: the cosine transform of blocks of 8 by 8 pixels, rounded to multiples of a step for each frequency.

Where nothing much happens such a film (JPEG, also in TIFF and DICOM) shows no noise at all, and around marks and edges the errors of
rounding, which no tile beside them tells. The steps show in the film: its coefficients lie on their multiples (Fan & de Queiroz, IEEE
Trans. Image Process. 12, 2003).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from rsa_vision.detect.film.tiles import nowhere_saturated, tiles_of
from rsa_vision.types import Float

_SIDE = 8  # pixels of a block
_MOST_ASKED, _MOST = 1024, 65536  # blocks, spread over the film: that may tell that it was not compressed, and how much it was
_HIGH = 8  # sum of the two frequencies from which hardly any coefficient of a compressed film is not zero
_FEW = 0.2  # part of them
_BUSIEST = 0.01  # part of them that has most in it: marks and edges
_ROUNDING = 0.289  # error of a coefficient by pixels that are whole numbers
_NOT_ZERO = 7 * _ROUNDING  # pixels that repeat each other are rounded alike
_COARSE = 4  # frequencies in each direction, of waves as wide as marks
_LEAST_STEP = 3.0  # less makes hardly more noise than whole numbers, and what is just not zero would look like it
_MIXED = 2  # frequencies both across and down, in a block whose pixels are rounded each by itself and not by rows
_ENOUGH = 8  # coefficients of a frequency that are not zero
_ON_STEPS = 3.0  # times that error, that those of a compressed film miss the multiples of their step by
_TESTED, _MOSTLY = 4, 0.5  # frequencies that tell, and part of them that has to have a step


@dataclass(frozen=True, slots=True, eq=False)
class Lossy:
    """Errors of compression.

    Attributes
    ----------
    variance : float
        Of a pixel in the busiest blocks.
    correlation : ndarray of shape (2 reach + 1, 2 reach + 1)
        Of pixels at (row, col) offsets, on average over the places in a block.
    pattern : float
        Height of the waves in a block that a single coefficient makes, if it is one step from zero.
    """

    variance: float
    correlation: Float
    pattern: float


def noise_of_compression(film: NDArray[Any], reach: int, floor: float = -np.inf, ceiling: float = np.inf) -> Lossy | None:
    """Return the errors that compression has left in the busiest blocks of a film; none if it was not compressed, or not noticeably.

    Coefficients that are not zero are wrong by up to half a step, evenly: ``q^2 / 12``. Those that are zero have lost all that they had;
    how much that was is told by how many are not zero, as coefficients of pictures are distributed by Laplace's law (Lam & Goodman, IEEE
    Trans. Image Process. 9, 2000). Frequencies that all blocks lack are taken to have had nothing.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    reach : int
        Pixels to which the correlation is followed, fewer than a block has.
    floor, ceiling : float
        Values at which pixels are saturated: what was beyond is lost to more than rounding.

    Returns
    -------
    Lossy or None
    """
    high = np.add.outer(np.arange(_SIDE), np.arange(_SIDE)) >= _HIGH
    some = _coefficients(film, _MOST_ASKED, floor, ceiling)
    if not len(some) or np.mean(np.abs(some[:, high]) > _NOT_ZERO) > _FEW:
        return None
    blocks = _coefficients(film, _MOST, floor, ceiling)
    blocks = blocks[np.count_nonzero(np.abs(blocks[:, 1:, 1:]) > _NOT_ZERO, axis=(1, 2)) >= _MIXED]
    steps = _steps(blocks)
    if steps is None:
        return None
    energy = np.square(blocks).sum((1, 2)) - np.square(blocks[:, 0, 0])
    busiest = blocks[np.argsort(-energy)[: max(_ENOUGH, round(_BUSIEST * len(blocks)))]]
    lost = _lost(np.where(steps > 0, np.mean(np.abs(busiest) > steps / 2, axis=0), 0.0), steps)
    variance = float(lost.sum()) / _SIDE**2
    # of frequencies that balls and arms have
    return Lossy(variance, _correlation(lost, reach), float(steps[:_COARSE, :_COARSE].max()) * 2 / _SIDE) if variance > 0 else None


def _coefficients(film: NDArray[Any], most: int, floor: float, ceiling: float) -> Float:
    """Of blocks spread over the film that are nowhere saturated, shape (n, 8, 8)."""
    blocks = tiles_of(film, _SIDE, most)
    blocks = blocks[nowhere_saturated(blocks, floor, ceiling)].astype(np.float32)
    return np.asarray(_basis() @ blocks @ _basis().T, np.float64)


@lru_cache(maxsize=1)
def _basis() -> Float:
    return np.asarray(dct(np.eye(_SIDE), axis=0, norm="ortho"), np.float32)


def _steps(blocks: Float) -> Float | None:
    """Steps of the frequencies, shape (8, 8), zero where they are not told; none if the film was not compressed."""
    steps, tested = np.zeros((_SIDE, _SIDE)), 0
    for u, v in np.ndindex(steps.shape):
        size = np.sort(np.abs(blocks[:, u, v]))
        size = size[np.searchsorted(size, _NOT_ZERO) :]
        if (u, v) == (0, 0) or len(size) < _ENOUGH:
            continue
        tested += 1
        step = float(size[len(size) // 10])  # among those of one step
        for _ in range(3):
            times = np.maximum(np.rint(size / step), 1.0)
            step = float(size @ times / (times @ times))
        missed = np.sqrt(np.mean(np.square(size - step * np.rint(size / step))))
        if step > _LEAST_STEP and missed < min(_ON_STEPS * _ROUNDING, step / 5):
            steps[u, v] = step
    if np.count_nonzero(steps) < max(_TESTED, _MOSTLY * tested):
        return None
    steps[0, 0] = max(steps[0, 1], steps[1, 0])  # usual tables have about as much for the mean, all of whose multiples occur
    return steps


def _lost(kept: Float, steps: Float) -> Float:
    """Mean squared error of coefficients of which this part is not zero."""
    h = -np.log(np.clip(kept, 1e-6, 0.9))  # half a step over the scale of Laplace's law
    of_zero = np.square(steps / (2 * h)) * (2 - np.exp(-h) * (h * h + 2 * h + 2)) / -np.expm1(-h)
    return np.where(kept > 0, (1 - kept) * of_zero + kept * np.square(steps) / 12, 0.0)


def _correlation(lost: Float, reach: int) -> Float:
    """Correlation of neighbours, given the variance of each frequency; those in other blocks have errors of their own."""
    along = np.stack([np.correlate(wave, wave, "full") for wave in _basis()], axis=1)[_SIDE - 1 - reach : _SIDE + reach]
    # reaches farther than it is followed: tapered, or spectra would be negative
    along *= 1 - np.abs(np.arange(-reach, reach + 1))[:, None] / (reach + 1)
    covariance = np.einsum("lu,uv,mv->lm", along, lost, along)
    return np.asarray(covariance / covariance[reach, reach])
