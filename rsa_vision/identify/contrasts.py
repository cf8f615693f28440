"""Contrasts of the images of one film as they would be on one background.

A ball takes away a part of the light that falls on it. On films whose values go with the light its image is the fainter the more lies
before it; on logarithmic ones it is not, but scatter and the toe of the film make it so, too. Each film shows how its contrasts go.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.types import Bool, Float

LEAST_IMAGES: Final = 6  # that tell
MOST_IMAGES: Final = 40  # that are asked
LEAST_EVIDENCE: Final = 5.0  # log likelihood ratio: one film in 150 shows a dependence by chance
LEAST_PART: Final = 0.1  # of the usual contrast: no line leads to nothing


def contrasts_alike(contrast: Float, background: Float, clear: Bool) -> Float:
    """Return contrasts as they would be on the usual background, if the film shows that they go with it.

    The line of least absolute deviations goes through two of the points: all such lines are tried (Bloomfield and Steiger, 1983). They are
    deviations of logarithms, so that of balls of several sizes the most numerous decide.

    Parameters
    ----------
    contrast : ndarray of shape (n,)
    background : ndarray of shape (n,)
        NaN where not known.
    clear : ndarray of bool, shape (n,)
        The images to learn from.

    Returns
    -------
    ndarray of shape (n,)
        Unchanged where the film does not tell.
    """
    free = np.flatnonzero(clear & np.isfinite(background) & (contrast > 0))
    if len(free) < LEAST_IMAGES:
        return contrast
    free = free[np.argsort(background[free], kind="stable")]
    free = free[np.unique(np.linspace(0, len(free) - 1, min(len(free), MOST_IMAGES)).round().astype(int))]
    x, y = background[free], contrast[free]
    usual = float(np.median(y))
    one, other = np.triu_indices(len(x), 1)
    apart = x[other] - x[one]
    one, other, apart = one[apart > 0], other[apart > 0], apart[apart > 0]
    slope = (y[other] - y[one]) / apart
    lines = np.column_stack([y[one] - slope * x[one], slope])
    expected = np.maximum(lines @ np.vstack([np.ones(len(x)), x]), LEAST_PART * usual)
    off = np.abs(np.log(y / expected)).sum(axis=1)
    constant = float(np.abs(np.log(y / usual)).sum())
    if not len(off) or len(x) * np.log(max(constant, 1e-9) / max(off.min(), 1e-9)) < LEAST_EVIDENCE + np.log(len(x)):
        return contrast
    a, b = lines[off.argmin()]
    factor = usual / np.maximum(a + b * background, LEAST_PART * usual)
    return np.where(np.isfinite(background), contrast * factor, contrast)
