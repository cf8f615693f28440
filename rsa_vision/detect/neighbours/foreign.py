"""What lies over or under a ball and goes on beside it: wires, their ends and kinks, scratches, dust at its rim.

Beside the ball it shows as residuals. Under the ball the fit takes it for a shift and no residual shows it: pixels in its line are not
to be believed there.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from rsa_vision.detect.balls.alike import SD_OF_MAD
from rsa_vision.detect.film.least_squares import invert
from rsa_vision.types import Bool, Float

_FAR: Final = 5.0  # standard deviations that noise does not reach
_MOST_FOREIGN: Final = 0.3  # part of what is around a ball; where it is more, the background itself is another
_SMOOTH: Final = 3  # pixels a side, over which faint wires add up
_TOUCHING_PX: Final = 2.5  # from the rim
_LONG_PX: Final = 8.0  # from the rim, the part of a wire that tells its direction
_SLIM: Final = 3.0  # ratio of variances from which something has a direction
_MARGIN_PX: Final = 0.5  # to either side
_SECTORS, _MOST_ROUND = 16, 0.6  # directions, and the part of them from which things may come
_AT_EASE: Final = 2.5  # standard deviations beyond which a pixel counts little
_FALL: Final = 1.5  # of the scale, each round
_ROUNDS: Final = 14


def foreign(residual: Float, weight: Float, where: Bool, gain: float) -> Bool:
    """Say which pixels around balls belong to other things.

    Parameters
    ----------
    residual, weight : ndarray of shape (n, pixels)
        Of square windows; weights are inverse variances, 0 where masked.
    where : ndarray of bool, shape (n, pixels)
        Pixels that lie around the balls.
    gain : float
        By how much the mean of few pixels varies more than in white noise.

    Returns
    -------
    ndarray of bool, shape (n, pixels)
    """
    side = int(np.sqrt(residual.shape[1]))
    normed = np.where(where, residual * np.sqrt(weight), 0.0)
    share, mean = (
        np.array([cv2.blur(row.reshape(side, side), (_SMOOTH, _SMOOTH)) for row in values]).reshape(where.shape)
        for values in (where.astype(np.float64), normed)
    )
    smooth = mean * _SMOOTH / np.sqrt(np.maximum(share, 1 / _SMOOTH**2) * gain)
    found = np.zeros(where.shape, bool)
    for off in (np.abs(normed), np.abs(smooth)):
        found |= where & beyond_noise(off, where & (weight > 0))
    little = found.sum(axis=1) < _MOST_FOREIGN * where.sum(axis=1)
    return np.asarray(found & little[:, None])


def beyond_noise(off: Float, seen: Bool) -> Bool:
    """Say what is five standard deviations off; these are one, or more where the usual pixel that is seen is farther off, (n, pixels)."""
    return np.asarray(off > _FAR * _scale(off, seen))


def _scale(off: Float, seen: Bool) -> Float:
    usual = np.array([np.median(row[here]) if here.any() else 0.0 for row, here in zip(off, seen, strict=True)])
    return np.asarray(np.maximum(1.0, SD_OF_MAD * usual)[:, None])


def robust_residual(images: Float, data: Float, weight: Float, precision: Float) -> Float:
    """Return what a fit leaves that the most part of each window agrees with (Geman and McClure, 1987, with falling scale).

    Parameters
    ----------
    images : ndarray of shape (n, p, pixels)
        What adds up to a window.
    data, weight : ndarray of shape (n, pixels)
    precision : ndarray of shape (n, p)
        Of what is known of the coefficients, all expected to be 0.

    Returns
    -------
    ndarray of shape (n, pixels)
    """
    each, trust = np.arange(images.shape[1]), weight
    residual, scale = data, np.full((len(data), 1), np.inf)
    for _ in range(_ROUNDS):
        weighted = images * trust[:, None]
        normal = np.matmul(weighted, images.swapaxes(1, 2))
        normal[:, each, each] += precision
        change = np.matmul(invert(normal), np.matmul(weighted, data[:, :, None]))[:, :, 0]
        residual = data - np.matmul(change[:, None], images)[:, 0]
        off = np.abs(residual) * np.sqrt(weight)
        least = _AT_EASE * _scale(off, weight > 0)
        scale = np.maximum(np.where(np.isfinite(scale), scale / _FALL, off.max(axis=1, keepdims=True)), least)
        trust = weight / (1 + (off / scale) ** 2) ** 2
    return residual


def in_line(found: Bool, place_px: Float, rim_px: Float) -> Bool:
    """Say which pixels under balls lie in the line of something that touches them.

    Parameters
    ----------
    found : ndarray of bool, shape (n, pixels)
        As of :func:`foreign`.
    place_px : ndarray of shape (n, 2)
        Centres in the windows, (col, row).
    rim_px : ndarray of shape (n,)
        Where the images end.

    Returns
    -------
    ndarray of bool, shape (n, pixels)
    """
    side = int(np.sqrt(found.shape[1]))
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1).astype(np.float64)
    out = np.zeros(found.shape, bool)
    for i in np.flatnonzero(found.any(axis=1)):
        at = np.column_stack([cols, rows]) - place_px[i]
        distance = np.hypot(*at.T)
        touching = at[found[i] & (distance < rim_px[i] + _TOUCHING_PX)]
        if len(np.unique(np.floor(np.arctan2(*touching.T) * _SECTORS / (2 * np.pi)))) > _MOST_ROUND * _SECTORS:
            continue  # the ball's own halo, where a film curve bends its profile
        count, label = cv2.connectedComponents((found[i] & (distance < rim_px[i] + _LONG_PX)).reshape(side, side).astype(np.uint8))
        label = label.ravel()
        for part in range(1, count):
            mine = at[label == part]
            if len(mine) < 2 or np.hypot(*mine.T).min() > rim_px[i] + _TOUCHING_PX:
                continue
            middle, away = mine.mean(axis=0), np.hypot(*mine.T)
            spread, axes = np.linalg.eigh(np.cov(mine.T))
            long = away.max() > rim_px[i] + _LONG_PX - 1
            if long or spread[1] > _SLIM * max(spread[0], 1 / 12):  # pixels in one row have no spread across but their own
                across = axes[:, 0]
                if long:  # a broad one as well
                    along = mine[away > np.median(away)].mean(axis=0) - mine[away <= np.median(away)].mean(axis=0)
                    across = np.array([-along[1], along[0]]) / np.hypot(*along)
                beyond = np.abs((at - middle) @ across) - np.abs((mine - middle) @ across).max()
            else:
                beyond = np.hypot(*(at - middle).T) - np.hypot(*(mine - middle).T).max()
            out[i] |= (beyond < _MARGIN_PX) & (distance < rim_px[i])
    return out
