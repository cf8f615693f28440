"""Where a focus may be: all places from which enough control points fall onto images.

The image of a control point, moved to the fiducial plane, and the control point fix a line through the focus. Two of them fix the focus; it
then predicts the images of all other control points.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.geometry.rays import closest_approach
from rsa_vision.identify.grids import needed
from rsa_vision.types import Float

NEAR_MM: Final = 1.2  # images in the plane: the grid is known to some tenths of a millimetre, the focus by two points only
LARGEST: Final = 4  # places that are returned
MOST_LINES: Final = 400
FEW: Final = 4


def find_foci(images_mm: Float, controls_mm: Float, nominal_mm: Float, reach_mm: float, missing: float) -> list[tuple[Float, int]]:
    """Find places of a focus.

    Parameters
    ----------
    images_mm : ndarray of shape (n, 2)
        All images of the film, transformed to the fiducial plane of this focus.
    controls_mm : ndarray of shape (m, 3)
        Control points in the plane frame.
    nominal_mm : ndarray of shape (3,)
    reach_mm : float
        Largest distance from the nominal focus.
    missing : float
        Largest fraction of control points without an image.

    Returns
    -------
    list of (ndarray of shape (3,), int)
        Places and the number of control points with an image there, best first.
    """
    least = needed(len(controls_mm), 2, missing)
    through = np.column_stack([images_mm, np.zeros(len(images_mm))])
    towards = controls_mm[:, None] - through[None]
    distance = _length(np.cross(towards, nominal_mm - through[None])) / _length(towards)
    slack = NEAR_MM * nominal_mm[2] / np.abs(controls_mm[:, 2]).clip(1.0)
    mark, image = np.nonzero(distance < reach_mm + slack[:, None])
    if len(np.unique(mark)) < least:
        return []
    if len(mark) > MOST_LINES:
        nearest = np.argsort(distance[mark, image])[:MOST_LINES]
        mark, image = mark[nearest], image[nearest]
    spread = _length(controls_mm[:, None] - controls_mm[None])
    apart = 0.35 * spread.max() if len(controls_mm) > FEW else 0.0  # of a few any two may be all that is left
    first, second = np.nonzero(np.triu((spread[mark][:, mark] > apart) & (image[:, None] != image), 1))
    near_a, near_b, *_ = closest_approach(
        through[image[first]], controls_mm[mark[first]], through[image[second]], controls_mm[mark[second]]
    )
    focus = (near_a + near_b) / 2
    with np.errstate(invalid="ignore"):
        crossing = _length(near_a - near_b) < slack[mark[first]] + slack[mark[second]]
        focus = focus[crossing & (_length(focus - nominal_mm) < reach_mm * 1.1 + 20)]
    if not len(focus):
        return []
    rise = controls_mm[None, :, 2] / (focus[:, None, 2] - controls_mm[None, :, 2])
    predicted = controls_mm[None, :, :2] + (controls_mm[None, :, :2] - focus[:, None, :2]) * rise[..., None]
    hit = np.zeros(predicted.shape[:2], bool)
    squared = np.zeros(len(focus))
    for m in range(len(controls_mm)):  # only images that were possible for this mark at all
        options = images_mm[image[mark == m]]
        if len(options):
            nearest = sum((predicted[:, m, axis, None] - options[:, axis]) ** 2 for axis in range(2)).min(axis=1)
            hit[:, m] = nearest < NEAR_MM**2
            squared += np.minimum(nearest, NEAR_MM**2)
    votes = hit.sum(axis=1)
    found: list[tuple[Float, int]] = []
    ranked = np.lexsort((squared, -votes))
    ranked = ranked[votes[ranked] >= least]
    while len(ranked) and len(found) < LARGEST:
        best = focus[ranked[0]]
        found.append((best, int(votes[ranked[0]])))
        away = np.abs(focus[ranked] - best)
        ranked = ranked[(away[:, 0] > 12) | (away[:, 1] > 12) | (away[:, 2] > 60)]
    return found


def _length(vectors: Float) -> Float:
    length: Float = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return length
