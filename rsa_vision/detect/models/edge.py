"""An edge in the background, of a bone or an implant: any smooth profile across it, the same all along it."""

from __future__ import annotations

import cv2
import numpy as np

from rsa_vision.detect.film.least_squares import weighted_least_squares
from rsa_vision.types import Float

_KNOTS = 1.5  # blur widths between the knots of a profile across an edge
_INTERVALS = 14  # between them at the most, of balls
_MOST_BENT = 1.0  # half windows to a radius


def edge_profile(bare: Float, valid: Float, sigma_px: float, *, bent: bool = False, intervals: int = _INTERVALS) -> Float:
    """Return functions that together make any smooth profile across the strongest edge of a window.

    The edge of a bone or an implant is nearly a circle over the width of a window: it changes across, not along. A ball changes both
    ways, so its centre stays determined, if less well across the edge; the covariance knows.

    Parameters
    ----------
    bare : ndarray of shape (rows, cols)
        The window without its marks.
    valid : ndarray of shape (rows, cols)
        1, or 0 where masked.
    sigma_px : float
        Blur of the film: nothing changes faster.
    bent : bool
        With direction and curvature of the gradients.
    intervals : int
        Between the knots of the profile, at the most.

    Returns
    -------
    ndarray of shape (p, rows * cols)
        Cubic B-splines of the coordinate across the edge.
    """
    weight, smooth = (cv2.GaussianBlur(image, (9, 9), 1.0, borderType=cv2.BORDER_REFLECT) for image in (valid, bare * valid))
    smooth = smooth / np.maximum(weight, 1e-6)
    by_row, by_col = np.gradient(smooth)
    inside = valid * (weight > 0.9)
    by = np.stack([by_col, by_row]).reshape(2, -1)
    tensor = (by * inside.ravel()) @ by.T
    across = np.linalg.eigh(tensor)[1][:, 1]
    row_steps, col_steps = (np.arange(n) - (n - 1) / 2 for n in bare.shape)
    t, along = ((col_steps * x + (row_steps * y)[:, None]).ravel() for x, y in (across, (-across[1], across[0])))
    if bent:  # around one centre gradients turn in proportion to the way along the edge
        forward, aside = across @ by, np.array([-across[1], across[0]]) @ by
        turn, bend = weighted_least_squares(np.stack([forward, forward * along], axis=1), inside.ravel(), aside)
        most = 2 * _MOST_BENT / max(bare.shape)
        t += turn * along + 0.5 * np.clip(bend, -most, most) * along**2
    step = max(_KNOTS * sigma_px, (t.max() - t.min()) / intervals)
    place = (t - t.min()) / step
    knot, n = place.astype(np.intp), len(t)
    part = place - knot
    # a spline reaches two knots to either side; those centred off the window are left out
    splines = np.zeros((int(knot.max()) + 4, n))
    of_four = ((1 - part) ** 3 / 6, 2 / 3 - part**2 + part**3 / 2, 2 / 3 - (1 - part) ** 2 + (1 - part) ** 3 / 2, part**3 / 6)
    first = knot * n + np.arange(n)
    for k, basis in enumerate(of_four):
        splines.ravel()[first + k * n] = basis
    return splines[1 : int(np.ceil(place.max() - 1e-9)) + 2]
