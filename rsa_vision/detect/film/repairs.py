"""Lines of a film that a flat panel's driver made up from those beside them, where the panel itself has none: interpolated or copied.

They look like film and hold none: beside the tip of an arm they move it by a tenth of a pixel. Noise tells them: what is made up has none
of its own against its neighbours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, median_filter

from rsa_vision.types import Bool, Float, Int

_ASKED = 32  # pixels of a line, spread over it
_CAP = 4.0  # of the typical difference: marks and edges count no more than that
_OWN = {1: 0.15, 2: 0.3}  # of the differences of lines around, from which a line has noise of its own; rounding leaves some of second ones
_AROUND = 17  # lines
_MOST_TOGETHER = 3  # lines beside each other; wider areas are saturated, or beyond a shutter
_MOST = 0.1  # part of all lines: more, and the film was resampled
_LEAST = 1.0  # typical difference, in stored values, below which rounding makes up as much


def repaired_lines(film: NDArray[Any]) -> tuple[Int, Int]:
    """Find columns and rows that were made up.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)

    Returns
    -------
    cols, rows : ndarray of int
        Of a copied line and the one it was copied from, both: which is which nobody knows.
    """
    down, across = (np.linspace(0, n - 1, min(_ASKED, n)).astype(np.intp) for n in film.shape)
    return _made_up(film[down]), _made_up(film[:, across].T)


def _made_up(lines: NDArray[Any]) -> Int:
    """``lines``: pixels of each line down its column."""
    values = lines.astype(np.float32)
    if values.shape[1] < _AROUND:
        return np.zeros(0, np.intp)
    first = np.diff(values, axis=1)
    copied, between = (np.flatnonzero(_without_noise(of, order)) for order, of in ((1, first), (2, np.diff(first, axis=1))))
    if len(copied) + len(between) > _MOST * values.shape[1]:
        return np.zeros(0, np.intp)
    return np.unique(np.concatenate([copied, copied + 1, between + 1]))


def _without_noise(differences: NDArray[np.float32], order: int) -> Bool:
    size = np.abs(differences)
    typical = float(np.median(size[::4, ::4]))
    if typical < _LEAST:
        return np.zeros(size.shape[1], bool)
    own: Float = np.minimum(size, _CAP * typical).mean(axis=0, dtype=np.float64)
    low = own < _OWN[order] * median_filter(own, _AROUND, mode="nearest")
    run, _ = label(low)
    return np.asarray(low & (np.bincount(run.ravel())[run] <= _MOST_TOGETHER))
