"""What was found on a film as one table, in film order, with flags and with all that is known of the errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import EDGE, height_of
from rsa_vision.detect.balls.find import CHANCE, DOUBTFUL, MISFIT, misfit
from rsa_vision.detect.balls.fits import BallFits, radii
from rsa_vision.detect.balls.optics import CAP, OF_CUT_OFF
from rsa_vision.detect.balls.unlike import COMPANY, of_odd_size, too_deep, too_pale
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.tiles import QUANTISATION
from rsa_vision.detect.marks.resolve import doubt_of_number
from rsa_vision.detect.marks.settle import STRUCTURE
from rsa_vision.detect.models.needles import NeedleFit, wrapped
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.arms import badly_placed, lone_tees, meet_others, perhaps_arms
from rsa_vision.detect.needles.fits import LINE_PX, excess_of, significant_misfit
from rsa_vision.detect.needles.pointed import LEAST_OF_A_KIND
from rsa_vision.detect.needles.states import LEAST_TAPER
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Bool, Float, MarkerImages

EXACT_PX = 0.002  # error of a centre without any noise: what areas of pixels and rims of balls are rounded to, here and in other programs
WHOLE, CUT_OFF = 0.999, 0.8  # part of the pixels under a ball
NEEDLES_ALIKE = 0.12  # of the logarithms of their half widths, as magnification, slant and film curve make them
_BLURRED = 2.0  # blur widths to which an image goes beyond its ball
_BLUNT = 1.01 * LEAST_TAPER  # needles that are no more pointed than a fit lets them be have no tip
# points over half their width, of what has none: any, and tees that leave so much of their depth, as strokes of letters do that meet
_RIGHT_ANGLE, _SHORT_POINT, _OF_STROKES = 1.0, 2.0, 0.02
_SEVERAL = 5  # tees that tell of all
_LOST = 0.3  # of the radius: larger standard deviations are of what lies beside an image, which is hardly told from it
_SOMEWHERE = 0.1  # of the squared radius: variance of a centre whose image the model does not describe
_SLIGHT = 0.02  # of the depth of a ball: structure around it that is no edge, however little noise there is
_SEEN = 0.5  # of a doubtful misfit, that noise makes seldom
_UNLIKE = 2.0  # times the misfit that is usual on the film
_STEEPER = 10.0  # times the answer to light beside a ball, where film under it gives that: beside it its curve has come to its flat end
_DOWN = np.linspace(0.0, 1.0, 11)  # the values under a ball, in units of its depth
_ROOM = 2.0  # standard deviations: nearer to an end of the range the mean of what is left of the noise is not that of the film


def what_is_left(balls: BallFits, usual: float, sigma_px: float, noise: NoiseModel) -> tuple[Float, Bool]:
    """Return the misfit of each ball, and which are not described well."""
    under = replace(balls, chi2_core=balls.chi2_core / max(usual, 1.0))  # noise that all balls have under them is no misfit of one
    left = misfit(under, noise, CHANCE)
    specks = balls.radius_px <= radii(sigma_px)[0]  # as small as a fit may be: how small they are is not known, nor what they are
    # what all of a film leave is an error of the model, which spares their middles; what is left of two in one comes on top of that
    least = np.sqrt(CHANCE * noise.scatter(balls.n_core) * noise.variance_at(balls.background)) / np.maximum(np.abs(balls.depth), 1e-9)
    seen = least < _SEEN * DOUBTFUL * MISFIT  # on fainter ones noise hides it
    told = left[seen] if np.count_nonzero(seen) >= COMPANY else left
    most = max(DOUBTFUL * MISFIT, _UNLIKE * float(np.median(told))) if len(told) >= COMPANY else DOUBTFUL * MISFIT
    beside = np.sqrt(np.maximum(balls.chi2_ring - 1, 0.0) * noise.variance_at(balls.background)) / np.maximum(np.abs(balls.depth), 1e-9)
    return left, (left > most) | ((balls.chi2_ring > EDGE) & (beside > _SLIGHT)) | specks


def table_of(
    film: NDArray[Any],
    bits: int,
    balls: BallFits,
    usual: float,
    ratio: Float,
    added: Float,
    touching: Bool,
    poor_ball: Bool,
    doubtful: Bool,
    needles: list[NeedleFit],
    junctions: Float,
    optics: Optics,
    noise: NoiseModel,
) -> tuple[MarkerImages, float]:
    """Put balls and needles into one table, row by row of the film, with flags.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int
    balls : BallFits
    usual : float
        Variance of the noise under balls, in units of that beside them.
    ratio : ndarray of shape (n,)
        Squared errors by their surroundings, as :func:`rsa_vision.detect.marks.settle.settle` tells.
    added : ndarray of shape (n + m, 2, 2)
        Covariances of balls and needles, px^2, that no noise multiplies.
    touching : ndarray of bool, shape (n + m,)
        Balls with something as dense beside them, and needles of which one hides a part.
    poor_ball, doubtful : ndarray of bool, shape (n,)
        Balls that the model does not describe; that may belong to the texture of the film.
    needles : list of NeedleFit
    junctions : ndarray of shape (k, 5)
        Of their polarity, as of :func:`rsa_vision.detect.search.junctions.find_junctions`.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    images : MarkerImages
    evidence : float
        For marks of this polarity.
    """
    full = float(2**bits - 1)
    n, m = len(balls.depth), len(needles)
    position = np.concatenate([balls.position_px, np.array([t.position_px for t in needles]).reshape(-1, 2)])
    # a model that leaves more than the noise has errors of its own: they widen the statement, once they are significant
    left = balls.chi2_uneven / usual
    excess = np.where(left > 1 + CHANCE * noise.scatter(balls.n_core), left, 1.0)
    # structure around a ball that its background does not hold goes on under it
    excess = np.maximum(excess, np.where(balls.chi2_ring > STRUCTURE, balls.chi2_ring, 0.0)) * ratio
    covariance = np.concatenate(
        [
            balls.covariance[:, :2, :2] * excess[:, None, None],
            np.array([t.covariance_px2 * excess_of(t, noise) for t in needles]).reshape(-1, 2, 2),
        ]
    )
    covariance += added
    radius = np.concatenate([balls.radius_px, [t.shape.half_width_px for t in needles]])
    depth = np.abs(np.concatenate([balls.depth, [t.depth for t in needles]]))
    background = np.concatenate([balls.background, [t.background for t in needles]])
    flags = np.zeros(n + m, np.int64)
    low, high = _extent(balls, needles, optics.sigma_px)
    edge = ((low < 0) | (high > np.array(film.shape[::-1]) - 1)).any(axis=1)
    flags[edge] |= MarkerFlag.EDGE
    valid = np.concatenate([balls.valid_fraction, [t.valid_fraction for t in needles]])
    for k in np.flatnonzero((valid < WHOLE) & ~edge):  # else something lies over it that is left out of the fit
        flags[k] |= MarkerFlag.SATURATED if _at_an_end(film, low[k], high[k], noise) else MarkerFlag.CLIPPED
    flags[valid < CUT_OFF] |= MarkerFlag.CLIPPED
    flat = _film_is_flat(balls, noise)
    flags[:n][flat] |= MarkerFlag.SATURATED
    short = _by_noise_under(balls.rows(flat), optics.sigma_px, noise) - np.linalg.eigvalsh(covariance[:n][flat])[:, 0]
    covariance[:n][flat] += np.maximum(short, 0.0)[:, None, None] * np.eye(2)
    flags[n:][[_noise_is_cut_off(t, noise) for t in needles]] |= MarkerFlag.SATURATED | MarkerFlag.CLIPPED
    flags[touching] |= MarkerFlag.OVERLAP
    arms = np.array([len(t.angles) for t in needles])
    for kind in (np.flatnonzero(arms == count) + n for count in (1, 3)):
        flags[kind] |= MarkerFlag.UNLIKE * of_odd_size(radius[kind], np.zeros(len(kind)), NEEDLES_ALIKE)
    snr = depth / np.sqrt(noise.variance_at(background))
    flags[n:][(arms == 3) & badly_placed(covariance[n:], radius[n:], snr[n:])] |= MarkerFlag.UNLIKE
    flags[n:][perhaps_arms(needles, junctions) | meet_others(film, needles) | (radius[n:] <= LINE_PX)] |= MarkerFlag.UNLIKE
    misfit_of = np.array([significant_misfit(t, noise) for t in needles])
    point = np.array([t.shape.taper * t.shape.length_px / t.shape.half_width_px for t in needles])
    blunt = np.array([t.shape.taper <= _BLUNT for t in needles], bool) | (point < _RIGHT_ANGLE)
    flags[n:][blunt | ((arms == 3) & (point < _SHORT_POINT) & (misfit_of > _OF_STROKES))] |= MarkerFlag.UNLIKE
    poor = np.concatenate([poor_ball, misfit_of > DOUBTFUL * MISFIT])
    if np.count_nonzero(arms == 3) >= _SEVERAL and poor[n:][arms == 3].mean() > 0.5:  # what most of them are not, none is for sure
        flags[n:][arms == 3] |= MarkerFlag.UNLIKE
    if n >= COMPANY:  # among balls a pin or two are more likely ends of rods, and a tee or two are letters of lead
        few = np.count_nonzero(arms == 1) < LEAST_OF_A_KIND
        flags[n:][((arms == 1) & few) | lone_tees(needles, ~poor[n:])] |= MarkerFlag.UNLIKE
    unknown = ~np.isfinite(covariance).all(axis=(1, 2))
    poor |= unknown
    covariance[unknown] = 0.0
    flags[poor] |= MarkerFlag.POOR_FIT
    # what the model does not describe may be two marks in one: its centre is only somewhere in it
    covariance[poor] += (_SOMEWHERE * radius[poor] ** 2)[:, None, None] * np.eye(2)
    # whatever lies around it, what was found of a ball lies under its image: evenly spread over a disc at worst
    most = 0.25 * (balls.radius_px + optics.sigma_px) ** 2
    covariance[:n] *= np.minimum(1.0, most / np.linalg.eigvalsh(covariance[:n])[:, -1])[:, None, None]
    covariance[:n] += EXACT_PX**2 * np.eye(2) + doubt_of_number(balls)
    lost = np.linalg.eigvalsh(covariance[:n])[:, -1] > (_LOST * balls.radius_px) ** 2
    flags[:n][lost] |= MarkerFlag.POOR_FIT
    flags[n:][np.linalg.eigvalsh(covariance[n:])[:, -1] > (2 * radius[n:]) ** 2] |= MarkerFlag.POOR_FIT
    pale = too_pale(depth[:n], balls.covariance[:, 3, 3], balls.background, flags[:n] == 0)
    pale |= too_deep(depth[:n], balls.covariance[:, 3, 3], balls.background, flags[:n] & ~MarkerFlag.OVERLAP == 0)
    marks = np.flatnonzero(~pale & ~poor[:n])  # what is none is no company for another's odd size
    odd = marks[of_odd_size(balls.radius_px[marks], balls.covariance[marks, 2, 2])]
    flags[np.append(np.flatnonzero(pale | doubtful), odd)] |= MarkerFlag.UNLIKE
    angle = np.concatenate([np.full(n, np.nan), [np.rad2deg(wrapped(t.angles[0])) for t in needles]])
    shape = np.array(["ball"] * n + [{1: "pin", 3: "tee"}[len(t.angles)] for t in needles], dtype="U4")
    table = MarkerImages(position, covariance, shape, radius, angle, depth / full, background / full, snr, flags)
    # of what is small against the blur hardly any of its depth is seen; texture has specks as high as marks, and more that are none
    over_structure = height_of(balls, optics.sigma_px) / np.sqrt(np.clip(balls.chi2_ring, 1.0, EDGE))
    high = np.concatenate([over_structure, depth[n:]]) / np.sqrt(noise.variance_at(background))
    doubted = poor | (flags & MarkerFlag.UNLIKE > 0)
    trust = np.where(doubted, 0.0, np.interp(valid, (CUT_OFF, WHOLE), (OF_CUT_OFF, 1.0)))
    evidence = float(trust @ np.minimum(high, CAP)) * np.count_nonzero(~doubted) / max(n + m, 1)
    return table.rows(np.lexsort((position[:, 0], np.rint(position[:, 1])))), evidence


def _extent(balls: BallFits, needles: list[NeedleFit], sigma_px: float) -> tuple[Float, Float]:
    """Least and largest (col, row) of the images, shape (n + m, 2) each."""
    half = balls.radius_px[:, None] + max(1.0, _BLURRED * sigma_px)
    low, high = [*(balls.position_px - half)], [*(balls.position_px + half)]
    for fit in needles:
        ends = fit.position_px + fit.shape.length_px * np.stack([np.cos(fit.angles), -np.sin(fit.angles)], axis=1)
        points = np.concatenate([fit.position_px[None], ends])
        low.append(points.min(axis=0) - fit.shape.half_width_px)
        high.append(points.max(axis=0) + fit.shape.half_width_px)
    return np.array(low).reshape(-1, 2), np.array(high).reshape(-1, 2)


def _at_an_end(film: NDArray[Any], low: Float, high: Float, noise: NoiseModel) -> bool:
    """Say whether pixels between these corners are at an end of the range."""
    (left, top), (right, bottom) = np.floor(low).astype(int), np.ceil(high).astype(int) + 1
    values = film[max(top, 0) : bottom, max(left, 0) : right]
    return bool(((values <= noise.floor) | (values >= noise.ceiling)).any())


def _film_is_flat(balls: BallFits, noise: NoiseModel) -> Bool:
    """Say beside which balls the film is at the flat end of its curve, as in black air: it hides their rims and changes of the light.

    It hides the noise as well, which is seen under them.
    """
    beside = np.maximum(noise.variance_at(balls.background) - QUANTISATION, QUANTISATION)
    return np.asarray(_noise_under(balls, noise).max(axis=1) - QUANTISATION > _STEEPER**2 * beside)


def _noise_under(balls: BallFits, noise: NoiseModel) -> Float:
    """Return the variance at values from the background to the middle of each ball, shape (n, k)."""
    return noise.variance_at(balls.background[:, None] + balls.depth[:, None] * _DOWN)


def _by_noise_under(balls: BallFits, sigma_px: float, noise: NoiseModel) -> Float:
    """Return the variance of one coordinate of centres, px^2, that a rim tells through the noise there is under the ball, shape (n,).

    What seems free of noise outside of it is no rim where the film hides that. A rim of depth d, blurred by a Gaussian, tells of a shift
    d^2 / (2 sqrt(pi) sigma) over the noise for each pixel of its length, of which a coordinate has half.
    """
    variance = balls.chi2_core * _noise_under(balls, noise).mean(axis=1)
    return np.asarray(2 * sigma_px * variance / (np.sqrt(np.pi) * balls.radius_px * balls.depth**2))


def _noise_is_cut_off(fit: NeedleFit, noise: NoiseModel) -> bool:
    """Say whether an end of the range cuts off the noise beside a needle, into which the image of its tip fades out.

    The middle of a ball is where it was, however much its rims have suffered.
    """
    room = min(fit.background - noise.floor, noise.ceiling - fit.background)
    return bool(room < _ROOM * np.sqrt(noise.variance_at(np.array([fit.background]))[0]))
