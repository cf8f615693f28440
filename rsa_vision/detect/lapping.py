"""What two balls in one beam share: the second takes from what the first has left, so their images do not add up."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from rsa_vision.types import Float

FINE = 3  # samples along a pixel
LEAST = 0.02  # largest value below which the product is nothing
_STEP_PX = 0.05
_BLURS = 4.0  # beyond which the blurred product has faded


def lapping(local: Float, radius: Float) -> list[tuple[int, int]]:
    """Return the pairs of balls whose shadows lie over each other, by their places (k, 2) and radii (k,)."""
    k = len(radius)
    gap = np.hypot(*(local[:, None] - local[None]).transpose(2, 0, 1))
    over = gap < radius[:, None] + radius[None] - _STEP_PX
    return [(i, j) for i in range(k) for j in range(i) if over[i, j]]


def product_image(local: Float, radius: Float, sigma_px: float, mu_px: float, size: int) -> tuple[Float, Float]:
    """Return the blurred product of the opacities of two balls.

    Parameters
    ----------
    local : ndarray of shape (2, 2)
        (col, row) in the window.
    radius : ndarray of shape (2,)
        Pixels.
    sigma_px, mu_px : float
    size : int
        Side of the window.

    Returns
    -------
    value : ndarray of shape (size * size,)
        Of ``(1 - exp(-mu c_1)) (1 - exp(-mu c_2))``, ``c`` being the chords, after the blur. Together with the sum of the two images it makes
        the opacity of both chords in one beam: ``1 - exp(-mu (c_1 + c_2))``.
    slopes : ndarray of shape (2, 3, size * size)
        Its derivatives by the (col, row, radius) of either ball.
    """
    apart = local[1] - local[0]
    gap = float(np.hypot(*apart))
    way = apart / max(gap, 1e-9)
    middle = local[0] + way * (gap + radius[0] - radius[1]) / 2
    reach = int(np.ceil(float(radius.min()) + _BLURS * sigma_px)) + 1
    first = np.maximum(np.rint(middle).astype(int) - reach, 0)
    last = np.minimum(np.rint(middle).astype(int) + reach + 1, size)
    value, slopes = np.zeros((size, size)), np.zeros((2, 3, size, size))
    if (last <= first).any():
        return value.ravel(), slopes.reshape(2, 3, -1)
    # two pixels more on each side, for the blur not to meet the border of the box
    x, y = (
        (np.arange((high - low + 4) * FINE) + 0.5) / FINE - 2.5 + low - at for low, high, at in zip(first, last, local[0], strict=True)
    )

    def image(dx: float, dy: float, r1: float, r2: float) -> Float:
        def opacity(x: Float, y: Float, r: float) -> Float:
            chord = 2 * np.sqrt(np.maximum(r * r - (x * x)[None] - (y * y)[:, None], 0.0))
            opaque: Float = -np.expm1(-mu_px * chord)
            return opaque

        sharp = opacity(x, y, r1) * opacity(x - dx, y - dy, r2)
        blurred: Float = gaussian_filter(sharp, sigma_px * FINE, mode="constant", truncate=_BLURS)
        return blurred

    def seen(fine: Float) -> Float:
        h, w = fine.shape
        pixels: Float = fine.reshape(h // FINE, FINE, w // FINE, FINE).mean((1, 3))[2:-2, 2:-2]
        return pixels

    at = np.array([apart[0], apart[1], radius[0], radius[1]])
    fine = image(*at)
    by_row, by_col = (np.gradient(fine, 1 / FINE, axis=axis) for axis in (0, 1))
    by = [(image(*(at + step)) - image(*(at - step))) / (2 * _STEP_PX) for step in _STEP_PX * np.eye(4)]
    box = (slice(first[1], last[1]), slice(first[0], last[0]))
    value[box] = seen(fine)
    # moving both moves the image; moving the second alone changes what they share
    parts = [[-by_col - by[0], -by_row - by[1], by[2]], [by[0], by[1], by[3]]]
    for ball, three in enumerate(parts):
        for kind, part in enumerate(three):
            slopes[(ball, kind, *box)] = seen(part)
    return value.ravel(), slopes.reshape(2, 3, -1)
