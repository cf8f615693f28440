"""Which candidates are balls: fits with the film's own optics, neighbours fitted together, one decision for all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rsa_vision.detect.balls import BallFits, ball_image, join
from rsa_vision.detect.candidates import Candidates
from rsa_vision.detect.find import Optics, distinct, fit_at, plausible, significance
from rsa_vision.detect.groups import fit_group
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.types import Bool, Float

Background = Callable[[Float, Float], Float]
"""Images of the tees at pixels (cols, rows), in film values."""

TOUCH = 3.0  # blur widths between two rims within which one ball disturbs the fit of the other
_MOST_IN_GROUP = 5
_LIKE = 0.35  # logarithm of the radius, against the film's median


def resolve_balls(
    film: NDArray[Any], candidates: Candidates, seeds: BallFits, optics: Optics, noise: NoiseModel, tees: Background | None
) -> tuple[BallFits, Bool]:
    """Fit all balls of a film.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
        Of the markers' polarity.
    seeds : BallFits
        First looks of that polarity.
    optics : Optics
    noise : NoiseModel
    tees : callable, optional
        Images of the tees, to be subtracted.

    Returns
    -------
    fits : BallFits
        Those that are balls.
    touching : ndarray of bool, shape (n,)
        Fitted together with a neighbour.
    """
    others = None if tees is None else lambda _i, cols, rows: tees(cols, rows)
    single = distinct(fit_at(film, seeds.position_px, seeds.radius_px, optics, noise, others, quick=True), noise) if len(seeds.depth) else seeds
    good = single.rows(plausible(single, noise, slack=1.5))
    groups, fits = _groups(good, optics), []
    tried = _unexplained_pairs(candidates, good, optics)
    for members in tried:
        position, radius = members[:, :2], members[:, 2]
        pair = fit_group(film, position, radius, optics.sigma_px, optics.mu_px, noise, tees)
        fits.append(pair.rows(_like(pair, good)))
    alone = [g[0] for g in groups if len(g) == 1]
    if alone:
        index = np.array(alone)
        fits.append(fit_at(film, good.position_px[index], good.radius_px[index], optics, noise, others))
    for g in groups:
        if 1 < len(g) <= _MOST_IN_GROUP:
            index = np.array(g)
            fits.append(fit_group(film, good.position_px[index], good.radius_px[index], optics.sigma_px, optics.mu_px, noise, tees))
        elif len(g) > _MOST_IN_GROUP:
            fits.append(_peel(film, good.rows(np.array(g)), optics, noise, tees))
    if not fits:
        return single.rows(np.zeros(len(single.depth), bool)), np.zeros(0, bool)
    found = join(fits)
    found = found.rows(plausible(found, noise) & inside(found, film))
    found = distinct(found, noise)
    near = [len(g) > 1 for g in _groups(found, optics)]
    touching = np.zeros(len(found.depth), bool)
    for g, several in zip(_groups(found, optics), near, strict=True):
        touching[g] = several
    return found, touching


def _like(fits: BallFits, known: BallFits) -> Bool:
    """Say which balls of a group are like those of the film that stand alone: two blobs can explain much that is none."""
    size = np.abs(np.log(fits.radius_px / np.median(known.radius_px))) < _LIKE
    return np.asarray(size & (np.abs(fits.depth) > 0.4 * np.median(np.abs(known.depth))))


def inside(fits: BallFits, film: NDArray[Any]) -> Bool:
    """Say which centres lie on the film."""
    col, row = fits.position_px.T
    return np.asarray((col > -0.5) & (row > -0.5) & (col < film.shape[1] - 0.5) & (row < film.shape[0] - 0.5))


def _groups(fits: BallFits, optics: Optics) -> list[list[int]]:
    """Sets of balls whose images touch."""
    n = len(fits.depth)
    if n == 0:
        return []
    gap = np.hypot(*(fits.position_px[:, None] - fits.position_px[None]).transpose(2, 0, 1))
    touch = gap < fits.radius_px[:, None] + fits.radius_px[None] + TOUCH * optics.sigma_px
    _, label = connected_components(csr_array(touch), directed=False)
    return [np.nonzero(label == k)[0].tolist() for k in range(label.max() + 1)]


def _unexplained_pairs(candidates: Candidates, good: BallFits, optics: Optics) -> list[Float]:
    """Starts (col, row, radius) of groups that single fits did not explain: peaks of the finest filter that have company."""
    if len(good.depth) == 0:
        return []
    typical = float(np.median(good.radius_px))
    fine = np.nonzero(candidates.radius_px <= 3.0)[0] if typical < 6 else np.arange(len(candidates.strength))
    peaks = candidates.position_px[fine]
    if len(peaks) == 0:
        return []
    free = np.min(np.hypot(*(peaks[:, None] - good.position_px[None]).transpose(2, 0, 1)), axis=1) > 0.6 * typical
    out = []
    used = np.zeros(len(peaks), bool)
    for i in np.nonzero(free)[0]:
        if used[i]:
            continue
        gap = np.hypot(*(peaks - peaks[i]).T)
        company = np.nonzero((gap < 2 * typical + TOUCH * optics.sigma_px) & (gap > 0.6 * typical) & free & ~used)[0]
        company = company[np.argsort(gap[company])][: _MOST_IN_GROUP - 1]
        known = good.position_px[np.hypot(*(good.position_px - peaks[i]).T) < 2 * typical + TOUCH * optics.sigma_px]
        if len(company) + len(known) == 0 or len(company) > 3:
            continue
        starts = np.concatenate([peaks[[i]], peaks[company], known])[:_MOST_IN_GROUP]
        used[[i, *company]] = True
        out.append(np.column_stack([starts, np.full(len(starts), typical)]))
    return out[:200]


def _peel(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel, tees: Background | None) -> BallFits:
    """Fit a large crowd one by one, each with the images of all others subtracted, until they settle."""
    for _ in range(4):
        last = fits

        def others(i: int, cols: Float, rows: Float, last: BallFits = last) -> Float:
            total = np.zeros_like(cols) if tees is None else tees(cols, rows)
            for j in range(len(last.depth)):
                dx, dy = cols - last.position_px[j, 0], rows - last.position_px[j, 1]
                if j != i and min(np.abs(dx).min(), np.abs(dy).min()) < 20:
                    image = ball_image(dx.reshape(1, -1), dy.reshape(1, -1), last.radius_px[[j]], optics.sigma_px, optics.mu_px)
                    total = total + last.depth[j] * image.reshape(cols.shape)
            return total

        fits = fit_at(film, fits.position_px, fits.radius_px, optics, noise, others)
    return fits


def strong_enough(fits: BallFits, limit: float) -> Bool:
    """Say which balls noise alone would not make."""
    return significance(fits) > limit
