"""More tees like those already known: a matched filter with their own image.

Where the images of two tees from the two foci nearly coincide, rings around the tips no longer look like a T. But other tees of the film
show what one looks like, and the correlation with that image has a peak of its own for each tip.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.least_squares import polynomial
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, arm_images, needle_image, support
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.fits import PROMISING, under
from rsa_vision.types import Bool, Float

LIKENESS = 0.4  # correlation coefficient from which a place is worth a fit; two tees one over the other reach 0.5 to 0.7
SCALE = 2  # the film is searched at half resolution
_BAND = 256  # rows of that, which stay in the cache
_AROUND = np.arange(-2, 3)  # pixels of that, over which a peak is the highest
_MEAN_OF = 0.33  # of the window's side: more than arms are wide, less than bones are
_SPARSE = 16  # every so-manieth pixel tells the mean of a film
_LEAST_VARIANCE = 0.02  # of rounded values, means of four


def template_of(known: NeedleFit, optics: Optics) -> NDArray[np.float32]:
    """Return the image of a known tee at the resolution of the search; its middle pixel is the tip."""
    half = int(np.ceil(known.shape.length_px + 2 * optics.sigma_px + 2) // SCALE * SCALE)
    axis = SCALE * (np.arange(-half // SCALE, half // SCALE + 1, dtype=np.float64))
    coarse = optics.pooled(SCALE)
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
    n_rows, n_cols = (n // SCALE for n in film.shape)
    side = len(template)
    found = [np.zeros((0, 3))]
    for first in range(0, n_rows - side + 1 if min(n_rows, n_cols) > side else 0, _BAND):
        top, bottom = max(first + _AROUND[0], 0), min(first + _BAND + _AROUND[-1] + side - 1, n_rows)
        band = film[SCALE * top : SCALE * bottom, : SCALE * n_cols]
        likeness = _correlation(cv2.resize(band, (n_cols, bottom - top), interpolation=cv2.INTER_AREA), template)
        row, col = np.divmod(np.flatnonzero(likeness > LIKENESS), likeness.shape[1])
        # few places are alike: to look around those costs less than a filter over all
        around = [axis[:, None] + _AROUND for axis in (row, col)]
        highest = likeness[np.clip(around[0], 0, len(likeness) - 1)[:, :, None], np.clip(around[1], 0, likeness.shape[1] - 1)[:, None]]
        peak = (likeness[row, col] == highest.max((1, 2))) & (row >= first - top) & (row < first - top + _BAND)
        row, col = row[peak], col[peak]
        centre = side // 2 + 0.5
        found.append(np.stack([(col + centre) * SCALE - 0.5, (row + top + centre) * SCALE - 0.5, likeness[row, col]], axis=1))
    table = np.concatenate(found)
    return table[np.argsort(-table[:, 2])]


def _correlation(image: NDArray[Any], template: NDArray[np.float32]) -> NDArray[np.float32]:
    """Correlation coefficient with all windows of an image, whose spread changes slowly from place to place: every second one tells it."""
    side, bare = len(template), _without_slopes(template, len(template), cv2.BORDER_CONSTANT)
    image = np.subtract(image, image[::_SPARSE, ::_SPARSE].mean(), dtype=np.float32)
    image, bare = _without_slopes(image, side, cv2.BORDER_REFLECT), bare - bare.mean()
    product = cv2.matchTemplate(image, bare, cv2.TM_CCORR)
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    twice, box = even.shape[::-1], (side // 2 + 1) // 2 * 2 + 1  # odd, of about as many pixels as the template
    mean, square = (
        cv2.boxFilter(cv2.resize(of, (twice[0] // 2, twice[1] // 2), interpolation=cv2.INTER_AREA), cv2.CV_64F, (box, box))
        for of in (even, cv2.multiply(even, even))
    )
    variance = cv2.subtract(square, cv2.multiply(mean, mean, dst=mean), dtype=cv2.CV_32F)
    spread = cv2.resize(cv2.sqrt(np.maximum(variance, np.float32(_LEAST_VARIANCE))), twice, interpolation=cv2.INTER_LINEAR)
    inside = tuple(slice(side // 2, side // 2 + n) for n in product.shape)
    return np.asarray(cv2.divide(product, spread[inside], dst=product, scale=1 / (side * float(np.linalg.norm(bare)))))


def _without_slopes(image: NDArray[np.float32], side: int, border: int) -> NDArray[np.float32]:
    """Return an image less its mean around each pixel: over the window of a tee the slope of a bone differs more than the tee does."""
    box = int(side * _MEAN_OF) | 1
    return np.asarray(cv2.subtract(image, cv2.blur(image, (box, box), borderType=border)))


def worth_a_fit(film: NDArray[Any], places: Float, known: NeedleFit, optics: Optics, noise: NoiseModel) -> tuple[Bool, Float]:
    """Say at which places the image of a known tee, on a quadratic background, explains a part of what lies under it.

    The first step from there to the best fit comes with it.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    places : ndarray of shape (n, 3)
        As of :func:`find_like`: all of one fraction of a pixel, so that one image does for all.
    known : NeedleFit
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    worth : ndarray of bool, shape (n,)
    step : ndarray of shape (n, 5)
        Of tip (col, row), half width, length and direction.
    """
    half = int(known.shape.length_px + 3 * optics.sigma_px) + 1
    axis = np.arange(-half, half + 1.0)
    row, col = np.nonzero(support(axis - 0.5, axis - 0.5, known.angles, known.shape, 3 * optics.sigma_px)) - np.array(half)
    image, *slopes = arm_images(col - 0.5, row - 0.5, known.angles, known.shape, optics).sum(1)
    cols, rows = ((np.floor(at)[:, None] + step).astype(np.intp) for at, step in zip(places.T, (col, row), strict=False))
    values = film[rows.clip(0, film.shape[0] - 1), cols.clip(0, film.shape[1] - 1)].astype(np.float64)
    basis = np.vstack([image, polynomial(half, col, row).T, *slopes])
    step = values @ np.linalg.pinv(basis)
    basis = basis[: -len(slopes)]
    theta = values @ np.linalg.pinv(basis)
    core = under(image)
    residual = (values - theta @ basis)[:, core]
    left, all_of_it = (np.square(part).mean(1) for part in (residual, residual + theta[:, :1] * image[core]))
    alone = noise.variance_at(theta[:, 1])
    worth = (left < (1 - PROMISING) * all_of_it) | (left - alone < (1 - PROMISING) * np.maximum(all_of_it - alone, 0.0))
    return worth, step[:, -len(slopes) :] / theta[:, :1]
