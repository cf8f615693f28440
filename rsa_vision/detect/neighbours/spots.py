"""Balls drawn by a focal spot that is no Gaussian: what the odd images of a film have in common is its spot.

Far above the film a ball's image is spread by the focal spot, times the magnification less one: by two ridges 5 pixels apart, where that
of a mark near the film is sharp. No blurred ball looks like that. A spot, as far as balls let it be seen, is two peaks of different
weights, each a pair across: four points, which stand for squares and discs as well. All images of the spot on marks of one height are the
same. So what single odd things look like excuses none of them: only what one spot explains of many is a ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, look_clear, over_clutter
from rsa_vision.detect.balls.find import DOUBTFUL, MISFIT, SURE, misfit, plausible
from rsa_vision.detect.balls.fits import RADIUS_PX, BallFits, half_size, join, slopes, uneven, uneven_white
from rsa_vision.detect.balls.focal_spot import Spot, shapes_of
from rsa_vision.detect.film.least_squares import invert, polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.profiles import Optics, ball_table
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.blobs import LEAST_GAIN
from rsa_vision.detect.neighbours.double_images import gain_over_two
from rsa_vision.types import Bool, Float

COMPANY = 6  # odd ones that one spot has to explain: twice what it has parameters, less one
_MOST = 12  # that tell the spot roughly
_EXPLAINED = 0.85
_FAINT = 0.25  # of the depth of those, or of the sixth deepest: bone
_LIKE = 1.25  # ratio of radii
_REACH = 0.8  # of the radius: what is spread farther is no ball with a spot, but a rod or a pair
_ACROSS = 0.25  # of the distance along: two points without extent across are pairs of balls, no spot
_STARTS = np.deg2rad([0.0, 45.0, 90.0, 135.0])
_STEPS, _LAST_STEPS = 6, 12
_H = 0.02  # pixels, for derivatives by the spot
_MOST_STEP_PX = 0.6
_SHRINK = 0.9  # of the radius, which has taken some of the spread
_TOGETHER = 0.25  # of what one alone must gain over two balls: of pairs that lie alike by chance in one of a hundred ways each loses nine
_BETTER = 0.5  # of what they left: less than that they leave with the spot


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Balls that the film's focal spot explains.

    Attributes
    ----------
    fits : BallFits
        None of them where fewer than :data:`COMPANY` are explained.
    spot : Spot or None
    doubtful : ndarray of bool, shape (n,)
        Two balls of the film's own explain these nearly as well.
    by_spot : ndarray of shape (n, 2, 2)
        To be added to the covariances of the centres for that, and for what is not known of the spot, px^2.
    """

    fits: BallFits
    spot: Spot | None
    doubtful: Bool
    by_spot: Float


def spot_of(along: Float) -> Spot:
    """Return the spot of two peaks ``2 (col, row)`` apart, each of two points ``2 b`` apart across, of weights ``(1 ± u) / 2``.

    Parameters
    ----------
    along : ndarray of shape (4,)
        col, row, b, u.
    """
    peak, b, uneven_ = along[:2], along[2], along[3]
    across = np.array([-peak[1], peak[0]]) / max(float(np.hypot(*peak)), 1e-9) * b
    sides = np.array([1.0, 1.0, -1.0, -1.0])
    points = (sides - uneven_)[:, None] * peak + np.array([1.0, -1.0, 1.0, -1.0])[:, None] * across
    return Spot(points, (1 + sides * uneven_) / 4)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    along: Float  # (4,)
    local: Float  # (n, 2)
    radius: Float  # (n,)
    linear: Float  # (n, 7): depth and background


def find_spot(film: NDArray[Any], odd: BallFits, clean: BallFits, optics: Optics, noise: NoiseModel, needles: Images | None) -> Drawn:
    """Find the spot that explains odd images, and fit the balls that it explains.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    odd : BallFits
        Single fits that leave more than a ball should.
    clean : BallFits
        Those that do not: a spot may have drawn some of them as well.
    optics : Optics
    noise : NoiseModel
    needles : callable, optional
        Images to be subtracted.

    Returns
    -------
    Drawn
    """
    sure = clean.rows(look_clear(clean, noise))
    nobody = Drawn(odd.rows(slice(0)), None, np.zeros(0, bool), np.zeros((0, 2, 2)))
    worth = (
        (odd.explained > _EXPLAINED)
        & (over_clutter(odd) > SURE)
        & (odd.valid_fraction > 0.95)
        & (odd.window_fraction > 0.5)
        & (odd.radius_px < RADIUS_PX[1])
    )
    odd = odd.rows(worth)
    # tantalum, not bone, and those with most company of their size
    if len(odd.depth) < COMPANY:
        return nobody
    depth = np.abs(odd.depth)
    usual = np.median(np.abs(sure.depth)) if len(sure.depth) >= LEAST_KNOWN else np.sort(depth)[-COMPANY]
    odd, clean = (of.rows(np.abs(of.depth) > _FAINT * usual) for of in (odd, clean))
    like = np.abs(np.log(odd.radius_px[:, None] / odd.radius_px)) < np.log(_LIKE)
    if like.sum(axis=1).max(initial=0) < COMPANY:
        return nobody
    like = like[like.sum(axis=1) >= COMPANY]
    odd = odd.rows(like[(like @ np.abs(odd.depth)).argmax()])
    odd = odd.rows(np.argsort(-over_clutter(odd)))
    radius = float(np.median(odd.radius_px))
    half = half_size(radius, optics.sigma_px)
    few = _window(film, odd.rows(slice(_MOST)), half, needles, noise)
    trials = []
    for angle in _STARTS:
        along = np.array([0.4 * radius * np.cos(angle), 0.4 * radius * np.sin(angle), 0.2 * radius, 0.0])
        trials.append(_fitted(few, _start(odd.rows(slice(_MOST)), few, along), _STEPS, optics, noise, radius))
    best, _ = min(trials, key=lambda trial: float(np.log(trial[1]).sum()))
    window = _window(film, odd, half, needles, noise)
    state, _ = _fitted(window, _start(odd, window, best.along), _LAST_STEPS, optics, noise, radius)
    if abs(state.along[2]) < _ACROSS * np.hypot(*state.along[:2]):
        return nobody
    fits, _ = _table(window, state, odd, optics, noise)
    rest, before = misfit(fits, noise), misfit(odd, noise)
    alike = np.abs(np.log(fits.radius_px / np.median(fits.radius_px))) < np.log(_LIKE)  # others are at another height
    kept = alike & plausible(fits, noise) & (rest < np.maximum(DOUBTFUL * MISFIT, _BETTER * before))
    if np.count_nonzero(kept & (rest < _BETTER * before)) < COMPANY:
        return nobody
    more = _drawn_as_well(film, clean, state, kept, half, optics, noise, needles)
    better = np.append((rest < _BETTER * before)[kept], np.zeros(np.count_nonzero(more), bool))
    odd, sure = join([odd.rows(kept), clean.rows(more)]), clean.rows(~more & look_clear(clean, noise))
    window = _window(film, odd, half, needles, noise)
    state, _ = _fitted(window, _start(odd, window, state.along), _LAST_STEPS, optics, noise, radius)
    fits, by_spot = _table(window, state, odd, optics, noise)
    spot = spot_of(state.along)

    def image(i: int, cols: Float, rows: Float) -> Float:
        dx, dy = (axis[None] - middle for axis, middle in zip((cols, rows), fits.position_px[i], strict=True))
        return np.asarray(shapes_of(optics, spot, dx, dy, fits.radius_px[[i]])[0][0])

    gain, apart = gain_over_two(film, fits, image, odd, sure, optics, noise, needles)
    # pairs would have to lie the same way by chance, all of them: they are judged together, and none of them decides alone
    told = better & (gain > 0)
    if np.count_nonzero(told) < COMPANY or np.minimum(gain[told], LEAST_GAIN).sum() < _TOGETHER * COMPANY * LEAST_GAIN:
        return nobody
    doubtful, may_be = gain < 0, gain > -LEAST_GAIN
    either = np.where(doubtful[:, None, None], apart[:, :, None] * apart[:, None], 0.0)
    return Drawn(fits.rows(may_be), spot, doubtful[may_be], (by_spot + either)[may_be])


def _drawn_as_well(
    film: NDArray[Any], clean: BallFits, spot: _State, kept: Bool, half: int, optics: Optics, noise: NoiseModel, needles: Images | None
) -> Bool:
    """Say which of these the spot explains better than a Gaussian does, as balls of the size of those that told it."""
    if len(clean.depth) == 0:
        return np.zeros(0, bool)
    usual = float(np.median(spot.radius[kept]))
    window = _window(film, clean, half, needles, noise)
    drawn, plain = (_at_rest(window, clean, along, optics, noise) for along in (spot.along, np.zeros(4)))
    alike = np.abs(np.log(drawn[0].radius / usual)) < np.log(_LIKE)
    return np.asarray(alike & (drawn[1] < plain[1]))


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    half: int
    corner: Float  # (n, 2)
    data: Float  # (n, p), less neighbours
    added: Float  # (n, p), those
    valid: Float  # (n, p)
    cols: Float  # (p,)
    rows: Float
    surface: Float  # (6, p)


def _start(odd: BallFits, window: _Window, along: Float) -> _State:
    return _State(along, odd.position_px - window.corner, _SHRINK * odd.radius_px, np.zeros((len(odd.depth), 7)))


def _window(film: NDArray[Any], balls: BallFits, half: int, needles: Images | None, noise: NoiseModel) -> _Window:
    patches = cut(film, balls.position_px, half, noise)
    corner, n = patches.corner_px.astype(np.float64), len(balls.depth)
    rows, cols = np.mgrid[0 : patches.size, 0 : patches.size].astype(np.float64)
    added = np.zeros((n, *cols.shape)) if needles is None else np.array([needles(*patches.places(k)) for k in range(n)])
    surface = polynomial(half, cols.ravel() - half, rows.ravel() - half).T
    flat = (n, -1)
    data = (patches.values - added).reshape(flat)
    return _Window(half, corner, data, added.reshape(flat), patches.valid.reshape(flat).astype(float), cols.ravel(), rows.ravel(), surface)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """What windows say of their balls: images, residuals and derivatives, all but the images over the standard deviations of the pixels."""

    value: Float  # (n, p)
    own: Float  # (n, 10, p)
    shared: Float  # (n, 4, p)
    root: Float  # (n, p), 1 / standard deviations
    residual: Float  # (n, p)
    linear: Float  # (n, 7)


def _equations(w: _Window, s: _State, optics: Optics, noise: NoiseModel) -> _Equations:
    spot, n = spot_of(s.along), len(s.radius)
    sides = [(spot_of(s.along + h), spot_of(s.along - h)) for h in _H * np.eye(len(s.along))]
    by_points, by_weights = (np.stack([(getattr(a, f) - getattr(b, f)) / (2 * _H) for a, b in sides]) for f in ("points", "weights"))
    table = ball_table(optics)
    dx, dy = w.cols - s.local[:, :1], w.rows - s.local[:, 1:]
    by = np.zeros((4, *dx.shape))  # of the ball: value, slopes by col, row and radius
    shared = np.zeros((n, len(s.along), dx.shape[1]))
    for k, (point, weight) in enumerate(zip(spot.points, spot.weights, strict=True)):
        part = slopes(table, dx - point[0], dy - point[1], s.radius, optics.sigma_px)
        by += weight * np.stack(part)
        shift = by_points[:, k, :, None, None] * weight
        shared += (by_weights[:, k, None, None] * part[0] - shift[:, 0] * part[1] - shift[:, 1] * part[2]).transpose(1, 0, 2)
    linear = np.concatenate([by[0][:, None], np.broadcast_to(w.surface, (n, *w.surface.shape))], axis=1)
    model = np.matmul(s.linear[:, None], linear)[:, 0] if s.linear.any() else w.data
    root = np.sqrt(w.valid / noise.variance_at(model + w.added))
    weighted = linear * root[:, None]
    inverse = invert(np.matmul(weighted, weighted.transpose(0, 2, 1)))
    theta = np.matmul(inverse, np.matmul(weighted, (root * w.data)[:, :, None]))[:, :, 0]
    residual = root * w.data - np.matmul(theta[:, None], weighted)[:, 0]
    of_ball = (theta[:, :1] * root)[:, None]
    place = np.stack([-by[1], -by[2], by[3]], axis=1) * of_ball
    return _Equations(by[0], np.concatenate([place, weighted], axis=1), shared * of_ball, root, residual, theta)


def _at_rest(w: _Window, balls: BallFits, along: Float, optics: Optics, noise: NoiseModel) -> tuple[_State, Float]:
    """Fit balls drawn by a known spot; with what they leave of a pixel."""
    s, left = _start(balls, w, along), np.ones(len(balls.depth))
    for _ in range(_LAST_STEPS):
        e = _equations(w, s, optics, noise)
        left = _left(w, e)
        s = _moved(s, e, along, _by_own(e, invert(np.matmul(e.own, e.own.transpose(0, 2, 1)))))
    return s, left


def _fitted(w: _Window, s: _State, steps: int, optics: Optics, noise: NoiseModel, radius: float) -> tuple[_State, Float]:
    """Fit balls and the spot that draws them; with what they leave of a pixel."""
    left = np.ones(len(s.radius))
    for _ in range(steps):
        e = _equations(w, s, optics, noise)
        own, shared, residual = e.own, e.shared, e.residual
        left = _left(w, e)
        say = 1 / np.maximum(left, 1.0)
        inverse = invert(np.matmul(own, own.transpose(0, 2, 1)))
        of_own = np.matmul(inverse, np.matmul(own, shared.transpose(0, 2, 1)))
        rest = shared - np.matmul(of_own.transpose(0, 2, 1), own)
        normal = np.einsum("n,nip,njp->ij", say, rest, rest)
        right = np.einsum("n,nip,np->i", say, rest, residual)
        normal += 1e-3 * np.diag(np.diag(normal)) + 1e-9 * np.eye(4)
        change = np.linalg.solve(normal, right)
        change *= min(1.0, _MOST_STEP_PX / max(float(np.abs(change).max()), 1e-9))
        along = s.along + change
        along[3] = np.clip(along[3], -0.9, 0.9)
        along[:3] *= min(1.0, _REACH * radius / float(np.hypot(np.hypot(*along[:2]), along[2])))
        s = _moved(s, e, along, _by_own(e, inverse) - of_own @ change)
    return s, left


def _left(w: _Window, e: _Equations) -> Float:
    return np.asarray(np.square(e.residual).sum(axis=1) / np.maximum(w.valid.sum(axis=1), 1))


def _by_own(e: _Equations, inverse: Float) -> Float:
    """Changes (n, 10) of what is each ball's own, the spot staying as it is."""
    return np.asarray(np.matmul(inverse, np.matmul(e.own, e.residual[:, :, None]))[:, :, 0])


def _moved(s: _State, e: _Equations, along: Float, by_own: Float) -> _State:
    by_own = by_own * np.minimum(1.0, _MOST_STEP_PX / np.maximum(np.abs(by_own[:, :3]).max(axis=1), 1e-9))[:, None]
    return _State(along, s.local + by_own[:, :2], np.clip(s.radius + by_own[:, 2], *RADIUS_PX), e.linear)


def _table(w: _Window, s: _State, odd: BallFits, optics: Optics, noise: NoiseModel) -> tuple[BallFits, Float]:
    """Return the fits, and what of the covariances of their centres is of what is not known of the spot."""
    e = _equations(w, s, optics, noise)
    weighted, shared, root, residual = e.own, e.shared, e.root, e.residual
    n, side, depth = len(e.value), 2 * w.half + 1, e.linear[:, 0]
    estimator = np.matmul(invert(np.matmul(weighted, weighted.transpose(0, 2, 1))), weighted)
    of_linear = weighted[:, 3:]
    alone = np.matmul(invert(np.matmul(of_linear, of_linear.transpose(0, 2, 1)))[:, :1], of_linear)
    scatter = influence_covariance(np.concatenate([estimator[:, :4], alone], axis=1).reshape(n, 5, side, side), noise.correlation)
    # what is not known of the spot moves all of them
    moved = np.matmul(estimator, shared.transpose(0, 2, 1))
    rest = shared - np.matmul(moved.transpose(0, 2, 1), weighted)
    unknown = invert(np.einsum("nip,njp->ij", rest, rest)[None])[0] * noise.correlation.sum()
    by_spot = np.einsum("nai,ij,nbj->nab", moved[:, :4], unknown, moved[:, :4])
    distance = np.hypot(w.cols - s.local[:, :1], w.rows - s.local[:, 1:])
    core: Bool = distance < (s.radius + optics.sigma_px)[:, None] + spot_of(s.along).reach_px
    square, weight = residual**2, root**2
    seen = (core * w.valid).sum(axis=1)
    counted = np.maximum(seen, 1.0)
    bare = np.where(root > 0, residual / np.where(root > 0, root, 1.0), 0.0)
    raised = weight * (bare + depth[:, None] * e.value) ** 2
    ring, under = uneven(bare, weight, s.local, side, ~core), uneven_white(bare, weight, s.local, side, core, noise)
    fits = replace(
        odd,
        position_px=s.local + w.corner,
        radius_px=s.radius,
        depth=depth,
        covariance=scatter[:, :4, :4],
        chi2_core=(square * core).sum(axis=1) / counted,
        chi2_ring=ring,
        chi2_uneven=under,
        explained=1 - (square * core).sum(axis=1) / np.maximum((raised * core).sum(axis=1), 1e-12),
        valid_fraction=seen / np.maximum(core.sum(axis=1), 1),
        window_fraction=w.valid.mean(axis=1),
        log_likelihood=-0.5 * square.sum(axis=1),
        background=(e.linear[:, 1:] @ w.surface)[np.arange(n), distance.argmin(axis=1)],
        significance=np.abs(depth) / np.sqrt(np.maximum(scatter[:, 4, 4], 1e-30)),
        n_core=counted,
        converged=np.ones(n, bool),
    )
    return fits, by_spot[:, :2, :2]


def with_spot(others: Images | None, balls: BallFits, spot: Spot | None, optics: Optics) -> Images | None:
    """Return what makes the images of these balls beside those of ``others``, at pixels (cols, rows)."""
    if spot is None:
        return others
    reach = balls.radius_px + 4 * optics.sigma_px + spot.reach_px

    def images(cols: Float, rows: Float) -> Float:
        total = np.zeros(cols.shape) if others is None else others(cols, rows)
        low, high = np.array([cols.min(), rows.min()]), np.array([cols.max(), rows.max()])
        at = balls.position_px
        for k in np.flatnonzero(((at > low - reach[:, None]) & (at < high + reach[:, None])).all(axis=1)):
            dx, dy = (axis.reshape(1, -1) - middle for axis, middle in zip((cols, rows), at[k], strict=True))
            total = total + balls.depth[k] * shapes_of(optics, spot, dx, dy, balls.radius_px[[k]])[0].reshape(cols.shape)
        return np.asarray(total)

    return images
