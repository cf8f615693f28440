"""Selvik's rule for gross errors (Selvik 1989, ch. 2): leave each mark out in turn, drop the one whose omission fits best."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeVar

import numpy as np

from rsa_vision.errors import GeometryError
from rsa_vision.types import Float, Int

STOP_AT: Final = 4  # marks that are never reduced further
EXACT: Final = 1e-9  # fits whose error is below this fraction of the limit are equally exact

Solution = TypeVar("Solution")


def drop_gross_errors(count: int, fit: Callable[[Int], tuple[Solution, Float]], limit: float) -> tuple[Solution, Int]:
    """Fit, and drop marks while the largest error exceeds a limit.

    Parameters
    ----------
    count : int
        Number of marks.
    fit : callable
        Takes the indices of the marks to use; returns the solution and the error of each of these marks. May raise
        :class:`GeometryError`, which counts as an error beyond all limits.
    limit : float
        In the unit of the errors.

    Returns
    -------
    solution
        Of the last fit.
    kept : ndarray of int
        The marks it used: all of them, or at least four.

    Raises
    ------
    GeometryError
        That of the fit to all marks, if no omission helps.
    """
    kept = np.arange(count)
    result: tuple[Solution, Float] | None = None
    failure: GeometryError | None = None
    try:
        result = fit(kept)
    except GeometryError as error:
        failure = error
    while len(kept) > STOP_AT and (result is None or result[1].max() > limit):
        trials: list[tuple[float, float, int, tuple[Solution, Float]]] = []
        for position in range(len(kept)):
            try:
                trial = fit(np.delete(kept, position))
            except GeometryError:
                continue
            rms = float(np.sqrt((trial[1] ** 2).mean()))
            # four fiducial marks always fit exactly: then the mark with the largest error among the five is dropped
            trials.append((rms if rms > EXACT * limit else 0.0, 0.0 if result is None else -float(result[1][position]), position, trial))
        if not trials:
            break
        _, _, position, result = min(trials, key=lambda item: item[:3])
        kept = np.delete(kept, position)
    if result is None:
        raise failure or GeometryError("no marks")
    return result[0], kept
