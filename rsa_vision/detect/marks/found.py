"""All marks of one polarity of a film: its pins and tees, then its balls, then where they are and with which errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.crowd import all_but_noise, lost_in_a_crowd, out_of_a_crowd
from rsa_vision.detect.balls.decide import CLOSE, LEAST_KNOWN, above_noise, are_balls, faint_beside, look_clear, show_what_marks_are_like
from rsa_vision.detect.balls.find import DOUBTFUL, MISFIT, ROUNDNESS, distinct, fit_at, misfit, plausible, short_of_end
from rsa_vision.detect.balls.fits import BallFits, join
from rsa_vision.detect.balls.leftover import noise_under
from rsa_vision.detect.balls.surroundings import Places, free_places
from rsa_vision.detect.balls.unlike import like_poor_ones, of_odd_size
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within, gaps
from rsa_vision.detect.marks.beaded import find_beaded
from rsa_vision.detect.marks.mixed import part
from rsa_vision.detect.marks.noise_curve import noise_by_value
from rsa_vision.detect.marks.polarity import Seen, look_off_holes, off_pins
from rsa_vision.detect.marks.resolve import Balls, resolve_balls
from rsa_vision.detect.marks.second_look import look_again
from rsa_vision.detect.marks.settle import STRUCTURE, settle
from rsa_vision.detect.marks.table import NEEDLES_ALIKE, WHOLE, table_of, what_is_left
from rsa_vision.detect.marks.unsteady import Marks, by_lines, unsteady_lines
from rsa_vision.detect.models.needles import NeedleFit, middle, needle_image
from rsa_vision.detect.models.painted import Painted, paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images, nothing
from rsa_vision.detect.needles.balls_beside import lapped
from rsa_vision.detect.needles.first_pins import look_for_pins
from rsa_vision.detect.needles.fits import significant_misfit
from rsa_vision.detect.needles.pins import find_pins
from rsa_vision.detect.needles.sets import as_usual, located, on_arms
from rsa_vision.detect.needles.tees import find_tees, is_tee
from rsa_vision.detect.neighbours.beside import MOST_IN_GROUP, groups_of, images_beside, lapping_balls
from rsa_vision.detect.neighbours.holes import are_holes
from rsa_vision.detect.neighbours.laid_on import fit_over, look_on_arms, over_arms
from rsa_vision.detect.neighbours.not_round import are_long, are_not_round
from rsa_vision.detect.neighbours.rims import cut_from_outlines, goes_on
from rsa_vision.detect.neighbours.rows import in_bars, in_rows, like_those_in_rows
from rsa_vision.detect.neighbours.under_curve import under_curve
from rsa_vision.detect.search.candidates import STRENGTH, Candidates
from rsa_vision.types import Bool, Float, Int, MarkerImages

_PULL = 0.1  # of the radius of a ball, by which a needle over it moves its centre
_AT_NEEDLES = 1.5  # of their lengths, from the tip: what the search answers to there is of a needle
# nothing that blurs the noise of a film leaves its marks sharper than that: filters that smooth between edges do, and leave noise at these
_SMOOTHED, _MUCH_MORE = 1.15, 2.0  # blur of the noise over that of the marks, noise under these over that beside them, from which one did
_USUAL_BLUR = 0.6  # of the noise at marks, over theirs
_BESIDE = 2.0, 3.0  # of the radius of a ball, and pixels more, within which the search answers to it
_SHORT = 6.5  # length over half the width, of two balls side by side and their blur; pins are longer
_MOST_IN_VAIN = 6  # tees that balls may hide, where there is no other
_BENT = 1.5  # of what a ball may leave, once an edge or bending surfaces around it could have taken it up


def marks_of(
    film: NDArray[Any],
    bits: int,
    seen: Seen,
    rough_pins: list[NeedleFit],
    candidates: Candidates,
    faint: Candidates,
    limit: float,
    *,
    mottled: bool,
) -> tuple[MarkerImages, float]:
    """Find and measure all marks of one polarity.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int
        Significant bits.
    seen : Seen
        What the film shows of this polarity.
    rough_pins : list of NeedleFit
        What may be pins, of both.
    candidates, faint : Candidates
        Where to look at first, and again; of both.
    limit : float
        Significance that noise alone would exceed too often.
    mottled : bool
        The film shows nearly as much of the other polarity.

    Returns
    -------
    images : MarkerImages
    evidence : float
        For this polarity.
    """
    mine = _of_sign(candidates, seen.sign)
    faint = _of_sign(faint, seen.sign)
    needles = _find_needles(film, mine, faint, candidates.strokes, rough_pins, seen)
    found, tees = _find_balls(film, mine, faint, needles, seen, limit, mottled=mottled)
    if beaded := _with_beaded(film, found, needles, seen):
        needles = beaded
        found, tees = _find_balls(film, mine, faint, needles, seen, limit, mottled=mottled)
    if len(tees) != len(needles.tees) or any(t is not before for t, before in zip(tees, needles.tees, strict=True)):
        needles = replace(needles, tees=tees, painted=_painted(tees, needles.pins, needles.tee_optics, needles.pin_optics))
    around = _around(film, found, needles, seen)
    if around.under > _MUCH_MORE and seen.noise.blur_px > _SMOOTHED * seen.optics.sigma_px:
        rougher = replace(seen, noise=seen.noise.blurred_by(_USUAL_BLUR * seen.optics.sigma_px))
        return marks_of(film, bits, rougher, rough_pins, candidates, faint, limit, mottled=mottled)
    return _measured(film, bits, found, needles, around, faint, seen.optics, seen.noise)


def _of_sign(candidates: Candidates, sign: int) -> Candidates:
    """Those of one sign of depth: strengths, of the filter's answer, have the other."""
    junctions, strokes = (of[np.sign(of[:, at]) == -sign] for of, at in ((candidates.junctions, 4), (candidates.strokes, 5)))
    return replace(candidates.rows(np.sign(candidates.strength) == -sign), junctions=junctions, strokes=strokes)


@dataclass(frozen=True, slots=True, eq=False)
class _Needles:
    """Pins and tees of a film."""

    tees: list[NeedleFit]
    pins: list[NeedleFit]
    doubtful: list[NeedleFit]  # tees with something else on them
    tee_optics: Optics
    pin_optics: Optics
    looks: BallFits  # at balls, less those at pins
    painted: Painted | None  # images of the tees and pins

    @property
    def all(self) -> list[NeedleFit]:
        return self.tees + self.pins


def _find_needles(
    film: NDArray[Any], mine: Candidates, faint: Candidates, all_strokes: Float, rough_pins: list[NeedleFit], seen: Seen
) -> _Needles:
    sign, optics, noise = seen.sign, seen.optics, seen.noise
    round_ones = join([seen.looks, seen.rowed])
    tees, doubtful, tee_optics = find_tees(film, mine.junctions, faint.strokes, optics, noise)
    tees = [fit for fit in tees if np.sign(fit.depth) == sign]
    tees = [fit for fit, ball in zip(tees, _are_rather_balls(film, tees, round_ones, optics, noise), strict=True) if not ball]
    perhaps = [*tees, *doubtful] if len(tees) >= LEAST_KNOWN else tees  # whose arms are no pins
    more_pins = look_for_pins(film, all_strokes[~on_arms(all_strokes[:, :2], perhaps)], noise)
    rough_pins = [p for p in rough_pins + more_pins if np.sign(p.depth) == sign]
    places, clear = _likeliest_first(faint), round_ones.rows(round_ones.explained > CLOSE)
    free = ~(on_arms(places, perhaps) | are_within(places, clear.position_px, clear.radius_px))
    lines = _long_places(mine, round_ones)
    pins, pin_optics = find_pins(film, rough_pins, places[free], lines, perhaps, sign, optics, noise)
    tees, pins = [_seen(tees, noise), _seen(located(pins), noise)]
    painted = _painted(tees, pins, tee_optics, pin_optics)
    hidden = _under_no_pins(film, mine, rough_pins, [*perhaps, *pins], noise)
    looks = off_pins(seen.looks, more_pins)
    looks = distinct(join([looks, hidden]), noise) if len(hidden.depth) else looks
    return _Needles(tees, pins, doubtful, tee_optics, pin_optics, looks, painted)


def _under_no_pins(film: NDArray[Any], mine: Candidates, rough: list[NeedleFit], needles: list[NeedleFit], noise: NoiseModel) -> BallFits:
    """First looks at what lies on short strokes that have turned out to be no pins: two balls side by side are as long."""
    refuted = [p for p in rough if p.shape.length_px < _SHORT * p.shape.half_width_px and not on_arms(middle(p)[None], needles).any()]
    here = mine.rows((mine.roundness > ROUNDNESS) & on_arms(mine.position_px, refuted))
    return look_off_holes(film, here, noise)


def _with_beaded(film: NDArray[Any], found: Balls, needles: _Needles, seen: Seen) -> _Needles | None:
    """Return the needles with the pins that balls have hidden, if there are any, fitted beside these."""
    if needles.painted is None:
        return None
    fitted = find_beaded(film, needles.pins, needles.painted, found.fits, seen.optics, needles.pin_optics, seen.noise)
    if fitted is None:
        return None
    pins = _seen(located(fitted[0]), seen.noise)
    return replace(needles, pins=pins, pin_optics=fitted[1], painted=_painted(needles.tees, pins, needles.tee_optics, fitted[1]))


def _painted(tees: list[NeedleFit], pins: list[NeedleFit], tee_optics: Optics, pin_optics: Optics) -> Painted | None:
    return paint([(t, tee_optics) for t in tees] + [(p, pin_optics) for p in pins]) if tees or pins else None


def _seen(needles: list[NeedleFit], noise: NoiseModel) -> list[NeedleFit]:
    """Leave out what lossy compression may have made."""
    return [fit for fit in needles if noise.rises_above(np.array(abs(fit.height)), np.array(fit.background))]


def _long_places(mine: Candidates, looks: BallFits) -> Float:
    """Places (n, 2) at which the search answers along a line, likeliest first, less those at balls."""
    places, balls = _likeliest_first(mine.rows(mine.roundness < ROUNDNESS)), looks.rows(looks.explained > CLOSE)
    return np.asarray(places[~are_within(places, balls.position_px, _BESIDE[0] * balls.radius_px + _BESIDE[1])])


def _likeliest_first(candidates: Candidates) -> Float:
    """Places (n, 2) at which the search answers, round or long."""
    strength = np.abs(np.concatenate([candidates.strength, STRENGTH * candidates.strokes[:, 5]]))
    return np.concatenate([candidates.position_px, candidates.strokes[:, :2]])[np.argsort(-strength)]


def _find_balls(
    film: NDArray[Any], mine: Candidates, faint: Candidates, needles: _Needles, seen: Seen, limit: float, *, mottled: bool
) -> tuple[Balls, list[NeedleFit]]:
    """Balls, and the tees with those that only a ball on them explains."""
    sign, optics, noise, others = seen.sign, seen.optics, seen.noise, needles.all

    def high(fits: BallFits) -> Bool:
        return ~faint_beside(fits, others, optics.sigma_px, noise)

    def bare(fits: BallFits) -> Bool:
        """Say which are of this polarity, and on no needle."""
        return np.asarray((np.sign(fits.depth) == sign) & ~_on_arms(fits, others))

    def decided(fits: BallFits) -> Bool:
        return are_balls(fits, limit, optics.sigma_px, noise, mottled=mottled, plain=plain)

    def over_noise(fits: BallFits) -> Bool:
        return above_noise(fits, limit, optics.sigma_px, noise)

    found = resolve_balls(film, mine, needles.looks, limit, optics, noise, needles.painted)
    found = found.rows(high(found.fits))
    plain = not mottled and all_but_noise(found.fits, over_noise(found.fits), _off_needles(faint, others))
    found = found.rows(decided(found.fits) & bare(found.fits))
    more, at_edge, crossed = look_again(film, faint, found.fits, limit, optics, noise, needles.painted)
    like = decided(join([found.fits, more]))[len(found.fits.depth) :] & bare(more) & high(more)
    # the last fit does not know what was masked either
    found = found.and_more(more.rows(like), touching=False, edged=at_edge[like], crossed=crossed[like])
    if len(found.fits.depth) and not show_what_marks_are_like(found.fits, limit, optics.sigma_px, noise):
        clear = look_clear(found.fits, noise) | (over_noise(found.fits) & plain)
        found = found.rows(clear | out_of_a_crowd(found.fits, _off_needles(faint, others)))
    if needles.painted is not None:
        found = _on_needles(film, faint, found, needles.painted, seen, limit)
    return _taken_apart(film, found, needles, optics, noise)


def _on_needles(film: NDArray[Any], faint: Candidates, found: Balls, painted: Painted, seen: Seen, limit: float) -> Balls:
    """Balls, those on needles fitted with what they take away of these, and more of them."""
    balls, optics, noise = found.fits, seen.optics, seen.noise
    over = over_arms(balls, painted)
    before = balls.rows(over)
    after = fit_over(film, before.position_px, before.radius_px, balls, optics, noise, painted)
    stays = np.hypot(*(after.position_px - before.position_px).T) < before.radius_px
    better = plausible(after, noise) & (misfit(after, noise) <= misfit(before, noise)) & stays
    before.covariance[:, :2, :2] += (_PULL * before.radius_px[:, None, None]) ** 2 * np.eye(2)
    more = look_on_arms(film, _likeliest_first(faint), balls, limit, optics, noise, painted)
    out = found.rows(~over).and_more(after.rows(better), touching=True, edged=False, crossed=False)
    out = out.and_more(before.rows(~better), touching=True, edged=found.edged[over][~better], crossed=found.crossed[over][~better])
    return out.and_more(more, touching=True, edged=False, crossed=False)


def _taken_apart(film: NDArray[Any], found: Balls, needles: _Needles, optics: Optics, noise: NoiseModel) -> tuple[Balls, list[NeedleFit]]:
    """Balls, and the tees with those that only a ball on them explains."""
    tees, painted, tee_optics = list[NeedleFit](), needles.painted or nothing, needles.tee_optics
    poor = of_odd_size(np.array([tee.shape.half_width_px for tee in needles.tees]), np.zeros(len(needles.tees)), NEEDLES_ALIKE)
    poor |= np.array([significant_misfit(tee, noise) > DOUBTFUL * MISFIT for tee in needles.tees], bool)
    clean = [tee for tee, odd in zip(needles.tees, poor, strict=True) if not odd]

    def without(tee: NeedleFit) -> Images:
        return lambda cols, rows: painted(cols, rows) - needle_image(cols - tee.position_px[0], rows - tee.position_px[1], tee, tee_optics)

    tried = [(tee, without(tee)) if odd else (tee, None) for tee, odd in zip(needles.tees, poor, strict=True)]
    for k, (tee, beside) in enumerate([*tried, *((tee, painted) for tee in needles.doubtful)]):
        if k == _MOST_IN_VAIN and not tees:
            break  # where nothing is a tee, what might be one under a ball is a screw
        places, both = found.fits.position_px, None
        on = places[found.touching & on_arms(places, [tee])]
        if beside and len(on) < 2:
            start = on[0] if len(on) else None
            both = part(film, as_usual(tee, clean), found.fits, optics, tee_optics, noise, beside, is_tee, start)
        if both:
            tees.append(both[0])
            found = found.rows(np.hypot(*(places - both[1].position_px[0]).T) > both[1].radius_px[0])
            found = found.and_more(both[1], touching=True, edged=False, crossed=False)
        elif tee in needles.tees:
            tees.append(tee)
    return found, tees


def _off_needles(candidates: Candidates, needles: list[NeedleFit]) -> Candidates:
    """Leave out what the search answers to a needle."""
    away = [np.hypot(*(candidates.position_px - n.position_px).T) > _AT_NEEDLES * n.shape.length_px for n in needles]
    return candidates.rows(np.all(away, axis=0)) if needles else candidates


@dataclass(frozen=True, slots=True, eq=False)
class _Around:
    """Film around the balls, and what these say of its noise."""

    places: list[Places]
    rowed: Bool  # (n,): in rows, as no markers are
    free: Bool  # (n,): other balls fitted alone
    clear: Int  # those of them with nothing on them or beside them, and no other spot than the Gaussian
    under: float  # variance of the noise under balls, in units of that beside them


def _around(film: NDArray[Any], found: Balls, needles: _Needles, seen: Seen) -> _Around:
    known, others, optics, noise = found.fits, needles.all, seen.optics, seen.noise
    place = np.array([t.position_px for t in others]).reshape(-1, 2)
    reach = np.array([t.shape.length_px + t.shape.half_width_px + 3 * optics.sigma_px for t in others])
    places = free_places(film, known, place, reach, optics, noise)
    every = join([known, seen.rowed])  # those that were found may be a few of a row only
    rowed = in_rows(every.position_px, every.radius_px, every.depth)[: len(known.depth)]
    free = ~(found.touching | found.crossed | rowed)
    clear = np.flatnonzero(free & ~found.drawn & (known.valid_fraction > WHOLE) & (known.chi2_ring < STRUCTURE))
    under = noise_under(known.chi2_uneven[clear], known.radius_px[clear], STRUCTURE, places, optics, noise)
    return _Around(places, rowed, free, clear, under)


def _measured(
    film: NDArray[Any], bits: int, found: Balls, needles: _Needles, around: _Around, faint: Candidates, optics: Optics, noise: NoiseModel
) -> tuple[MarkerImages, float]:
    """Where the marks are, with their errors and flags, and how much they speak for their polarity."""
    known, touching, painted, others = found.fits, found.touching, needles.painted, needles.all
    free, clear, under = around.free, around.clear, around.under

    def beside(i: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return images_beside(known, np.array([i]), optics, painted, cols, rows)

    curve = noise_by_value(film, known.rows(clear), lambda i, *at: beside(int(clear[i]), *at), optics, noise)
    if curve is not None:
        core, odd = known.chi2_core / under, known.chi2_uneven / under
        known = replace(known, covariance=under * known.covariance, chi2_core=core, chi2_uneven=odd)
        noise, under = curve, 1.0
    bent, under_one_curve = under_curve(film, known, found.edged, clear, _undisturbed(found, optics), optics, noise, painted)
    found = replace(found, fits=bent, edged=found.edged & ~under_one_curve)
    balls, ratio, besides, covered, pulled = settle(film, found, around.places, under, free, beside, optics, noise)
    balls, added = _by_lines(Marks(film, balls, others, painted, optics, noise), clear, around.places, under)
    added[: len(besides)] += besides[:, None, None] * np.eye(2)
    if painted is not None:  # one shadow takes from what the other has left, and what a tee's arm shows of itself is the ball's as well
        touching = touching | over_arms(balls, painted)
    left, poor = what_is_left(balls, under, optics.sigma_px, noise)
    lone = np.flatnonzero(~around.rowed)  # these alone say what balls are like
    single = balls.rows(lone)
    poor[lone] = what_is_left(single, under, optics.sigma_px, noise)[1]
    poor |= covered | short_of_end(balls, noise)
    keep = left < _BENT * MISFIT
    ends = goes_on(film, balls, np.arange(len(poor)), beside, optics.sigma_px)
    keep &= ~(poor & ends)

    def beside_single(i: int, cols: Float, rows: Float) -> tuple[Float, Bool]:
        return beside(int(lone[i]), cols, rows)

    poor[lone] |= are_not_round(film, single, beside_single, optics, noise)
    clear_ones = np.count_nonzero(look_clear(single, noise))
    strokes = clear_ones < LEAST_KNOWN and are_long(film, single, beside_single, optics, noise)  # else they show what each of them is like
    touching = touching | ends | pulled  # something as high as itself beside it, which a ball on the end of a bar has as well
    balls, ratio, touching, poor, rowed = balls.rows(keep), ratio[keep], touching[keep], poor[keep], around.rowed[keep]
    added = added[np.append(keep, np.ones(len(others), bool))]
    one, other = lapping_balls(balls)
    poor |= rowed | np.isin(np.arange(len(poor)), one[poor[other]])  # what one of them leaves may be another's
    poor |= like_poor_ones(balls.radius_px, balls.depth, poor & ~rowed)
    doubtful = rowed | strokes | like_those_in_rows(balls.position_px, balls.radius_px, balls.depth, rowed, poor)
    doubtful |= in_bars(balls.position_px, balls.radius_px, balls.depth)
    doubtful |= cut_from_outlines(touching, ends[keep]) | are_holes(film, balls, optics.sigma_px)
    doubtful |= lost_in_a_crowd(balls, _off_needles(faint, others))
    # a pin has one arm: what hides a part of it is felt at its tip
    touching = np.concatenate([touching, np.zeros(len(needles.tees), bool), lapped(needles.pins, balls, optics)])
    return table_of(film, bits, balls, under, ratio, added, touching, poor, doubtful, others, faint.junctions, optics, noise)


def _by_lines(marks: Marks, clear: Int, places: list[Places], under: float) -> tuple[BallFits, Float]:
    """Balls, and what displaced lines add to the covariances of them and of the needles; what these left under balls is no noise."""
    lines = unsteady_lines(marks, clear, places)
    if lines is None:
        return marks.balls, np.zeros((len(marks.balls.depth) + len(marks.needles), 2, 2))
    # of noise that neighbours share there is less in the differences of lines than its variance
    less = min(lines.noise / under, 1.0) if marks.noise.is_white else 1.0
    return replace(marks.balls, covariance=less * marks.balls.covariance), by_lines(lines, marks)


def _undisturbed(found: Balls, optics: Optics) -> list[Int]:
    """Groups of balls whose images touch, with nothing else on them."""
    plain = ~(found.crossed | found.drawn)
    groups = [np.array(g) for g in groups_of(found.fits, optics)]
    return [g for g in groups if 1 < len(g) <= MOST_IN_GROUP and plain[g].all()]


def _are_rather_balls(film: NDArray[Any], tees: list[NeedleFit], seeds: BallFits, optics: Optics, noise: NoiseModel) -> list[bool]:
    """Say which tees a ball over their tip explains better: three thick arms that run into each other make a disc."""
    result = [False] * len(tees)
    tips = np.array([t.position_px for t in tees]).reshape(-1, 2)
    gap = gaps(tips, seeds.position_px)
    tee, seed = np.nonzero(gap < seeds.radius_px[None] + 1)
    if len(tee):
        balls = fit_at(film, seeds.position_px[seed], seeds.radius_px[seed], optics, noise, quick=True)
        as_ball = plausible(balls, noise) & (np.hypot(*(balls.position_px - tips[tee]).T) < balls.radius_px + 1)
        for k in np.flatnonzero(as_ball):
            result[tee[k]] |= bool(balls.chi2_core[k] < tees[tee[k]].chi2_core)
    return result


def _on_arms(balls: BallFits, needles: list[NeedleFit]) -> Bool:
    """Say which balls are left-overs of the thick ends of needles."""
    out = np.zeros(len(balls.depth), bool)
    for t in needles:
        dx, dy = (balls.position_px - t.position_px).T
        for angle, depth in zip(t.angles, t.depths, strict=True):
            c, s = np.cos(angle), -np.sin(angle)
            along, across = dx * c + dy * s, -dx * s + dy * c
            on = (along > -2) & (along < t.shape.length_px + t.shape.half_width_px) & (np.abs(across) < t.shape.half_width_px + 1.5)
            out |= on & (np.abs(balls.depth) < 0.5 * abs(depth))
    return out
