"""What a ball shares with another, or with anything else in one beam: it takes from what that has left, so their images do not add up."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rsa_vision.detect.film.places import gaps
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Float

FINE = 3  # samples along a pixel
LEAST = 0.02  # largest value below which the product is nothing
_STEP_PX = 0.05
_EITHER_WAY = _STEP_PX * np.concatenate([np.eye(3), -np.eye(3)])  # (col, row, radius)
_ROOM_PX = 2 * _STEP_PX
_BLURS = 4.0  # beyond which the blurred product has faded


def lapping(local: Float, radius: Float, beside_px: float = 0.0) -> list[tuple[int, int]]:
    """Return the pairs of balls whose shadows lie over each other, or as near, by their places (k, 2) and radii (k,)."""
    k = len(radius)
    gap = gaps(local, local)
    over = gap < radius[:, None] + radius[None] - _STEP_PX + beside_px
    return [(i, j) for i in range(k) for j in range(i) if over[i, j]]


@lru_cache(maxsize=64)
def _blur_to_pixels(n: int, sigma_px: float) -> tuple[Float, Float]:
    """Return what makes pixels of ``n`` fine samples along one axis: blurred, without the two pixels at either end; and their slopes."""
    blur = gaussian_filter1d(np.eye(n), sigma_px * FINE, axis=0, mode="constant", truncate=_BLURS)

    def seen(fine: Float) -> Float:
        pixels: Float = fine.reshape(n // FINE, FINE, n).mean(1)[2:-2]
        return pixels

    return seen(blur), seen(np.asarray(np.gradient(blur, 1 / FINE, axis=0)))


def _opacities(x: Float, y: Float, balls: Float, mu_px: float) -> Float:
    """Opacities of balls, rows of (col, row, radius), on a grid, shape (n, rows, columns); single precision is far finer than the grid."""
    col, row, radius = balls.T[:, :, None]
    u, v = ((radius**2 - np.square(x - col)).astype(np.float32), np.square(y - row).astype(np.float32))
    chord = np.sqrt(np.maximum(u[:, None] - v[:, :, None], 0))
    opaque: Float = -np.expm1(-2 * mu_px * chord)
    return opaque


def product_image(local: Float, radius: Float, optics: Optics, size: int) -> tuple[Float, Float]:
    """Return the blurred product of the opacities of two balls.

    Parameters
    ----------
    local : ndarray of shape (2, 2)
        (col, row) in the window.
    radius : ndarray of shape (2,)
        Pixels.
    optics : Optics
    size : int
        Side of the window.

    Returns
    -------
    value : ndarray of shape (size * size,)
        Of ``(1 - exp(-mu c_1)) (1 - exp(-mu c_2))``, ``c`` being the chords, blurred. With the sum of the two images it makes
        the opacity of both chords in one beam: ``1 - exp(-mu (c_1 + c_2))``.
    slopes : ndarray of shape (2, 3, size * size)
        Its derivatives by the (col, row, radius) of either ball.
    """
    apart = local[1] - local[0]
    gap = float(np.hypot(*apart))
    way = apart / max(gap, 1e-9)
    middle = local[0] + way * (gap + radius[0] - radius[1]) / 2
    reach = int(np.ceil(float(radius.min()) + _BLURS * optics.sigma_px)) + 1
    first = np.maximum(np.rint(middle).astype(int) - reach, 0)
    last = np.minimum(np.rint(middle).astype(int) + reach + 1, size)
    value, slopes = np.zeros((size, size)), np.zeros((2, 3, size, size))
    if (last <= first).any():
        return value.ravel(), slopes.reshape(2, 3, -1)
    # two pixels more on each side, for the blur not to meet the border of the box
    lengths = (last - first + 4) * FINE
    fine = [(np.arange(n) + 0.5) / FINE - 2.5 + low - at for n, low, at in zip(lengths, first, local[0], strict=True)]
    # the product is nothing but where the two lie over each other
    both = [
        (f > max(-radius[0], d - radius[1]) - _ROOM_PX) & (f < min(radius[0], d + radius[1]) + _ROOM_PX)
        for f, d in zip(fine, apart, strict=True)
    ]
    x, y = fine[0][both[0]], fine[1][both[1]]
    at = np.stack([np.zeros(3), *_EITHER_WAY]) + np.append(apart, radius[1])
    one, larger, smaller = _opacities(x, y, np.array([[0.0, 0.0, radius[0] + step] for step in (0.0, _STEP_PX, -_STEP_PX)]), optics.mu_px)
    two, *moved = _opacities(x, y, at, optics.mu_px)
    # of the second ball's moves, and of either radius: blurring is linear, so differences are taken first
    by_sharp = [one * (more - less) for more, less in zip(moved[:3], moved[3:], strict=True)]
    by_sharp.append((larger - smaller) * two)
    across, down = ([m[:, part] for m in _blur_to_pixels(int(n), optics.sigma_px)] for n, part in zip(lengths, both, strict=True))
    seen = down[0] @ (one * two) @ across[0].T
    by_row, by_col = down[1] @ (one * two) @ across[0].T, down[0] @ (one * two) @ across[1].T
    by_two_x, by_two_y, by_two_r, by_one_r = down[0] @ (np.array(by_sharp) / (2 * _STEP_PX)) @ across[0].T
    box = (slice(first[1], last[1]), slice(first[0], last[0]))
    value[box] = seen
    # moving both moves the image; moving the second alone changes what they share
    slopes[(slice(None), slice(None), *box)] = [[-by_col - by_two_x, -by_row - by_two_y, by_one_r], [by_two_x, by_two_y, by_two_r]]
    return value.ravel(), slopes.reshape(2, 3, -1)


def fine_places(size: int) -> Float:
    """Return where a window of so many pixels is sampled along either axis for :func:`product_with`: two pixels beyond it as well."""
    return (np.arange((size + 4) * FINE) + 0.5) / FINE - 2.5


def product_with(other: Float, local: Float, radius: float, optics: Optics) -> tuple[Float, Float]:
    """Return the blurred product of the opacity of a ball and of anything else.

    Parameters
    ----------
    other : ndarray of shape (m, m)
        Opacity of that without blur, at the :func:`fine_places` of a square window (rows, columns).
    local : ndarray of shape (2,)
        (col, row) of the ball in the window.
    radius : float
        Pixels.
    optics : Optics

    Returns
    -------
    value : ndarray of shape (size * size,)
        As of :func:`product_image`.
    slopes : ndarray of shape (3, size * size)
        Its derivatives by the (col, row, radius) of the ball.
    """
    size = len(other) // FINE - 4
    at = fine_places(size)
    cols, rows = (np.flatnonzero(np.abs(at - middle) < radius + _ROOM_PX) for middle in local)
    ball = np.append(np.zeros(2), radius)
    one, *moved = _opacities(at[cols] - local[0], at[rows] - local[1], ball + np.concatenate([np.zeros((1, 3)), _EITHER_WAY]), optics.mu_px)
    sharp = np.array([one, *((more - less) / (2 * _STEP_PX) for more, less in zip(moved[:3], moved[3:], strict=True))])
    blur = _blur_to_pixels(len(at), optics.sigma_px)[0]
    value, *slopes = (blur[:, rows] @ (sharp * other[np.ix_(rows, cols)]) @ blur[:, cols].T).reshape(4, -1)
    return value, np.array(slopes)
