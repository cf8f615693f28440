"""Balls and lines: whatever goes straight through a window, with any profile across, as wires and edges do.

Faint balls that a line explains better are parts of it. Balls on and beside lines that are as strong as they are show only beside the line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits, join
from rsa_vision.detect.beside import MOST_IN_GROUP, Background, all_but, groups_of, images_beside
from rsa_vision.detect.decide import LEAST_KNOWN, heights, look_clear
from rsa_vision.detect.find import no_fits
from rsa_vision.detect.groups import edge_profile, fit_group, images_in, window_around
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.patches import damped_solution
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.rims import goes_on
from rsa_vision.detect.whitening import whiten_rows
from rsa_vision.types import Bool, Float

_FAINT = 0.75  # of the film's usual height: a ball that has all of it is no part of anything, and is taken away beside others
_FAR = 1.5  # times the significance that a mark must have, for one that lies on a line


def without_lines(film: NDArray[Any], fits: BallFits, limit: float, optics: Optics, noise: NoiseModel, tees: Background | None) -> BallFits:
    """Drop the parts of lines, and fit again what was fitted together with them.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        Of one film.
    limit : float
        Significance that a mark must have.
    optics : Optics
    noise : NoiseModel
    tees : callable, optional
        Images to be taken away first.

    Returns
    -------
    BallFits
    """
    lost = on_lines(film, fits, limit, optics, noise, tees)
    if not lost.any():
        return fits
    touched = np.zeros(len(lost), bool)
    for g in groups_of(fits, optics):
        touched[g] = lost[g].any() and len(g) <= MOST_IN_GROUP
    kept, again = fits.rows(~lost), touched[~lost]
    parts = [kept.rows(~again)]
    for g in groups_of(kept, optics):
        index = np.array(g)
        if again[g].any():
            at = (kept.position_px[index], kept.radius_px[index], optics.sigma_px, optics.mu_px, noise)
            parts.append(fit_group(film, *at, all_but(kept, index, optics, tees)))
    return join(parts)


def on_lines(film: NDArray[Any], fits: BallFits, limit: float, optics: Optics, noise: NoiseModel, tees: Background | None) -> Bool:
    """Say which faint balls a line explains better, and add little to it.

    Both are judged by likelihood, in noise made white. A ball on a wire is more than that: it keeps its significance beside any profile.
    The end of a wire keeps some as well, but goes on beyond its rim.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
    limit : float
    optics : Optics
    noise : NoiseModel
    tees : callable, optional
        As of :func:`without_lines`.

    Returns
    -------
    ndarray of bool, shape (n,)
        None where too few balls are clear.
    """
    out, height, clear = np.zeros(len(fits.depth), bool), heights(fits, optics.sigma_px), look_clear(fits, noise)
    if np.count_nonzero(clear) < LEAST_KNOWN:
        return out
    full = height > _FAINT * np.median(height[clear])
    strong = fits.rows(full)

    def beside(_: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return images_beside(strong, np.arange(0), optics, tees, cols, rows)

    others = all_but(strong, np.arange(0), optics, tees)
    for i in np.flatnonzero(~full):
        of_ball, of_line, of_both = _gains(film, fits.position_px[[i]], fits.radius_px[[i]], optics, noise, others)
        if of_line > of_ball:
            out[i] = of_both - of_line < (_FAR * limit) ** 2 or goes_on(film, fits.rows([i]), np.array([i]), beside, optics.sigma_px)[0]
    return out


def balls_on_lines(
    film: NDArray[Any], place_px: Float, radius_px: float, limit: float, optics: Optics, noise: NoiseModel, others: Background
) -> BallFits:
    """Fit balls of this size at places that a line explains best, but not all of them.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    place_px : ndarray of shape (n, 2)
        (col, row).
    radius_px, limit : float
    optics : Optics
    noise : NoiseModel
    others : callable
        Images of all that is known.

    Returns
    -------
    BallFits
        With the line in their background, several perhaps of one ball.
    """
    parts = []
    for at in place_px:
        start = at[None], np.array([radius_px])
        of_ball, of_line, of_both = _gains(film, *start, optics, noise, others)
        if of_line > of_ball and of_both - of_line > (_FAR * limit) ** 2:
            parts.append(fit_group(film, *start, optics.sigma_px, optics.mu_px, noise, others, edge=True))
    return join(parts) if parts else no_fits()


def _gains(
    film: NDArray[Any], at_px: Float, radius_px: Float, optics: Optics, noise: NoiseModel, others: Background
) -> tuple[float, float, float]:
    """Return twice the log-likelihood that a ball, a line, and both gain over a background alone, to first order."""
    window = window_around(film, at_px, radius_px, optics.sigma_px, noise, others)
    images = images_in(window, window.surface, at_px - window.corner_px, radius_px, optics.sigma_px, optics.mu_px)
    data = window.raw - window.neighbours
    line = edge_profile(data, window.valid, optics.sigma_px)
    rows = np.concatenate([images.value, *images.slopes, window.surface.T, line.T, data[None]])
    white = whiten_rows(rows * np.sqrt(window.valid / noise.variance_at(window.raw)), window.size, noise)
    gram = white @ white.T  # holds the normal equations of all of them
    before, after = 4 * len(at_px), len(rows) - 1 - line.shape[1]  # the background

    def explained(first: int, end: int) -> float:
        right = gram[first:end, -1]
        return float(right @ damped_solution(gram[first:end, first:end], right, 1e-9))

    nothing, of_ball, of_line, of_both = (explained(*part) for part in ((before, after), (0, after), (before, -1), (0, -1)))
    return of_ball - nothing, of_line - nothing, of_both - nothing
