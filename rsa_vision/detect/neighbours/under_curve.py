"""Balls that lie over each other on a film whose curve is bent: what it shows of both is not what it shows of each.

Of single balls the curve is taken up by their attenuation and radius, and moves no centre. Between two that lie over each other it
does: a film that answers more the more of its light is gone shows more there than both images, and a fit without the curve draws them
together. Single balls and those that lie over each other tell it, together with blur and attenuation, by Gauss-Newton steps in which
each ball's own numbers are eliminated (variable projection; Golub & Pereyra, SIAM J. Numer. Anal. 10, 1973). Whether two lie in one
beam or are of two exposures, which add up, either group tells as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.fits import BallFits, radii
from rsa_vision.detect.film.least_squares import weighted_least_squares
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.film_curve import by_film_curve, curve_of_bend, film_curve
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import all_but
from rsa_vision.detect.neighbours.group_images import GroupWindow, ImagesUnderCurve, images_under_curve, opacities_in, window_around
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.types import Bool, Float, Int

_LEAST = 3  # balls and groups that tell a curve
_MOST_GROUPS, _MOST_SINGLE = 8, 8  # that are asked
_EXPECTED = np.array([0.3, 0.5, 1.0, 0.3])  # errors of the logarithms of blur and of attenuation along it, of the curve, before
_STEP = np.array([[0.05, 0.0, 0.0, 0.0], [0.0, 0.1, 0.0, 0.0]])  # of those logarithms, for derivatives
_MOST = np.array([0.2, 0.4, 0.5, 0.2])  # of a step
_MOST_PX = 0.5  # of a step of centres and radii
_BENT = np.array([3.0, 0.8])  # of a curve
_ROUNDS, _SHORTER = 20, 4
_SETTLED = 0.1  # of twice the log-likelihood
_PROMISING, _LEAST_GAIN = 5.0, 10.0  # twice the log-likelihood that two numbers of a curve must gain, to first order and in the end
_NEAR = 0.5  # of radius and blur: farther from where they were they are not believed
_MORE = 1.1  # times as much left is no better
_MEASURED = ("position_px", "covariance", "chi2_core", "chi2_ring", "chi2_uneven", "explained")
_SCALE = 1e-7  # of the normal equations, for what pixels do not tell
_BLURS, _CURVE = slice(0, 2), slice(2, 4)


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Balls of one window, as far as their fit has come."""

    window: GroupWindow
    weight: Float  # (n,)
    local: Float  # (k, 2)
    radius: Float  # (k,)
    one_light: bool = True  # they lie in one beam; else they are of two exposures


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """What a group leaves at its best, to first order."""

    group: _Group
    images: ImagesUnderCurve
    depth: Float  # (k,)
    own: Float  # (n, p), derivatives by its own numbers, weighted and of length one
    scale: Float  # (p,), their lengths
    inverse: Float  # (p, p)
    target: Float  # (n,), what is left, weighted
    step: Float  # (p,), of its own numbers
    left: float  # mean square of what is left

    @property
    def pixels(self) -> int:
        return int(np.count_nonzero(self.group.weight))


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """What a group says of what is common."""

    normal: Float  # (4, 4)
    right: Float  # (4,)
    by_common: Float  # (p, 4), what its own numbers do as the common ones change


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Where steps have come to."""

    common: Float  # (4,): logarithms of blur and of attenuation along it, and the two numbers of the curve
    rests: list[_Rest]
    told: list[_Told]
    normal: Float  # (4, 4)
    right: Float  # (4,)
    cost: float  # twice the negative logarithm of likelihood and prior


def under_curve(
    film: NDArray[Any],
    known: BallFits,
    edged: Bool,
    singles: Int,
    groups: list[Int],
    optics: Optics,
    noise: NoiseModel,
    needles: Images | None,
) -> tuple[BallFits, Bool]:
    """Fit balls that lie over each other with the curve of the film, if it shows that it is bent.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    known : BallFits
        All of the film.
    edged : ndarray of bool, shape (n,)
        Those fitted together with an edge, for which the neck between two may have passed.
    singles : ndarray of int
        Clear ones with nothing beside them.
    groups : list of ndarray of int
        Balls whose images touch, as fitted together without a curve.
    optics : Optics
        Without a curve.
    noise : NoiseModel
    needles : callable, optional
        Images of pins and tees.

    Returns
    -------
    fits : BallFits
        All, in the same order. Radii and depths are those without a curve, as of balls that stand alone.
    changed : ndarray of bool, shape (n,)
        Fitted so, on a background without an edge. To the errors of others without an edge is added by how much they would have moved.
    """
    changed, fitted = np.zeros(len(known.depth), bool), {name: getattr(known, name).copy() for name in _MEASURED}
    curve = _told_curve(film, known, singles, groups, optics, noise, needles) if groups else None
    if curve is None:
        return known, changed
    for members in groups:
        before, found = known.rows(members), _fit(film, known.rows(members), curve, noise, all_but(known, members, optics, needles))
        apart = found.position_px - before.position_px
        there = bool((np.hypot(*apart.T) < _NEAR * (before.radius_px + optics.sigma_px)).all() and (found.valid_fraction > 0).all())
        if there and (_as_good(found, before) or (found.converged.all() and not edged[members].any())):
            changed[members] = True
            for name, values in fitted.items():
                values[members] = getattr(found, name)
        elif not edged[members].any():  # neither fit is to be relied on
            fitted["covariance"][members, :2, :2] += apart[:, :, None] * apart[:, None]
    return replace(known, **fitted), changed


def _as_good(found: BallFits, before: BallFits) -> bool:
    """Say whether no more is left, under the balls and around them."""
    now, then = ((f.chi2_core.mean(), f.chi2_ring.mean()) for f in (found, before))
    return bool(now[0] < _MORE * then[0] and now[1] < _MORE * then[1])


def _told_curve(
    film: NDArray[Any], known: BallFits, singles: Int, groups: list[Int], optics: Optics, noise: NoiseModel, needles: Images | None
) -> _State | None:
    """Ask balls for the curve of their film; as for :func:`under_curve`; None where the film does not show that it is bent."""
    best = singles[np.argsort(-known.significance[singles])][:_MOST_SINGLE, None]
    clearest = sorted(groups, key=lambda g: -float(known.significance[g].min()))[:_MOST_GROUPS]
    asked = [_group(film, known.rows(g), optics, noise, all_but(known, g, optics, needles)) for g in [*best, *clearest]]
    if len(asked) < _LEAST:
        return None
    each, start = float(noise.correlation.sum()), np.array([np.log(optics.sigma_px), np.log(optics.mu_px * optics.sigma_px), 0.0, 0.0])
    bent = np.array([*start[_BLURS], *curve_of_bend(optics.bend)])  # of single balls; lapping ones tell more of the curve than those
    straight = _state([_likelier(group, bent) for group in asked], bent, start, each)
    plain = _first_order(straight, _BLURS)
    begin = [straight]
    if any(not rest.group.one_light for rest in straight.rests):  # it may be the curve that makes up for what two take from each other
        begin.append(_state([_rest(group, bent) for group in asked], bent, start, each))
    least, found = straight.cost - plain, None
    for state in begin:
        if state.cost - _first_order(state, slice(0, 4)) > least - _PROMISING:
            continue
        settled = _settled(state, start, each)
        again = [_likelier(rest.group, settled.common) for rest in settled.rests]
        if any(a.group.one_light != b.group.one_light for a, b in zip(again, settled.rests, strict=True)):
            settled = _settled(_state(again, settled.common, start, each), start, each)
        if settled.cost < least - _LEAST_GAIN:
            least, found = settled.cost + _LEAST_GAIN, settled
    return found


def _settled(state: _State, start: Float, each: float) -> _State:
    """Go downhill from a state."""
    for _ in range(_ROUNDS):
        step = np.linalg.solve(state.normal, state.right)
        step *= min(1.0, float((_MOST / np.maximum(np.abs(step), 1e-12)).min()))
        for _ in range(_SHORTER):
            to = state.common + step
            to[_CURVE] = np.clip(to[_CURVE], -_BENT, _BENT)
            moved = [_rest(_moved(r, t, to - state.common, to), to) for r, t in zip(state.rests, state.told, strict=True)]
            gain = state.cost - _cost(moved, to, start, each)
            if gain > 0:
                break
            step = step / 3
        else:
            break
        state = _state(moved, to, start, each)
        if gain < _SETTLED:
            break
    return state


def _state(rests: list[_Rest], common: Float, start: Float, each: float) -> _State:
    """``each``: pixels that noise makes one of."""
    told, held = [_told(rest, common) for rest in rests], _EXPECTED**-2.0
    # as if the variance of each were unknown: what its model leaves is no noise
    say = 1 / (each * np.array([max(rest.left, 1.0) for rest in rests]))
    normal = np.einsum("n,nij->ij", say, np.array([t.normal for t in told])) + np.diag(held)
    right = say @ np.array([t.right for t in told]) - held * (common - start)
    return _State(common, rests, told, normal, right, _cost(rests, common, start, each))


def _cost(rests: list[_Rest], common: Float, start: Float, each: float) -> float:
    """Twice the negative log-likelihood, of an unknown variance where more than noise is left, and that of what is expected."""
    of_each = [r.pixels * (np.log(max(r.left, 1.0)) + min(r.left, 1.0) - 1.0) for r in rests]
    return float(sum(of_each) / each + np.square((common - start) / _EXPECTED).sum())


def _first_order(state: _State, part: slice) -> float:
    """What steps of some of the common numbers gain at most."""
    return float(state.right[part] @ np.linalg.solve(state.normal[part, part], state.right[part]))


def _fit(film: NDArray[Any], fits: BallFits, curve: _State, noise: NoiseModel, others: Images) -> BallFits:
    """Fit a group; the error of the curve is in its covariances."""
    optics, k = _optics(curve.common), len(fits.radius_px)
    one_light = _likelier(_group(film, fits, optics, noise, others), curve.common).group.one_light
    images = partial(images_under_curve, optics=optics, one_light=one_light)
    found = fit_group(film, fits.position_px, fits.radius_px, optics, noise, others, images=images)
    rest = _rest(replace(_group(film, found, optics, noise, others), one_light=one_light), curve.common)
    by_common, of_common = _told(rest, curve.common).by_common, np.linalg.inv(curve.normal)
    by = by_common[np.arange(4 * k).reshape(4, k).T]
    return replace(found, covariance=found.covariance + by @ of_common @ by.swapaxes(1, 2))


def _optics(common: Float) -> Optics:
    sigma = float(np.exp(common[0]))
    return Optics(sigma, float(np.exp(common[1])) / sigma, (float(common[2]), float(common[3])))


def _group(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel, others: Images) -> _Group:
    window = window_around(film, fits.position_px, fits.radius_px, optics.sigma_px, noise, others)
    weight = window.valid / noise.variance_at(window.raw)
    return _Group(window, weight, fits.position_px - window.corner_px, fits.radius_px)


def _likelier(group: _Group, common: Float) -> _Rest:
    """What a group leaves, in one beam or of two exposures."""
    either = [_rest(replace(group, one_light=one_light), common) for one_light in ((True, False) if len(group.radius) > 1 else (True,))]
    return min(either, key=lambda rest: rest.left)


def _rest(group: _Group, common: Float) -> _Rest:
    window, root = group.window, np.sqrt(group.weight)
    images = images_under_curve(window, window.surface, group.local, group.radius, _optics(common), one_light=group.one_light)
    data = window.raw - window.neighbours
    theta = weighted_least_squares(images.linear, group.weight, data)
    own = images.jacobian(theta) * root[:, None]
    scale = np.sqrt(np.maximum((own**2).sum(axis=0), 1e-30))
    own = own / scale
    inverse = np.linalg.inv(own.T @ own + _SCALE * np.eye(len(scale)))
    residual = (data - images.linear @ theta) * root
    step = inverse @ (own.T @ residual)
    target = residual - own @ step
    left = float(target @ target) / max(int(np.count_nonzero(root)), 1)
    return _Rest(group, images, theta[: len(group.radius)], own, scale, inverse, target, step / scale, left)


def _told(rest: _Rest, common: Float) -> _Told:
    group, optics = rest.group, _optics(common)
    opacities = partial(opacities_in, group.window, group.local, group.radius, one_light=group.one_light)

    def shown(optics: Optics) -> Float:
        return np.asarray(opacities(optics).under(partial(film_curve, curve=optics.curve)).T @ rest.depth)

    def by_curve(which: int, opacity: Float) -> Float:
        return by_film_curve(opacity, optics.curve)[which]

    before = rest.images.value.T @ rest.depth
    by = [(shown(_optics(common + step)) - before) / step.sum() for step in _STEP]
    by += [rest.images.light.under(partial(by_curve, which)).T @ rest.depth for which in (0, 1)]
    shared = np.stack(by, axis=1) * np.sqrt(group.weight)[:, None]
    by_own = rest.inverse @ (rest.own.T @ shared)
    left = shared - rest.own @ by_own
    return _Told(left.T @ left, left.T @ rest.target, -by_own / rest.scale[:, None])


def _moved(rest: _Rest, told: _Told, step: Float, to: Float) -> _Group:
    """Balls after a step of their own numbers, and of the common ones, to these."""
    group, k = rest.group, len(rest.group.radius)
    move = (rest.step + told.by_common @ step)[: 3 * k].reshape(3, k)
    move = move * min(1.0, _MOST_PX / max(float(np.abs(move).max()), 1e-9))
    return replace(group, local=group.local + move[:2].T, radius=np.clip(group.radius + move[2], *radii(_optics(to).sigma_px)))
