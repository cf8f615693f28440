"""The pins and tees of a film painted once: what balls beside them are fitted on, and where they leave nothing to explain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.patches import Box
from rsa_vision.detect.models.needles import NeedleFit, needle_image, support
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float, Int

_BLURS = 4.0  # beyond which an image has faded
_SHARP_PX = 0.2  # blur that tables of needles can draw and films hide
_EXPLAINED = 0.8  # of the contrast of a place, made by needles: the rest is less than the half of an arm that a ball must be
_SAMPLES = 12
_RINGS = (0.0, 0.5, 1.0)  # of a radius, on which samples lie


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """Images of needles in film values; callable with pixels (cols, rows).

    Attributes
    ----------
    corner_px : ndarray of int, shape (n, 2)
        (col, row) of the first pixel of the square around each needle. A picture of the size of the film would be mostly empty, and
        costs more time than all the rest.
    images : ndarray of float32, shape (n, s, s)
    needles : list of NeedleFit
    optics : list of Optics
        Of each of them.
    """

    corner_px: Int
    images: NDArray[np.float32]
    needles: list[NeedleFit]
    optics: list[Optics]

    def __call__(self, cols: Float, rows: Float) -> Float:
        """Return the images at the pixels nearest to these places."""
        total = np.zeros(cols.shape)
        if cols.size == 0:
            return total
        side = self.images.shape[1]
        ends = zip(self.corner_px.T, (cols, rows), strict=True)
        near = np.flatnonzero(np.logical_and(*((first < at.max() + 1) & (first > at.min() - side - 1) for first, at in ends)))
        place = [np.rint(at).astype(np.intp) for at in (cols, rows)] if len(near) else []
        for k in near:
            col, row = (at - first for at, first in zip(place, self.corner_px[k], strict=True))
            inside = (col >= 0) & (col < side) & (row >= 0) & (row < side)
            total[inside] += self.images[k, row[inside], col[inside]]
        return total

    def and_more(self, needles: list[tuple[NeedleFit, Optics]]) -> Painted:
        """Return these and others, each with its optics."""
        return paint([*zip(self.needles, self.optics, strict=True), *needles])

    def sharp(self, cols: Float, rows: Float) -> Float:
        """Return what they would show at these places (c,), (r,) on a film that is linear and hardly blurs, shape (r, c)."""
        total = np.zeros((len(rows), len(cols)))
        side = self.images.shape[1]
        for corner, fit, optics in zip(self.corner_px, self.needles, self.optics, strict=True):
            if all(first < at[-1] and first + side > at[0] for first, at in zip(corner, (cols, rows), strict=True)):
                dx, dy = np.meshgrid(cols - fit.position_px[0], rows - fit.position_px[1])
                total += needle_image(dx, dy, fit, Optics(_SHARP_PX, optics.mu_px))
        return total

    def taken_from(self, box: NDArray[Any], left: int, top: int) -> NDArray[np.float32]:
        """Return a box of the film, whose first pixel is at this column and row, without the images."""
        out = Box(box.astype(np.float32), np.array([left, top]))
        self.take_from(out)
        return out.values

    def take_from(self, box: Box) -> None:
        """Take the images away from a box of the film, in place."""
        film, side, size = box.values, self.images.shape[1], np.array(box.values.shape[::-1])
        low = self.corner_px - box.corner_px
        for k in np.flatnonzero(((low < size) & (low + side > 0)).all(1)):
            (c0, r0), (c1, r1) = np.maximum(low[k], 0), np.minimum(low[k] + side, size)
            film[r0:r1, c0:c1] -= self.images[k, r0 - low[k, 1] : r1 - low[k, 1], c0 - low[k, 0] : c1 - low[k, 0]]

    def explain(self, film: NDArray[Any], position_px: Float, radius_px: Float) -> Bool:
        """Say at which places (n, 2) the needles make nearly all by which a disc differs from a ring around it, shape (n,)."""
        angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES

        on, around = (
            position_px.T[:, :, None] + reach[:, None] * np.array([np.cos(angle), np.sin(angle)])[:, None]
            for reach in (0.5 * radius_px, 2 * radius_px + 3)
        )

        def contrast(image: Callable[[Float, Float], Float]) -> Float:
            difference: Float = image(*on).mean(1) - np.median(image(*around), axis=1)
            return difference

        ours, all_of_it = contrast(self), contrast(lambda cols, rows: _at(film, cols, rows))
        return np.asarray((np.abs(ours) > 0) & (np.abs(all_of_it - ours) < (1 - _EXPLAINED) * np.abs(ours)))

    def under(self, position_px: Float, radius_px: Float) -> Float:
        """Return the largest difference that needles make somewhere under discs at these places (n, 2), in film values, shape (n,)."""
        angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
        steps = np.concatenate([part * np.stack([np.cos(angle), np.sin(angle)]) for part in _RINGS], axis=1)
        cols, rows = position_px.T[:, :, None] + radius_px[:, None] * steps[:, None]
        return np.asarray(np.abs(self(cols, rows)).max(axis=1, initial=0.0))


def paint(needles: list[tuple[NeedleFit, Optics]]) -> Painted:
    """Paint needles, each with its optics."""
    half = max(int(np.ceil(f.shape.length_px + f.shape.half_width_px + _BLURS * optics.sigma_px)) + 1 for f, optics in needles)
    corner = np.rint([f.position_px for f, _ in needles]).astype(np.intp) - half
    images = np.zeros((len(needles), 2 * half + 1, 2 * half + 1), np.float32)
    axis = np.arange(2.0 * half + 1)
    for image, first, (fit, optics) in zip(images, corner, needles, strict=True):
        dx, dy = (axis + (begin - at) for begin, at in zip(first, fit.position_px, strict=True))
        row, col = np.nonzero(support(dx, dy, fit.angles, fit.shape, _BLURS * optics.sigma_px + 1))
        image[row, col] = needle_image(dx[col], dy[row], fit, optics)
    return Painted(corner, images, [fit for fit, _ in needles], [optics for _, optics in needles])


def _at(image: NDArray[Any], cols: Float, rows: Float) -> Float:
    row, col = (np.rint(x).astype(np.intp).clip(0, n - 1) for x, n in zip((rows, cols), image.shape, strict=True))
    return np.asarray(image[row, col], np.float64)
