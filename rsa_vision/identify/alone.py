"""Images without a partner: clutter, and now and then a marker that the other focus does not show; learnt from the films at hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import expit

from rsa_vision.identify.densities import log_kernels, log_student, weighted_median
from rsa_vision.identify.looks import CLASSES, KIND, WIDE, Looks
from rsa_vision.types import Bool, Float, Int

HIDDEN: Final = (0.5, 10.0)  # markers that one focus does not show, of all: a guess of one in twenty, which weighs like ten markers
UNKNOWN: Final = 2.0  # images that look like anything, which are presumed beside those at hand


@dataclass(frozen=True, slots=True, eq=False)
class Alone:
    """Images without a partner.

    Attributes
    ----------
    log_density : ndarray of shape (n,)
        Of their looks, at that of every ray.
    log_quality : ndarray of shape (n,)
        Log likelihood ratio of the class of every ray's image: with a partner, against without.
    hidden : float
        The part of all markers that one focus does not show.
    """

    log_density: Float
    log_quality: Float
    hidden: float


def images_alone(looks: Looks, paired: Float) -> Alone:
    """Describe the images without a partner, by what is at hand and by presumed ones: hidden markers, and images that look like anything.

    Parameters
    ----------
    looks : Looks
    paired : ndarray of shape (n,)
        Probability of the image of every ray to have a partner.

    Returns
    -------
    Alone
    """
    _, one = np.unique(looks.image, return_index=True)  # on a shared film an image has several rays
    single, pairs = 1 - paired[one], float(paired[one].sum()) / 2
    quality, value, unsure = looks.quality[one], looks.of_ray[one], looks.unsure[one]
    wide, kind = WIDE[: value.shape[1]], KIND[: value.shape[1]]
    known: Bool = np.array(np.isfinite(value).all(axis=1))
    clear = known & (quality == 0)
    density = np.zeros(len(looks.of_ray))
    if not clear.any() or pairs < 0.5:
        return Alone(density, density.copy(), _hidden(float(single.sum()), pairs))
    middle = weighted_median(value[clear], np.ones(int(clear.sum())))
    of_pairs = np.where(clear, np.maximum(paired[one], 1e-9), 0.0)
    broad = (log_student((value - middle) / np.hypot(wide, unsure), 3.0) - np.log(np.hypot(wide, unsure))).sum(axis=1)
    shares = _shares(quality, paired[one])
    odds = np.log(CLASSES * shares)[quality]
    odds[known] += [
        log_kernels(value[k], value[clear], of_pairs[clear], np.hypot(kind, unsure[k]), 2 * pairs) for k in np.flatnonzero(known)
    ]
    odds[known] -= broad[known]
    hidden = _hidden(float(single @ expit(odds)), pairs)
    presumed = hidden * 2 * pairs
    of_image = np.zeros(len(one))
    for k in np.flatnonzero(known):  # among those fitted as well as this one, or as badly
        alike = known & ((quality == 0) == (quality[k] == 0))
        others, unknown = np.arange(len(one)) != k, UNKNOWN * (1 if quality[k] == 0 else CLASSES - 1) / CLASSES
        markers = presumed * float(shares[0] if quality[k] == 0 else 1 - shares[0])
        weights, widths = (np.where(alike & others, single, 0.0), np.where(clear & others, of_pairs, 0.0)), np.hypot(kind, unsure[k])
        parts = [np.log(unknown) + broad[k]]
        if weights[0].sum() > 0:
            n = float(weights[0].sum())
            # unlike those of markers, their looks have no kind: how far they spread is not told by one or two
            spread = np.hypot(np.hypot(widths, unsure[k]), wide / (2 * np.sqrt(n + 1)))
            parts.append(np.log(n) + log_kernels(value[k], value[alike], weights[0][alike], spread, n))
        if weights[1].sum() > 0:
            parts.append(np.log(markers) + log_kernels(value[k], value[clear], weights[1][clear], widths, 2 * pairs))
        of_image[k] = np.logaddexp.reduce(parts) - np.log(weights[0].sum() + markers + unknown)
    density = of_image[np.searchsorted(looks.image[one], looks.image)]
    return Alone(density, _log_quality(looks, one, paired, presumed), hidden)


def _log_quality(looks: Looks, one: Int, paired: Float, presumed: float) -> Float:
    """Return how much likelier the class of every ray's image is with a partner than without, by the other images.

    Among those without are presumed ones, as for the looks: hidden markers, and some of any class.
    """
    result = np.zeros(len(looks.quality))
    for ray, mine in enumerate(looks.quality):
        others = one[looks.image[one] != looks.image[ray]]
        with_partner, single = _shares(looks.quality[others], paired[others]), 1 - paired[others]
        without = np.bincount(looks.quality[others], single, CLASSES) + presumed * with_partner + UNKNOWN / CLASSES
        result[ray] = np.log(with_partner[mine] / (without[mine] / without.sum()))
    return result


def _shares(quality: Int, weight: Float) -> Float:
    """Return the share of every class among images that count by a weight, and one more that is presumed in equal parts."""
    count = np.bincount(quality, weight, CLASSES) + 1 / CLASSES
    result: Float = count / count.sum()
    return result


def _hidden(alone: float, pairs: float) -> float:
    return min((alone + HIDDEN[0]) / (pairs + alone + HIDDEN[1]), 0.5)
