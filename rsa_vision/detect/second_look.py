"""Balls that a first look missed: where the film's balls are known, one like them is looked for at every candidate left over.

A first look starts from the size that the filter suits and from guessed optics. Beside an edge, or faint on bone, it grows until it holds
the bone as well; started from the usual size it stays with the ball. Then balls on lines as strong as they are, and under scratches.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls import BallFits, join
from rsa_vision.detect.beside import all_but, images_beside
from rsa_vision.detect.candidates import SCALES, Candidates
from rsa_vision.detect.crossed import without_scratches
from rsa_vision.detect.decide import LEAST_KNOWN, look_clear, over_clutter
from rsa_vision.detect.edges import NEAR_EDGES, beside_edges
from rsa_vision.detect.find import (
    DOUBTFUL,
    MISFIT,
    STRENGTH,
    SURE,
    distinct,
    fit_at,
    in_correlated_noise,
    misfit,
    no_fits,
    plausible,
    promising,
)
from rsa_vision.detect.lines import balls_on_lines, on_lines
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.painted import Painted
from rsa_vision.detect.profiles import Optics
from rsa_vision.detect.resolve import inside
from rsa_vision.types import Bool, Float

_CLEAR = 0.9  # of the limit, over clutter
_FAR, _SLACK = 1.5, 1.4  # times the limit, times the misfit that is tolerated otherwise
_ROUND = 0.4  # the filter that suits the usual size answers balls of it by round extrema
_SIZE = 1.6  # ratio of the fitted radius to the usual one
_ROUGH = 4.0  # times the misfit that is tolerated otherwise, before they are masked
_OF_SIZE = 1.25  # the same to that of any clear ball, where lines and scratches are what is seen first


def look_again(
    film: NDArray[Any], candidates: Candidates, balls: BallFits, limit: float, optics: Optics, noise: NoiseModel, needles: Painted | None
) -> tuple[BallFits, Bool, Bool]:
    """Fit balls of the usual size at the candidates where none was found.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
        Of the markers' polarity.
    balls : BallFits
        Found so far.
    limit : float
        Significance that noise alone would exceed too often.
    optics : Optics
    noise : NoiseModel
    needles : Painted, optional
        Images of pins and tees.

    Returns
    -------
    fits : BallFits
        What may be balls, beside those found so far.
    edged : ndarray of bool, shape (n,)
        Fitted together with an edge.
    crossed : ndarray of bool, shape (n,)
        Fitted without the pixels of what crosses them.
    """
    if len(balls.depth) < LEAST_KNOWN:
        return no_fits(), np.zeros(0, bool), np.zeros(0, bool)
    usual = float(np.median(balls.radius_px))
    scale = SCALES[int(np.argmin([abs(np.log(radius / usual)) for *_, radius in SCALES]))][-1]
    fitting = (candidates.radius_px == scale) & (candidates.roundness > _ROUND) & ~_near(candidates.position_px, balls, usual)
    place, strong = candidates.position_px[fitting], np.abs(candidates.strength[fitting]) > STRENGTH
    if needles is not None:
        free = ~needles.explain(film, place, np.full(len(place), usual))
        place, strong = place[free], strong[free]
    fits, edged, rough = _of_the_usual_size(film, place, balls, usual, limit, optics, noise, needles)
    known = join([balls, fits])
    # a line takes the most part of what is there, and the rest has to be sure: faint places are not worth it
    left_over = place[strong]
    over = _over_lines(film, left_over[~_near(left_over, known, usual)], known, usual, limit, optics, noise, needles)
    known = join([known, over])
    crossed = _under_scratches(film, rough, known, usual, limit, optics, noise, needles)
    count = [len(fits.depth), len(over.depth), len(crossed.depth)]
    at_edges = np.concatenate([edged, np.repeat([True, False], count[1:])])
    return join([fits, over, crossed]), at_edges, np.repeat([False, False, True], count)


def _of_the_usual_size(
    film: NDArray[Any],
    place: Float,
    balls: BallFits,
    usual: float,
    limit: float,
    optics: Optics,
    noise: NoiseModel,
    needles: Painted | None,
) -> tuple[BallFits, Bool, BallFits]:
    """Balls at these places, those of them with an edge, and what is sure but leaves too much for a ball."""

    def others(_: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return images_beside(balls, np.arange(0), optics, needles, cols, rows)

    def fit(at: Float, *, quick: bool) -> tuple[BallFits, Bool]:
        fits = fit_at(film, at, np.full(len(at), usual), optics, noise, others, quick=quick) if len(at) else no_fits()
        stays = inside(fits, film) & ~_near(fits.position_px, balls, usual) & (np.abs(np.log(fits.radius_px / usual)) < np.log(_SIZE))
        return fits, stays

    fits, stays = fit(place, quick=True)
    sure = in_correlated_noise(fits, optics.sigma_px, noise) > max(SURE, limit)
    rough = fits.rows(stays & sure & plausible(fits, noise, _ROUGH) & ~plausible(fits, noise))
    enough = promising(fits, limit, optics.sigma_px, noise)
    fits = distinct(fits.rows(stays & _like_a_ball(fits, limit, noise, NEAR_EDGES) & enough), noise)
    fits, stays = fit(fits.position_px, quick=False)
    enough = over_clutter(fits) > _CLEAR * limit
    fits = distinct(fits.rows(stays & _like_a_ball(fits, limit, noise, NEAR_EDGES) & enough), noise)
    fits = fits.rows(~on_lines(film, join([balls, fits]), limit, optics, noise, needles)[len(balls.depth) :])
    fits, edged = beside_edges(film, fits, optics, noise, all_but(balls, np.arange(0), optics, needles))
    like = _like_a_ball(fits, limit, noise)
    return fits.rows(like), edged[like], rough


def _under_scratches(
    film: NDArray[Any],
    rough: BallFits,
    known: BallFits,
    usual: float,
    limit: float,
    optics: Optics,
    noise: NoiseModel,
    needles: Painted | None,
) -> BallFits:
    """Balls that are described well once what crosses them is masked."""
    rough = distinct(rough.rows(~_near(rough.position_px, known, usual)), noise)
    fits = without_scratches(film, rough, optics, noise, all_but(known, np.arange(0), optics, needles))
    return distinct(fits.rows(~_near(fits.position_px, known, usual) & _sure_of_a_size(fits, known, limit, noise)), noise)


def _over_lines(
    film: NDArray[Any],
    place: Float,
    known: BallFits,
    usual: float,
    limit: float,
    optics: Optics,
    noise: NoiseModel,
    needles: Painted | None,
) -> BallFits:
    """Balls that are seen only beside the line that they lie on."""
    others = all_but(known, np.arange(0), optics, needles)
    fits = balls_on_lines(film, place, usual, limit, optics, noise, others)
    fits = distinct(fits.rows(inside(fits, film) & ~_near(fits.position_px, known, usual) & plausible(fits, noise, NEAR_EDGES)), noise)
    fits, edged = beside_edges(film, fits, optics, noise, others)
    return fits.rows(edged & _sure_of_a_size(fits, known, limit, noise))


def _sure_of_a_size(fits: BallFits, known: BallFits, limit: float, noise: NoiseModel) -> Bool:
    """Say which are of the sizes of clear balls, sure, and well described."""
    clear = known.radius_px[look_clear(known, noise)]
    size = np.abs(np.log(fits.radius_px[:, None] / clear)).min(axis=1, initial=np.inf) < np.log(_OF_SIZE)
    close = plausible(fits, noise) & (misfit(fits, noise) < DOUBTFUL * MISFIT)
    return np.asarray(size & close & (over_clutter(fits) > max(SURE, limit)))


def _like_a_ball(fits: BallFits, limit: float, noise: NoiseModel, slack: float = _SLACK) -> Bool:
    """Say which are plausible; what stands out far may leave more: dust, an edge or bone lies over balls as well."""
    far = over_clutter(fits) > _FAR * limit
    return np.asarray(plausible(fits, noise) | (far & plausible(fits, noise, slack)))


def _near(position_px: Float, balls: BallFits, radius_px: float) -> Bool:
    gap = np.hypot(*(position_px[:, None] - balls.position_px[None]).transpose(2, 0, 1))
    return np.asarray((gap < np.maximum(radius_px, balls.radius_px)).any(axis=1))
