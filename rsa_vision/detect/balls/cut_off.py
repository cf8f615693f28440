"""What an end of the range has cut off of windows around balls, and what is expected there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.types import Bool, Float, Int

_CUT_OFF: Final = 0.5  # of the pixels inside a ball, from which its depth is told by what can be
_DEEPER, _DEEPER_SD = 1.4, 0.5  # depth of such a ball, and its error, of what the range has room for
_HIDDEN: Final = 0.7  # of the pixels beside a ball, from which nothing tells how its background bends
# slopes and bends over half a window, of what the range has room for: light changes little behind so small a thing. That bends are free
# within reason takes up what blurs of other forms and scatter make of the rim, which is all there is to tell depths by
_SLOPES, _BENDS = np.full(2, 0.1), np.full(3, 0.4)


def depths_cut_off(values: Float, valid: Bool, inside: Bool, noise: NoiseModel) -> tuple[Float, Float]:
    """Return one over the variance of the depths of balls whose middle is cut off by an end of the range, and what they may be.

    Rims tell how steep an image is; how deep, and with it the radius, they hardly do.

    Parameters
    ----------
    values : ndarray of shape (n, p)
        Of the film, in windows.
    valid, inside : ndarray of bool, shape (n, p)
        Pixels that are looked at, and those inside the balls.
    noise : NoiseModel
        Says which values are at an end.

    Returns
    -------
    known, expected : ndarrays of shape (n,)
        0 for all others.
    """
    known, expected = np.zeros((2, len(values)))
    for _, cut, room in _cut_off(values, valid, inside, _CUT_OFF, noise):
        expected[cut], known[cut] = _DEEPER * room, (_DEEPER_SD * room) ** -2.0
    return known, expected


def grounds_cut_off(values: Float, valid: Bool, beside: Bool, noise: NoiseModel) -> tuple[Float, Int]:
    """Return one over the variances of slopes and bends of backgrounds that an end of the range hides, and which end it is.

    As in air around a limb, where a film is black: a ball's middle is all that is seen. Any surface would do for what is not seen, and with
    it any radius and depth.

    Parameters
    ----------
    values : ndarray of shape (n, p)
        Of the film, in windows.
    valid, beside : ndarray of bool, shape (n, p)
        Pixels that are looked at, and those beyond the rims of the balls.
    noise : NoiseModel

    Returns
    -------
    held : ndarray of shape (n, 5)
        Of the coefficients of all monomials but the constant one, as of :func:`rsa_vision.detect.film.least_squares.polynomial`.
    hidden : ndarray of int, shape (n,)
        1 where it is the upper end, -1 where it is the lower one, 0 where backgrounds are seen.
    """
    held, hidden = np.zeros((len(values), 5)), np.zeros(len(values), np.int64)
    for sign, cut, room in _cut_off(values, valid, beside, _HIDDEN, noise):
        held[cut] = (np.concatenate([_SLOPES, _BENDS]) * room[:, None]) ** -2.0
        hidden[cut] = sign
    return held, hidden


def _cut_off(values: Float, valid: Bool, there: Bool, most: float, noise: NoiseModel) -> Iterator[tuple[int, Int, Float]]:
    """Yield for each end of the range, -1 or 1, the windows (k,) of which it cuts off more than that part there, and the room up to it.

    That is how far it is from the median of what is seen, (k,).
    """
    for sign, end in ((-1, noise.floor), (1, noise.ceiling)):
        if np.isfinite(end):
            beyond = sign * values >= sign * end
            cut = np.flatnonzero(((beyond & there).sum(axis=1) > most * there.sum(axis=1)) & valid.any(axis=1))
            yield sign, cut, end - np.array([np.median(values[k, valid[k]]) for k in cut])
