"""The values of a film at and beyond which pixels are saturated."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_MOST_LOOKED_AT = 1500**2  # pixels that tell whether a film is saturated
_NOISY = 3.0  # values by which pixels differ from what those beside them foretell: noise that makes specks in all that is not cut off
_OTHERS = 0.1  # part of a film that tells of it: more than marks alone take up
_MUCH, _SPECKS = 0.2, 0.2  # part of a film that its background is, part of the runs of pixels in it that are one pixel long
_ENOUGH, _FADES = 30, 2.0  # pixels within a distance of its value, and how many times as many as there are within the fourth of such
_TAIL = 16  # such distances are less than this part of the values


def saturation(film: NDArray[Any], bits: int) -> tuple[float, float]:
    """Return the values at and beyond which pixels are saturated.

    A limit of the value range counts as saturation only where a crowd of pixels piles up on it: more than on the values beside it. So do
    the pixels of the background of a film without noise. What is cut off goes on beside it as steeply as before; into such a background the
    images of marks fade out: the nearer to it, the more pixels have a value. Where there is noise in the rest, what has none is cut off.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int
        Significant bits.

    Returns
    -------
    floor, ceiling : float
        Pixels must lie strictly between; infinite where nothing is saturated.
    """
    sample = film[:: max(1, film.size // _MOST_LOOKED_AT)]  # whole rows, as they lie in memory
    low, high = int(sample.min()), int(sample.max())
    floor = float(low) if _is_saturated(sample, low, 1, low == 0) else -np.inf
    ceiling = float(high) if _is_saturated(sample, high, -1, high >= 2**bits - 1) else np.inf
    return floor, ceiling


def _is_saturated(sample: NDArray[Any], edge: int, inward: int, limit: bool) -> bool:
    there = sample == edge
    count = int(np.count_nonzero(there))
    if count <= max(20, sample.size // 20000):
        return False
    if not limit and count <= 5 * max(1, *(int(np.count_nonzero(sample == edge + inward * k)) for k in range(1, 6))):
        return False
    # noise makes specks in areas of one value; of a tail there are as many pixels at a distance as are inverse to it
    specks = np.count_nonzero(there[:, :-2] & ~there[:, 1:-1] & there[:, 2:])
    if count < _MUCH * sample.size or specks > _SPECKS * np.count_nonzero(there[:, :-1] & ~there[:, 1:]):
        return True
    if _is_noisy(sample, there):
        return True
    distance = np.sort((sample[~there].astype(np.int64) - edge) * inward)
    if len(distance) == 0:
        return True
    reach = 2 ** np.arange(max(1, int(np.log2(distance[-1] / _TAIL)) + 1))
    near, third, far = (np.searchsorted(distance, k * reach, side="right") for k in (1, 3, 4))
    counted = near >= _ENOUGH
    return bool(not counted.any() or (near < _FADES * (far - third))[counted].any())


def _is_noisy(sample: NDArray[Any], there: NDArray[Any]) -> bool:
    """Say whether there is noise in what is not at an end of the range: second differences along rows (Immerkaer, CVIU 64, 1996)."""
    rows = sample[:, :-2].astype(np.float64) - 2 * sample[:, 1:-1] + sample[:, 2:]
    seen = ~(there[:, :-2] | there[:, 1:-1] | there[:, 2:])
    return bool(np.count_nonzero(seen) > _OTHERS * seen.size and np.median(np.abs(rows[seen])) > _NOISY)
