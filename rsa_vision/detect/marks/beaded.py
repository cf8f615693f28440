"""Pins that balls beside them or on them have hidden: sought once the balls are known, without these, and taken apart from them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import plausible
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import gaps
from rsa_vision.detect.marks.mixed import part
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.painted import Painted, paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.arms import meet_others
from rsa_vision.detect.needles.balls_beside import BallsBeside, lapped, mask_under
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.detect.needles.fits import PROMISING, explains
from rsa_vision.detect.needles.of_a_kind import is_of_kind, starts_like, typical_of
from rsa_vision.detect.needles.pins import fit_beside_balls
from rsa_vision.detect.needles.pointed import either_way, middle, unexplained
from rsa_vision.detect.needles.sets import NEAREST_PX
from rsa_vision.detect.neighbours.beside import all_but, deep_at, take_balls
from rsa_vision.detect.neighbours.laid_on import over_arms
from rsa_vision.types import Bool, Float

_STEPS = 10  # of a pin's length, between places where it may be
_LOW = 0.1  # of the height of a typical pin, over the film around a place on one
_MOST_IN_VAIN = 3  # starts near one ball
# pin lengths from a ball that a fit may see: of the place, of its tip from there, of how far that may move, and of what lies behind
_SEEN_FROM = 5.0
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
    left = ~_are_these(balls, on_them) & ~(over_arms(balls, now) & now.explain(film, balls.position_px, balls.radius_px))
    balls = join([balls.rows(left), on_them])
    beside = BallsBeside(all_but(balls, np.arange(0), optics, None), balls, optics)
    fitted, pin_optics = fit_beside_balls(film, [*pins, *more], beside, optics, pin_optics, noise)
    return (fitted, pin_optics) if all(_is_there(f, fitted) for f in pins) else None


def _hidden(
    film: NDArray[Any], pins: list[NeedleFit], painted: Painted, balls: BallFits, optics: Optics, pin_optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], BallFits]:
    """Pins beside balls and under them, and those of the balls that lie on these."""
    more, on_them, all_painted = list[NeedleFit](), [balls.rows(slice(0))], painted
    if typical := typical_of(pins, noise):
        sure = plausible(balls, noise)  # what only an edge beside it explains may be the thick end of a pin
        bare, masked = (_without(film, of, painted, balls.position_px, typical, optics) for of in (balls.rows(sure), balls))
        mask_under(masked, balls, optics)
        places, in_vain = _around(balls, typical.shape.length_px), np.zeros(len(sure), np.intp)
        places = places[deep_at(bare, places, typical.shape.half_width_px, None) > _LOW * abs(typical.height)]
        for start in starts_like(bare, masked, typical, places, painted.needles, pin_optics, noise):
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


def _without(
    film: NDArray[Any], balls: BallFits, painted: Painted, places: Float, typical: NeedleFit, optics: Optics
) -> NDArray[np.float32]:
    """Return the film as far around places as fits of pins on them see, without balls and needles; zero elsewhere, which takes no memory."""
    out, half = np.zeros(film.shape, np.float32), int(_SEEN_FROM * typical.shape.length_px)
    for col, row in np.rint(places).astype(np.intp):
        box = slice(max(row - half, 0), max(row + half + 1, 0)), slice(max(col - half, 0), max(col + half + 1, 0))
        out[box] = film[box]
    take_balls(out, balls, optics)
    painted.near(places, half).take_from(out, 0, 0)
    return out


def _is_there(needle: NeedleFit, fitted: list[NeedleFit]) -> bool:
    return any(math.dist(needle.position_px, f.position_px) < NEAREST_PX for f in fitted)


def _around(balls: BallFits, length_px: float) -> Float:
    """Places (n, 2) around balls, out to the length of a pin."""
    step = length_px / _STEPS
    axis = step * np.arange(-_STEPS, _STEPS + 1)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*grid.T) < length_px]
    return np.asarray((balls.position_px[:, None] + grid).reshape(-1, 2))


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


def _are_these(balls: BallFits, others: BallFits) -> Bool:
    """Say which balls are others, as they were before."""
    gap = gaps(balls.position_px, others.position_px)
    return np.asarray((gap < others.radius_px).any(axis=1))
