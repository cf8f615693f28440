"""Balls on arms of tees and pins: in one beam a shadow takes only from what the other has left, so the two do not add up."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, like_clear, look_clear
from rsa_vision.detect.balls.find import distinct, no_fits
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.least_squares import weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within
from rsa_vision.detect.models.lapping import fine_places
from rsa_vision.detect.models.painted import Painted
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import all_but
from rsa_vision.detect.neighbours.edges import OF_SHIFT
from rsa_vision.detect.neighbours.group_images import GroupImages, GroupWindow, images_in, images_over, window_around
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.types import Bool, Float

Draw = Callable[[GroupWindow, Float, Float, Float], GroupImages]
OVER = 0.1  # of the depth of a ball, from which a needle lies over it
_DEEP = 0.4  # least depth, in parts of that of clear balls
_STAYS = 1.0  # of the radius, within which a fit comes out
_APART = 0.5  # of the radius, between two places from which a fit begins


def over_arms(balls: BallFits, painted: Painted) -> Bool:
    """Say which balls lie on needles, shape (n,)."""
    return np.asarray(painted.under(balls.position_px, balls.radius_px) > OVER * np.abs(balls.depth))


def fit_over(
    film: NDArray[Any],
    start_px: Float,
    start_radius_px: Float,
    known: BallFits,
    optics: Optics,
    noise: NoiseModel,
    painted: Painted,
) -> BallFits:
    """Fit balls on needles, each by itself, with what they take away of these.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    start_px : ndarray of shape (n, 2)
    start_radius_px : ndarray of shape (n,)
    known : BallFits
        Others, whose images are subtracted; those of them at a start are that ball.
    optics : Optics
    noise : NoiseModel
    painted : Painted
        The needles.

    Returns
    -------
    BallFits
        In the order of the starts.
    """
    fits = [no_fits()]
    for at, radius in zip(start_px, start_radius_px, strict=True):
        itself = np.flatnonzero(np.hypot(*(known.position_px - at).T) < radius)
        ball, doubt, _ = fit_one_over(film, at, float(radius), all_but(known, itself, optics, painted), optics, noise, painted)
        ball.covariance[:, :2, :2] += doubt
        fits.append(ball)
    return join(fits)


def fit_one_over(
    film: NDArray[Any], at_px: Float, radius_px: float, others: Images, optics: Optics, noise: NoiseModel, painted: Painted
) -> tuple[BallFits, Float, Images]:
    """Fit one ball on needles.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    at_px : ndarray of shape (2,)
        Start.
    radius_px : float
        The same.
    others : callable
        Images to be subtracted, those of the needles as well.
    optics : Optics
    noise : NoiseModel
    painted : Painted
        The needles.

    Returns
    -------
    ball : BallFits
        One row.
    doubt : ndarray of shape (2, 2)
        Covariance of its centre by how far two models of what it takes away of them differ, px^2.
    shown : callable
        What it adds to the needles at pixels (cols, rows), in film values.
    """
    tried = [
        (draw, fit_group(film, at_px[None], np.array([radius_px]), optics, noise, others, images=draw))
        for draw in (_linear(painted, optics), _additive(painted, optics))
    ]
    (draw, ball), (_, other) = sorted(tried, key=lambda one: float(one[1].chi2_core[0]))
    apart = (ball.position_px - other.position_px)[0]
    window = window_around(film, ball.position_px, ball.radius_px, optics.sigma_px, noise, others)
    linear = draw(window, window.surface, ball.position_px - window.corner_px, ball.radius_px).linear
    theta = weighted_least_squares(linear, window.valid / noise.variance_at(window.raw), window.raw - window.neighbours)
    picture, corner = (linear[:, [0, -1]] @ theta[[0, -1]]).reshape(window.size, window.size), window.corner_px.astype(np.intp)

    def shown(cols: Float, rows: Float) -> Float:
        col, row = np.rint(cols).astype(np.intp) - corner[0], np.rint(rows).astype(np.intp) - corner[1]
        inside = (np.minimum(col, row) >= 0) & (np.maximum(col, row) < window.size)
        return np.where(inside, picture[row.clip(0, window.size - 1), col.clip(0, window.size - 1)], 0.0)

    return ball, OF_SHIFT * np.outer(apart, apart), shown


def _linear(painted: Painted, optics: Optics) -> Draw:
    """What draws balls on needles on a film that shows light as it is: the product of both shadows is blurred."""

    @cache
    def arms(corner_col: float, corner_row: float, size: int) -> Float:
        fine = fine_places(size)
        shown = painted.sharp(fine + corner_col, fine + corner_row)
        return np.asarray(shown / max(float(np.abs(shown).max()), 1e-9))

    def draw(window: GroupWindow, surface: Float, local: Float, radius: Float) -> GroupImages:
        other = arms(*window.corner_px.tolist(), window.size)
        return images_over(other, window, surface, local, radius, optics)

    return draw


def _additive(painted: Painted, optics: Optics) -> Draw:
    """The same on any other: each takes away a part of what the film shows of the other."""

    def draw(window: GroupWindow, surface: Float, local: Float, radius: Float) -> GroupImages:
        shown = painted(window.cols + window.corner_px[0], window.rows + window.corner_px[1])
        arms = shown / max(float(np.abs(shown).max()), 1e-9)
        return images_in(window, surface, local, radius, optics, np.broadcast_to(arms, (len(radius), len(arms))))

    return draw


def look_on_arms(
    film: NDArray[Any], place: Float, known: BallFits, limit: float, optics: Optics, noise: NoiseModel, painted: Painted
) -> BallFits:
    """Find balls on needles: like the clear ones of the film, sure, and described well.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    place : ndarray of shape (n, 2)
        Where to look, likeliest first.
    known : BallFits
        Balls of the film; nothing is looked for where one is, and nothing at all where fewer than three are clear.
    limit : float
        Significance that noise alone would exceed too often.
    optics : Optics
    noise : NoiseModel
    painted : Painted
        The needles.

    Returns
    -------
    BallFits
    """
    clear = known.rows(look_clear(known, noise))
    if len(clear.depth) < LEAST_KNOWN:
        return no_fits()
    usual, depth = float(np.median(clear.radius_px)), float(np.median(np.abs(clear.depth)))
    sizes = np.full(len(place), usual)
    place = place[(painted.under(place, sizes) > OVER * depth) & ~painted.explain(film, place, sizes)]
    place = place[~are_within(place, known.position_px, usual)]
    starts = _apart(place, _APART * usual)
    balls = fit_over(film, starts, np.full(len(starts), usual), known, optics, noise, painted)
    deep = np.sign(np.median(clear.depth)) * balls.depth > _DEEP * depth
    stays = np.hypot(*(balls.position_px - starts).T) < _STAYS * usual
    taken = are_within(balls.position_px, known.position_px, usual)
    return distinct(balls.rows(like_clear(balls, known, limit, noise) & deep & stays & ~taken), noise)


def _apart(place: Float, gap_px: float) -> Float:
    """Leave out places nearer to one before them."""
    kept: list[int] = []
    for k, at in enumerate(place):
        if all(np.hypot(*(place[j] - at)) > gap_px for j in kept):
            kept.append(k)
    return place[kept]
