"""A ball on a pin or on an arm of a tee: neither is one alone, together they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.balls.find import plausible
from rsa_vision.detect.balls.fits import BallFits, ball_image
from rsa_vision.detect.film.least_squares import polynomial
from rsa_vision.detect.film.noise import NoiseModel, influence_covariance
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.models.needles import NeedleFit, arm_images
from rsa_vision.detect.models.painted import paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.detect.neighbours.laid_on import fit_one_over
from rsa_vision.types import Float

_ROUNDS = 5
_ROUGHLY = 2.5  # ratio to the usual radius and depth, beyond which no more rounds are worth it after these
_SOUGHT = 1  # rounds after which the ball is sought anew
_STEP_PX = 0.01  # for differences of the ball's image


def part(
    film: NDArray[Any],
    needle: NeedleFit,
    balls: BallFits,
    optics: Optics,
    needle_optics: Optics,
    noise: NoiseModel,
    beside: Images,
    is_one: Callable[[NeedleFit], bool],
    start_px: Float | None = None,
) -> tuple[NeedleFit, BallFits] | None:
    """Take a pin or a tee and a ball on it apart.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needle : NeedleFit
        That does not fit well enough alone.
    balls : BallFits
        Those of the film that stand alone: what the ball has to be like.
    optics, needle_optics : Optics
    noise : NoiseModel
    beside : callable
        Images of all other marks at pixels (cols, rows).
    is_one : callable
        Says whether a fit looks like a pin, or a tee.
    start_px : ndarray of shape (2,), optional
        Where the ball is; else it is looked for.

    Returns
    -------
    (NeedleFit, BallFits) or None
        None where the two do not explain it.
    """
    if len(balls.depth) == 0:
        return None
    radius, depth = float(np.median(balls.radius_px)), float(np.median(balls.depth))

    def without_needle(cols: Float, rows: Float) -> Float:
        total: Float = beside(cols, rows) + arms(cols, rows)
        return total

    def without_ball(cols: Float, rows: Float) -> Float:
        total: Float = beside(cols, rows) + shown(cols, rows)
        return total

    def fitted(at_px: Float, size: float) -> tuple[BallFits, Float, Images]:
        return fit_one_over(film, at_px, size, without_needle, optics, noise, arms)

    def sought() -> tuple[BallFits, Float, Images]:
        return fitted(_brightest_rest(film, needle, np.sign(depth), without_needle) if start_px is None else start_px, radius)

    arms = paint([(needle, needle_optics)])
    ball, doubt, shown = sought()
    for step in range(_ROUNDS):
        needle = fit_crossing(film, [needle], needle_optics, noise, others=without_ball, steps=6)[0]
        arms = paint([(needle, needle_optics)])
        # what a ball has bent is no good guide to it
        ball, doubt, shown = sought() if step < _SOUGHT else fitted(ball.position_px[0], float(ball.radius_px[0]))
        if step == _SOUGHT and not (abs(np.log(ball.radius_px[0] / radius)) < np.log(_ROUGHLY) and ball.depth[0] / depth > 1 / _ROUGHLY):
            return None
    alike = abs(np.log(ball.radius_px[0] / radius)) < 0.25 and 0.4 < ball.depth[0] / depth < 2.5
    if not (alike and plausible(ball, noise).all() and is_one(needle)):
        return None
    of_needle, of_ball = _joint_covariance(film, needle, ball, optics, needle_optics, noise)
    excess = max(1.0, needle.chi2_core, float(ball.chi2_core[0]))
    of_ball = excess * of_ball
    of_ball[:2, :2] += doubt
    return replace(needle, covariance_px2=excess * of_needle), replace(ball, covariance=of_ball[None])


def _joint_covariance(
    film: NDArray[Any], needle: NeedleFit, ball: BallFits, optics: Optics, needle_optics: Optics, noise: NoiseModel
) -> tuple[Float, Float]:
    """Covariances of the tip (col, row) and of the ball (col, row, radius, depth) when both are free at once."""
    half = int(np.ceil(1.2 * needle.shape.length_px + np.abs(needle.position_px - ball.position_px[0]).max() + 6))
    patch = cut(film, needle.position_px[None], half, noise)
    rows, cols = np.mgrid[0 : patch.size, 0 : patch.size].reshape(2, -1).astype(np.float64) + patch.corner_px[0][::-1, None]
    dx, dy = cols - needle.position_px[0], rows - needle.position_px[1]
    arms, *moves, turn = arm_images(dx, dy, needle.angles, needle.shape, needle_optics)
    (x, y), radius, depth = ball.position_px[0], ball.radius_px[0], ball.depth[0]

    def image(x: float, y: float, radius: float) -> Float:
        at = ((cols - x)[None], (rows - y)[None])
        value: Float = ball_image(*at, np.array([radius]), optics)[0]
        return value

    h = _STEP_PX
    by_ball = [image(x + h, y, radius) - image(x - h, y, radius), image(x, y + h, radius) - image(x, y - h, radius)]
    by_ball += [image(x, y, radius + h) - image(x, y, radius - h)]
    columns = [needle.depths @ m for m in moves] + [needle.depths @ turn, arms.sum(0)]
    n_needle = len(columns)
    columns += [depth * b / (2 * h) for b in by_ball] + [image(x, y, radius)]
    near = (np.hypot(dx, dy) < half) & patch.valid[0].ravel()
    jac = np.column_stack([*columns, polynomial(half, dx, dy)]) * near[:, None]
    sd = np.sqrt(noise.variance_at(patch.values[0].ravel()))
    weighted = jac / sd[:, None]
    covariance = np.linalg.pinv(weighted.T @ weighted, hermitian=True)
    wanted = [0, 1, n_needle, n_needle + 1, n_needle + 2, n_needle + 3]
    whole = influence_covariance((covariance[wanted] @ weighted.T).reshape(6, patch.size, patch.size), noise.correlation)
    return whole[:2, :2], whole[2:, 2:]


def _brightest_rest(film: NDArray[Any], needle: NeedleFit, sign: float, model: Callable[[Float, Float], Float]) -> Float:
    """Place (col, row) near a needle where most is left over once this is taken away."""
    reach = int(np.ceil(needle.shape.length_px + 8))
    col, row = np.rint(needle.position_px).astype(np.intp)
    top, left = max(row - reach, 0), max(col - reach, 0)
    window = film[top : row + reach + 1, left : col + reach + 1].astype(np.float64)
    rows, cols = np.mgrid[top : top + window.shape[0], left : left + window.shape[1]].astype(np.float64)
    rest = sign * gaussian_filter(window - model(cols, rows), 2.0)
    best = np.unravel_index(int(rest.argmax()), rest.shape)
    return np.array([cols[best], rows[best]])
