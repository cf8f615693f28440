"""Places on a film, (col, row): how far apart they are, and which lie on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.types import Bool, Float


def gaps(places: Float, others: Float) -> Float:
    """Return the distances of places (n, 2) from others (m, 2), shape (n, m)."""
    return np.asarray(np.hypot(*(places[:, None] - others).transpose(2, 0, 1)))


def on_film(film: NDArray[Any], cols: Float, rows: Float) -> Bool:
    """Say which places lie on the film."""
    return np.asarray((cols > -0.5) & (cols < film.shape[1] - 0.5) & (rows > -0.5) & (rows < film.shape[0] - 0.5))
