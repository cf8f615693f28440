"""Pins that balls beside them or on them have hidden: sought once the balls are known, without these, and taken apart from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import plausible
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import Box, box_of
from rsa_vision.detect.film.places import are_within
from rsa_vision.detect.marks.mixed import part
from rsa_vision.detect.models.needles import NeedleFit, either_way, middle, unexplained
from rsa_vision.detect.models.painted import Painted, paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.arms import meet_others
from rsa_vision.detect.needles.balls_beside import BallsBeside, lapped, mask_under
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.detect.needles.fits import PROMISING, explains
from rsa_vision.detect.needles.of_a_kind import is_of_kind, starts_like, typical_of
from rsa_vision.detect.needles.pins import fit_beside_balls
from rsa_vision.detect.needles.sets import is_apart
from rsa_vision.detect.neighbours.beside import all_but, deep_at, take_balls
from rsa_vision.detect.neighbours.laid_on import over_arms
from rsa_vision.types import Bool, Float

_STEPS = 10  # of a pin's length, between places where it may be
_LOW = 0.1  # of the height of a typical pin, over the film around a place on one
_MOST_IN_VAIN = 3  # starts near one ball
_SEEN_FROM = 5.0  # pin lengths from a ball, of the place, its tip, and its way from there, and what lies around that: all that a fit sees
_MOST_OVER = 2  # balls found on what may be a pin


def find_beaded(
    film: NDArray[Any], pins: list[NeedleFit], painted: Painted, balls: BallFits, optics: Optics, pin_optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], Optics] | None:
    """Find pins of the kind of the clear ones beside balls and under them, and fit all pins beside these.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    pins : list of NeedleFit
        That were found.
    painted : Painted
        These, and the tees.
    balls : BallFits
    optics, pin_optics : Optics
    noise : NoiseModel

    Returns
    -------
    (list of NeedleFit, Optics) or None
        All pins, and as they tell the film; None where no ball lies on one.
    """
    if not pins or len(balls.depth) == 0:
        return None
    real = [f for f, is_arm in zip(pins, meet_others(film, pins), strict=True) if not is_arm]  # what tees have lost may be of a kind too
    more, on_them = _hidden(film, real, painted, balls, optics, pin_optics, noise)
    if not more and not lapped(real, balls, optics).any():
        return None
    now = paint([(f, pin_optics) for f in [*pins, *more]])
    left = balls.rows(~are_within(balls.position_px, on_them.position_px, on_them.radius_px))
    left = left.rows(~(over_arms(left, now) & now.explain(film, left.position_px, left.radius_px)))
    balls = join([left, on_them])
    beside = BallsBeside(all_but(balls, np.arange(0), optics, None), balls, optics)
    fitted, pin_optics = fit_beside_balls(film, [*pins, *more], beside, optics, pin_optics, noise)
    return (fitted, pin_optics) if not any(is_apart(f, fitted) for f in pins) else None


def _hidden(
    film: NDArray[Any], pins: list[NeedleFit], painted: Painted, balls: BallFits, optics: Optics, pin_optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], BallFits]:
    """Pins beside balls and under them, and those of the balls that lie on these."""
    more, on_them, all_painted = list[NeedleFit](), [balls.rows(slice(0))], painted
    if typical := typical_of(pins, noise):
        sure = plausible(balls, noise)  # what only an edge beside it explains may be the thick end of a pin
        half = int(_SEEN_FROM * typical.shape.length_px)

        def bare(place: Float) -> Box:
            return _without(film, balls.rows(sure), painted, place, half, optics)

        def masked(place: Float) -> Box:
            box = _without(film, balls, painted, place, half, optics)
            mask_under(box, balls, optics)
            return box

        looks = (_look(bare(place), place, typical) for place in balls.position_px)
        in_vain = np.zeros(len(sure), np.intp)
        for start in starts_like(looks, masked, typical, painted.needles, pin_optics, noise):
            nearest = np.hypot(*(balls.position_px - middle(start)).T).argmin()
            others = all_but(balls.rows(sure), np.arange(0), optics, all_painted)
            left = fit_crossing(film, [start], pin_optics, noise, others=others, quick=True)[0]  # of what has been found since less is
            if in_vain[nearest] == _MOST_IN_VAIN or not explains(left, PROMISING):
                continue
            in_vain[nearest] += 1
            if one := _one_of(film, start, typical, all_painted, balls, sure, optics, pin_optics, noise):
                in_vain[nearest] = 0
                more.append(one[0])
                on_them.append(one[1])
                all_painted = painted.and_more([(f, pin_optics) for f in more])
    return more, join(on_them)


def _without(film: NDArray[Any], balls: BallFits, painted: Painted, place: Float, half: int, optics: Optics) -> Box:
    """Return the film around a place without balls and needles."""
    box = box_of(film, place, half)
    take_balls(box, balls, optics)
    painted.take_from(box)
    return box


def _look(box: Box, ball: Float, typical: NeedleFit) -> tuple[Box, Float]:
    """Return a box and the places (n, 2) around a ball in it, out to the length of a pin, where something lies."""
    step = typical.shape.length_px / _STEPS
    axis = step * np.arange(-_STEPS, _STEPS + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    places = ball + grid[np.hypot(*grid.T) < typical.shape.length_px]
    deep = deep_at(box.values, places - box.corner_px, typical.shape.half_width_px, None)
    return box, places[deep > _LOW * abs(typical.height)]


def _one_of(
    film: NDArray[Any],
    start: NeedleFit,
    typical: NeedleFit,
    painted: Painted,
    balls: BallFits,
    sure: Bool,
    optics: Optics,
    pin_optics: Optics,
    noise: NoiseModel,
) -> tuple[NeedleFit, BallFits] | None:
    """Fit what may be a pin beside balls, or under one of them, and return it with that ball if it is one of the kind."""

    def is_one(fit: NeedleFit) -> bool:
        return is_of_kind(fit, typical, noise)

    found = list[tuple[NeedleFit, BallFits]]()
    for way in either_way(start):
        over = np.flatnonzero(over_arms(balls, paint([(way, pin_optics)])))
        others = all_but(balls, over, optics, painted)
        if not sure[over].any():
            found.append((fit_crossing(film, [way], pin_optics, noise, others=others)[0], balls.rows(slice(0))))
        for k in over if len(over) <= _MOST_OVER else ():
            both = part(film, way, balls, optics, pin_optics, noise, others, is_one, balls.position_px[k])
            found += [both] if both else []
    return min((one for one in found if is_one(one[0])), key=lambda one: unexplained(one[0]), default=None)
