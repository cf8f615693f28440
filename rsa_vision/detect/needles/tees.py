"""The tees of a film: a few from junctions, the others from their likeness, all fitted with the neighbours whose arms they cross."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import COARSE_SIGMA_PX, EXPLAINED, MISFIT
from rsa_vision.detect.balls.optics import CAP
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import are_within
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape, unexplained
from rsa_vision.detect.models.painted import paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.covered import find_covered, uncovered
from rsa_vision.detect.needles.crossing import chi2_of, fit_crossing, moved, window_of
from rsa_vision.detect.needles.edges import proportion_of, tees_beside_edges
from rsa_vision.detect.needles.ends import arms_go_on
from rsa_vision.detect.needles.fits import excess_of, explains, fit_needles
from rsa_vision.detect.needles.optics import BLURS_PX, GUESS, common_optics
from rsa_vision.detect.needles.sets import MOST_TOGETHER, NEAREST_PX, TAPERS, fit_all, is_apart, others_beside
from rsa_vision.detect.needles.shared import fit_shared
from rsa_vision.detect.needles.templates import SCALE, find_like, template_of, worth_a_fit
from rsa_vision.detect.needles.twins import APART_PX, split_twins
from rsa_vision.detect.search.junctions import ALONE, RINGS_PX
from rsa_vision.types import Float

AtJunction = Callable[..., NeedleFit | None]
"""Fits a tee of some taper at a junction, col, row, angle, ring and strength; None where nothing may be one."""

_BEFORE = 1.5  # tolerance before attenuation and ends are fitted
ROUGH = 3.5  # tolerance of a first look, while neighbours still disturb
ENOUGH = 6  # clean tees after which no more junctions are looked at: likeness finds the others
# radians by which a junction may point aside, and parts of its ring's radius by which it may lie before or behind the tip, along the stem
_STARTS = ((0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.25), (0.0, -0.25))
_ASKEW = 0.4  # explained by a first start, from which others are worth it
_TURNED = 0.2  # radians, from which a tee is not like another
_SAME_JUNCTION = 0.5  # of the length of its arms, from a junction to the tip fitted to it
_MOST_JUNCTIONS = 80
_MOST_IN_VAIN = 30  # places in a row that look like a tee and are none
_FAINTEST = 0.05  # of the depth of the film's clearest tee: a film linear in exposure has little of it behind thick tissue
_ACROSS = 1.5  # of the length of a tee, less what its image is wider by blur: arms of nearer ones cross its own
_TOUCHING = 1.05  # of the lengths of two tees, by which tips are apart whose arms reach each other; ends are blurred
_LEAST_PIXELS = 30  # under the arms: three arms of fewer fit anything
_LEAST_PARALLEL = 5  # tees of a film from which a common direction of the arms is worth asking for
# by which tees of a set differ: logarithms of half width, which stands for depth, and of length, radians; part of them that do not more
_ALIKE, _MOST_ALIKE = (0.35, 0.2, 0.15), 0.7
_ODD = 1.5  # times what is left under most tees of a film, from which something lies over one
_ASKED = 3  # cleanest tees that tell blur and taper
CLEAN = 0.04  # what the model of a clean tee leaves at the most; then no other taper is tried


def find_tees(
    film: NDArray[Any], junctions: Float, strokes: Float, optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], list[NeedleFit], Optics]:
    """Find and fit all tees of one polarity.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    junctions : ndarray of shape (n, 5)
        As of :func:`rsa_vision.detect.search.junctions.find_junctions`, one polarity.
    strokes : ndarray of shape (m, 6)
        As of :func:`rsa_vision.detect.search.strokes.find_strokes`, of the same.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    tees, doubtful : list of NeedleFit
        What are tees, and what look like tees with something else on them.
    optics : Optics
        With the attenuation that suits the arms: they are thinner than balls, and the film curve is bent.
    """
    strong = np.abs(junctions[:, 4]) > ALONE
    fitted_at = cache(partial(_at_junction, film, optics, noise))  # the strong ones are among all
    found = _found_from(film, junctions[strong], fitted_at, strokes, optics, noise)
    if found[0] or strong.all():
        return found
    weak = _found_from(film, junctions, fitted_at, strokes, optics, noise)
    return weak if _is_a_set([t for t in weak[0] if is_tee(t)]) else found


def _is_a_set(tees: list[NeedleFit]) -> bool:
    """Say whether there are several tees, most of them as large as each other and parallel: trabeculae are of any size."""
    if len(tees) < _LEAST_PARALLEL:
        return False
    size = np.log([[t.shape.half_width_px, t.shape.length_px] for t in tees])
    way = np.exp(1j * np.array([t.angles[0] for t in tees]))
    apart = np.column_stack([size - np.median(size, axis=0), np.angle(way / (np.median(way.real) + 1j * np.median(way.imag)))])
    like = (np.abs(apart) < _ALIKE).all(axis=1)
    return bool(np.count_nonzero(like) >= max(_LEAST_PARALLEL, _MOST_ALIKE * len(tees)))


def _found_from(
    film: NDArray[Any], junctions: Float, fitted_at: AtJunction, strokes: Float, optics: Optics, noise: NoiseModel
) -> tuple[list[NeedleFit], list[NeedleFit], Optics]:
    models, turned = _models(junctions, fitted_at)
    if not models:
        return [], [], optics
    tees = _like(film, models, turned, optics, noise)
    for again in (1, MOST_TOGETHER):
        tees = _distinct(fit_all(film, tees, optics, noise, again=again), models[0])
    if not tees:
        return [], [], optics
    if under := _outshone(film, tees, models[0], optics, noise):
        tees = _distinct(fit_all(film, [*tees, *under], optics, noise, again=MOST_TOGETHER), models[0])
    if optics.rough:  # where arms cross hardly depends on where they end; with a wrong blur one tee leaves what two explain
        optics, _ = common_optics(film, tees, optics, noise)
        tees = fit_all(film, tees, optics, noise)
    around = tees

    def others_of(mine: list[NeedleFit]) -> Images | None:
        return others_beside(mine, [t for t in around if all(t is not m for m in mine)], optics)

    tees = split_twins(film, tees, optics, noise, is_tee, others_of)
    tees = [t for t in tees if not arms_go_on(film, t, optics, others_beside(t, [o for o in tees if o is not t], optics))]
    if not tees:
        return [], [], optics
    # arms that are parallel on a cage stay so on a film, nearly; the tip is where lines along them meet: to know directions sharpens it
    nearly = [t for t in tees if is_tee(t, slack=_BEFORE)]
    optics = replace(optics, proportion=proportion_of(film, nearly, optics))
    tees, optics = tees_beside_edges(film, tees, optics, noise, is_tee)
    nearly = [t for t in tees if is_tee(t, slack=_BEFORE)]
    fitted, optics = fit_shared(film, nearly, optics, noise, parallel=len(nearly) >= _LEAST_PARALLEL)
    if len(one_each := _one_each(fitted)) < len(fitted):
        fitted, optics = fit_shared(film, one_each, optics, noise, parallel=len(one_each) >= _LEAST_PARALLEL)
    others = [t for t in tees if not is_tee(t, slack=_BEFORE)]
    bare, fitted, optics = _undisturbed(film, fitted, optics, noise)
    clean = [t for t in fitted if is_tee(t)]
    if len(clean) >= _LEAST_PARALLEL:
        bare, more = find_covered(film, bare, clean, strokes, optics, noise, _FAINTEST)
        if more:
            rough = [t for t in fitted if all(t is not c for c in clean) and is_apart(t, more)]
            others = [t for t in others if is_apart(t, more, _SAME_JUNCTION * clean[0].shape.length_px)]
            fitted, optics = fit_shared(bare, [*clean, *rough, *more], optics, noise, parallel=True)
    slack = _BEFORE if len(clean) >= _LEAST_PARALLEL else 1.0  # of what is parallel to others, and as large, bone may leave more
    others += [replace(t, slants=None) for t in fitted if not is_tee(t, slack)]
    return [t for t in fitted if is_tee(t, slack)], [t for t in others if is_tee(t, slack=ROUGH)], optics


def _one_each(tees: list[NeedleFit]) -> list[NeedleFit]:
    """Leave out the fainter of two that have come together: what was split in two is one."""
    kept: list[NeedleFit] = []
    for fit in sorted(tees, key=lambda t: -abs(t.depth)):
        if is_apart(fit, kept, APART_PX[0] / 2):
            kept.append(fit)
    return kept


def _undisturbed(
    film: NDArray[Any], fitted: list[NeedleFit], optics: Optics, noise: NoiseModel
) -> tuple[NDArray[Any], list[NeedleFit], Optics]:
    """Fit all again without what lies over some, under which much more is left than under most: a bead on an arm pulls at the tip.

    Returns the film as well, NaN where something was taken out.
    """
    clean = [t for t in fitted if is_tee(t)]
    left = np.array([excess_of(t, noise) for t in clean])
    odd = left > _ODD * np.median(left) if len(left) else np.zeros(0, bool)
    plain = [t for t, is_odd in zip(clean, odd, strict=True) if not is_odd]
    disturbed = [t for t in fitted if all(t is not p for p in plain)]
    if not disturbed or len(plain) < _LEAST_PARALLEL:
        return film, fitted, optics
    bare, again = uncovered(film, plain, disturbed, optics, noise)
    bared, as_before = [t for t in again if t is not None], [t for t, now in zip(disturbed, again, strict=True) if now is None]
    if not bared:
        return film, fitted, optics
    fitted, optics = fit_shared(bare, [*plain, *bared, *as_before], optics, noise, parallel=True)
    return bare, fitted[: len(plain) + len(bared)] + as_before, optics


def first_tees(film: NDArray[Any], junctions: Float, noise: NoiseModel) -> list[NeedleFit]:
    """Fit tees at junctions with guessed optics.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    junctions : ndarray of shape (n, 5)
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        The few cleanest of what may be tees.
    """
    strongest = junctions[np.argsort(-np.abs(junctions[:, 4]))][:_MOST_JUNCTIONS]
    return _at_junctions(strongest, TAPERS[0], partial(_at_junction, film, GUESS, noise))[:_ASKED]


def optics_of_tees(film: NDArray[Any], cleanest: list[NeedleFit], noise: NoiseModel) -> tuple[Optics, float]:
    """Estimate the blur from the cleanest tees, for films without balls.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    cleanest : list of NeedleFit
        As of :func:`first_tees`.
    noise : NoiseModel

    Returns
    -------
    optics : Optics
    evidence : float
        Significance of the tees that tell it; where there are none it is guessed.
    """
    # the very strongest are where arms cross, and of what is no tee the widest blur leaves least
    windows = [window_of(film, [f], replace(GUESS, sigma_px=BLURS_PX[-1]), noise, None) for f in cleanest]
    fits, left = {}, {}
    for sigma in BLURS_PX:
        optics = replace(GUESS, sigma_px=sigma)
        fits[sigma] = [fit_needles(film, f.position_px, f.angles, f.shape, optics, noise) for f in cleanest]
        left[sigma] = sum(chi2_of(window, f, optics, noise) for window, f in zip(windows, fits[sigma], strict=True))
    best = min(left, key=lambda sigma: left[sigma])
    evidence = float(sum(min(f.significance, CAP) for f in fits[best] if is_tee(f, slack=_BEFORE)))
    return replace(GUESS, sigma_px=best if evidence > 0 else COARSE_SIGMA_PX, rough=True), evidence


def is_tee(fit: NeedleFit, slack: float = 1.0) -> bool:
    """Say whether a fit looks like a tee: little misfit, arms square to each other, all of it on the film."""
    if not np.isfinite(fit.misfit) or fit.significance < 6.0 or fit.valid_fraction < 0.6:
        return False
    first, *others = fit.angles.tolist()
    square = all(abs(math.remainder(a - first - at, math.tau)) < 0.35 for a, at in zip(others, (math.pi / 2, -math.pi / 2), strict=True))
    slim = fit.shape.length_px > 2.0 * fit.shape.half_width_px and fit.shape.length_px > RINGS_PX[0] and fit.n_core > _LEAST_PIXELS
    return bool(square and slim and fit.misfit < 1.3 * MISFIT * slack and explains(fit, 1 - (1 - EXPLAINED) * slack))


def _models(junctions: Float, fitted_at: AtJunction) -> tuple[list[NeedleFit], list[NeedleFit]]:
    """Fit tees at the strongest junctions until a few are clean; the cleanest first, one of each size, and those turned against it."""
    order = junctions[np.argsort(-np.abs(junctions[:, 4]))][:_MOST_JUNCTIONS]
    rough: list[NeedleFit] = []
    best_taper = TAPERS[0]
    for taper in TAPERS:  # full cones first; pins with a short point leave more than cones do
        tried = _at_junctions(order, taper, fitted_at)
        if _mean_misfit(tried) < 0.8 * _mean_misfit(rough):
            rough, best_taper = tried, taper
        if not rough or _mean_misfit(rough) < CLEAN:
            break
        tips = np.array([f.position_px for f in rough])  # what is nearly a tee of one taper is where there are tees of another
        order = order[are_within(order[:, :2], tips, 0.0, _SAME_JUNCTION * order[:, 3])]
    if not rough or not is_tee(rough[0], slack=1.5):
        return [], []  # crossings of other things: not one is nearly a tee
    rough = [f for f in rough if f.shape.taper == best_taper]
    clean = [f for f in rough if is_tee(f)] or rough[:1]
    sizes = sorted(clean, key=lambda f: f.shape.length_px)
    ends = [sizes[0], sizes[-1]] if sizes[-1].shape.length_px > 1.08 * sizes[0].shape.length_px else []
    turned: list[NeedleFit] = []
    for i, fit in enumerate(rough):  # the closest first: one turned by a right angle may explain much of another
        closer = [clean[0], *rough[:i]]
        if is_tee(fit, slack=_BEFORE) and _turned(fit, clean[0]) and is_apart(fit, closer, _SAME_JUNCTION * fit.shape.length_px):
            turned.append(fit)
    return [clean[0], *(f for f in ends if f is not clean[0] and all(f is not t for t in turned))], turned


def _turned(fit: NeedleFit, model: NeedleFit) -> bool:
    """Say whether a tee does not look like another because it points elsewhere."""
    return abs(math.remainder(fit.angles[0] - model.angles[0], math.tau)) > _TURNED


def _at_junctions(junctions: Float, taper: float, fitted_at: AtJunction) -> list[NeedleFit]:
    """Fit a tee at each junction until enough are clean; best first."""
    rough: list[NeedleFit] = []
    for junction in junctions.tolist():
        fit = fitted_at(taper, *junction)
        rough += [fit] if fit else []
        clean = [f for f in rough if is_tee(f)]
        if len(clean) >= ENOUGH and not any(_turned(f, clean[0]) for f in clean):
            break
    return sorted(rough, key=unexplained)


def _at_junction(
    film: NDArray[Any], optics: Optics, noise: NoiseModel, taper: float, col: float, row: float, angle: float, ring: float, strength: float
) -> NeedleFit | None:
    """Fit a tee at a junction, or aside from where that points or lies, and return the best that may be one."""
    start = NeedleShape(float(np.clip(0.22 * ring, 1.2, 6.0)), 1.5 * ring, taper)
    tried: list[NeedleFit] = []
    for turn, along in _STARTS:
        angles = angle + turn + np.array([0.0, np.pi / 2, -np.pi / 2])
        tip = np.array([col, row]) + along * ring * np.array([math.cos(angle), -math.sin(angle)])
        tried.append(fit_needles(film, tip, angles, start, optics, noise))
        if is_tee(tried[-1]) or tried[0].explained < _ASKEW:
            break
    like = (f for f in tried if is_tee(f, slack=ROUGH) and f.depth * strength < 0)  # the answer has the other sign
    return min(like, key=unexplained, default=None)


def _mean_misfit(fits: list[NeedleFit]) -> float:
    """Mean over the best few of what the model leaves; infinite for none."""
    return float(np.mean([unexplained(f) for f in fits[:_ASKED]])) if fits else np.inf


def _like(film: NDArray[Any], models: list[NeedleFit], turned: list[NeedleFit], optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Look at every place that looks like one of the models, and at tees that cannot, being turned against them."""
    found = [find_like(film, template_of(m, optics)) for m in models]
    # what brighter tees hide here is found once these are known
    looks = [worth_a_fit(film, places, m, optics, noise) for m, places in zip(models, found, strict=True)]
    worth, step = (np.concatenate(of) for of in zip(*looks, strict=True))
    model, places = np.repeat(np.arange(len(models)), [len(f) for f in found]), np.concatenate(found)
    starts = list(turned)
    free = worth
    for i in np.argsort(-places[:, 2], kind="stable"):
        if free[i]:
            start = replace(models[model[i]], position_px=places[i, :2])
            starts += moved([start], step[[i]], int(start.shape.length_px) * 2)
            free &= np.hypot(*(places[:, :2] - places[i, :2]).T) > NEAREST_PX
    return _peeled(film, starts, optics, noise)


def _outshone(film: NDArray[Any], tees: list[NeedleFit], model: NeedleFit, optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Find faint tees whose arms reach among those of brighter ones: what the film looks like without these."""
    starts: list[tuple[float, NeedleFit]] = []
    painted, seen = paint([(t, optics) for t in tees]), template_of(model, optics)
    for tee in tees:
        # tips as far away as thick ends can touch, and all of their arms
        half = int(_TOUCHING * (tee.shape.length_px + model.shape.length_px)) + SCALE * (len(seen) // 2 + 1)
        left, top = (max(int(x) - half, 0) // SCALE * SCALE for x in tee.position_px)
        box = film[top : top + 2 * half, left : left + 2 * half]
        for col, row, likeness in find_like(painted.taken_from(box, left, top), seen):
            start = replace(model, position_px=np.array([col + left, row + top]))
            if is_apart(start, tees):
                starts.append((likeness, start))
    best = [start for _, start in sorted(starts, key=lambda item: -item[0])]
    found = _peeled(film, best, optics, noise, tees)[len(tees) :]
    # where arms only touch, a first look is as good as a last one
    blurred = SCALE * (len(seen) // 2) - model.shape.length_px
    across = [any(math.dist(f.position_px, t.position_px) < _ACROSS * t.shape.length_px - blurred for t in tees) for f in found]
    return [f for f, near in zip(found, across, strict=True) if near or is_tee(f)]


def _peeled(
    film: NDArray[Any], starts: list[NeedleFit], optics: Optics, noise: NoiseModel, known: Sequence[NeedleFit] = ()
) -> list[NeedleFit]:
    """Keep the starts that still have something to explain once better ones, and those known, have taken their part."""
    kept = list(known)
    in_vain = 0
    for start in starts:  # best likeness first: after a long row of failures only other things are left
        if in_vain == _MOST_IN_VAIN:
            break
        in_vain += 1
        others = others_beside(start, kept, optics)
        fit = fit_crossing(film, [start], optics, noise, others=others, quick=True)[0]
        deep = np.sign(fit.depth) == np.sign(start.depth) and abs(fit.depth) > _FAINTEST * abs(start.depth)
        near = math.dist(fit.position_px, start.position_px) < 2 * NEAREST_PX
        if deep and near and is_tee(fit, slack=ROUGH) and is_apart(fit, kept):
            kept.append(fit)
            in_vain = 0
    return kept


def _distinct(tees: list[NeedleFit], model: NeedleFit) -> list[NeedleFit]:
    kept: list[NeedleFit] = []
    for fit in sorted(tees, key=unexplained):
        deep = np.sign(fit.depth) == np.sign(model.depth) and abs(fit.depth) > _FAINTEST * abs(model.depth)
        if deep and is_tee(fit, slack=ROUGH) and is_apart(fit, kept):
            kept.append(fit)
    return kept
