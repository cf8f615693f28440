"""When to end a fit of what is no mark: its steps would go on to the last one."""

from __future__ import annotations

from collections.abc import Sequence

WEIGHED = 3  # step after which weights hardly change any more, and what is left can be compared
_UNLIKE = 4.0  # times the noise, more than which marks seldom leave
_GAINED, _MOST = 0.02, 3  # of what was left before, that a step is to gain; steps in a row that need not


def in_vain(left: Sequence[float], by_noise: float) -> bool:
    """Say whether the last steps of a fit gained next to nothing while far more than noise is left.

    Parameters
    ----------
    left : sequence of float
        Weighted squares that each step left, with the same weights, from the one after ``WEIGHED`` on.
    by_noise : float
        What noise leaves of them: the number of pixels.

    Returns
    -------
    bool
    """
    return len(left) > _MOST and all(
        left[i] > max(_UNLIKE * by_noise, (1 - _GAINED) * min(left[:i])) for i in range(len(left) - _MOST, len(left))
    )
