"""Wires and scratches that pass over a ball or beside it, each pixel of them too faint to be masked: together they pull at its centre.

The most likely straight one of each ball is tested by its likelihood ratio, all that was fitted being fitted anew with it, as specks are.
It must show on both sides of the ball: under it a profile that is not quite the model's leaves lines as well.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.random_effects import Common, Solution
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.neighbours.pulls import Pulls, no_pulls
from rsa_vision.types import Bool, Float

_SPREADS_PX: Final = (0.8, 1.6)  # across; half as much and twice as much are found as well
_ANGLES: Final = 24
_BEYOND_PX: Final = 3.0  # the rim
_SURE: Final = 5.5  # standard deviations that none of a film's lines reaches by chance
_SHARE: Final = 0.6  # of the significance there is before anything else is fitted anew
_EACH_SIDE: Final = 0.3  # of the significance, on either side of the ball
_LEAST: Final = 1 / 3  # of a wire, that the fit does not take for something else: with less nothing is known of it
_LIKELIEST: Final = 4  # lines of a ball that are fitted
_NOTHING: Final = 1e-30


def find_wires(solution: Solution, where: Bool, rim_px: Float, excess: Float, side: int, common: Common) -> Pulls:
    """Look for one wire on each ball.

    Parameters
    ----------
    solution : Solution
        Of windows of ``side`` pixels.
    where : ndarray of bool, shape (n,)
        Balls on no edge, of which lines are parts.
    rim_px : ndarray of shape (n,)
        Where the images of the balls end.
    excess : ndarray of shape (n,)
        Variance around the balls, in units of the noise.
    side : int
    common : Common

    Returns
    -------
    Pulls
    """
    noise, out = common.noise, no_pulls(solution)
    root, sure = np.sqrt(solution.weight), _SURE * np.sqrt(np.maximum(excess, 1.0))
    lines, offset, across, along = _lines(side)
    middle = solution.local_px - 0.5 * (side - 1)
    x, y = np.mgrid[0:side, 0:side].reshape(2, -1)[::-1, None] - solution.local_px.T[:, :, None]
    beside = np.hypot(x, y) > rim_px[:, None]
    white = whiten_rows(solution.residual * root, side, noise)
    told = np.where(beside, whiten_rows(white, side, noise) * root, 0.0).astype(np.float32) @ lines.T
    alone = np.where(beside, solution.weight, 0.0).astype(np.float32) @ np.square(lines).T / noise.gain(np.array(1.0))
    near = np.abs(offset - middle @ across.T) < rim_px[:, None] + _BEYOND_PX
    rough = np.where(near, np.abs(told) / np.sqrt(np.maximum(alone, _NOTHING)), 0.0)
    for i in np.flatnonzero(where & (rough.max(axis=1) > _SHARE * sure)).tolist():
        best = sure[i]
        for k in np.argsort(-rough[i])[:_LIKELIEST]:
            shown = whiten_rows(lines[k] * (beside[i] * root[i]), side, noise)
            own, _ = _own(shown, solution, i)
            height, first = shown @ white[i], (shown * (along[k] @ [x[i], y[i]] > 0)) @ white[i]
            if own > _LEAST * (shown @ shown) and abs(height) > best * np.sqrt(own) and _EACH_SIDE < first / height < 1 - _EACH_SIDE:
                best = abs(height) / np.sqrt(own)
                wire = lines[k] * solution.shade[i, 0]  # a ball takes away its part of it
                shown = whiten_rows(wire * root[i], side, noise)
                own, fitted = _own(shown, solution, i)
                out.put(i, solution, wire, fitted, float(shown @ white[i] / own), float((sure[i] / _SURE) ** 2 / own))
    return out


def _own(shown: Float, solution: Solution, i: int) -> tuple[float, Float]:
    """Return how much of something made white no other coefficient of a ball takes up, and what these become by it."""
    taken = solution.white[i] @ shown
    fitted = solution.inverse[i] @ taken
    return max(float(shown @ shown - taken @ fitted), _NOTHING), np.asarray(fitted)


@lru_cache(maxsize=8)
def _lines(side: int) -> tuple[NDArray[np.float32], Float, Float, Float]:
    """Lines through windows of a size (k, pixels), their offsets from the middle (k,), and directions across and along them (k, 2)."""
    half = 0.5 * (side - 1)
    angle, offset, spread = (
        of.ravel() for of in np.meshgrid(np.pi * np.arange(_ANGLES) / _ANGLES, np.arange(-half, half + 1), _SPREADS_PX, indexing="ij")
    )
    across, along = np.array([np.cos(angle), np.sin(angle)]).T, np.array([-np.sin(angle), np.cos(angle)]).T
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1) - half
    away = across @ np.array([cols, rows]) - offset[:, None]
    return np.exp(-0.5 * np.square(away / spread[:, None])).astype(np.float32), offset, across, along
