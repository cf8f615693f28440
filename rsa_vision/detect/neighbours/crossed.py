"""Balls under scratches, dead rows and dust: what most of the window agrees with is a ball, and the rest of it is masked."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import fit_at, no_fits
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.foreign import beyond_noise, robust_residual
from rsa_vision.detect.neighbours.group_images import images_in, window_around
from rsa_vision.types import Bool, Float

_LEAST_SEEN: Final = 0.4  # part of the pixels under a ball
_ROUNDS: Final = 2  # the first mask is that of a fit which the scratch has pulled


def without_scratches(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel, others: Images) -> BallFits:
    """Fit balls again without the pixels that a robust fit leaves over.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        That explain most of their windows, and leave too much.
    optics : Optics
    noise : NoiseModel
    others : callable
        Images of all else.

    Returns
    -------
    BallFits
        Those of which two fifths are seen at least.
    """
    parts = [no_fits()]
    for i in range(len(fits.depth)):
        ball: BallFits | None = fits.rows([i])
        for _ in range(_ROUNDS):
            ball = ball and _masked(film, ball, optics, noise, others)
        if ball is not None:
            parts.append(ball)
    out = join(parts)
    return out.rows(out.valid_fraction > _LEAST_SEEN)


def _masked(film: NDArray[Any], ball: BallFits, optics: Optics, noise: NoiseModel, others: Images) -> BallFits | None:
    """Fit a ball once without what is foreign; none where that is as broad as the ball: bars and letters leave such rests."""
    window = window_around(film, ball.position_px, ball.radius_px, optics.sigma_px, noise, others)
    local = ball.position_px - window.corner_px
    images = images_in(window, window.surface, local, ball.radius_px, optics)
    parts = np.concatenate([images.value, ball.depth[0] * images.slopes[:, 0], window.surface.T])[None]
    weight = window.valid / noise.variance_at(window.raw)
    data = window.raw - window.neighbours
    residual = robust_residual(parts, data[None], weight[None], np.zeros(parts.shape[:2]))
    off = beyond_noise(np.abs(residual) * np.sqrt(weight), weight[None] > 0)
    found = off.reshape(window.size, window.size).astype(np.uint8)
    broad = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (int(ball.radius_px[0]) + 1,) * 2)
    if cv2.erode(found, broad, borderType=cv2.BORDER_CONSTANT, borderValue=0).any():
        return None
    mask = cv2.dilate(found, np.ones((3, 3), np.uint8)) > 0  # what is left of its flanks pulls as well
    col, row = np.rint(window.corner_px).astype(np.intp)

    def beside(_: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        c, r = np.rint(cols).astype(np.intp) - col, np.rint(rows).astype(np.intp) - row
        within = (c >= 0) & (r >= 0) & (c < window.size) & (r < window.size)
        return others(cols, rows), within & mask[r.clip(0, window.size - 1), c.clip(0, window.size - 1)]

    return fit_at(film, ball.position_px, ball.radius_px, optics, noise, beside)
