"""What two images of one marker look like, against images without a partner; both are learnt from the films at hand.

The images of a marker have the size and contrast of the other markers, and agree with each other, better still, in the size that their
depth implies and in contrast. Images without a partner look like anything: clutter, or now and then a marker that the other focus does not
show. Logarithms of size and contrast are used throughout, so that a shift is a factor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import expit, gammaln

from rsa_vision.types import Bool, Float, Int

LEARNT_FROM: Final = 3.0  # pairs (sum of their probabilities) that teach what pairs look like
USUAL: Final = np.array([0.05, 0.10])  # sd of the ratio of sizes, and of contrasts: a guess that weighs like USUAL_COUNT pairs
USUAL_COUNT: Final = 1.0
LEAST: Final = np.array([0.01, 0.03])
KIND: Final = np.array([0.03, 0.05])  # sd of sizes and contrasts within a kind of ball
WIDE: Final = np.array([0.7, 0.7])  # sd of sizes and contrasts of any images
HIDDEN: Final = (0.5, 10.0)  # markers that one focus does not show, of all: a guess of one in twenty, which weighs like ten markers
UNKNOWN: Final = 2.0  # images that look like anything, which are presumed beside those at hand
UNLIKE: Final = (0.5, 10.0)  # pairs that do not look like one (bone before one image, a film's toe), of all: as HIDDEN
NEW_KIND: Final = (0.5, 10.0)  # markers of a size or contrast that no other has, of all: as HIDDEN
FAR: Final = 4.0  # spreads from which a pair does not look like one
UNSURE: Final = np.array([0.2, 0.4])  # error of the logs of size and contrast of an image that is not clear
FAINT: Final = 1e-3  # pairs less probable than that teach nothing
CLASSES: Final = 3  # of images: clear, disturbed (by a neighbour, an edge, saturation), and not described by the model


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """What is known of the looks of rays and of their crossings.

    Attributes
    ----------
    image : ndarray of int, shape (n,)
        Image of every ray.
    of_ray : ndarray of shape (n, 2)
        Log of apparent radius and of contrast; NaN where unknown.
    quality : ndarray of int, shape (n,)
        Class of the image of every ray, below :data:`CLASSES`.
    a, b : ndarray of int, shape (m,)
        The rays of every crossing.
    grown_a, grown_b : ndarray of shape (m,)
        Log of the factor by which a marker at the crossing is smaller than its images.
    """

    image: Int
    of_ray: Float
    quality: Int
    a: Int
    b: Int
    grown_a: Float
    grown_b: Float

    @property
    def unsure(self) -> Float:
        """Error of the look of every ray, shape (n, 2)."""
        result: Float = np.where((self.quality > 0)[:, None], UNSURE[: self.of_ray.shape[1]], 0.0)
        return result

    @property
    def sizes(self) -> Looks:
        """The same without contrast."""
        return replace(self, of_ray=self.of_ray[:, :1])

    def as_usual_here(self, pair: Float) -> Looks:
        """Take disturbed images for clear ones where too few pairs are clear to teach: on saturated films all look like that.

        Parameters
        ----------
        pair : ndarray of shape (m,)
            Probability of every crossing to be a marker, so far.

        Returns
        -------
        Looks
        """
        clear = (self.quality[self.a] == 0) & (self.quality[self.b] == 0)
        return self if pair[clear].sum() >= LEARNT_FROM else replace(self, quality=np.maximum(self.quality - 1, 0))


def log_odds_of_looks(looks: Looks, pair: Float, alone: Alone, alone_by_size: Alone) -> Float:
    """Return the log likelihood ratio of what the images of crossings look like: one marker, against two images without partners.

    Parameters
    ----------
    looks : Looks
    pair : ndarray of shape (m,)
        Probability of every crossing to be a marker, so far.
    alone : Alone
    alone_by_size : Alone
        Of the sizes only.

    Returns
    -------
    ndarray of shape (m,)
        0 where neither look is known or too few pairs have taught. No crossing is judged by what its own rays have taught.

    Notes
    -----
    Two images of different markers need no place in this ratio: the assignments that give each its own partner speak against theirs. A pair
    that does not look like one may still do so in size: bone before one image, or another exposure, changes its contrast only.
    """
    like, unlike = _log_like(looks, pair, alone)
    like_in_size, unlike_in_size = _log_like(looks.sizes, pair, alone_by_size)
    share = (UNLIKE[0] / 2 + unlike_in_size) / (UNLIKE[0] + np.maximum(unlike, unlike_in_size))  # of the pairs unlike in either
    taught = float(pair.sum())
    part = (UNLIKE[0] + unlike) / (UNLIKE[1] + taught)
    rest = np.logaddexp(np.log1p(-share) + like_in_size, np.log(share))
    result: Float = np.logaddexp(np.log1p(-part) + like, np.log(part) + rest)
    return result


def _log_like(looks: Looks, pair: Float, alone: Alone) -> tuple[Float, Float]:
    """Return the log likelihood ratio of pairs that look like one, and how many of the teachers of each do not; zeros if none taught."""
    d = looks.of_ray.shape[1]
    first, second = looks.of_ray[looks.a].copy(), looks.of_ray[looks.b].copy()
    first[:, 0] += looks.grown_a
    second[:, 0] += looks.grown_b
    known_a: Bool = np.array(np.isfinite(first).all(axis=1))
    known_b: Bool = np.array(np.isfinite(second).all(axis=1))
    unsure_a, unsure_b = looks.unsure[looks.a], looks.unsure[looks.b]
    # what a marker looks like is told by both images, or by the one that is known, or clear
    weight_a = np.where(known_a, np.where(unsure_a[:, 0] > 0, 1e-3, 1.0), 0.0)[:, None]
    weight_b = np.where(known_b, np.where(unsure_b[:, 0] > 0, 1e-3, 1.0), 0.0)[:, None]
    both = np.maximum(weight_a + weight_b, 1e-9)
    mean = (weight_a * np.nan_to_num(first) + weight_b * np.nan_to_num(second)) / both
    unsure = np.hypot(weight_a * unsure_a, weight_b * unsure_b) / both
    of_pair = np.column_stack([mean, first - second])
    teachers = np.flatnonzero(known_a & known_b & ~unsure_a.any(axis=1) & ~unsure_b.any(axis=1) & (pair > FAINT))
    result, unlike = np.zeros(len(pair)), np.zeros(len(pair))
    for e in np.flatnonzero(known_a | known_b):
        free = teachers[(looks.a[teachers] != looks.a[e]) & (looks.b[teachers] != looks.b[e])]
        weight = pair[free]
        n = float(weight.sum())
        if n < LEARNT_FROM:
            continue
        ratios = first[free] - second[free]
        middle = _weighted_median(ratios, weight)
        deviation = np.abs(ratios - middle)
        spread = np.maximum(1.4826 * _weighted_median(deviation, weight), LEAST[:d])
        spread = np.sqrt((n * spread**2 + USUAL_COUNT * USUAL[:d] ** 2) / (n + USUAL_COUNT))
        unlike[e] = weight[(deviation > FAR * spread).any(axis=1)].sum()
        new, wide = NEW_KIND[0] / (NEW_KIND[1] + n), np.hypot(WIDE[:d], unsure[e])
        of_new = float((log_student((mean[e] - _weighted_median(mean[free], weight)) / wide, 3.0) - np.log(wide)).sum())
        of_known = log_kernels(mean[e], mean[free], weight, np.hypot(np.hypot(KIND[:d], unsure[e]), spread / 2), n)
        marker = float(np.logaddexp(np.log1p(-new) + of_known, np.log(new) + of_new))
        if known_a[e] and known_b[e]:
            wider = np.hypot(spread * np.sqrt(1 + 1 / n), np.hypot(unsure_a[e], unsure_b[e]))
            marker += float((log_student((first[e] - second[e] - middle) / wider, min(n, 4.0)) - np.log(wider)).sum())
            # where two exposures lap on a film, contrasts come in sorts: as likely, a pair looks like one of the other pairs
            width = np.hypot([*KIND[:d], *np.minimum(spread, USUAL[:d])], [*unsure[e], *np.hypot(unsure_a[e], unsure_b[e])])
            marker = np.logaddexp(marker, log_kernels(of_pair[e], of_pair[free], weight, width, n)) - np.log(2)
        result[e] = marker - known_a[e] * alone.log_density[looks.a[e]] - known_b[e] * alone.log_density[looks.b[e]]
    return result, unlike


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
    middle = _weighted_median(value[clear], np.ones(int(clear.sum())))
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
            parts.append(np.log(n) + log_kernels(value[k], value[alike], weights[0][alike], np.hypot(widths, unsure[k]), n))
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


def log_kernels(value: Float, sample: Float, weight: Float, least: Float, n: float) -> float:
    """Return the log of a kernel density estimate; kernels of half of Scott's width, since there may be several kinds of balls."""
    middle = weight @ sample / weight.sum()
    spread = np.sqrt(weight @ (sample - middle) ** 2 / weight.sum())
    return _log_density(value, sample, weight, np.hypot(least, 0.5 * max(n, 1.0) ** (-1 / 6) * spread), n)


def _log_density(value: Float, sample: Float, weight: Float, width: Float, n: float) -> float:
    kernels = (log_student((value - sample) / width, n) - np.log(width)).sum(axis=1)
    with np.errstate(divide="ignore"):
        return float(np.logaddexp.reduce(kernels + np.log(weight / weight.sum())))


def _weighted_median(values: Float, weight: Float) -> Float:
    """Return the median of every column."""
    order = np.argsort(values, axis=0)
    total = np.cumsum(weight[order], axis=0)
    place = (total < total[-1] / 2).sum(axis=0)
    result: Float = np.take_along_axis(values, np.take_along_axis(order, place[None], axis=0), axis=0)[0]
    return result


def log_student(t: Float, freedom: float) -> Float:
    """Return the log density of Student's t distribution, of two degrees of freedom at least."""
    v = max(float(freedom), 2.0)
    scale = gammaln((v + 1) / 2) - gammaln(v / 2) - 0.5 * np.log(v * np.pi)
    result: Float = scale - (v + 1) / 2 * np.log1p(np.square(t) / v)
    return result
