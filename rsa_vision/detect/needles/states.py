"""Where a fit of all pins or tees of a film is, and where a step leads: not too far at once, and within the bounds of what can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsa_vision.detect.balls.alike import true_spread
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.differing import MOST_BLURRIER, MOST_DENSER, Differing
from rsa_vision.detect.needles.equations import (
    LATE,
    LOGGED,
    OF_SLANTS,
    OPTICS,
    OWN,
    SHARED,
    SLANT,
    TAPER,
    UNEVEN,
    Equations,
    Expected,
    Shown,
    own_parameters,
)
from rsa_vision.detect.needles.fits import LEAST_HALF_WIDTH_PX, between
from rsa_vision.detect.needles.irregular import ARMS, WAYS, Regularity, moved_arms
from rsa_vision.types import Float

LEAST_TAPER = 0.1
_SOME = 2  # needles: of forty that are alike one is an outlier by chance, and alone tells nothing
_SEVERAL = 0.05  # spread of the logarithms of lengths; slants of up to 25 degrees make 0.03
_BOUNDS = (-3.0, 3.0), (-0.8, 1.5), (-0.6, 0.6)  # of the curve, whose skewness is largest where it is a logarithm, and of the tail
_MOST_LATE, _MOST_LOGGED = 0.6, 3.0
_MOST_UNEVEN = 0.8
_MOST_BY_STEP, _MOST_TAPER_BY_STEP, _MOST_LOGGED_BY_STEP = 0.6, 0.2, 2.0
_BLURRIER_BY_STEP, _DENSER_BY_STEP = 0.2, 0.3  # by a step, of one needle's
_MOST_SLANT, _MOST_SKEW = 0.6, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Sizes:
    """Sizes of the needles of a film.

    Attributes
    ----------
    typical : ndarray of shape (2,)
        Logarithms of half width and length that are usual.
    spread : list of ndarrays of shape (members, 2)
        Standard deviations of each needle from them, by windows.
    """

    typical: Float
    spread: list[Float]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step of a fit.

    Attributes
    ----------
    change : ndarray of shape (c,)
        Of the common parameters.
    own : list of ndarrays of shape (p,)
        Of the own ones, by windows.
    """

    change: Float
    own: list[Float]

    def shorter(self) -> Step:
        """Return a third of it."""
        return Step(self.change / 3, [own / 3 for own in self.own])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where a fit is.

    Attributes
    ----------
    sets : list of lists of NeedleFit
        By windows.
    moved : ndarray of shape (c,)
        What the common parameters differ from the start.
    taper : float
        Common to all, or what each may differ from.
    sizes : Sizes
    blurs : Differing
    tapers : Differing
        What is typical of the differences from the common one.
    densities : Differing
    regularity : Regularity, optional
        Of the arms of tees.
    """

    sets: list[list[NeedleFit]]
    moved: Float
    taper: float
    sizes: Sizes
    blurs: Differing
    tapers: Differing
    densities: Differing
    regularity: Regularity | None

    @property
    def own_blurs(self) -> Float:
        """Logarithms of the blurs of all needles over the film's."""
        return np.array([f.blurrier for members in self.sets for f in members])

    @property
    def own_tapers(self) -> Float:
        """Tapers of all needles."""
        return np.array([f.shape.taper for members in self.sets for f in members])

    @property
    def own_densities(self) -> Float:
        """Logarithms of the attenuations of all needles over the film's."""
        return np.array([f.denser for members in self.sets for f in members])

    @property
    def expected(self) -> list[Expected]:
        """What is expected of the needles, by sets."""
        ways = [np.zeros((len(m), WAYS)) for m in self.sets] if self.regularity is None else self.regularity.spread
        each = zip(self.sizes.spread, self.blurs.spread, self.tapers.spread, self.densities.spread, ways, strict=True)
        size, blur, taper, density = self.sizes.typical, self.blurs.typical, self.taper + self.tapers.typical, self.densities.typical
        return [
            Expected(size, of_size, blur, of_blur, taper, of_taper, density, of_density, self.regularity, way)
            for of_size, of_blur, of_taper, of_density, way in each
        ]

    def after(self, step: Step, seen: list[Shown], parallel: bool) -> State:
        """Return where a step leads from there."""
        taper = self.taper + float(step.change[TAPER])
        all_alike = taper if self.tapers.nothing else None
        sets = [_moved(e.members, own, step.change, all_alike, parallel) for e, own in zip(seen, step.own, strict=True)]
        sizes = replace(self.sizes, typical=self.sizes.typical + step.change[OPTICS:SHARED])
        known = self.regularity
        if known is not None and parallel:
            known = replace(known, common=known.common + step.change[SHARED:])
        return State(sets, self.moved + step.change, taper, sizes, self.blurs, self.tapers, self.densities, known)


def sizes_of(systems: list[Equations]) -> Sizes:
    """What fits with sizes of their own tell of the sizes: pins of one cage are alike, but for how the rays meet them."""
    values, variance = (np.concatenate(of) for of in zip(*(e.free_sizes() for e in systems), strict=True))
    told = [true_spread(values[:, k], variance[:, k]) for k in range(2)]
    spread = np.stack([np.where(belongs, sd, np.inf) for _, sd, belongs in told], axis=1)
    return Sizes(np.array([centre for centre, _, _ in told]), np.split(spread, np.cumsum([len(e.members) for e in systems])[:-1]))


def of_several_sizes(sizes: Sizes) -> bool:
    """Say whether some needles differ in size: rays go a longer way through those at a slant, others may be of another metal."""
    return bool((np.concatenate(sizes.spread) > _SEVERAL).any(axis=1).sum() >= _SOME)


def of_several_lengths(sizes: Sizes) -> bool:
    """Say whether some needles differ in length by more than a slant makes, which leaves their tapers as they are."""
    return bool((np.concatenate(sizes.spread)[:, 1] > _SEVERAL).sum() >= _SOME)


def of_usual_size(sets: list[list[NeedleFit]]) -> list[list[NeedleFit]]:
    """Needles of the size that is usual among them."""
    width, length = np.median([(f.shape.half_width_px, f.shape.length_px) for members in sets for f in members], axis=0).tolist()
    return [[replace(f, shape=replace(f.shape, half_width_px=width, length_px=length)) for f in members] for members in sets]


def change_of(normal: Float, target: Float, at: State, start: Optics) -> Float:
    """Change of the common parameters, not too far at once; what has bounds stays within them, the others follow.

    ``start``: from which ``at`` has moved.
    """
    least, most = np.full((2, len(target)), np.array([[-np.inf], [np.inf]]))
    for k, now, low, high in (
        (TAPER, at.taper, LEAST_TAPER, 1.0),
        (LATE, start.late + at.moved[LATE], 0.0, _MOST_LATE),
        (LOGGED, start.logged + at.moved[LOGGED], 0.0, _MOST_LOGGED),
    ):
        least[k], most[k] = low - now, high - now
    change = np.linalg.solve(normal, target).astype(np.float64)
    change *= _as_far(change)
    held = (change < least) | (change > most)
    if held.any():
        change[held] = np.clip(change, least, most)[held]
        others = ~held
        change[others] = np.linalg.solve(normal[np.ix_(others, others)], target[others] - normal[np.ix_(others, held)] @ change[held])
        change *= _as_far(change)
    return np.clip(change, least, most)


def _as_far(change: Float) -> float:
    """Part of a change that one step may go."""
    most = np.full(len(change), _MOST_BY_STEP)
    most[[TAPER, LOGGED]] = _MOST_TAPER_BY_STEP, _MOST_LOGGED_BY_STEP
    return float(min(1.0, 1.0 / max(float((np.abs(change) / most).max()), 1e-9)))


def moved_optics(start: Optics, by: Float) -> Optics:
    """Optics with these changes of the logarithms of attenuation and blur, of curve, tail, what is late, logged and what is uneven."""
    bow, skewed, tail = (
        between(was + step, *bounds) for was, step, bounds in zip((*start.curve, start.tail), by[3:6], _BOUNDS, strict=True)
    )
    late, logged = between(start.late + by[LATE], 0.0, _MOST_LATE), between(start.logged + by[LOGGED], 0.0, _MOST_LOGGED)
    dense, blurred = np.exp(by[:2]).tolist()
    along, oblique = start.uneven + by[UNEVEN]
    part = min(1.0, _MOST_UNEVEN / max(float(np.hypot(along, oblique)), 1e-9))
    uneven = (float(along * part), float(oblique * part))
    mu, sigma = start.mu_px * dense, start.sigma_px * blurred
    return replace(start, mu_px=mu, sigma_px=sigma, curve=(bow, skewed), tail=tail, late=late, logged=logged, uneven=uneven)


def _moved(members: Sequence[NeedleFit], delta: Float, change: Float, taper: float | None, parallel: bool) -> list[NeedleFit]:
    """Needles after a step of their own parameters and of the common ones; ``taper``: of all, if not each its own."""
    arms = len(members[0].angles)
    wider, longer, turns = *change[OPTICS:SHARED], change[SHARED:]
    turning = 1 if parallel else arms
    each, ends = own_parameters(arms, parallel), OWN + turning + OF_SLANTS[arms].shape[1]
    parts = delta[: each * len(members)].reshape(len(members), each)
    shift, turn = float(np.abs(parts[:, :2]).max()), float(np.abs(parts[:, OWN : OWN + turning]).max())
    scale = min(1.0, 1.0 / max(shift, 1e-9), 0.1 / max(turn, 1e-9), _BLURRIER_BY_STEP / max(float(np.abs(parts[:, OWN - 1]).max()), 1e-9))
    out = []
    for f, part in zip(members, scale * parts, strict=True):
        width, length = f.shape.half_width_px, f.shape.length_px
        width = between(width + between(part[2] + width * wider, -0.5, 0.5), LEAST_HALF_WIDTH_PX, 0.3 * length)
        ways = np.append(np.zeros(WAYS - each + ends), part[ends:])  # no leans where each arm has a direction of its own
        angles, lengths = moved_arms(f, ways) if arms == ARMS else (f.angles, f.shape.arms)
        length = max(length + between(part[3] + length * longer, -2.0, 2.0), 3.0)
        shape = NeedleShape(width, length, _own_taper(f, float(part[-1] + change[TAPER])) if taper is None else taper, lengths)
        angles = angles + part[OWN : OWN + turning] + (np.concatenate([[0.0], turns]) if parallel else 0.0)
        slants = (np.zeros((2, arms)) if f.slants is None else f.slants) + (OF_SLANTS[arms] @ part[OWN + turning : ends]).reshape(2, arms)
        slants = np.clip(slants, [[-SLANT], [-_MOST_SKEW]], [[_MOST_SLANT], [_MOST_SKEW]])
        blurrier = between(f.blurrier + part[OWN - 1], -MOST_BLURRIER, MOST_BLURRIER)
        denser = between(f.denser + between(part[-2], -_DENSER_BY_STEP, _DENSER_BY_STEP), -MOST_DENSER, MOST_DENSER) if arms == 1 else 0.0
        at = f.position_px + part[:2]
        out.append(replace(f, position_px=at, shape=shape, angles=angles, slants=slants, blurrier=blurrier, denser=denser))
    return out


def _own_taper(fit: NeedleFit, change: float) -> float:
    return between(fit.shape.taper + between(change, -_MOST_TAPER_BY_STEP, _MOST_TAPER_BY_STEP), LEAST_TAPER, 1.0)
