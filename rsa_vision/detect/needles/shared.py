"""The last fit of a film's pins or tees: all at once, with what they have in common estimated beside what is each one's own.

Errors of attenuation, blur and the directions of parallel arms move every tip the same way and do not average out over a cage. Estimated
from one needle these are poor, from all of them they are good. Each needle's own parameters are eliminated from the normal equations
(variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973), so that the work goes with the number of needles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.balls_beside import BallsBeside
from rsa_vision.detect.needles.crossing import Window, window_of
from rsa_vision.detect.needles.differing import equal
from rsa_vision.detect.needles.equations import ATTENUATION, BLUR, OPTICS, TAPER, Equations, Shown, by_optics, linearise
from rsa_vision.detect.needles.fits import excess_of
from rsa_vision.detect.needles.irregular import ARMS, regular
from rsa_vision.detect.needles.questions import (
    MORE_STEPS,
    OF_ARMS,
    OF_BLURS,
    OF_DENSITIES,
    OF_TAPERS,
    UNEVEN_ERROR,
    Agenda,
    odd_arms,
    with_own_blurs,
    with_own_densities,
    with_own_tapers,
    with_uneven_blur,
)
from rsa_vision.detect.needles.sets import beside_each, clusters
from rsa_vision.detect.needles.stated import AtRest, quietest, with_errors
from rsa_vision.detect.needles.states import Sizes, State, Step, change_of, moved_optics, of_usual_size, sizes_of
from rsa_vision.types import Float

_STEPS = 12
# root mean square over the tips of pins and of tees, in standard deviations: by the former a few go to and fro for ever; three arms hold a
# tip, so that after the latter the next step is a quarter of that
_CONVERGED = {1: 0.15, 3: 0.25}
_FINEST_PX = 0.02  # added to those, for the tables are interpolated
_ATTENUATION_ERROR, _BLUR_ERROR = 0.7, 0.3  # of the logarithms, before the needles are asked: they know better than balls
_TAPER_ERROR = 0.1
_SPOILT = 1.5  # times the chi2 of most pins: what leaves so much, on bone, tells nothing of what they have in common
_SIZE_ERROR = 1.0  # of those, before
_STEPS_AGAIN = 6  # of those that have gone astray
_SIZES_AFTER = 2  # steps, from which sizes are near enough to tell how much they differ
_DIRECTION_ERROR = 0.2  # radians, of the directions of arms against the first, before
_SETTLED = 0.1  # conditional standard deviations of all that is common
_CURVE_ERROR, _CURVE_OF_PINS_ERROR, _TAIL_ERROR = (0.6, 0.1), (1.0, 0.1), 0.07
_ENOUGH_PINS = 3  # that tell what comes after the film curve
_PIXEL, _MOST_PIXEL = 1 / 12, 0.5  # px^2 of blur by the area of a scanner's pixel, and part of the variance that it may be at first
_LATE_ERROR, _LOGGED_ERROR, _FIXED = 0.15, 2.5, 1e-3  # of what comes after the film curve, of the logarithm there, of either where it stays
_EVEN_ERROR = 0.02  # of what is uneven of the blur, where no first estimate has told something of it
# of attenuation, blur, taper, curve, tail, late, logged, uneven: changes from which derivatives by them are taken anew
_MUCH = np.array([0.15, 0.15, 0.02, 0.1, 0.1, 0.1, 0.1, 0.5, 0.1, 0.1])
_NEAR = np.array([0.3, 0.1, 0.1, 0.2, 0.1, 0.1, 0.1, 0.5, 0.1, 0.1])  # changes of those with which the last step gets there
_SHORTER = 3  # attempts at a step that loses nothing
_CLOSELY = 0.95  # explained of most, from which it is beyond doubt that they are of a kind: what texture has of them is less


def fit_shared(
    film: NDArray[Any],
    needles: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    *,
    parallel: bool,
    alike: bool = False,
    balls: BallsBeside | None = None,
    steps: int = _STEPS,
) -> tuple[list[NeedleFit], Optics]:
    """Fit all needles of a film and their common attenuation, blur and directions.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
        Starts, all pins or all tees.
    optics : Optics
        Start.
    noise : NoiseModel
    parallel : bool
        The arms of all needles have the same directions against their first; else each arm its own.
    alike : bool
        Their sizes differ as little as fits with free sizes show: for pins, whose tips depend on where they end. Three of them or more tell
        what comes after the film curve as well, which moves no tip that three arms hold; before it is known that there are pins, rods may
        be bent into them.
    balls : BallsBeside, optional
        Beside them and on them.
    steps : int
        At the most.

    Returns
    -------
    needles : list of NeedleFit
        In their order. The covariance of a tip holds the errors of what is common.
    optics : Optics
    """
    if not needles:
        return [], optics
    task = _begin(film, needles, optics, noise, balls, parallel=parallel and len(needles[0].angles) > 1, alike=alike)
    at, systems, precision, through, converged = _come_near(film, task, noise, steps)
    through = through or quietest(film, task.windows, systems, noise)
    systems = _filtered(task.windows, systems, through)
    told = [e.information() for e in compress(systems, task.telling)]
    normal = precision + sum(matrix for matrix, _ in told)
    change = change_of(normal, sum(target for _, target in told) - precision @ at.moved, at, task.start)
    step = Step(change, [e.step(change) for e in systems])
    at = at.after(step, [e.shown for e in systems], task.parallel)
    optics = moved_optics(task.start, at.moved)
    rest = AtRest(task.windows, systems, at.sets, step, task.telling, normal, precision, optics, through, converged)
    place = np.argsort([i for index in task.belong for i in index])
    fitted = with_errors(film, rest, noise)
    return [fitted[k] for k in place], optics


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What a fit of all needles of a film begins with."""

    belong: list[list[int]]  # which needles are in each window
    windows: list[Window]
    at: State
    start: Optics
    precision: Float  # (c, c), of what is common
    n_free: int  # of that
    gain: float  # of the variances, by noise that neighbours share
    telling: list[bool]  # windows that tell what is common
    typical: float  # part of the variance that needles explain
    parallel: bool
    alike: bool


def _begin(
    film: NDArray[Any],
    needles: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    balls: BallsBeside | None,
    *,
    parallel: bool,
    alike: bool,
) -> _Task:
    taper = float(np.median([f.shape.taper for f in needles]))
    belong = clusters(needles)
    sets = [[replace(needles[i], shape=replace(needles[i].shape, taper=taper)) for i in index] for index in belong]
    others = beside_each(sets, optics)
    if balls:
        others = [balls.and_others(o) for o in others]
    unseen = balls.over if balls else None
    windows = [window_of(film, m, optics, noise, beside, unseen=unseen) for m, beside in zip(sets, others, strict=True)]
    windows = [w.with_edge(m, optics) if any(f.edged for f in m) else w for w, m in zip(windows, sets, strict=True)]
    of_blur = UNEVEN_ERROR if any(optics.uneven) else _EVEN_ERROR
    scanned = alike and len(needles) >= _ENOUGH_PINS
    of_scanner = [_LATE_ERROR, _LOGGED_ERROR] if scanned else [_FIXED, _FIXED]
    if not scanned:
        optics = replace(optics, late=0.0, logged=0.0)
    elif not optics.late:
        optics = replace(optics, late=min(_PIXEL / optics.sigma_px**2, _MOST_PIXEL))
    of_curve = _CURVE_OF_PINS_ERROR if scanned else _CURVE_ERROR
    of_beam = [_ATTENUATION_ERROR, _BLUR_ERROR, _TAPER_ERROR, *of_curve, _TAIL_ERROR]
    errors = [*of_beam, *of_scanner, of_blur, of_blur, _SIZE_ERROR, _SIZE_ERROR]
    precision = np.diag(np.array(errors + [_DIRECTION_ERROR] * ((len(needles[0].angles) - 1) * parallel)) ** -2.0)
    # steps weigh pixels as if noise were white, and believe them the more the more neighbours share of it
    gain = float(noise.gain(np.hypot(optics.sigma_px, np.median([f.shape.half_width_px for f in needles]))))
    n_free = len(precision) - len(of_scanner) * (not scanned)
    sizes = Sizes(np.zeros(2), [np.full((len(m), 2), np.inf) for m in sets])
    arms = regular(sets) if len(needles[0].angles) == ARMS else None
    at = State(sets, np.zeros(len(precision)), taper, sizes, equal(sets), equal(sets), equal(sets), arms)
    telling = _telling(sets, noise) if alike else [True] * len(sets)
    typical = float(np.median([f.explained for f in needles]))
    return _Task(belong, windows, at, optics, precision, n_free, gain, telling, typical, parallel, alike)


def _come_near(film: NDArray[Any], task: _Task, noise: NoiseModel, steps: int) -> tuple[State, list[Equations], Float, Filter | None, bool]:
    """Go on until the last step gets there; what needles may differ by is asked on the way.

    Returns
    -------
    at : State
    systems : list of Equations
        There.
    precision : ndarray of shape (c, c)
        Of what is common, as far as it has been let free.
    through : Filter or None
        Once it has been asked for.
    converged : bool
    """
    windows, at, start, parallel, alike, telling = task.windows, task.at, task.start, task.parallel, task.alike, task.telling
    precision, close = task.precision, _CONVERGED[len(at.sets[0][0].angles)] ** 2
    held = precision * task.gain
    agenda, sizes_at = Agenda.of(alike=alike), _SIZES_AFTER
    slopes, since, of_each = list[list[NDArray[np.float32]]](), np.full(OPTICS, np.inf), at
    last: list[Shown | None] = [None] * len(windows)
    before: tuple[State, list[Shown], Step] | None = None
    converged, restarted, shorter, least = False, False, 0, np.inf
    through: Filter | None = None

    def linearised(at: State) -> list[Equations]:
        optics, each = moved_optics(start, at.moved), zip(windows, at.sets, slopes, at.expected, last, strict=True)
        return [linearise(w, m, k, optics, noise, parallel, expected, e) for w, m, k, expected, e in each]

    for count in range(steps + sum(MORE_STEPS.values()) + _STEPS_AGAIN + 1):
        if (np.abs(at.moved[:OPTICS] - since) > _MUCH).any() or _far_apart(at, of_each):
            slopes = [by_optics(w, m, moved_optics(start, at.moved)) for w, m in zip(windows, at.sets, strict=True)]
            since, of_each = at.moved[:OPTICS], at
        systems, quiet = list[Equations](), list[Equations]()  # those before take much memory
        systems = linearised(at)
        cost = sum(e.cost for e in systems) + float(at.moved @ held @ at.moved)
        if before and cost > least + task.n_free and shorter < _SHORTER and count < steps:
            at, seen, step = before  # far from a straight line: back, and not as far; what was seen from there tells nothing
            step, shorter, converged = step.shorter(), shorter + 1, False
            systems = linearised(at) if alike and count + 1 == sizes_at else systems
        else:
            told = [e.information() for e in compress(systems, telling)]
            normal = held + sum(matrix for matrix, _ in told)
            target = np.sum([right for _, right in told], axis=0)
            if count == steps and not (converged or alike or restarted) and task.typical > _CLOSELY:
                # some have gone astray, far from a straight line: tees of a film are of one size, and from there they all may get there
                at, least, before, restarted = replace(at, sets=of_usual_size(at.sets)), np.inf, None, True
                steps += _STEPS_AGAIN
                continue
            if count == steps or converged:
                break
            least, shorter, seen = cost, 0, [e.shown for e in systems]
            change = change_of(normal, target - held @ at.moved, at, start)
            if np.abs(change[:OPTICS]).max() > 0 and (np.abs(change) < _SETTLED / np.sqrt(normal.diagonal())).all():
                change[:OPTICS] = 0.0  # new tables for so little are not worth their time
            far = float(change @ normal @ change) / len(change)
            step = Step(change, [e.step(change) for e in systems])
            surprise = np.concatenate([e.surprise(own, _FINEST_PX) for e, own in zip(systems, step.own, strict=True)])
            converged = count > 0 and max(float(surprise.mean()), far if alike else 0.0) < close
            converged &= bool((np.abs(change[:OPTICS]) < _NEAR).all())  # the image as well as the tip: it is taken away for others
            answer: State | None = None
            for question in agenda.due(count, converged, count >= sizes_at):
                through = through or quietest(film, windows, systems, noise)
                quiet = quiet or _filtered(windows, systems, through)  # what needles differ by, and not what noise and bone make of that
                if question == OF_BLURS:
                    answer = with_own_blurs(quiet, at, task.at, start)
                    sizes_at = sizes_at if answer is None else count + 1 + _SIZES_AFTER
                elif question == OF_TAPERS:
                    answer = with_own_tapers(quiet, at)
                elif question == OF_DENSITIES:
                    answer = with_own_densities(quiet, at)
                elif question == OF_ARMS:
                    odd = odd_arms(quiet, at) if parallel else None
                    if (uneven := with_uneven_blur(precision, normal - held, target, at.moved, task.gain)) is not None:
                        precision, held = uneven, uneven * task.gain
                    if odd or uneven is not None:
                        answer = replace(at, regularity=odd or at.regularity)
                if answer is not None:
                    steps += MORE_STEPS[question]
                    break
            if answer is not None:
                at, converged, least, before = answer, False, np.inf, None
                continue
            if converged and not alike:
                break  # from so near the last step gets there as well; that to the sizes of all is longer
        before, last = (at, seen, step), [*seen]
        at = at.after(step, seen, parallel)
        if alike and count + 1 == sizes_at:
            through = through or quietest(film, windows, systems, noise)
            at, converged, least = replace(at, sizes=sizes_of(_filtered(windows, systems, through))), False, np.inf
    return at, systems, precision, through, converged


def _telling(sets: list[list[NeedleFit]], noise: NoiseModel) -> list[bool]:
    """Say which sets tell what is common: not those of which much more is left than of most."""
    left = np.array([max(excess_of(f, noise) for f in m) for m in sets])
    typical = np.sort(left)[: max(len(left) // 2, 1)].max()
    return [bool(of < _SPOILT * typical) for of in left]


def _filtered(windows: list[Window], systems: list[Equations], through: Filter) -> list[Equations]:
    return [e.filtered(w, through) for e, w in zip(systems, windows, strict=True)]


def _far_apart(at: State, before: State) -> bool:
    """Say whether some needles have changed so much of their own that derivatives by what is common are taken anew."""
    blurrier, tapers = np.abs(at.own_blurs - before.own_blurs), np.abs(at.own_tapers - before.own_tapers)
    denser = np.abs(at.own_densities - before.own_densities)
    return bool(blurrier.max() > _MUCH[BLUR] or tapers.max() > _MUCH[TAPER] or denser.max() > _MUCH[ATTENUATION])
