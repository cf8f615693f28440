"""Balls and lines: whatever goes straight through a window, with any profile across, as wires and edges do.

Faint balls that a line explains better are parts of it. Balls on and beside lines that are as strong as they are show only beside the line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, height_of, look_clear
from rsa_vision.detect.balls.find import BATCH, no_fits
from rsa_vision.detect.balls.fits import BallFits, half_size, join
from rsa_vision.detect.balls.focal_spot import shapes_of
from rsa_vision.detect.film.least_squares import damped_solution
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.whitening import whiten_rows
from rsa_vision.detect.models.edge import edge_profile
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images, for_all
from rsa_vision.detect.neighbours.beside import MOST_IN_GROUP, all_but, groups_of
from rsa_vision.detect.neighbours.group_images import square
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.detect.neighbours.rims import goes_on
from rsa_vision.types import Bool, Float

_FAINT = 0.75  # of the film's usual height: a ball that has all of it is no part of anything, and is taken away beside others
_FAR = 1.5  # times the significance that a mark must have, for one that lies on a line
_OF_ENDS = 3.0  # the same, that the end of a line may keep


def without_lines(film: NDArray[Any], fits: BallFits, limit: float, optics: Optics, noise: NoiseModel, needles: Images | None) -> BallFits:
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
    needles : callable, optional
        Images to be taken away first.

    Returns
    -------
    BallFits
    """
    lost = on_lines(film, fits, limit, optics, noise, needles)
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
            at = (kept.position_px[index], kept.radius_px[index], optics, noise)
            parts.append(fit_group(film, *at, all_but(kept, index, optics, needles)))
    return join(parts)


def on_lines(film: NDArray[Any], fits: BallFits, limit: float, optics: Optics, noise: NoiseModel, needles: Images | None) -> Bool:
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
    needles : callable, optional
        As of :func:`without_lines`.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    out, height, clear = np.zeros(len(fits.depth), bool), height_of(fits, optics.sigma_px), look_clear(fits, noise)
    known = np.count_nonzero(clear) >= LEAST_KNOWN
    full = height > _FAINT * np.median(height[clear]) if known else clear
    others = all_but(fits.rows(full), np.arange(0), optics, needles)
    for i in np.flatnonzero(~full):
        of_ball, of_line, of_both = _gains(film, fits.position_px[[i]], float(fits.radius_px[i]), optics, noise, others)[0]
        if of_line > of_ball:
            own = np.sqrt(max(of_both - of_line, 0.0))
            end = own < _OF_ENDS * limit and goes_on(film, fits.rows([i]), np.array([i]), for_all(others), optics.sigma_px)[0]
            out[i] = end or own < _FAR * limit
    return out


def balls_on_lines(
    film: NDArray[Any], place_px: Float, radius_px: float, limit: float, optics: Optics, noise: NoiseModel, others: Images
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
    gains = [_gains(film, place_px[k : k + BATCH], radius_px, optics, noise, others) for k in range(0, len(place_px), BATCH)]
    of_ball, of_line, of_both = np.concatenate([np.zeros((0, 3)), *gains]).T
    worth = place_px[(of_line > of_ball) & (of_both - of_line > (_FAR * limit) ** 2)]
    how = (np.array([radius_px]), optics, noise, others)
    return join([no_fits(), *(fit_group(film, at[None], *how, edge=True) for at in worth)])


def _gains(film: NDArray[Any], at_px: Float, radius_px: float, optics: Optics, noise: NoiseModel, others: Images) -> Float:
    """Return twice the log-likelihood that a ball, a line, and both gain over a background alone, to first order.

    For places (n, 2), shape (n, 3).
    """
    half = half_size(radius_px, optics.sigma_px)
    patches, (cols, rows, surface) = cut(film, at_px, half, noise), square(half)
    n, local, radius = len(at_px), at_px - patches.corner_px, np.full(len(at_px), radius_px)
    balls = np.stack(shapes_of(optics, None, cols - local[:, :1], rows - local[:, 1:], radius), axis=1)
    raw, valid = patches.values.reshape(n, -1), patches.valid.reshape(n, -1).astype(np.float64)
    root = np.sqrt(valid / noise.variance_at(raw))
    first, end = balls.shape[1], balls.shape[1] + surface.shape[1]  # the background, between the ball and the line
    explained = np.zeros((n, 4))
    for i, (col, row) in enumerate(patches.corner_px.tolist()):
        data = raw[i] - others(cols + col, rows + row)
        line = edge_profile(data.reshape(patches.size, -1), valid[i].reshape(patches.size, -1), optics.sigma_px)
        white = whiten_rows(np.concatenate([balls[i], surface.T, line, data[None]]) * root[i], patches.size, noise)
        gram = white @ white.T  # holds the normal equations of any part of them
        explained[i] = [_explained(gram, part) for part in (slice(first, end), slice(end), slice(first, -1), slice(-1))]
    return np.asarray(explained[:, 1:] - explained[:, :1])


def _explained(gram: Float, part: slice) -> float:
    """Return how much of the squares of the last row the best combination of a part of the others takes, by the products of all."""
    return float(gram[part, -1] @ damped_solution(gram[part, part], gram[part, -1], 1e-9))
