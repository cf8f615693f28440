"""More tees like those already known: a matched filter with their own image.

Where the images of two tees from the two foci nearly coincide, rings around the tips no longer look like a T. But other tees of the film
show what one looks like, and the correlation with that image has a peak of its own for each tip.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.needle_images import NeedleFit, needle_image
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Float

LIKENESS = 0.4  # correlation coefficient from which a place is worth a fit; two tees one over the other reach 0.5 to 0.7
SCALE = 2  # the film is searched at half resolution


def template_of(known: NeedleFit, optics: Optics) -> NDArray[np.float32]:
    """Return the image of a known tee at the resolution of the search; its middle pixel is the tip."""
    half = int(np.ceil(known.shape.length_px + 2 * optics.sigma_px + 2) // SCALE * SCALE)
    axis = SCALE * (np.arange(-half // SCALE, half // SCALE + 1, dtype=np.float64))
    coarse = replace(optics, sigma_px=float(np.hypot(optics.sigma_px, SCALE / np.sqrt(12))))
    return needle_image(*np.meshgrid(axis, axis), known, coarse).astype(np.float32)


def find_like(film: NDArray[Any], template: NDArray[np.float32]) -> Float:
    """Find places that look like a known tee.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    template : ndarray of shape (s, s)
        As of :func:`template_of`.

    Returns
    -------
    ndarray of shape (n, 3)
        col_px, row_px, correlation coefficient; best first.
    """
    small = cv2.resize(film, (film.shape[1] // SCALE, film.shape[0] // SCALE), interpolation=cv2.INTER_AREA).astype(np.float32)
    side = len(template)
    if min(small.shape) <= side:
        return np.zeros((0, 3))
    likeness = cv2.matchTemplate(small, template, cv2.TM_CCOEFF_NORMED)
    row, col = np.divmod(np.flatnonzero(likeness > LIKENESS), likeness.shape[1])
    peak = likeness[row, col] == cv2.dilate(likeness, np.ones((5, 5), np.uint8))[row, col]
    row, col = row[peak], col[peak]
    centre = side // 2
    table = np.stack([(col + centre + 0.5) * SCALE - 0.5, (row + centre + 0.5) * SCALE - 0.5, likeness[row, col]], axis=1)
    return table[np.argsort(-table[:, 2])].astype(np.float64)
