"""Crowds: what stands out as far as a ball, is larger, and nothing explains yet, tried as two to four of the film's balls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.alike import true_spread
from rsa_vision.detect.balls import BallFits
from rsa_vision.detect.blobs import LEAST_APART, LEAST_GAIN, STRETCH, long_axis
from rsa_vision.detect.candidates import Candidates
from rsa_vision.detect.decide import LEAST_KNOWN, look_clear
from rsa_vision.detect.find import DOUBTFUL, MISFIT, fit_at, misfit, plausible
from rsa_vision.detect.groups import fit_group, images_in, window_around
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.detect.patches import weighted_least_squares
from rsa_vision.detect.profiles import Optics
from rsa_vision.types import Bool, Float

_MOST = 4  # balls of a crowd
_CROWDS = 100  # most of a film, those that stand out most
_EXPLAINED = 0.6  # least that one ball explains of what a few make
_SIZES = (0.7, 3.5)  # radii of that ball, relative to the film's
_DEEP = (0.4, 2.5)  # depths relative to the film's usual one, of balls, and the least of a place
_HOPELESS = 3.0  # times the misfit a ball may leave: one more ball than fitted will not mend that
_SURE = 3.0  # standard deviations
_LEAST_SPREAD = 0.05  # of the logarithms of radii
_LINE = 0.61  # of the separation that the second moments suggest of two, where three are in a row


def resolve_crowds(
    film: NDArray[Any], candidates: Candidates, found: BallFits, optics: Optics, noise: NoiseModel, beside: Callable[[Any], Any], deep: Any
) -> list[BallFits]:
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
    beside : callable
        ``beside()``: images of the known balls and tees, for the fits to subtract.
    deep : callable
        ``deep(places, radius)``: how far the film differs there from its surroundings.

    Returns
    -------
    list of BallFits
        One for each crowd.
    """
    known = found.rows(look_clear(found, noise))
    if len(known.depth) < LEAST_KNOWN:
        return []
    radius, depth = float(np.median(known.radius_px)), float(np.median(known.depth))
    place = candidates.position_px
    gap = np.hypot(*(place[:, None] - found.position_px[None]).transpose(2, 0, 1))
    place = place[(gap > found.radius_px + 0.6 * radius).all(axis=1)]
    place = place[deep(place, radius) > _DEEP[0] * abs(depth)]
    if len(place) == 0:
        return []
    others = beside()
    single = fit_at(film, place, np.full(len(place), 1.4 * radius), optics, noise, lambda _, c, r: (others(c, r), np.zeros(c.shape, bool)), quick=True)
    size = single.radius_px / radius
    worth = (size > _SIZES[0]) & (size < _SIZES[1]) & (single.explained > _EXPLAINED) & (np.sign(single.depth) == np.sign(depth))
    worth &= np.abs(single.depth) > _DEEP[0] * abs(depth)
    single = single.rows(worth)
    single = single.rows(np.argsort(-single.explained))
    out: list[BallFits] = []
    tried = np.zeros((0, 2))
    for i in range(len(single.depth)):
        if len(tried) >= _CROWDS:
            break
        at = single.position_px[[i]]
        if (np.hypot(*(np.concatenate([tried, *[c.position_px for c in out]]) - at).T) < radius).any():
            continue
        tried = np.concatenate([tried, at])
        crowd = _crowd(film, single.rows([i]), known, optics, noise, others)
        if crowd is not None:
            out.append(crowd)
    return out


def _crowd(film: NDArray[Any], blob: BallFits, known: BallFits, optics: Optics, noise: NoiseModel, others: Any) -> BallFits | None:
    """Return the fewest balls that explain a blob."""
    radius, sign = float(np.median(known.radius_px)), float(np.sign(blob.depth[0]))

    def fit(start: Float) -> BallFits:
        return fit_group(film, start, np.full(len(start), radius), optics.sigma_px, optics.mu_px, noise, others)

    axis = long_axis(film, blob, sign)
    middle = blob.position_px
    before = [fit(middle + np.array([[-0.5], [0.5]]) * stretch * axis) for stretch in STRETCH]
    for count in range(2, _MOST + 1):
        best = min(before, key=lambda fits: float(misfit(fits, noise).max()))
        if _all_balls(best, known, noise):
            return best
        if misfit(best, noise).min() > _HOPELESS * MISFIT or count == _MOST:
            return None
        before = [fit(np.concatenate([best.position_px, _most_left(film, best, radius, optics, noise, others)]))]
        if count == 2:
            before.append(fit(middle + np.array([[-_LINE], [0.0], [_LINE]]) * axis))
    return None


def _most_left(film: NDArray[Any], fits: BallFits, radius: float, optics: Optics, noise: NoiseModel, others: Any) -> Float:
    """Place, shape (1, 2), where one more ball would explain most of what these leave."""
    window = window_around(film, fits.position_px, fits.radius_px, optics.sigma_px, noise, others)
    local = fits.position_px - window.corner_px
    basis = images_in(window, window.surface, local, fits.radius_px, optics.sigma_px, optics.mu_px).linear
    data, weight = window.raw - window.neighbours, window.valid / noise.variance_at(window.raw)
    left = (data - basis @ weighted_least_squares(basis, weight, data, 1e-9)) * window.valid * np.sign(fits.depth[0])
    smooth = gaussian_filter(left.reshape(window.size, window.size), 0.5 * radius).ravel()
    near = (np.hypot(window.cols - local[:, :1], window.rows - local[:, 1:]) < 2.5 * radius).any(axis=0)
    k = int(np.argmax(np.where(near, smooth, -np.inf)))
    return np.array([[window.cols[k], window.rows[k]]]) + window.corner_px


def _all_balls(fits: BallFits, known: BallFits, noise: NoiseModel) -> bool:
    depth = np.abs(fits.depth) / np.median(np.abs(known.depth))
    gap = np.hypot(*(fits.position_px[:, None] - fits.position_px[None]).transpose(2, 0, 1)) + 99.0 * np.eye(len(depth))
    return bool(
        like_known(fits, known).all()
        and (np.sign(fits.depth) == np.sign(np.median(known.depth))).all()
        and ((depth > _DEEP[0]) & (depth < _DEEP[1])).all()
        and gap.min() > LEAST_APART * fits.radius_px.min()
        and (plausible(fits, noise) & (misfit(fits, noise) < DOUBTFUL * MISFIT)).all()
    )


def like_known(fits: BallFits, known: BallFits) -> Bool:
    """Say which balls are of a size that others of the film have, as far as sizes differ and are known."""
    log, variance = (np.log(f.radius_px) for f in (fits, known)), known.covariance[:, 2, 2] / known.radius_px**2
    mine, theirs = log
    _, spread, _ = true_spread(theirs, variance)
    own = fits.covariance[:, 2, 2] / fits.radius_px**2
    allowed = _SURE * np.sqrt(own + np.clip(spread, _LEAST_SPREAD, 0.15) ** 2)
    return np.asarray(np.abs(mine[:, None] - theirs).min(axis=1) < allowed)
