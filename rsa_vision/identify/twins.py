"""Bodies alike: what lies where one of them is known to fit may be another, with markers that were not known before.

A marker that was hidden when a body was seen first is a point too many later. Of two bodies alike the one with more points then seems to
be the one of which more markers are known, whichever it is: its points say nothing of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.candidates import FOUND
from rsa_vision.identify.poses import Cloud, Pairs, place

TWIN: Final = 1e-3  # probability that a body is like another of which nothing was known
MOST: Final = 60  # assignments of either kind that compete

Points = tuple[int, ...]


def twins(
    markers: Cloud, points: Cloud, groups: Sequence[tuple[float, Pairs]], volume: float, stray: float, *, whole: bool
) -> list[tuple[float, Pairs, Points]]:
    """List what may lie at the points of assignments instead: bodies like those, of which fewer markers are known, or none.

    Parameters
    ----------
    markers, points : Cloud
        `markers` of all bodies.
    groups : sequence of (log odds, pairs)
        Assignments of them.
    volume : float
        In which points may be, mm³.
    stray : float
        How many points are expected that belong to nothing known.
    whole : bool
        All markers of the known bodies are known.

    Returns
    -------
    list of (log odds, pairs, points)
        The likeliest of either kind. Known markers at their points, and points beyond those: of markers of the same body that were hidden
        before, and lie where one like it has them; or of a whole body like it, of which nothing was known.
    """
    worth = float(np.log(volume / stray) + np.log(FOUND * (1 - FOUND)))
    sets = [({i for i, _ in pairs}, {a for _, a in pairs}) for _, pairs in groups]
    more: dict[tuple[Pairs, Points], float] = {}
    unknown: dict[tuple[Pairs, Points], float] = {}
    for (odds, pairs), (mine, hits) in zip(groups, sets, strict=True):
        for (other, elsewhere), (others, theirs) in zip(groups, sets, strict=True):
            if not hits & theirs and len(mine & others) >= LEAST_POINTS:
                key = elsewhere, tuple(sorted(hits))
                unknown[key] = max(unknown.get(key, -np.inf), odds + other + float(np.log(TWIN)))
            elif not whole and not mine & others and len(theirs) >= LEAST_POINTS and theirs < hits:
                every, part = (place(markers, points, some) for some in (pairs, tuple(pair for pair in pairs if pair[1] in theirs)))
                if every is not None and part is not None:
                    key = elsewhere, tuple(sorted(hits - theirs))
                    gain = every.log_likelihood - part.log_likelihood + len(key[1]) * worth
                    more[key] = max(more.get(key, -np.inf), other + gain)
    return [(odds, *key) for some in (more, unknown) for key, odds in sorted(some.items(), key=lambda one: (-one[1], one[0]))[:MOST]]
