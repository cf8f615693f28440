"""GROWTH: all lengths between the points of a model, at two times or against a standard (Selvik, chapter 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.geometry.rigid import best_rotation
from rsa_vision.types import Float

MIRROR_RATIO: Final = 4.0  # a mirror image that fits so much better (sums of squares) is the truth
LEAST_SHARE: Final = 1e-6  # of the model's own sum of squares: less is a flat model, which is its own mirror image
ROD: Final = 0.02  # spread about the best line over that along it, below which a model is a rod
UM: Final = 1000.0
PPM: Final = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """Lengths of one model, and how they have changed.

    Attributes
    ----------
    first, second : ndarray of int, shape (m,)
        Points at the ends of each of the n (n - 1) / 2 lengths.
    length_from_mm, length_to_mm, difference_um, sd_um : ndarray of shape (m,)
        ``sd_um`` of the difference; NaN where no covariances are known.
    rmsv_um : float
        Root mean square of the differences.
    s0_um : float
        Hallert's standard error of one coordinate of a point when a shift of the origin and a scale are taken out.
    scale_ppm : float
        The scale: how much longer the model is.
    form : str
        ``rod``: points in line, coordinates along it, ``s0^2 = sum v^2 / (n - 2)``. ``model``: points in space, whose rotation is taken out
        as well, ``s0^2 = sum v^2 / (3 n - 7)``. ``mirrored``: points whose mirror image fits far better; they have no s0 and no scale.
        Empty where the points lie in one place.
    """

    first: np.ndarray[tuple[int], np.dtype[np.int64]]
    second: np.ndarray[tuple[int], np.dtype[np.int64]]
    length_from_mm: Float
    length_to_mm: Float
    difference_um: Float
    sd_um: Float
    rmsv_um: float
    s0_um: float
    scale_ppm: float
    form: str


def compare_lengths(source_mm: Float, target_mm: Float, source_mm2: Float, target_mm2: Float) -> Growth:
    """Compare all lengths of two sets of points that correspond.

    Parameters
    ----------
    source_mm, target_mm : ndarray of shape (n, 3)
        At the first time (or the standard) and at the second.
    source_mm2, target_mm2 : ndarray of shape (n, 3, 3)
        Covariances; NaN where not known. Those of a standard may be 0.

    Returns
    -------
    Growth
        NaN for what too few points do not determine: s0 and the scale of a rod need 3 points, those of a model as well.
    """
    first, second = np.triu_indices(len(source_mm), 1)
    lengths, variances = [], []
    for points, errors in ((source_mm, source_mm2), (target_mm, target_mm2)):
        way = points[second] - points[first]
        length = np.linalg.norm(way, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = way / length[:, None]
        lengths.append(length)
        variances.append(np.einsum("ka,kab,kb->k", unit, errors[first] + errors[second], unit))
    difference = (lengths[1] - lengths[0]) * UM
    rmsv = float(np.sqrt((difference**2).mean())) if len(difference) else np.nan
    s0, scale, form = _hallert(source_mm, target_mm)
    return Growth(
        first, second, lengths[0], lengths[1], difference, np.sqrt(variances[0] + variances[1]) * UM, rmsv, s0 * UM, scale * PPM, form
    )


def _hallert(source: Float, target: Float) -> tuple[float, float, str]:
    """Return the standard error of a coordinate (mm), the scale less 1, and the form of the model."""
    n = len(source)
    if n < 3:
        return np.nan, np.nan, ""
    before, after = source - source.mean(axis=0), target - target.mean(axis=0)
    if not ((before**2).sum() > 0 and (after**2).sum() > 0):
        return np.nan, np.nan, ""
    _, singular, right = np.linalg.svd(before)
    if np.hypot(singular[1], singular[2]) < ROD * singular[0]:
        # along its own line at each time: how a rod lies is no error
        along = before @ right[0]
        other = np.linalg.svd(after)[2][0]
        place = after @ other * np.sign((after @ other) @ along)
        scale = float(place @ along / (along @ along))
        return float(np.sqrt(((place - scale * along) ** 2).sum() / (n - 2))), scale - 1, "rod"
    rotation, singular, handedness = best_rotation(after.T @ before)
    turned = before @ rotation.T
    scale = float((after * turned).sum() / (before**2).sum())
    squares = float(((after - scale * turned) ** 2).sum())
    if handedness < 0:
        reflected = float((after**2).sum() - singular.sum() ** 2 / (before**2).sum())
        if squares > MIRROR_RATIO * max(reflected, LEAST_SHARE * float((after**2).sum())):
            return np.nan, np.nan, "mirrored"
    return float(np.sqrt(squares / (3 * n - 7))), scale - 1, "model"
