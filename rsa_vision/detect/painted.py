"""The pins and tees of a film painted once: what balls beside them are fitted on, and where they leave nothing to explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.needle_images import NeedleFit, needle_image, support
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Bool, Float

_BLURS = 5.0  # beyond which an image has faded
_EXPLAINED = 0.8  # of the contrast of a place, made by needles: the rest is less than the half of an arm that a ball must be
_SAMPLES = 12


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """Images of needles in film values; callable with pixels (cols, rows).

    Attributes
    ----------
    canvas : ndarray of float32, shape of the film
        Zero, and without memory of its own, where no needle is.
    """

    canvas: NDArray[np.float32]

    def __call__(self, cols: Float, rows: Float) -> Float:
        """Return the images at the pixels nearest to these places; beyond the film those of its rim."""
        return _at(self.canvas, cols, rows)

    def explain(self, film: NDArray[Any], position_px: Float, radius_px: Float) -> Bool:
        """Say at which places (n, 2) the needles make nearly all by which a disc differs from a ring around it, shape (n,)."""
        angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES

        def contrast(image: NDArray[Any]) -> Float:
            on, around = (
                _at(image, *(position_px.T[:, :, None] + reach[:, None] * np.array([np.cos(angle), np.sin(angle)])[:, None]))
                for reach in (0.5 * radius_px, 2 * radius_px + 3)
            )
            difference: Float = on.mean(1) - np.median(around, axis=1)
            return difference

        ours, all_of_it = contrast(self.canvas), contrast(film)
        return np.asarray((np.abs(ours) > 0) & (np.abs(all_of_it - ours) < (1 - _EXPLAINED) * np.abs(ours)))


def paint(shape: tuple[int, ...], needles: list[tuple[NeedleFit, Optics]]) -> Painted:
    """Paint needles, each with its optics, on an empty film of this shape."""
    canvas = np.zeros(shape, np.float32)
    for fit, optics in needles:
        half = int(np.ceil(fit.shape.length_px + fit.shape.half_width_px + _BLURS * optics.sigma_px)) + 1
        col, row = np.rint(fit.position_px).astype(np.intp)
        cols, rows = (np.arange(max(at - half, 0), min(at + half + 1, n)) for at, n in ((col, shape[1]), (row, shape[0])))
        dx, dy = cols - fit.position_px[0], rows - fit.position_px[1]
        i, j = np.nonzero(support(dx, dy, fit.angles, fit.shape, _BLURS * optics.sigma_px + 1))
        canvas[rows[i], cols[j]] += needle_image(dx[j], dy[i], fit, optics)
    return Painted(canvas)


def _at(image: NDArray[Any], cols: Float, rows: Float) -> Float:
    row, col = (np.rint(x).astype(np.intp).clip(0, n - 1) for x, n in zip((rows, cols), image.shape, strict=True))
    return np.asarray(image[row, col], np.float64)
