"""Precision from double examinations: repeated measurements against each other (Selvik 5:3; ISO 16087)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import stdtrit

from rsa_vision.types import Float

WITHIN_95: Final = 1.96


@dataclass(frozen=True, slots=True)
class Precision:
    """Statistics of the differences between double measurements.

    Attributes
    ----------
    n : int
    mean : float
        A systematic difference between first and second measurement, if it is not zero.
    sd : float
        Standard deviation of the differences about their mean.
    limit_95 : float
        1.96 times that.
    from_zero : float
        ``sqrt(sum d^2 / n)``: spread about zero, which is the true difference.
    single : float
        ``sqrt(sum d^2 / (2 n))``, Selvik (5:3): standard error of one measurement.
    median, low, high : float
        Median and range, for what has no sign.
    mean_low, mean_high : float
        95 % confidence interval of the mean (Student's distribution).
    """

    n: int
    mean: float
    sd: float
    limit_95: float
    from_zero: float
    single: float
    median: float
    low: float
    high: float
    mean_low: float
    mean_high: float


def summarise(differences: Float) -> Precision:
    """Return the statistics of differences, shape (n,); those that n does not determine are NaN. NaN among them is left out."""
    d = differences[np.isfinite(differences)]
    n = len(d)
    if n == 0:
        return Precision(0, *[np.nan] * 10)
    mean, sd = float(d.mean()), float(d.std(ddof=1)) if n > 1 else np.nan
    zero = float(np.sqrt((d**2).mean()))
    reach = float(stdtrit(n - 1, 0.975)) * sd / np.sqrt(n) if n > 1 else np.nan
    middle, low, high = float(np.median(d)), float(d.min()), float(d.max())
    return Precision(n, mean, sd, WITHIN_95 * sd, zero, zero / np.sqrt(2), middle, low, high, mean - reach, mean + reach)
