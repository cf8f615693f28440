"""Which candidates are balls: fits with the film's own optics, neighbours fitted together, one decision for all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import LEAST_KNOWN, hopeless, look_clear
from rsa_vision.detect.balls.find import CHANCE, COARSE_SIGMA_PX, DOUBTFUL, MISFIT, SURE, distinct, fit_at, misfit, plausible, promising
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.focal_spot import Spot
from rsa_vision.detect.balls.usual import over_kinds
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within, gaps, on_film
from rsa_vision.detect.marks.peaks import NECKS, lone_peaks, unexplained_pairs
from rsa_vision.detect.models.painted import Painted
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images, for_all
from rsa_vision.detect.neighbours.beside import MOST_IN_GROUP, TOUCH, all_but, groups_of, heaps_of, images_beside, lapping_balls
from rsa_vision.detect.neighbours.blobs import split_blobs
from rsa_vision.detect.neighbours.crowds import resolve_crowds
from rsa_vision.detect.neighbours.edges import NEAR_EDGES, balls_beside_edges
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.detect.neighbours.lines import without_lines
from rsa_vision.detect.neighbours.not_round import are_not_round
from rsa_vision.detect.neighbours.spots import Drawn, find_spot, with_spot
from rsa_vision.detect.search.candidates import Candidates
from rsa_vision.types import Bool, Float, Int

_LARGER, _UNLIKE, _LEAST_UNLIKE = 1.1, 3.0, 0.015  # of two in one: radius and misfit against the known ones, least misfit
_BAR = 0.03  # misfit that balls in a row may leave of which one does not touch another
_LIKE = 0.35  # logarithm of the radius, against the film's median


@dataclass(frozen=True, slots=True, eq=False)
class Balls:
    """Balls of a film.

    Attributes
    ----------
    fits : BallFits
    touching : ndarray of bool, shape (n,)
        Fitted together with a neighbour, or perhaps two.
    edged : ndarray of bool, shape (n,)
        Fitted together with an edge.
    crossed : ndarray of bool, shape (n,)
        Fitted without the pixels that something else lies on.
    drawn : ndarray of bool, shape (n,)
        Fitted with the film's focal spot.
    by_spot : ndarray of shape (n, 2, 2)
        As of :class:`rsa_vision.detect.neighbours.spots.Drawn`; zero for the others.
    spot : Spot or None
    """

    fits: BallFits
    touching: Bool
    edged: Bool
    crossed: Bool
    drawn: Bool
    by_spot: Float
    spot: Spot | None

    def rows(self, which: Bool) -> Balls:
        """Return those that ``which`` selects."""
        touching, edged, crossed, drawn = (of[which] for of in (self.touching, self.edged, self.crossed, self.drawn))
        return Balls(self.fits.rows(which), touching, edged, crossed, drawn, self.by_spot[which], self.spot)

    def and_more(self, fits: BallFits, *, touching: Bool | bool, edged: Bool | bool, crossed: Bool | bool) -> Balls:
        """Return these and others, of which none is drawn by the spot."""
        n = len(fits.depth)
        touching, edged, crossed, drawn = (
            np.append(now, np.broadcast_to(more, n))
            for now, more in ((self.touching, touching), (self.edged, edged), (self.crossed, crossed), (self.drawn, False))
        )
        by_spot = np.concatenate([self.by_spot, np.zeros((n, 2, 2))])
        return Balls(join([self.fits, fits]), touching, edged, crossed, drawn, by_spot, self.spot)


def resolve_balls(
    film: NDArray[Any],
    candidates: Candidates,
    seeds: BallFits,
    limit: float,
    optics: Optics,
    noise: NoiseModel,
    needles: Painted | None,
) -> Balls:
    """Fit all balls of a film.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    candidates : Candidates
        Of the markers' polarity.
    seeds : BallFits
        First looks of that polarity.
    limit : float
        Significance that a mark must have.
    optics : Optics
    noise : NoiseModel
    needles : Painted, optional
        Images of pins and tees, to be subtracted.

    Returns
    -------
    Balls
    """
    worth = ~hopeless(seeds, COARSE_SIGMA_PX, noise)
    if needles is not None and np.count_nonzero(look_clear(seeds, noise)) >= LEAST_KNOWN:  # else these too are asked what balls are like
        worth &= ~needles.explain(film, seeds.position_px, seeds.radius_px)
    seeds = seeds.rows(worth)
    if len(seeds.depth) == 0:
        none = np.zeros(0, bool)
        return Balls(seeds, none, none, none, none, np.zeros((0, 2, 2)), None)
    beside: Images | None = needles
    others = None if needles is None else for_all(needles)
    single = distinct(fit_at(film, seeds.position_px, seeds.radius_px, optics, noise, others, quick=True), noise)
    clean = plausible(single, noise) & (misfit(single, noise) < DOUBTFUL * MISFIT)
    drawn = find_spot(film, single.rows(~clean), single.rows(clean), optics, noise, needles)
    rest = ~_taken(single, drawn.fits)
    single, clean, beside = single.rows(rest), clean[rest], with_spot(beside, drawn.fits, drawn.spot, optics)
    good = single.rows(plausible(single, noise, slack=1.5))

    def groups_worth_fitting() -> list[list[int]]:
        worth = promising(good, limit, optics.sigma_px, noise) & ~hopeless(good, optics.sigma_px, noise)
        return [g for g in groups_of(good, optics) if worth[g].any()]

    groups, fits = groups_worth_fitting(), []
    clear = look_clear(good, noise)
    sized = bool(np.count_nonzero(clear) >= LEAST_KNOWN)
    like = good.rows(clear) if sized else good
    for members in unexplained_pairs(film, candidates, good, like, sized, optics, beside):
        pair = fit_group(film, members[:, :2], members[:, 2], optics, noise, beside)
        # one peak too many takes part of a ball, and then there is none
        while sized and len(pair.depth) > 2 and not _like(pair, like).all():
            others_px = pair.rows(np.arange(len(pair.depth)) != pair.significance.argmin()).position_px
            fewer = fit_group(film, others_px, np.full(len(others_px), members[0, 2]), optics, noise, beside)
            if np.count_nonzero(plausible(pair, noise)) < 2 and not (_like(fewer, like) & plausible(fewer, noise)).all():
                break
            pair = fewer
        if not _is_bar(pair, like, 2 * members[0, 2] + TOUCH * optics.sigma_px, noise):
            fits.append(pair.rows(_like(pair, like) & ~_cancelled(pair)))
    clean &= ~perhaps_two(single, single.rows(clean), noise)
    asked = clean & promising(single, limit, optics.sigma_px, noise) & ~hopeless(single, optics.sigma_px, noise)
    one_each = single.rows(asked)
    clean[asked] = ~are_not_round(film, one_each, lambda i, *at: images_beside(one_each, np.array([i]), optics, beside, *at), optics, noise)
    sure = single.rows(clean)
    blobs = single.rows(~clean & ~_taken(single, sure))
    if sized:
        peaks, size = lone_peaks(film, candidates, single, like, optics, beside)
        blobs = join([blobs, fit_at(film, peaks, size, optics, noise, others, quick=True)])
    split = len(sure.depth) > 0 or needles is None  # else what arms leave is all there is
    pairs = split_blobs(film, blobs, sure, optics, noise, lambda: all_but(sure, np.arange(0), optics, beside)) if split else []
    if pairs and not sized:  # these are the first to show what balls are like
        paired = join(pairs)
        peaks, size = lone_peaks(film, candidates, join([single, paired]), paired, optics, beside)
        more = join([blobs.rows(~_taken(blobs, paired)), fit_at(film, peaks, size, optics, noise, others, quick=True)])
        pairs += split_blobs(film, more, paired, optics, noise, lambda: all_but(paired, np.arange(0), optics, beside))
    fits += pairs
    if pairs:  # a blob that two balls explain is no ball
        good = good.rows(~_taken(good, join(pairs)) & ~_between(good, pairs))
        groups = groups_worth_fitting()
    known, there, lone = good, np.ones(len(good.depth), bool), [g[0] for g in groups if len(g) == 1]
    for g in sorted(groups, key=len, reverse=True):  # those that touch first: the others are fitted beside their images
        index = np.array(g)
        if 1 < len(g) <= MOST_IN_GROUP:
            near = all_but(known, index, optics, beside)
            group = fit_group(film, good.position_px[index], good.radius_px[index], optics, noise, near)
            tells = (plausible(group, noise) & ~_cancelled(group)).any()
            if not tells and (one := _one_for_all(good, index, noise)):
                there[index] = np.isin(index, one)
                lone += one
            else:
                fits.append(group)
        elif len(g) > MOST_IN_GROUP:
            fits.append(_peel(film, good.rows(index), optics, noise, beside))
    if lone:
        known, alone = good.rows(there), (np.cumsum(there) - 1)[lone]

        def neighbours(i: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
            return images_beside(known, alone[[i]], optics, beside, cols, rows)

        fits.append(fit_at(film, known.position_px[alone], known.radius_px[alone], optics, noise, neighbours))
    found = join([single.rows(slice(0)), *fits])
    found = found.rows(~_cancelled(found))
    found = found.rows(on_film(film, *found.position_px.T) & ~_taken(found, drawn.fits))
    balls = plausible(found, noise)
    alike = np.abs(np.log(found.radius_px[:, None] / like.radius_px)).min(axis=1, initial=np.inf) < _LIKE
    perhaps, found = found.rows(~balls & alike & plausible(found, noise, NEAR_EDGES)), found.rows(balls)
    found = found.rows(~_bar(found, misfit(found, noise, CHANCE) < DOUBTFUL * MISFIT))
    found = resolve_crowds(film, candidates, distinct(found, noise), optics, noise, beside)
    found = join([found, perhaps.rows(~_in_one_beam(join([perhaps, found]))[: len(perhaps.depth)])])
    found = without_lines(film, distinct(found, noise), limit, optics, noise, beside)
    found, edged = balls_beside_edges(film, found, optics, noise, beside)
    balls = plausible(found, noise)
    found, edged = found.rows(balls), edged[balls]
    of_spot, at_edge = _drawn_beside_edges(film, drawn, optics, noise, needles)
    n, every = len(found.depth), join([found, of_spot])
    is_drawn, none = np.arange(len(every.depth)) >= n, np.zeros(len(every.depth), bool)
    touching = np.append(np.zeros(n, bool), drawn.doubtful)
    for g in groups_of(every, optics):
        touching[g] |= len(g) > 1
    edged = np.append(edged, at_edge)
    return Balls(every, touching, edged, none, is_drawn, np.concatenate([np.zeros((n, 2, 2)), drawn.by_spot]), drawn.spot)


def _drawn_beside_edges(
    film: NDArray[Any], drawn: Drawn, optics: Optics, noise: NoiseModel, needles: Painted | None
) -> tuple[BallFits, Bool]:
    """Fit again, as :func:`balls_beside_edges`, those that surely are single balls drawn by the spot."""
    parts, edged = [drawn.fits.rows(slice(0))], drawn.doubtful.copy()
    for i, doubtful in enumerate(drawn.doubtful):
        one, others = drawn.fits.rows([i]), with_spot(needles, drawn.fits.rows(np.arange(len(edged)) != i), drawn.spot, optics)
        fits, at_edge = (one, [False]) if doubtful else balls_beside_edges(film, one, optics, noise, others, drawn.spot)
        parts.append(fits)
        edged[i] = at_edge[0]
    return join(parts), edged


def perhaps_two(fits: BallFits, known: BallFits, noise: NoiseModel) -> Bool:
    """Say which balls may be two: larger than known ones of a kind, and not of a larger one, and less like a ball than those.

    Parameters
    ----------
    fits, known : BallFits
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
        None where fewer than three are known.
    """
    if len(known.depth) < LEAST_KNOWN:
        return np.zeros(len(fits.depth), bool)
    clear = known.rows(look_clear(known, noise))
    larger = over_kinds(fits.radius_px, (clear if len(clear.depth) else known).radius_px, LEAST_KNOWN)[0] > np.log(_LARGER)
    known = known.rows(np.argsort(known.chi2_core)[: max(LEAST_KNOWN, len(known.depth) // 4)])  # the others may be two themselves
    left = misfit(fits, noise)
    unlike = (
        (left > _UNLIKE * np.median(misfit(known, noise))) & (left > _LEAST_UNLIKE) & (fits.chi2_core > 1 + 5 * noise.scatter(fits.n_core))
    )
    return np.asarray(unlike & larger)


def _in_one_beam(fits: BallFits) -> Bool:
    """Say whose shadow lies over that of another ball."""
    return np.isin(np.arange(len(fits.depth)), lapping_balls(fits)[0])


def _bar(fits: BallFits, close: Bool) -> Bool:
    """Say which of those in one beam are no balls: two explain much, so they must explain it closely; between two that do not is a bar."""
    one, other = lapping_balls(fits)
    partners, poor = (np.bincount(of, minlength=len(close)) for of in (one, one[~close[other]]))
    return np.asarray(((partners > 0) & ~close) | (poor > 1))


def _cancelled(fits: BallFits) -> Bool:
    """Say over which lies one of the other polarity: together they may explain anything."""
    one, other = lapping_balls(fits)
    return np.isin(np.arange(len(fits.depth)), one[np.sign(fits.depth[one]) != np.sign(fits.depth[other])])


def doubt_of_number(fits: BallFits) -> Float:
    """Return the variances that three or more lapping balls have because they may be one fewer, shape (n, 2, 2), px^2.

    Where one of them is faint, two in a row of three could have come from one between them: half their distance from where it is.

    Parameters
    ----------
    fits : BallFits

    Returns
    -------
    ndarray of shape (n, 2, 2)
        Zero for single balls, for pairs, and where all are beyond doubt.
    """
    out = np.zeros((len(fits.depth), 2, 2))
    for members in heaps_of(fits):
        if len(members) > 2 and fits.significance[members].min() < SURE:
            apart = fits.position_px[members][:, None] - fits.position_px[members]
            nearest = (np.hypot(*apart.transpose(2, 0, 1)) + 1e9 * np.eye(len(members))).argmin(axis=1)
            half = 0.5 * apart[np.arange(len(members)), nearest]
            out[members] = half[:, :, None] * half[:, None]
    return out


def _taken(fits: BallFits, good: BallFits) -> Bool:
    """Say which fits lie on a ball that is already known."""
    return are_within(fits.position_px, good.position_px, 0.6 * good.radius_px)


def _one_for_all(fits: BallFits, members: Int, noise: NoiseModel) -> list[int]:
    """Return the one of a group that describes it alone, if there is one: what else began there was its flank, or noise on it."""
    group = fits.rows(members)
    close = plausible(group, noise) & (misfit(group, noise, CHANCE) < DOUBTFUL * MISFIT)
    return [int(members[np.where(close, group.significance, 0.0).argmax()])] if close.any() else []


def _between(fits: BallFits, pairs: list[BallFits]) -> Bool:
    """Say which fits lie on both balls of a pair: they are what one ball explains of it."""
    off = [gaps(fits.position_px, pair.position_px) / pair.radius_px for pair in pairs]
    return np.asarray(np.any([of_both.max(axis=1) < 1.0 for of_both in off], axis=0))


def _like(fits: BallFits, known: BallFits) -> Bool:
    """Say which balls of a group are like those of the film that stand alone: two blobs can explain much that is none."""
    size = np.abs(np.log(fits.radius_px / np.median(known.radius_px))) < _LIKE
    apart = gaps(fits.position_px, fits.position_px) + 99.0 * np.eye(len(size))
    size = size & (apart.min(1, initial=99.0) > 0.4 * fits.radius_px)  # two nearly in one place share its depth between them anyhow
    return np.asarray(
        size & (np.sign(fits.depth) == np.sign(np.median(known.depth))) & (np.abs(fits.depth) > 0.4 * np.median(np.abs(known.depth)))
    )


def _is_bar(fits: BallFits, like: BallFits, touch_px: float, noise: NoiseModel) -> bool:
    """Say whether balls in a row, of which one does not touch another, lap too far to show necks, or leave what single ones do not.

    A bar is explained nearly as well by some.
    """
    apart = gaps(fits.position_px, fits.position_px) + 1e9 * np.eye(len(fits.depth))
    if len(apart) < LEAST_KNOWN or not (np.triu(apart, 1) > touch_px).any():
        return False
    left = misfit(fits, noise)
    unlike = (left > max(_UNLIKE * float(np.median(misfit(like, noise))), _BAR)) & (fits.chi2_core > 1 + 5 * noise.scatter(fits.n_core))
    return bool(unlike.any() or (apart.min(axis=1) < NECKS * fits.radius_px).any())


def _peel(film: NDArray[Any], fits: BallFits, optics: Optics, noise: NoiseModel, beside: Images | None) -> BallFits:
    """Fit a large crowd one by one, each with the images of all others subtracted, until they settle."""
    for _ in range(4):
        last = fits

        def others(i: int, cols: Float, rows: Float, last: BallFits = last) -> tuple[Float, Bool]:
            return images_beside(last, np.array([i]), optics, beside, cols, rows)[0], np.zeros(cols.shape, bool)

        fits = fit_at(film, fits.position_px, fits.radius_px, optics, noise, others)
    return fits
