"""Peaks of a film that no known ball explains, where fits of several balls may begin."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import height_of
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.film.places import are_within, gaps
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import MOST_IN_GROUP, TOUCH, deep_at
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool, Float, Int

NECKS = 1.7  # of the radius, between balls in a row of which one does not touch another
_COMPANY, _COARSE = 3, 0.6  # peaks beside one that a group may start from; of the radius, from which they are a ball's own
# radius of two balls beside each other as one; of theirs and the blur, up to which what answers is a peak; part of their height; peaks
_OF_TWO, _PEAK, _HIGH, _MOST_PEAKS = 1.6, 2.0, 0.4, 100


def unexplained_pairs(
    film: NDArray[Any], candidates: Candidates, good: BallFits, like: BallFits, sized: bool, optics: Optics, beside: Images | None
) -> list[Float]:
    """Starts of groups, rows of (col, row, radius), at peaks off all known balls.

    ``like`` says what a ball is like on this film; ``sized``: and how large it is.
    """
    if len(good.depth) == 0:
        return []
    typical = float(np.median(like.radius_px))
    fine = np.nonzero(candidates.radius_px <= 3.0)[0] if typical < 6 else np.arange(len(candidates.strength))
    peaks = candidates.position_px[fine]
    if len(peaks) == 0:
        return []
    deep = deep_at(film, peaks, typical, beside) > 0.4 * np.median(np.abs(like.depth))
    fine, peaks = fine[deep], peaks[deep]
    if len(peaks) == 0:
        return []
    free = ~are_within(peaks, good.position_px, np.maximum(0.6 * typical, 0.9 * good.radius_px))
    out = []
    used = np.zeros(len(peaks), bool)
    for i in np.nonzero(free)[0]:
        if used[i]:
            continue
        gap = np.hypot(*(peaks - peaks[i]).T)
        own, touching = 0.6 * typical, 2 * typical + TOUCH * optics.sigma_px
        company = np.nonzero((gap < touching) & (gap > own) & free & ~used)[0]
        if len(company) < _COMPANY:
            company = _chain(peaks, np.append(i, company), free & ~used, own, NECKS * typical, touching)
        if sized and len(company) > _COMPANY:  # fine peaks lie all along the rim of a large ball
            company = company[candidates.radius_px[fine[company]] > _COARSE * typical]
        company = company[np.argsort(gap[company])][: MOST_IN_GROUP - 1]
        known = good.position_px[np.hypot(*(good.position_px - peaks[i]).T) < 2 * typical + TOUCH * optics.sigma_px]
        if len(company) + len(known) == 0 or len(company) > _COMPANY:
            continue
        starts = np.concatenate([peaks[[i]], peaks[company], known])[:MOST_IN_GROUP]
        used[[i, *company]] = True
        out.append(np.column_stack([starts, np.full(len(starts), typical)]))
    return out[:200]


def lone_peaks(
    film: NDArray[Any], candidates: Candidates, single: BallFits, like: BallFits, optics: Optics, beside: Images | None
) -> tuple[Float, Float]:
    """Places (n, 2) as high as balls that no single one explains, strongest first, and radii: two that nearly touch have one peak."""
    typical, height = float(np.median(like.radius_px)), float(np.median(height_of(like, optics.sigma_px)))
    peaks = candidates.position_px[candidates.radius_px <= _PEAK * (typical + optics.sigma_px)]
    peaks = peaks[deep_at(film, peaks, typical + optics.sigma_px, beside) > _HIGH * height]
    peaks = peaks[~are_within(peaks, single.position_px, np.maximum(typical, 0.9 * single.radius_px))]
    places = np.zeros((0, 2))
    for peak in peaks:
        if len(places) < _MOST_PEAKS and not (np.hypot(*(places - peak).T) < 2 * typical).any():
            places = np.append(places, peak[None], axis=0)
    return places, np.full(len(places), _OF_TWO * typical)


def _chain(peaks: Float, first: Int, free: Bool, own_px: float, neck_px: float, touch_px: float) -> Int:
    """Return all but the first of some peaks, with those that touch these, and so on, if they are few and one behind the other.

    Where they touch each other all round there may be anything of that size: a full stop of lead passes for four balls. Nearer to each
    other they show no necks, as a wire shows none.
    """
    chain = first
    while len(chain) <= _COMPANY + 1:
        nearest = gaps(peaks, peaks[chain]).min(axis=1)
        more = np.flatnonzero(free & (nearest < touch_px) & (nearest > own_px))
        if not len(more):
            apart = gaps(peaks[chain], peaks[chain])
            links = apart[np.triu(apart < touch_px, 1)]
            return chain[1:] if len(links) < len(chain) and links.min(initial=np.inf) > neck_px else first[1:]
        chain = np.append(chain, more[nearest[more].argmin()])
    return first[1:]
