"""The last fit of a film's pins or tees: all at once, with what they have in common estimated beside what is each one's own.

Errors of attenuation, blur and the directions of parallel arms move every tip the same way and do not average out over a cage. Estimated
from one needle these are poor, from all of them they are good. Each needle's own parameters are eliminated from the normal equations
(variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973), so that the work goes with the number of needles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.balls.leftover import LEAST, at_rims, usual_square
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import Window, window_of
from rsa_vision.detect.needles.disturbed import louder
from rsa_vision.detect.needles.equations import (
    BENT,
    OF_SLANTS,
    OPTICS,
    OWN,
    SHARED,
    SLANT,
    UNEVEN,
    Equations,
    Expected,
    by_optics,
    linearise,
    own_parameters,
)
from rsa_vision.detect.needles.fits import between, excess_of, scored
from rsa_vision.detect.needles.grounds import errors_by_ground
from rsa_vision.detect.needles.irregular import ARMS, WAYS, Regularity, moved_arms, regular, told_by
from rsa_vision.detect.needles.penumbra import MOST as MOST_BLURRIER
from rsa_vision.detect.needles.penumbra import Blurs, differing, equal
from rsa_vision.detect.needles.sets import beside_each, clusters
from rsa_vision.types import Float

_STEPS = 12
# root mean square over the tips of pins and of tees, in standard deviations: by the former a few go to and fro for ever; three arms hold a
# tip, so that after the latter the next step is a quarter of that
_CONVERGED = {1: 0.15, 3: 0.25}
_FINEST_PX = 0.02  # added to those, for the tables are interpolated
_ATTENUATION_ERROR, _BLUR_ERROR = 0.7, 0.3  # of the logarithms, before the needles are asked: they know better than balls
_TAPER_ERROR, _LEAST_TAPER = 0.1, 0.1
_SIZE_ERROR = 1.0  # of those, before
_ASKED_AFTER = 4  # steps, after which it is asked at the latest how far arms and blurs differ: what differs does not converge
_BLURS_AFTER, _MORE_STEPS = 3, 6
_SIZES_AFTER = 2  # steps, from which sizes are near enough to tell how much they differ
_DIRECTION_ERROR = 0.2  # radians, of the directions of arms against the first, before
_SETTLED = 0.1  # conditional standard deviations of all that is common
_CURVE_ERROR, _TAIL_ERROR = (0.6, 0.1), 0.07
# of what is uneven of the blur: of a first estimate, and where that, or the needles as a whole, have told something of it
_EVEN_ERROR, _UNEVEN_ERROR = 0.02, 0.2
_OF_UNEVEN = np.eye(2) / _UNEVEN_ERROR**2
_BY_CHANCE = 14.0  # chi2 of two degrees of freedom
# of attenuation, blur, taper, curve, tail, uneven: changes from which derivatives by them are taken anew
_MUCH = np.array([0.15, 0.15, 0.02, 0.1, 0.1, 0.1, 0.1, 0.1])
_NEAR = np.array([0.3, 0.1, 0.1, 0.2, 0.1, 0.1, 0.1, 0.1])  # changes of those with which the last step gets there
_MOST = 3.0, 0.8, 0.6  # curve and tail
_MOST_UNEVEN = 0.8
_MOST_BY_STEP, _MOST_TAPER_BY_STEP = 0.6, 0.2  # of all these
_BLURRIER_BY_STEP = 0.2  # by a step, of one needle's
_SHORTER = 3  # attempts at a step that loses nothing
_SQUARE_PX = (
    17  # side of squares than which all that is slower is left out, on bone; near enough the best for arms of half widths of 2.5 to 4
)
_GAIN = 0.2  # of the logarithm of the variance of tips, from which they are
_ASKED = 8  # windows that tell whether it is to be
_MOST_SLANT, _MOST_SKEW = 0.6, 0.3


def fit_shared(
    film: NDArray[Any],
    needles: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
    *,
    parallel: bool,
    alike: bool = False,
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
        Their sizes differ as little as fits with free sizes show: for pins, whose tips depend on where they end.
    steps : int
        At the most.

    Returns
    -------
    needles : list of NeedleFit
        In another order. The covariance of a tip holds the errors of what is common.
    optics : Optics
    """
    if not needles:
        return [], optics
    parallel = parallel and len(needles[0].angles) > 1
    sets = clusters(needles)
    windows = [window_of(film, m, optics, noise, others) for m, others in zip(sets, beside_each(sets, optics), strict=True)]
    of_blur = _UNEVEN_ERROR if any(optics.uneven) else _EVEN_ERROR
    errors = [_ATTENUATION_ERROR, _BLUR_ERROR, _TAPER_ERROR, *_CURVE_ERROR, _TAIL_ERROR, of_blur, of_blur, _SIZE_ERROR, _SIZE_ERROR]
    precision = np.diag(np.array(errors + [_DIRECTION_ERROR] * ((len(needles[0].angles) - 1) * parallel)) ** -2.0)
    # steps weigh pixels as if noise were white, and believe them the more the more neighbours share of it
    gain = float(noise.gain(np.hypot(optics.sigma_px, np.median([f.shape.half_width_px for f in needles]))))
    held = precision * gain
    sizes = _Sizes(np.zeros(2), [np.full((len(m), 2), np.inf) for m in sets])
    arms = regular(sets) if len(needles[0].angles) == ARMS else None
    at = _State(sets, np.zeros(len(precision)), needles[0].shape.taper, sizes, equal(sets), arms)
    asked, asked_of_blurs, sizes_at = False, False, _SIZES_AFTER
    start, slopes, since, of_blurs = optics, list[list[Float]](), np.full(OPTICS, np.inf), at.own_blurs
    last: list[Equations | None] = [None] * len(sets)
    before: tuple[_State, list[Equations], _Step] | None = None
    converged, shorter, least = False, 0, np.inf
    for count in range(steps + _MORE_STEPS + 1):
        optics = _moved_optics(start, at.moved)
        if (np.abs(at.moved[:OPTICS] - since) > _MUCH).any() or np.abs(at.own_blurs - of_blurs).max() > _MUCH[1]:
            slopes = [by_optics(w, m, optics) for w, m in zip(windows, at.sets, strict=True)]
            since, of_blurs = at.moved[:OPTICS], at.own_blurs
        systems = [
            linearise(w, m, k, optics, noise, parallel, expected, e)
            for w, m, k, expected, e in zip(windows, at.sets, slopes, at.expected, last, strict=True)
        ]
        cost = sum(e.cost for e in systems) + float(at.moved @ held @ at.moved)
        if before and cost > least + len(held) and shorter < _SHORTER and count < steps:
            at, systems, step = before  # far from a straight line: back, and not as far; what was seen from there tells nothing
            step, shorter, converged = step.shorter(), shorter + 1, False
        else:
            told = [e.information() for e in systems]
            normal = held + sum(matrix for matrix, _ in told)
            target = np.sum([right for _, right in told], axis=0)
            if count == steps or converged:
                break
            least, shorter = cost, 0
            change = _change(normal, target - held @ at.moved, at.taper)
            if np.abs(change[:OPTICS]).max() > 0 and (np.abs(change) < _SETTLED / np.sqrt(normal.diagonal())).all():
                change[:OPTICS] = 0.0  # new tables for so little are not worth their time
            far = float(change @ normal @ change) / len(change)
            step = _Step(change, [e.step(change) for e in systems])
            surprise = np.concatenate([e.surprise(own, _FINEST_PX) for e, own in zip(systems, step.own, strict=True)])
            converged = count > 0 and max(float(surprise.mean()), far if alike else 0.0) < _CONVERGED[len(needles[0].angles)] ** 2
            converged &= bool((np.abs(change[:OPTICS]) < _NEAR).all())  # the image as well as the tip: it is taken away for others
            if (converged or count >= _BLURS_AFTER) and not asked_of_blurs:
                asked_of_blurs = True
                if differ := _blurs(systems, gain):
                    moved = at.moved.copy()
                    moved[BENT] = [-was for was in (*start.curve, start.tail, *start.uneven)]  # a curve that made up for them leads astray
                    at, converged, least, before = (
                        replace(at, sets=differ[0], blurs=differ[1], moved=moved, sizes=sizes),
                        False,
                        np.inf,
                        None,
                    )
                    steps, sizes_at = steps + _MORE_STEPS, count + 1 + _SIZES_AFTER
                    continue
            if (converged or count >= _ASKED_AFTER) and not asked:  # near enough to tell how far their arms differ
                asked = True
                odd = _odd(systems, at, gain) if parallel else None
                if uneven := _is_uneven(precision, normal - held, target, at.moved, gain):
                    precision[UNEVEN, UNEVEN] = _OF_UNEVEN
                    held = precision * gain
                if odd or uneven:
                    at, converged, least, before = replace(at, regularity=odd or at.regularity), False, np.inf, None
                    continue
            if converged and not alike:
                break  # from so near the last step gets there as well; that to the sizes of all is longer
        before, last = (at, systems, step), [*systems]
        at = at.after(step, systems, parallel)
        if alike and count + 1 == sizes_at:
            at, converged, least = replace(at, sizes=_sizes(systems, at.sets)), False, np.inf
    through = _quietest(film, windows, systems, noise)
    systems = [e.filtered(w, through) for e, w in zip(systems, windows, strict=True)]
    told = [e.information() for e in systems]
    normal = precision + sum(matrix for matrix, _ in told)
    change = _change(normal, sum(target for _, target in told) - precision @ at.moved, at.taper)
    step = _Step(change, [e.step(change) for e in systems])
    at = at.after(step, systems, parallel)
    optics = _moved_optics(start, at.moved)
    left = np.array([e.noise_under(own, change) for e, own in zip(systems, step.own, strict=True)])
    left = left[np.isfinite(left)]
    # less noise under needles than beside them is that of the film; more may as well be an error of the model, which is each one's own
    under = at_rims(min(usual_square(left), 1.0)) if len(left) >= LEAST else 1.0
    by_noise = [_by_noise(window, e, through) for window, e in zip(windows, systems, strict=True)]
    of_common = _common_errors(systems, by_noise, normal, precision, under)
    out = []
    for window, e, members, scatter in zip(windows, systems, at.sets, by_noise, strict=True):
        out += _finished(window, e, members, under * scatter, of_common, optics, noise, converged)
    tips = [scatter[: len(e.tips), : len(e.tips)] for scatter, e in zip(by_noise, systems, strict=True)]
    by_ground = errors_by_ground(film, windows, systems, tips, out, through)
    over = [louder(w, e, own, change, optics.sigma_px) for w, e, own in zip(windows, systems, step.own, strict=True)]
    more = _more(out, np.concatenate(by_ground), tips, over, noise)
    return [replace(f, covariance_px2=f.covariance_px2 + extra) for f, extra in zip(out, more, strict=True)], optics


def _change(normal: Float, target: Float, taper: float) -> Float:
    """Change of the common parameters, not too far at once; the taper stays within its bounds, the others follow."""
    change = np.linalg.solve(normal, target).astype(np.float64)
    change *= _as_far(change)
    held = between(change[2], _LEAST_TAPER - taper, 1.0 - taper)
    if held != change[2]:
        others = np.arange(len(change)) != 2
        change[others] = np.linalg.solve(normal[np.ix_(others, others)], target[others] - normal[others, 2] * held)
        change[2] = held
        change *= _as_far(change)
    return change


def _as_far(change: Float) -> float:
    """Part of a change that one step may go."""
    return float(min(1.0, _MOST_BY_STEP / max(float(np.abs(change).max()), 1e-9), _MOST_TAPER_BY_STEP / max(abs(change[2]), 1e-9)))


@dataclass(frozen=True, slots=True, eq=False)
class _Sizes:
    """Logarithms of half width and length that are usual on a film, and what each needle may differ from them, by sets (m, 2)."""

    typical: Float
    spread: list[Float]


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A change of the common parameters (c,), and of the own ones of each set."""

    change: Float
    own: list[Float]

    def shorter(self) -> _Step:
        return _Step(self.change / 3, [own / 3 for own in self.own])


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Where a fit is: needles by sets, what the common parameters (c,) differ from the start, their taper and their sizes."""

    sets: list[list[NeedleFit]]
    moved: Float
    taper: float
    sizes: _Sizes
    blurs: Blurs
    regularity: Regularity | None

    @property
    def own_blurs(self) -> Float:
        """Logarithms of the blurs of all needles over the film's."""
        return np.array([f.blurrier for members in self.sets for f in members])

    @property
    def expected(self) -> list[Expected]:
        """What is expected of the needles, by sets."""
        ways = [np.zeros((len(m), WAYS)) for m in self.sets] if self.regularity is None else self.regularity.spread
        each = zip(self.sizes.spread, self.blurs.spread, ways, strict=True)
        return [Expected(self.sizes.typical, size, self.blurs.typical, blur, self.regularity, way) for size, blur, way in each]

    def after(self, step: _Step, systems: list[Equations], parallel: bool) -> _State:
        taper = self.taper + float(step.change[2])
        sets = [_moved(e.members, own, step.change, taper, parallel) for e, own in zip(systems, step.own, strict=True)]
        sizes = replace(self.sizes, typical=self.sizes.typical + step.change[OPTICS:SHARED])
        known = self.regularity
        if known is not None and parallel:
            known = replace(known, common=known.common + step.change[SHARED:])
        return _State(sets, self.moved + step.change, taper, sizes, self.blurs, known)


def _sizes(systems: list[Equations], sets: list[list[NeedleFit]]) -> _Sizes:
    """What fits with sizes of their own tell of the sizes: pins of one cage are alike, but for how the rays meet them."""
    size = np.array([[f.shape.half_width_px, f.shape.length_px] for members in sets for f in members])
    variance = np.concatenate([e.variance_of_sizes for e in systems]) / size**2
    values = np.log(size)
    told = [true_spread(values[:, k], variance[:, k]) for k in range(2)]
    spread = np.stack([np.where(belongs, sd, np.inf) for _, sd, belongs in told], axis=1)
    return _Sizes(np.array([centre for centre, _, _ in told]), np.split(spread, np.cumsum([len(m) for m in sets])[:-1]))


def _odd(systems: list[Equations], at: _State, gain: float) -> Regularity | None:
    """How far arms differ, where they do; ``gain``: of the variances, by noise that neighbours share."""
    if at.regularity is None:
        return None
    ways, variances = zip(*(e.free_ways(at.regularity.common) for e in systems), strict=True)
    return told_by(list(ways), [gain * v for v in variances], at.regularity)


def _blurs(systems: list[Equations], gain: float) -> tuple[list[list[NeedleFit]], Blurs] | None:
    """Needles with blurs of their own, and how far these differ, where they do; ``gain``: of the variances, by noise of neighbours."""
    blurs, variances = zip(*(e.free_blurs() for e in systems), strict=True)
    told = differing(list(blurs), [gain * v for v in variances])
    if told is None:
        return None
    sets = [
        [replace(f, blurrier=between(b, -MOST_BLURRIER, MOST_BLURRIER)) for f, b in zip(e.members, of, strict=True)]
        for e, of in zip(systems, blurs, strict=True)
    ]
    return sets, told


def _is_uneven(precision: Float, told: Float, target: Float, moved: Float, gain: float) -> bool:
    """Say whether what needles tell, (c, c) and (c,), makes the blur uneven that was taken as even so far.

    ``precision``: of the common parameters before; ``moved``: what they differ from the start; ``gain``: of the variances, by noise that
    neighbours share.
    """
    free = precision.copy()
    free[UNEVEN, UNEVEN] = _OF_UNEVEN
    if (free == precision).all():
        return False
    covariance = np.linalg.inv(told + gain * free)
    uneven = moved[UNEVEN] + (covariance @ (target - gain * free @ moved))[UNEVEN]
    return bool(uneven @ np.linalg.solve(covariance[UNEVEN, UNEVEN], uneven) > gain * _BY_CHANCE)


def _moved_optics(start: Optics, by: Float) -> Optics:
    """Optics with these changes of the logarithms of attenuation and blur, of curve, tail and what is uneven."""
    bow, skewed, tail = (
        between(was + step, -most, most) for was, step, most in zip((*start.curve, start.tail), by[3:6], _MOST, strict=True)
    )
    dense, blurred = np.exp(by[:2]).tolist()
    along, oblique = start.uneven + by[UNEVEN]
    part = min(1.0, _MOST_UNEVEN / max(float(np.hypot(along, oblique)), 1e-9))
    uneven = (float(along * part), float(oblique * part))
    return replace(start, mu_px=start.mu_px * dense, sigma_px=start.sigma_px * blurred, curve=(bow, skewed), tail=tail, uneven=uneven)


def _moved(members: Sequence[NeedleFit], delta: Float, change: Float, taper: float, parallel: bool) -> list[NeedleFit]:
    """Needles after a step of their own parameters and of the common ones."""
    arms = len(members[0].angles)
    wider, longer, turns = *change[OPTICS:SHARED], change[SHARED:]
    turning = 1 if parallel else arms
    each, ends = own_parameters(arms, parallel), OWN + turning + OF_SLANTS[arms].shape[1]
    parts = delta[: each * len(members)].reshape(len(members), each)
    shift, turn = float(np.abs(parts[:, :2]).max()), float(np.abs(parts[:, OWN : OWN + turning]).max())
    scale = min(1.0, 1.0 / max(shift, 1e-9), 0.1 / max(turn, 1e-9), _BLURRIER_BY_STEP / max(float(np.abs(parts[:, OWN - 1]).max()), 1e-9))
    out = []
    for f, part in zip(members, scale * parts, strict=True):
        width, length = f.shape.half_width_px, f.shape.length_px
        width = between(width + between(part[2] + width * wider, -0.5, 0.5), 0.6, 0.3 * length)
        ways = np.append(np.zeros(WAYS - each + ends), part[ends:])  # no leans where each arm has a direction of its own
        angles, lengths = moved_arms(f, ways) if arms == ARMS else (f.angles, f.shape.arms)
        length = max(length + between(part[3] + length * longer, -2.0, 2.0), 3.0)
        shape = NeedleShape(width, length, taper, lengths)
        angles = angles + part[OWN : OWN + turning] + (np.concatenate([[0.0], turns]) if parallel else 0.0)
        slants = (np.zeros((2, arms)) if f.slants is None else f.slants) + (OF_SLANTS[arms] @ part[OWN + turning : ends]).reshape(2, arms)
        slants = np.clip(slants, [[-SLANT], [-_MOST_SKEW]], [[_MOST_SLANT], [_MOST_SKEW]])
        blurrier = between(f.blurrier + part[OWN - 1], -MOST_BLURRIER, MOST_BLURRIER)
        out.append(replace(f, position_px=f.position_px + part[:2], shape=shape, angles=angles, slants=slants, blurrier=blurrier))
    return out


def _quietest(film: NDArray[Any], windows: list[Window], systems: list[Equations], noise: NoiseModel) -> Filter:
    """Return the filter with which noise and the film beside some needles move their tips least."""
    needles = [f for e in systems for f in e.members]
    asked = slice(None, None, 1 + len(systems) // _ASKED)
    variances = {}
    for through in (Filter(noise), Filter(noise, _SQUARE_PX)):
        some = [e.filtered(w, through) for e, w in zip(systems[asked], windows[asked], strict=True)]
        scatter = [_by_noise(w, e, through)[: len(e.tips), : len(e.tips)] for e, w in zip(some, windows[asked], strict=True)]
        by_ground = np.concatenate(errors_by_ground(film, windows[asked], some, scatter, needles, through))
        variances[through] = np.concatenate([s.diagonal() for s in scatter]) + np.einsum("maa->ma", by_ground).ravel()
    plain, fine = (float(np.log(v).mean()) for v in variances.values())
    return list(variances)[fine < plain - _GAIN]


def _by_noise(window: Window, e: Equations, through: Filter) -> Float:
    """Covariance that noise which neighbouring pixels share makes of the tips, and of what the common parameters are estimated from."""
    influence = np.concatenate([e.inverse[e.tips] @ e.own, e.common - e.own_by_common.T @ e.own])
    return window.covariance(window.filtered(influence, through), through.noise)


def _common_errors(systems: list[Equations], by_noise: list[Float], normal: Float, precision: Float, under: float) -> Float:
    """Covariance of the common parameters."""
    spread = precision.copy()
    for e, scatter in zip(systems, by_noise, strict=True):
        rest = slice(len(e.tips), None)
        spread += (under * scatter[rest, rest] + e.own_by_common.T @ (e.prior[:, None] ** 2 * e.own_by_common)) / e.excess
    inverse = np.linalg.inv(normal)
    covariance: Float = inverse @ spread @ inverse
    return covariance


def _finished(
    window: Window,
    e: Equations,
    members: list[NeedleFit],
    by_noise: Float,
    errors: Float,
    optics: Optics,
    noise: NoiseModel,
    converged: bool,
) -> list[NeedleFit]:
    by_common, tips = e.own_by_common[e.tips], slice(len(e.tips))
    covariance = by_noise[tips, tips] + by_common @ errors @ by_common.T
    of_prior = e.inverse[e.tips] * e.prior  # what is held near to the expected is not exactly there
    covariance = covariance + of_prior @ of_prior.T
    variance = float(noise.variance_at(np.array([e.background]))[0])
    out = []
    for i, (fit, image) in enumerate(zip(members, e.images, strict=True)):
        at = slice(2 * i, 2 * i + 2)
        fit = replace(fit, covariance_px2=covariance[at, at], converged=converged)
        out.append(scored(fit, image, e.left, e.weight, window.surface, e.background, variance, window.hidden, optics))
    return out


def _more(needles: list[NeedleFit], by_ground: Float, by_noise: list[Float], over: list[float], noise: NoiseModel) -> Float:
    """Covariances (n, 2, 2) by what else lies over needles: what the film beside them promises, or what their fits leave if that is more.

    ``by_noise``: covariances of the tips of each window; ``over``: what to multiply them by.
    """
    out = by_ground.copy()
    each = [(matrix[i : i + 2, i : i + 2], times) for matrix, times in zip(by_noise, over, strict=True) for i in range(0, len(matrix), 2)]
    for k, (own, times) in enumerate(each):
        left = max(times / excess_of(needles[k], noise) - 1.0, 0.0) * own  # by the excess the table widens all of it
        if np.trace(left) > np.trace(out[k]):
            out[k] = left
    return out
