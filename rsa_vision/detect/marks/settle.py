"""The last fit of balls: on a background that goes on under them as the film goes on beside them.

With noise alone a fit on a quadratic background is the best there is. Bone bends further under a ball, where no residual shows it,
and pulls at the centre. How much of it there is, and how fine, free places around the ball tell (`surroundings.py`); with that as
their variance the coefficients of further surfaces are fitted as well (least squares with random effects: Henderson, Biometrics 31,
1975). A mark takes away its part of that background, on a linear film more where there is more: left out, the slope of a bone pulls
at the centres of large balls. The radius is held near what the balls of the film have in common, as far as they do. The same
estimator, held over the free places, shows what errors are left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import CLOSE, EDGE
from rsa_vision.detect.balls.find import CHANCE
from rsa_vision.detect.balls.fits import BallFits, uneven_white
from rsa_vision.detect.balls.focal_spot import shapes_of
from rsa_vision.detect.balls.quanta import ENOUGH, Left, left_over, shared_more, spread
from rsa_vision.detect.balls.random_effects import Common, Solution, Windows, hold, solve, variance_of
from rsa_vision.detect.balls.surroundings import Modes, Places, around_each, mean_beside, modes, texture
from rsa_vision.detect.balls.usual import Proportion, proportion, size_unlike, usual_size
from rsa_vision.detect.film.least_squares import chi2, polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.shoulder import Curve, curve_of, shown, told_by, unseen_slope
from rsa_vision.detect.marks.resolve import Balls
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Beside, beside_each
from rsa_vision.detect.neighbours.edges import OF_SHIFT
from rsa_vision.detect.neighbours.foreign import foreign, in_line, robust_residual
from rsa_vision.detect.neighbours.pulls import Pulls
from rsa_vision.detect.neighbours.specks import Specks, find_specks, how_rough
from rsa_vision.detect.neighbours.wires import find_wires
from rsa_vision.types import Bool, Float, Int

STRUCTURE = 2.0  # variance around a ball, in units of the noise, from which there is more than noise
_UNEVEN = 1.25  # the same, from which something may lie there
_WHOLE, _DESCRIBED = 0.95, 6.0  # of the pixels under a ball; variance under it: what more the model leaves is not all even
MOST_COVERED = 0.85  # of a ball: from less it cannot be measured
_TINY = 1e-12
_NONE = 1e-3  # of a promised squared error
_QUIETEST = 0.6  # of a promised squared error
_ROUNDED = 1.0  # variance of noise up to which areas have one value
_QUARTILE, _OF_CHANCE = 0.75, 2.773  # the upper one, of chi2 with two degrees of freedom: errors by bone have longer tails than it
_BATCH = 20
_USUAL = 6.0  # of chi2 with two degrees of freedom: 95 of 100 are less
_OF_EDGE = 0.25  # how likely the edge is the better model, where surfaces do as well
_AGREE = 3.0  # less than 1 / OF_SHIFT: by that part of the square in its variance every way back to the fit without the edge would be near
_LEAST_CHANCE = 0.2  # of the variance by weights alone


def settle(
    film: NDArray[Any],
    found: Balls,
    places: list[Places],
    under: float,
    free: Bool,
    beside: Beside,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[BallFits, Float, Float, Bool, Bool]:
    """Fit the centres of balls once more.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    found : Balls
        Those that were fitted together with an edge stay as they are if bending surfaces leave more of it.
    places : list of Places
        Around them.
    under : float
        Variance of the noise under balls, in units of that beside them.
    free : ndarray of bool, shape (n,)
        Not fitted together with a neighbour: those stay as they are.
    beside : callable
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    balls : BallFits
        With new centres, their covariances, and what is left of the windows.
    ratio : ndarray of shape (n,)
        Squared errors that free places would make of these centres over those that the covariances promise.
    besides : ndarray of shape (n,)
        Variance of centres that is none by noise, px^2: of balls that are of a size of their own, as of
        :func:`rsa_vision.detect.balls.usual.size_unlike`, and of those in saturated film.
    covered : ndarray of bool, shape (n,)
        Something else lies on nearly all of it.
    pulled : ndarray of bool, shape (n,)
        A wire would move it by more than its error.
    """
    balls, edged, drawn = found.fits, found.edged, found.drawn
    if len(balls.depth) == 0:
        return balls, np.ones(0), np.zeros(0), *np.zeros((2, 0), bool)
    around = texture(places, len(free), noise)
    structure = np.where(free[:, None], around.structure, 0.0)
    alone, level = free & ~edged & ~drawn & (balls.chi2_ring < EDGE), mean_beside(places, len(free))
    told = alone & np.isfinite(level)
    clear = balls.rows(alone & (balls.chi2_ring < STRUCTURE))
    alike = Common(optics, noise, under, usual_size(clear), around.differ)
    clear_drawn = balls.rows(free & drawn & ~edged & (balls.chi2_ring < STRUCTURE))
    by_spot = replace(alike, size=usual_size(clear_drawn), spot=found.spot)
    single = free & ~drawn
    usual = float(np.median(balls.chi2_uneven[single])) if single.any() else 1.0  # what all balls leave is no speck on one
    of_depth = proportion(balls.depth[told], balls.background[told], level[told], balls.background)
    fit = partial(_fitted, film, found, places, free, beside, structure, usual, of_depth)
    last = fit(alike, by_spot)
    if any(specks.pulls.found.any() for specks in last.specks):  # or noise, of which there may be more under balls
        alike, by_spot = (replace(common, rough=how_rough(last.specks)) for common in (alike, by_spot))
        last = fit(alike, by_spot)
    ratio = around_each(last.ratios, places, len(free), _least(noise), _QUARTILE)[:, 0]
    if (more := shared_more(last.left)) > 0:
        more /= max(1.0, float(np.median(ratio)))  # what is there beside balls as well multiplies all of it in the end
        last = fit(*(replace(common, more=more) for common in (alike, by_spot)))
    out = last.balls
    out.covariance[:, :2, :2] += found.by_spot
    besides = last.by_light
    for kind, usual_ones in ((edged & ~drawn, clear), (edged & drawn, clear_drawn)):
        besides[kind] += size_unlike(balls.rows(kind), usual_ones)
    return out, ratio, besides, last.covered > MOST_COVERED, last.pulled


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """The last fit of all balls of a film."""

    balls: BallFits
    ratios: list[Float]  # of squared errors at the places, (k, 1) for each size
    covered: Float  # (n,), part of a ball on which something else lies
    pulled: Bool  # (n,), moved by a wire, by more than their errors
    by_light: Float  # (n,), variance of those in saturated film
    left: list[Left]  # by clear balls
    specks: list[Specks]


def _fitted(
    film: NDArray[Any],
    found: Balls,
    places: list[Places],
    free: Bool,
    beside: Beside,
    structure: Float,
    usual: float,
    of_depth: Proportion,
    alike: Common,
    by_spot: Common,
) -> _Fitted:
    balls, edged, drawn = found.fits, found.edged, found.drawn
    noise, under, curve = alike.noise, alike.under, curve_of(film)
    clear = balls.rows((balls.explained > CLOSE) & (balls.hidden == 0))
    curve = told_by(clear.background, clear.depth, clear.radius_px, curve)
    out, ratios, (covered, by_light) = replace(balls, covariance=under * balls.covariance), [], np.zeros((2, len(free)))
    left, every, louder = list[Left](), list[Specks](), list[Float]()
    stayed, pulled = np.ones(len(free), bool), np.zeros(len(free), bool)
    for these in places:
        known, errors = modes(these.half, noise), np.zeros((len(these.near), 1))
        for batch, common in _batches(drawn[these.balls], alike, by_spot):
            part = these.balls[batch]
            windows = _windows(film, balls, part, these.half, beside, noise, of_depth)
            windows = _without_others(windows, edged[part], common)
            solution = solve(windows, known, structure[part], common)
            excess = np.maximum(under * np.maximum(windows.fits.chi2_ring, 1.0), usual)
            rim_px = solution.radius_px + common.rim_px
            specks = find_specks(solution, rim_px, windows.fits.depth, excess, 2 * these.half + 1, common)
            wires = find_wires(solution, ~edged[part], rim_px, excess, 2 * these.half + 1, common)
            pulls = specks.pulls.but(wires)
            every.append(specks)
            fits = _fits(windows, solution, pulls, known, common)
            pulled[part] = free[part] & wires.found & (chi2(wires.shift_px, fits.covariance[:, :2, :2]) > 1)
            better = (balls.chi2_uneven[part] - fits.chi2_uneven) / noise.scatter(fits.n_core)
            covered[part], by_light[part] = windows.covered, _by_light(windows, solution, curve)
            crossed, apart = (windows.covered > 0) & (windows.covered <= MOST_COVERED), fits.position_px - balls.position_px[part]
            both = OF_SHIFT * apart[:, :, None] * apart[:, None] * edged[part, None, None]  # both models could be right
            both += OF_SHIFT * ((apart**2).sum(axis=1) * crossed)[:, None, None] * np.eye(2)  # what lies on a ball has any profile
            hidden = _hidden(windows, solution, curve, common)
            fits.covariance[:, :2, :2] += both + hidden
            # there is an edge, which surfaces do not know: they are believed if they agree with it, or leave less
            chance = chi2(apart, balls.covariance[part, :2, :2])
            stays = (fits.chi2_ring > STRUCTURE) | (better < -CHANCE) | ((chance > _AGREE) & (better < CHANCE))
            moved = free[part] & ~(edged[part] & stays)
            # surfaces that bend as the film does elsewhere promise more than they can at an edge: either model may be right
            fits.covariance[edged[part], :2, :2] *= 1 - _OF_EDGE
            fits.covariance[edged[part], :2, :2] += _OF_EDGE * out.covariance[part[edged[part]], :2, :2]
            out = _put(out, part, fits, moved)
            stayed[part[moved]] = False
            if common.more:
                estimated = solution.estimator, solution.weight, 2 * these.half + 1
                all_of_it, stated = (
                    np.trace(_of_noise(*estimated, told), axis1=1, axis2=2) for told in (common, replace(common, more=0.0))
                )
                louder.append(all_of_it / stated)
            described = (fits.chi2_ring < _UNEVEN) & (fits.chi2_core < _DESCRIBED)
            clear_ones = np.flatnonzero(moved & described & (fits.valid_fraction > _WHOLE))
            if common.spot is None and len(clear_ones) and sum(len(of.found) for of in left) < ENOUGH:
                of = fits.background[clear_ones], pulls.found[clear_ones]
                left.append(left_over(solution, clear_ones, *of, known, these.half, common))
            both[~crossed] = 0.0
            stay = free[part] & ~moved
            out.covariance[part[stay], :2, :2] += (both + hidden + _by_depth(windows, solution))[stay]
            mine = np.isin(these.near, batch)
            by_background, near = solution.estimator * solution.shade, np.searchsorted(batch, these.near[mine])
            errors[mine, 0] = _held_over(these.values[mine], near, by_background, known, structure[part], noise)
        ratios.append(errors)
    if louder:
        out.covariance[stayed] *= np.median(np.concatenate(louder))
    return _Fitted(out, ratios, covered, pulled, by_light, left, every)


def _batches(drawn: Bool, alike: Common, by_spot: Common) -> Iterator[tuple[Int, Common]]:
    """Yield balls, by their indices, that are fitted at once, and what these share: those drawn by the film's spot by themselves."""
    for index, common in ((np.flatnonzero(~drawn), alike), (np.flatnonzero(drawn), by_spot)):
        for begin in range(0, len(index), _BATCH):
            yield index[begin : begin + _BATCH], common


def _windows(film: NDArray[Any], balls: BallFits, part: Int, half: int, beside: Beside, noise: NoiseModel, of_depth: Proportion) -> Windows:
    fits = balls.rows(part)
    patches = cut(film, fits.position_px, half, noise)
    corner = patches.corner_px.astype(np.float64)
    images, doubtful = beside_each(patches, part, beside)
    added = images + fits.background[:, None, None]
    flat = (len(part), -1)
    return Windows(
        fits,
        half,
        corner,
        (patches.values - added).reshape(flat),
        added.reshape(flat),
        (patches.valid & ~doubtful).reshape(flat),
        np.zeros(len(part)),
        of_depth.rows(part).but_of_hidden(fits.hidden != 0),
    )


def _without_others(windows: Windows, edged: Bool, common: Common) -> Windows:
    """Mask the pixels of wires, dust and scratches, under the balls as well."""
    half, noise = windows.half, common.noise
    some = np.flatnonzero((windows.fits.chi2_ring > _UNEVEN) | edged)
    fits, before = windows.fits.rows(some), windows.valid[some]
    rows, cols = np.mgrid[0 : 2 * half + 1, 0 : 2 * half + 1].reshape(2, -1).astype(np.float64)
    local, rim, depth = fits.position_px - windows.corner_px[some], fits.radius_px + common.rim_px, fits.depth[:, None]
    shapes = shapes_of(common.optics, common.spot, cols - local[:, :1], rows - local[:, 1:], fits.radius_px)
    value, *by = (shape.astype(np.float64) for shape in shapes)
    surface = np.broadcast_to(polynomial(half, cols - half, rows - half).T, (len(some), 6, len(cols)))
    images = np.concatenate([np.stack([*(depth * slope for slope in by), value], axis=1), surface], axis=1)
    target, held = hold(fits, common)
    precision = np.zeros(images.shape[:2])
    precision[:, 2] = held
    at_target = depth * (value + (target - fits.radius_px)[:, None] * by[2])
    weight = before / noise.variance_at(depth * value + windows.added[some])
    residual = robust_residual(images, windows.data[some] - at_target, weight, precision)
    under = np.hypot(cols - local[:, :1], rows - local[:, 1:]) < rim[:, None]
    found = foreign(residual, weight, before & ~under, float(noise.gain(np.array(1.0))))
    after = before & ~found & ~in_line(found, local, rim)
    part = (before & ~after & under).sum(axis=1) / np.maximum((before & under).sum(axis=1), 1)
    valid, covered = windows.valid.copy(), windows.covered.copy()
    valid[some], covered[some] = np.where((part > MOST_COVERED)[:, None], before, after), part
    return replace(windows, valid=valid, covered=covered)


def _fits(windows: Windows, found: Solution, pulls: Pulls, known: Modes, common: Common) -> BallFits:
    """Put centres, their covariances and what is left into a table."""
    fits, side, estimator = windows.fits, 2 * windows.half + 1, found.estimator
    at_ease = common.noise.variance_at(fits.background)[:, None]
    every = np.ones((len(at_ease), 1))
    covariance = fits.covariance.copy()
    of_noise, of_plain = (_of_noise(e, found.weight, side, common) for e in (estimator, found.plain))
    covariance[:, :2, :2] = (
        of_noise
        + _surprise(found.apart, of_noise, of_plain)
        + _by((estimator * found.shade) @ known.surface, at_ease * variance_of(known, found.structure))
        # what holding the radius at the usual one does where it is not, and what a wrong proportion does
        + _by(found.inverse[:, :2, 2:3] * found.held[:, None, None], every * common.size.radius_sd_px**2)
        + _by_depth(windows, found)
        + pulls.covariance
        + OF_SHIFT * pulls.shift_px[:, :, None] * pulls.shift_px[:, None]
    )
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, -1)
    local, residual = found.local_px + pulls.shift_px, found.residual - pulls.image
    distance = np.hypot(cols - local[:, :1], rows - local[:, 1:])
    core = distance < (found.radius_px + common.rim_px)[:, None]
    under, ring = (uneven_white(residual, found.weight, local, side, where, common.noise) for where in (core, ~core))
    left = (found.weight * residual**2 * core).sum(axis=1) / np.maximum((core & (found.weight > 0)).sum(axis=1), 1)
    left = np.minimum(left, fits.chi2_core)  # a fit that is the best in correlated noise leaves more of slow changes
    position = local + windows.corner_px
    return replace(fits, position_px=position, covariance=covariance, chi2_core=left, chi2_uneven=under, chi2_ring=ring)


def _of_noise(estimator: Float, weight: Float, side: int, common: Common) -> Float:
    """Covariance of what an estimator makes of noise."""
    by_noise = (estimator / np.sqrt(np.where(weight > 0, weight, 1.0))[:, None]).reshape(-1, 2, side, side)
    covariance = influence_covariance(by_noise, common.noise.correlation)
    if common.more:
        covariance = covariance + common.more * influence_covariance(by_noise, spread(common.noise, common.optics).correlation)
    return np.asarray(common.under * covariance)


def _by_depth(windows: Windows, found: Solution) -> Float:
    """Covariance by an error of how depths go with the background, shape (n, 2, 2)."""
    return _by(np.matmul(found.estimator, found.ground[:, :, None]), windows.proportion.sd[:, None] ** 2)


def _hidden(windows: Windows, found: Solution, curve: Curve, common: Common) -> Float:
    """Covariance by changes of the light that the film hides beside a ball and shows under it, shape (n, 2, 2)."""
    fits, side = windows.fits, 2 * windows.half + 1
    values = fits.background[:, None] + fits.depth[:, None] * found.images[:, 3]
    offset = np.mgrid[0:side, 0:side].reshape(2, 1, -1)[::-1] - found.local_px.T[:, :, None]  # by columns, by rows
    unseen = offset * unseen_slope(fits.background, windows.half, curve, common.noise)[:, None]
    shown_more = np.stack([shown(values, fits.background, change, curve, common.noise) for change in (found.back, *unseen)], axis=2)
    return _by(np.matmul(found.estimator, shown_more), np.ones((len(values), 3)))


def _by_light(windows: Windows, found: Solution, curve: Curve) -> Float:
    """Variance by slopes of light of which nothing is seen but what balls in saturated film leave of it, shape (n,).

    As steep as the light is elsewhere, a ball leaves less of it by the same part.
    """
    fits, side = windows.fits, 2 * windows.half + 1
    offset = np.mgrid[0:side, 0:side].reshape(2, 1, -1)[::-1] - found.local_px.T[:, :, None]
    behind = np.where(fits.hidden != 0, curve.shading * fits.depth, 0.0)[:, None] * found.images[:, 3]
    return np.asarray(0.5 * np.square(np.matmul(found.estimator, np.stack(list(offset * behind), axis=2))).sum(axis=(1, 2)))


def _surprise(apart: Float, efficient: Float, plain: Float) -> Float:
    """Square of what two estimators differ by, as far as noise does not explain it (Hausman, Econometrica 46, 1978); shape (n, 2, 2).

    Were all as described, the variance of the difference is the difference of the variances. If it is not, neither is known to be better.
    """
    size, of_plain = (np.maximum(np.trace(c, axis1=1, axis2=2), _TINY) for c in (efficient, plain))
    chance = np.maximum(1 - size / of_plain, _LEAST_CHANCE)[:, None, None] * plain + _TINY * np.eye(2)
    square = chi2(apart, chance)
    part = np.maximum(1 - _USUAL / np.maximum(square, _TINY), 0.0)
    return np.asarray(part[:, None, None] * apart[:, :, None] * apart[:, None])


def _held_over(values: NDArray[Any], near: Int, estimator: Float, known: Modes, structure: Float, noise: NoiseModel) -> Float:
    """Squared errors that free places make of centres, over what is stated for noise and structure as they are there, shape (k,)."""
    side = round(np.sqrt(values.shape[1]))
    mean = values.mean(axis=1)
    stated = influence_covariance(estimator.reshape(-1, 2, side, side), noise.correlation)
    stated = stated + _by(estimator @ known.surface, variance_of(known, structure))
    stated = stated + _TINY * np.eye(2)  # a ball may lie wholly under others
    error = np.einsum("kip,kp->ki", estimator[near], values - mean[:, None])
    return np.asarray(chi2(error, stated[near]) / noise.variance_at(mean) / _OF_CHANCE)


def _least(noise: NoiseModel) -> float:
    """Part of the promised squared errors that can be all there is: less is not believed of areas of one value, nor of white noise."""
    if noise.is_lossy:  # places where there was nothing have lost nothing
        return 1.0
    return _QUIETEST if noise.is_white or noise.typical_sd**2 < _ROUNDED else _NONE


def _by(response: Float, variance: Float) -> Float:
    """Covariance of what responds (n, 2, k) to independent figures of these variances (n, k)."""
    return np.asarray(np.matmul(response * variance[:, None], response.swapaxes(1, 2)))


def _put(balls: BallFits, part: Int, fits: BallFits, moved: Bool) -> BallFits:
    """Put the new centres in the place of the old ones."""
    changed = {}
    for name in ("position_px", "covariance", "chi2_core", "chi2_uneven", "chi2_ring"):
        changed[name] = getattr(balls, name).copy()
        changed[name][part[moved]] = getattr(fits, name)[moved]
    return replace(balls, **changed)
