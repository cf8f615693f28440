"""Images without a partner: clutter, and now and then a marker that the other focus does not show; learnt from the films at hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import expit

from rsa_vision.identify.densities import log_kernels, log_student, some_of, weighted_median
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
    images = np.flatnonzero(known)
    for at in some_of(images, int(clear.sum())):
        odds[at] += log_kernels(value[at], value[clear], of_pairs[clear], np.hypot(kind, unsure[at]), 2 * pairs) - broad[at]
    hidden = _hidden(float(single @ expit(odds)), pairs)
    presumed = hidden * 2 * pairs
    of_image = np.zeros(len(one))
    for at in some_of(images, len(images)):  # among those fitted as well as this one, or as badly
        well = quality[at] == 0
        others = at[:, None] != images
        weight = others * np.where(well[:, None] == (quality[images] == 0), single[images], 0.0)
        of_markers = others * of_pairs[images]
        unknown, markers = UNKNOWN * np.where(well, 1, CLASSES - 1) / CLASSES, presumed * np.where(well, shares[0], 1 - shares[0])
        n, width = weight.sum(axis=1), np.hypot(kind, unsure[at])
        # unlike those of markers, their looks have no kind: how far they spread is not told by one or two
        spread = np.hypot(np.hypot(width, unsure[at]), wide / (2 * np.sqrt(n + 1))[:, None])
        parts = np.full((3, len(at)), -np.inf)
        parts[0] = np.log(unknown) + broad[at]
        some = n > 0
        parts[1, some] = np.log(n[some]) + log_kernels(value[at[some]], value[images], weight[some], spread[some], n[some])
        some = of_markers.sum(axis=1) > 0
        parts[2, some] = np.log(markers[some]) + log_kernels(value[at[some]], value[images], of_markers[some], width[some], 2 * pairs)
        of_image[at] = np.logaddexp.reduce(parts, axis=0) - np.log(n + markers + unknown)
    density = of_image[np.searchsorted(looks.image[one], looks.image)]
    return Alone(density, _log_quality(looks, one, paired, presumed), hidden)


def _log_quality(looks: Looks, one: Int, paired: Float, presumed: float) -> Float:
    """Return how much likelier the class of every ray's image is with a partner than without, by the other images.

    Among those without are presumed ones, as for the looks: hidden markers, and some of any class.
    """
    mine = np.eye(CLASSES)[looks.quality]
    of_all, own = np.eye(CLASSES)[looks.quality[one]], paired[one][np.searchsorted(looks.image[one], looks.image), None]
    with_partner = np.maximum(paired[one] @ of_all - own * mine, 0.0) + 1 / CLASSES
    with_partner /= with_partner.sum(axis=1, keepdims=True)
    without = np.maximum((1 - paired[one]) @ of_all - (1 - own) * mine, 0.0) + presumed * with_partner + UNKNOWN / CLASSES
    without /= without.sum(axis=1, keepdims=True)
    return np.asarray(np.log((with_partner * mine).sum(axis=1) / (without * mine).sum(axis=1)))


def _shares(quality: Int, weight: Float) -> Float:
    """Return the share of every class among images that count by a weight, and one more that is presumed in equal parts."""
    count = np.bincount(quality, weight, CLASSES) + 1 / CLASSES
    result: Float = count / count.sum()
    return result


def _hidden(alone: float, pairs: float) -> float:
    return min((alone + HIDDEN[0]) / (pairs + alone + HIDDEN[1]), 0.5)
