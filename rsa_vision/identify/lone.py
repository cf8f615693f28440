"""Which images without a partner may be markers that the other focus does not show, and which are clutter.

A hidden marker looks like the markers of the film (size, contrast) and lies among them; clutter looks like anything and lies anywhere.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import expit, gammaln

from rsa_vision.identify.densities import log_kernels, log_student, some_of
from rsa_vision.identify.looks import KIND, UNSURE, WIDE
from rsa_vision.types import Bool, Float, Int

OF_MARKERS: Final = (0.94, 0.05, 0.01)  # images of markers that are clear, disturbed by something beside them, described badly
PRESUMED_IMAGES: Final = 2.0  # images that such a presumption is worth; of clutter, one is as frequent as the other
PRESUMED: Final = (0.5, 0.05)  # markers that one focus does not show: that many, and that part of those both show
FREEDOM: Final = 4.0  # of the places of markers on a film: another bone may lie apart
LEAST_SPREAD: Final = 0.05  # of the places, as a part of the film's larger side


def chance_of_marker(look: Float, place_px: Float, quality: Int, paired: Bool, shape: tuple[int, int]) -> Float:
    """Return how probable the images of one film are to be markers, by those that have a partner.

    Parameters
    ----------
    look : ndarray of shape (n, 2) or (n, 1)
        Logarithms of radius and contrast, or of the radius alone.
    place_px : ndarray of shape (n, 2)
        (col, row).
    quality : ndarray of int, shape (n,)
        0 clear, 1 disturbed by something beside it, 2 not described well; the look of the latter two says little.
    paired : ndarray of bool, shape (n,)
        Whether it has a partner.
    shape : tuple of two ints
        (rows, cols) of the film.

    Returns
    -------
    ndarray of shape (n,)
        1 for those with a partner; 0 for the others of a film without any: nothing tells what its markers look like.
    """
    result = paired.astype(float)
    lone, teachers = np.flatnonzero(~paired), np.flatnonzero(paired)
    if not len(lone) or not len(teachers):
        return result
    log_place = _log_density_of_places(place_px[lone], place_px[teachers], max(shape)) + np.log(shape[0] * shape[1])
    seen = np.bincount(quality[teachers], minlength=len(OF_MARKERS)) + PRESUMED_IMAGES * np.array(OF_MARKERS)
    odds = np.log(len(seen) * (seen / seen.sum())[quality[lone]]) + log_place
    odds += np.log((PRESUMED[0] + PRESUMED[1] * len(teachers)) / len(lone))
    clear = teachers[quality[teachers] == 0]
    if len(clear):
        kind, wide, unsure = (error[: look.shape[1]] for error in (KIND, WIDE, UNSURE))
        middle = np.median(look[clear], axis=0)
        for at in some_of(np.arange(len(lone)), len(clear)):
            mine = look[lone[at]]
            width = np.hypot(kind, np.where((quality[lone[at]] > 0)[:, None], unsure, 0.0))
            anything = (log_student((mine - middle) / wide, 3.0) - np.log(wide)).sum(axis=1)
            odds[at] += log_kernels(mine, look[clear], np.ones(len(clear)), width, len(clear)) - anything
    result[lone] = expit(odds)
    return result


def _log_density_of_places(places: Float, markers: Float, side: float) -> Float:
    """Return the log density, per px2, of a bivariate t distribution about the markers."""
    spread = (LEAST_SPREAD * side) ** 2 * np.eye(2)
    middle = markers.mean(axis=0)
    covariance = (spread + (markers - middle).T @ (markers - middle)) / max(len(markers) - 1, 1)
    away = places - middle
    squared = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    constant = gammaln(FREEDOM / 2 + 1) - gammaln(FREEDOM / 2) - np.log(FREEDOM * np.pi) - 0.5 * np.linalg.slogdet(covariance)[1]
    result: Float = constant - (FREEDOM / 2 + 1) * np.log1p(squared / FREEDOM)
    return result
