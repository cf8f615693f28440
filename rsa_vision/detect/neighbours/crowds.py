"""Crowds: what stands out as far as a ball, is larger, and nothing explains yet, tried as two to four of the film's balls."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.balls.decide import LEAST_KNOWN, look_clear
from rsa_vision.detect.balls.find import CHANCE, DOUBTFUL, MISFIT, fit_at, misfit, plausible
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within, gaps
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images, for_all
from rsa_vision.detect.neighbours.beside import all_but, deep_at, lapping_balls
from rsa_vision.detect.neighbours.blobs import LEAST_APART, STRETCH, long_axis
from rsa_vision.detect.neighbours.group_images import images_in, window_around
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool, Float

_MOST = 4  # balls of a crowd
_VAIN = 40  # attempts of a film that may fail; what one ball explains best goes first
_EXPLAINED = 0.6  # least that one ball explains of what a few make
_START, _SIZES = 1.4, (0.7, 3.5)  # radii of that ball, relative to the film's: to begin with, and those that count
_DEEP = 0.4  # least depth of a place, relative to the film's usual one
_HOPELESS, _LARGE = 2.0, 1.6  # times the misfit a ball may leave, and the usual radius: one ball more will not mend that
_AROUND = 4.0  # times the variance that is around balls of the film: more is a wire or an edge that goes on
_SURE = 3.0  # standard deviations
_TOUCH = 1.1  # sums of two radii, within which one of a crowd has a neighbour
_ROOM = 6.0  # blur widths between the rims of balls that stand alone
_DIFFER = 0.04  # of radii and of depths, by which balls of one size and beam do
_LEFT = 0.2  # of the misfit that a ball may leave, beyond what the film's do
_LINE = 0.61  # of the separation that the second moments suggest of two, where three are in a row


def resolve_crowds(
    film: NDArray[Any],
    candidates: Candidates,
    found: BallFits,
    optics: Optics,
    noise: NoiseModel,
    needles: Images | None,
) -> BallFits:
    """Explain what was left over by a few of the film's own balls.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
        Of the markers' polarity.
    found : BallFits
        Balls of the film.
    optics : Optics
    noise : NoiseModel
    needles : callable, optional
        Images of pins and tees, to be subtracted.

    Returns
    -------
    BallFits
        Those found, and the balls of crowds.
    """
    alone = ~np.isin(np.arange(len(found.depth)), lapping_balls(found, _ROOM * optics.sigma_px)[0])
    known = found.rows(look_clear(found, noise) & alone)
    if len(known.depth) < LEAST_KNOWN:
        return found
    radius, depth = float(np.median(known.radius_px)), float(np.median(known.depth))
    others = for_all(all_but(found, np.arange(0), optics, needles))
    place = candidates.position_px
    place = place[~are_within(place, found.position_px, found.radius_px + 0.6 * radius)]
    place = place[deep_at(film, place, radius, needles) > _DEEP * abs(depth)]
    if len(place) == 0:
        return found
    single = fit_at(film, place, np.full(len(place), _START * radius), optics, noise, others, quick=True)
    size = single.radius_px / radius
    worth = (size > _SIZES[0]) & (size < _SIZES[1]) & (single.explained > _EXPLAINED) & (np.sign(single.depth) == np.sign(depth))
    worth &= np.abs(single.depth) > _DEEP * abs(depth)
    single = single.rows(worth)
    single = single.rows(np.argsort(-single.explained))
    vain = np.zeros((0, 2))
    for i, at in enumerate(single.position_px):
        if len(vain) == _VAIN:
            break
        if (np.hypot(*(np.concatenate([vain, found.position_px]) - at).T) < radius).any():
            continue
        crowd = _crowd(film, single.rows([i]), known, optics, noise, all_but(found, np.arange(0), optics, needles))
        if crowd is None:
            vain = np.concatenate([vain, at[None]])
        else:
            found = _joined(film, found, crowd, optics, noise, needles)
    return found


def _joined(film: NDArray[Any], found: BallFits, crowd: BallFits, optics: Optics, noise: NoiseModel, needles: Images | None) -> BallFits:
    """Put a crowd to the balls found, fitted again together with those that it laps over."""
    near = are_within(found.position_px, crowd.position_px, crowd.radius_px, found.radius_px)
    if near.any():
        start = join([found.rows(near), crowd])
        others = all_but(found, np.flatnonzero(near), optics, needles)
        crowd = fit_group(film, start.position_px, start.radius_px, optics, noise, others)
        if not (plausible(crowd, noise) & (misfit(crowd, noise) < DOUBTFUL * MISFIT)).all():
            return found
    return join([found.rows(~near), crowd])


def _crowd(film: NDArray[Any], blob: BallFits, known: BallFits, optics: Optics, noise: NoiseModel, others: Images) -> BallFits | None:
    """Return the fewest balls that explain a blob."""
    radius, sign = float(np.median(known.radius_px)), float(np.sign(blob.depth[0]))

    def fit(start: Float) -> BallFits:
        return fit_group(film, start, np.full(len(start), radius), optics, noise, others)

    axis = long_axis(film, blob, sign)
    middle = blob.position_px
    before = [fit(middle + np.array([[-0.5], [0.5]]) * stretch * axis) for stretch in STRETCH]
    for count in range(2, _MOST + 1):
        best = min(before, key=lambda fits: float(misfit(fits, noise).max()))
        if _all_balls(best, known, noise):
            return best
        if count == _MOST or misfit(best, noise).max() > _HOPELESS * MISFIT or best.radius_px.max() > _LARGE * radius:
            return None
        before = [fit(np.concatenate([best.position_px, _most_left(film, best, radius, optics, noise, others)]))]
        if count == 2:
            before.append(fit(middle + np.array([[-_LINE], [0.0], [_LINE]]) * axis))
    return None


def _most_left(film: NDArray[Any], fits: BallFits, radius: float, optics: Optics, noise: NoiseModel, others: Images) -> Float:
    """Place, shape (1, 2), where one more ball would explain most of what these leave."""
    window = window_around(film, fits.position_px, fits.radius_px, optics.sigma_px, noise, others)
    local = fits.position_px - window.corner_px
    basis = images_in(window, window.surface, local, fits.radius_px, optics).linear
    left = window.left_by(basis, noise)[0] * window.valid * np.sign(fits.depth[0])
    smooth = gaussian_filter(left.reshape(window.size, window.size), 0.5 * radius).ravel()
    near = (np.hypot(window.cols - local[:, :1], window.rows - local[:, 1:]) < 2.5 * radius).any(axis=0)
    k = int(np.argmax(np.where(near, smooth, -np.inf)))
    return np.array([[window.cols[k], window.rows[k]]]) + window.corner_px


def _all_balls(fits: BallFits, known: BallFits, noise: NoiseModel) -> bool:
    """Say whether these are like the film's clear balls, each in size and depth, and explain what they do as closely."""
    gap = gaps(fits.position_px, fits.position_px) + 99.0 * np.eye(len(fits.depth))
    usual = float(np.median(known.chi2_core))
    more = fits.chi2_core - usual
    more = np.where(more > CHANCE * noise.scatter(fits.n_core) * usual, more, 0.0)
    left = np.sqrt(more * noise.variance_at(fits.background)) / np.maximum(np.abs(fits.depth), 1e-9)
    return bool(
        (left < _LEFT * MISFIT).all()
        and (np.sign(fits.depth) == np.sign(np.median(known.depth))).all()
        and gap.min() > LEAST_APART * fits.radius_px.min()
        and (gap < _TOUCH * (fits.radius_px[:, None] + fits.radius_px)).any(axis=1).all()
        and (fits.chi2_ring < _AROUND * max(float(np.median(known.chi2_ring)), 1.0)).all()
        and plausible(fits, noise).all()
        and _among(fits.radius_px, fits.covariance[:, 2, 2], known.radius_px, known.covariance[:, 2, 2]).all()
        and _among(fits.depth, fits.covariance[:, 3, 3], known.depth, known.covariance[:, 3, 3]).all()
    )


def _among(values: Float, variances: Float, known: Float, of_known: Float) -> Bool:
    """Say which values are as those of three of the known ones."""
    apart = np.abs(values[:, None] - known) / np.sqrt(variances[:, None] + of_known + (_DIFFER * known) ** 2)
    return np.asarray(np.sort(apart, axis=1)[:, LEAST_KNOWN - 1] < _SURE)
