"""Balls that a first look missed: where the film's balls are known, one like them is looked for at every candidate left over.

A first look starts from the size that the filter suits and from guessed optics. Beside an edge, or faint on bone, it grows until it holds
the bone as well; started from the usual size it stays with the ball. Then balls on lines as strong as they are, half out of implants, and
under scratches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, like_clear, look_clear, over_clutter
from rsa_vision.detect.balls.find import (
    SURE,
    distinct,
    fit_at,
    in_correlated_noise,
    no_fits,
    plausible,
    promising,
)
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within, on_film
from rsa_vision.detect.models.painted import Painted
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import all_but, images_beside
from rsa_vision.detect.neighbours.crossed import without_scratches
from rsa_vision.detect.neighbours.edges import NEAR_EDGES, balls_beside_edges
from rsa_vision.detect.neighbours.lines import balls_on_lines, on_lines
from rsa_vision.detect.search.candidates import SCALES, STRENGTH, Candidates
from rsa_vision.types import Bool, Float

_CLEAR = 0.9  # of the limit, over clutter
_FAR, _SLACK = 1.5, 1.4  # times the limit, times the misfit that is tolerated otherwise
_ROUND = 0.4  # the filter that suits the usual size answers balls of it by round extrema
_SIZE = 1.6  # ratio of the fitted radius to the usual one
_ROUGH = 4.0  # times the misfit that is tolerated otherwise, before rims are fitted too or scratches masked
_DEEP = 0.4  # of the depth of clear balls: half of one is seen against what is beside the rim; threads of screws are shallower


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
    look = _Look(film, usual, limit, optics, noise, needles)
    fits, edged, rough = _of_the_usual_size(look, place, balls)
    known = join([balls, fits])
    # a line takes the most part of what is there, and the rest has to be sure: faint places are not worth it
    over = _over_lines(look, place[strong], known)
    at_rims = _at_rims(look, rough, join([known, over]))
    with_edge = join([over, at_rims])
    crossed = _under_scratches(look, rough, join([known, with_edge]))
    count = [len(fits.depth), len(with_edge.depth), len(crossed.depth)]
    at_edges = np.concatenate([edged, np.repeat([True, False], count[1:])])
    return join([fits, with_edge, crossed]), at_edges, np.repeat([False, False, True], count)


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What all three kinds of balls are looked for with, as of :func:`look_again`; ``usual`` is the radius of the film's balls."""

    film: NDArray[Any]
    usual: float
    limit: float
    optics: Optics
    noise: NoiseModel
    needles: Painted | None

    def beside(self, known: BallFits) -> Images:
        """Images of needles and of all these balls."""
        return all_but(known, np.arange(0), self.optics, self.needles)

    def may_be(self, fits: BallFits, known: BallFits) -> Bool:
        """Say which lie on the film and on no known ball."""
        return on_film(self.film, *fits.position_px.T) & ~_near(fits.position_px, known, self.usual)

    def sure(self, fits: BallFits, known: BallFits) -> Bool:
        """Say which are as :func:`like_clear`."""
        return like_clear(fits, known, self.limit, self.noise)


def _of_the_usual_size(look: _Look, place: Float, balls: BallFits) -> tuple[BallFits, Bool, BallFits]:
    """Balls at these places, those of them with an edge, and what is sure at first, though it may leave too much for a ball."""
    film, usual, limit, optics, noise, needles = look.film, look.usual, look.limit, look.optics, look.noise, look.needles

    def others(_: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return images_beside(balls, np.arange(0), optics, needles, cols, rows)

    def fit(at: Float, *, quick: bool) -> tuple[BallFits, Bool]:
        fits = fit_at(film, at, np.full(len(at), usual), optics, noise, others, quick=quick) if len(at) else no_fits()
        return fits, look.may_be(fits, balls) & (np.abs(np.log(fits.radius_px / usual)) < np.log(_SIZE))

    fits, stays = fit(place, quick=True)
    sure = in_correlated_noise(fits, optics.sigma_px, noise) > max(SURE, limit)
    rough = fits.rows(stays & sure & plausible(fits, noise, _ROUGH))  # a longer fit may slip into what is beside it
    enough = promising(fits, limit, optics.sigma_px, noise)
    fits = distinct(fits.rows(stays & _like_a_ball(fits, limit, noise, NEAR_EDGES) & enough), noise)
    fits, stays = fit(fits.position_px, quick=False)
    enough = over_clutter(fits) > _CLEAR * limit
    fits = distinct(fits.rows(stays & _like_a_ball(fits, limit, noise, NEAR_EDGES) & enough), noise)
    fits = fits.rows(~on_lines(film, join([balls, fits]), limit, optics, noise, needles)[len(balls.depth) :])
    fits, edged = balls_beside_edges(film, fits, optics, noise, look.beside(balls))
    like = _like_a_ball(fits, limit, noise)
    return fits.rows(like), edged[like], rough


def _over_lines(look: _Look, place: Float, known: BallFits) -> BallFits:
    """Balls that are seen only beside the line that they lie on."""
    others, place = look.beside(known), place[~_near(place, known, look.usual)]
    fits = balls_on_lines(look.film, place, look.usual, look.limit, look.optics, look.noise, others)
    fits = distinct(fits.rows(look.may_be(fits, known) & plausible(fits, look.noise, NEAR_EDGES)), look.noise)
    fits, edged = balls_beside_edges(look.film, fits, look.optics, look.noise, others, wanted=lambda some: look.sure(some, known))
    return fits.rows(edged & look.sure(fits, known))


def _at_rims(look: _Look, rough: BallFits, known: BallFits) -> BallFits:
    """Balls half out of something as dense as they are: of its rim a surface leaves so much that only a fit with the edge can tell."""
    rough = distinct(rough.rows(~_near(rough.position_px, known, look.usual)), look.noise)
    clear = np.abs(known.depth[look_clear(known, look.noise)])
    least = _DEEP * np.median(clear) if len(clear) else np.inf

    def wanted(fits: BallFits) -> Bool:
        return np.asarray((np.abs(fits.depth) > least) & look.may_be(fits, known) & look.sure(fits, known))

    fits, edged = balls_beside_edges(look.film, rough, look.optics, look.noise, look.beside(known), wanted=wanted)
    return distinct(fits.rows(edged & wanted(fits)), look.noise)


def _under_scratches(look: _Look, rough: BallFits, known: BallFits) -> BallFits:
    """Balls that are described well once what crosses them is masked."""
    rough = distinct(rough.rows(~plausible(rough, look.noise) & ~_near(rough.position_px, known, look.usual)), look.noise)
    fits = without_scratches(look.film, rough, look.optics, look.noise, look.beside(known))
    return distinct(fits.rows(look.may_be(fits, known) & look.sure(fits, known)), look.noise)


def _like_a_ball(fits: BallFits, limit: float, noise: NoiseModel, slack: float = _SLACK) -> Bool:
    """Say which are plausible; what stands out far may leave more: dust, an edge or bone lies over balls as well."""
    far = over_clutter(fits) > _FAR * limit
    return np.asarray(plausible(fits, noise) | (far & plausible(fits, noise, slack)))


def _near(position_px: Float, balls: BallFits, radius_px: float) -> Bool:
    return are_within(position_px, balls.position_px, np.maximum(radius_px, balls.radius_px))
