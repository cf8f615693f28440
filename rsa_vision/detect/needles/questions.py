"""What the pins or tees of a film may differ by, which is asked once on the way to the last fit: blurs, tapers, attenuations, arms.

Each answer is where the fit goes on, with parameters of their own that are expected to differ as much as they do, or None: they are alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.differing import LEAST_TELLING, MOST_BLURRIER, MOST_DENSER, MOST_TAPER, SLANTED, differing, unknown
from rsa_vision.detect.needles.equations import BENT, UNEVEN, Equations
from rsa_vision.detect.needles.fits import between
from rsa_vision.detect.needles.irregular import Regularity, told_by
from rsa_vision.detect.needles.states import LEAST_TAPER, State, of_several_lengths, of_several_sizes
from rsa_vision.types import Float

OF_BLURS, OF_TAPERS, OF_DENSITIES, OF_ARMS = "blurs", "tapers", "densities", "arms"
# rounds after which each is asked at the latest, in this order: what differs does not converge
_LATEST = {OF_BLURS: 3.0, OF_TAPERS: 5.0, OF_DENSITIES: np.inf, OF_ARMS: 4.0}
MORE_STEPS = {OF_BLURS: 6, OF_TAPERS: 6, OF_DENSITIES: 6, OF_ARMS: 0}  # that an answer takes
_OF_PINS = (OF_TAPERS, OF_DENSITIES)  # tees lie flat, and are of one length and metal
_DENSITIES_AFTER = 4  # rounds with tapers of their own
# logarithms of the odds from which they differ: by chance one film of a hundred gets to that of tapers; a curve feigns blurs that differ;
# whether pins of several widths are of several metals, all they can tell counts
_BLURS_SURE, _TAPERS_SURE, _DENSITIES_SURE = 3.0, 1.0, -np.inf
UNEVEN_ERROR = 0.2  # of what is uneven of the blur, where the needles as a whole have told something of it
_OF_UNEVEN = np.eye(2) / UNEVEN_ERROR**2
_BY_CHANCE = 14.0  # chi2 of two degrees of freedom


@dataclass(slots=True)
class Agenda:
    """What is still to be asked.

    Attributes
    ----------
    latest : dict
        The round in which each is asked at the latest.
    """

    latest: dict[str, float]

    @classmethod
    def of(cls, *, alike: bool) -> Agenda:
        """Return what is asked of pins that are nearly alike, or of other needles."""
        return cls({name: latest for name, latest in _LATEST.items() if alike or name not in _OF_PINS})

    def due(self, count: int, converged: bool, sizes_known: bool) -> Iterator[str]:
        """Yield what is to be asked in this round, one after the other, until something has an answer; nothing is asked again."""
        for name in list(self.latest):
            near = sizes_known if name == OF_TAPERS else name != OF_DENSITIES or OF_TAPERS not in self.latest
            if near and (converged or count >= self.latest[name]):
                del self.latest[name]
                if name == OF_TAPERS:
                    self.latest[OF_DENSITIES] = count + _DENSITIES_AFTER
                yield name


def with_own_blurs(systems: list[Equations], at: State, begun: State, start: Optics) -> State | None:
    """Return where needles have blurs of their own, if these differ.

    ``begun``: where the fit began, at optics ``start``, to which sizes and curve go back: one that made up for blurs leads astray.
    """
    blurs, variances = zip(*(e.free_blurs() for e in systems), strict=True)
    told = differing(list(blurs), list(variances), MOST_BLURRIER, _BLURS_SURE)
    if told is None:
        return None
    sets = [
        [replace(f, blurrier=between(b, -MOST_BLURRIER, MOST_BLURRIER)) for f, b in zip(e.members, of, strict=True)]
        for e, of in zip(systems, blurs, strict=True)
    ]
    moved = at.moved.copy()
    moved[BENT] = [-was for was in (*start.curve, start.tail, 0.0, start.logged, *start.uneven)]
    return replace(at, sets=sets, blurs=told, moved=moved, sizes=begun.sizes)


def with_own_tapers(systems: list[Equations], at: State) -> State | None:
    """Return where pins of several lengths have tapers of their own, if these differ."""
    if not of_several_lengths(at.sizes):
        return None
    tapers, variances = zip(*(e.free_tapers() for e in systems), strict=True)
    told = differing(list(tapers), list(variances), MOST_TAPER, _TAPERS_SURE)
    if told is None:
        return None
    sets = [
        [replace(f, shape=replace(f.shape, taper=between(t, LEAST_TAPER, 1.0))) for f, t in zip(e.members, of, strict=True)]
        for e, of in zip(systems, tapers, strict=True)
    ]
    return replace(at, sets=sets, tapers=replace(told, typical=told.typical - at.taper))


def with_own_densities(systems: list[Equations], at: State) -> State | None:
    """Return where pins of several sizes have attenuations of their own, if these differ."""
    if not of_several_sizes(at.sizes):
        return None
    densities, variances = zip(*(e.free_densities() for e in systems), strict=True)
    few = sum(map(len, densities)) < LEAST_TELLING
    told = unknown(list(densities), SLANTED) if few else differing(list(densities), list(variances), MOST_DENSER, _DENSITIES_SURE)
    if told is None or abs(told.typical) > SLANTED:  # by what all differ, the film's is not at rest yet
        return None
    sets = [
        [replace(f, denser=between(d, -MOST_DENSER, MOST_DENSER)) for f, d in zip(e.members, of, strict=True)]
        for e, of in zip(systems, densities, strict=True)
    ]
    return replace(at, sets=sets, densities=told)


def odd_arms(systems: list[Equations], at: State) -> Regularity | None:
    """Return how far the arms of tees differ, if they do."""
    if at.regularity is None:
        return None
    ways, variances = zip(*(e.free_ways(at.regularity.common) for e in systems), strict=True)
    return told_by(list(ways), list(variances), at.regularity)


def with_uneven_blur(precision: Float, told: Float, target: Float, moved: Float, gain: float) -> Float | None:
    """Return the precision of what is common with a blur that may be uneven, if it was taken as even so far and needles tell otherwise.

    Parameters
    ----------
    precision : ndarray of shape (c, c)
        Before.
    told, target : ndarrays of shape (c, c) and (c,)
        What needles tell.
    moved : ndarray of shape (c,)
        What the common parameters differ from the start.
    gain : float
        Of the variances, by noise that neighbours share.

    Returns
    -------
    ndarray of shape (c, c), or None
    """
    free = precision.copy()
    free[UNEVEN, UNEVEN] = _OF_UNEVEN
    if (free == precision).all():
        return None
    covariance = np.linalg.inv(told + gain * free)
    uneven = moved[UNEVEN] + (covariance @ (target - gain * free @ moved))[UNEVEN]
    return free if uneven @ np.linalg.solve(covariance[UNEVEN, UNEVEN], uneven) > gain * _BY_CHANCE else None
