"""What two images of one marker look like, against images without a partner; both are learnt from the films at hand.

The images of a marker have the size and contrast of the other markers, and agree with each other, better still, in the size that their
depth implies and in contrast. What lies before them, and the exposure, change their contrasts; with its contrast the fitted size of an
image changes by little, but alike on all films of an examination.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rsa_vision.identify.alone import Alone
from rsa_vision.identify.densities import log_kernels, log_student, some_of, weighted_median
from rsa_vision.identify.looks import FAINT, KIND, LEARNT_FROM, WIDE, Looks
from rsa_vision.types import Bool, Float, Int

USUAL: Final = np.array([0.05, 0.10])  # sd of the ratio of sizes, and of contrasts: a guess that weighs like USUAL_COUNT pairs
USUAL_COUNT: Final = 1.0
LEAST: Final = np.array([0.01, 0.03])
SLOPE: Final = 0.1  # of log size against log contrast, sd; 0.5 would leave the light that a ball takes away unchanged
UNLIKE: Final = (0.5, 10.0)  # pairs that do not look like one (bone before one image, a film's toe), of all: as HIDDEN
NEW_KIND: Final = (0.5, 10.0)  # markers of a size or contrast that no other has, of all: as HIDDEN
FAR: Final = 4.0  # spreads from which a pair does not look like one
PRESUMED: Final = 0.5  # pairs that each model describes, beside those at hand (Jeffreys)
TURNS: Final = 4  # of estimates that depend on each other: slope and spread, models and their parts


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
    like_in_size, unlike_in_size = _log_like(looks, pair, alone_by_size, contrast=False)
    presumed = UNLIKE[1] + float(pair.sum())
    if looks.of_ray.shape[1] == 1:
        return _either(like_in_size, 0.0, (UNLIKE[0] + unlike_in_size) / presumed)
    like, unlike = _log_like(looks, pair, alone, contrast=True)
    share = (UNLIKE[0] / 2 + unlike_in_size) / (UNLIKE[0] + np.maximum(unlike, unlike_in_size))  # of the pairs unlike in either
    return _either(like, _either(like_in_size, 0.0, share), (UNLIKE[0] + unlike) / presumed)


def _either(log_usual: Float, log_other: Float | float, part: Float) -> Float:
    """Return the log of a mixture of two densities, the second of which has a part."""
    result: Float = np.logaddexp(np.log1p(-part) + log_usual, np.log(part) + log_other)
    return result


def _log_like(looks: Looks, pair: Float, alone: Alone, *, contrast: bool) -> tuple[Float, Float]:
    """Return the log likelihood ratio of pairs that look like one, and how many of the teachers of each do not; zeros if none taught.

    Three models say what a marker's two images look like: like those of all markers, and like each other; like the two of one of the other
    pairs, since contrasts come in sorts where two exposures lap on a film; or of one size, each with the contrast of any image of a marker
    from its focus, since bone lies before one and not before the other. How often each holds, the other pairs tell.
    """
    d = 2 if contrast else 1
    look = np.zeros((len(looks.of_ray), 2))  # sizes alone are as at one contrast
    look[:, : looks.of_ray.shape[1]] = looks.of_ray
    first, second = look[looks.a], look[looks.b]
    first[:, 0] += looks.grown_a
    second[:, 0] += looks.grown_b
    known_a: Bool = np.array(np.isfinite(first).all(axis=1))
    known_b: Bool = np.array(np.isfinite(second).all(axis=1))
    first, second = np.nan_to_num(first), np.nan_to_num(second)  # what is not known weighs nothing
    unsure_a, unsure_b = looks.unsure[looks.a], looks.unsure[looks.b]
    # what a marker looks like is told by both images, as well as each is known
    weight_a = np.where(known_a, 1 / (KIND[0] ** 2 + unsure_a[:, 0] ** 2), 0.0)[:, None]
    weight_b = np.where(known_b, 1 / (KIND[0] ** 2 + unsure_b[:, 0] ** 2), 0.0)[:, None]
    both = np.maximum(weight_a + weight_b, 1e-9)
    of_both = (weight_a * first + weight_b * second) / both
    clear = looks.quality == 0
    teachers = np.flatnonzero(known_a & known_b & clear[looks.a] & clear[looks.b] & (pair > FAINT))
    models, unlike = np.zeros((len(pair), 3 if contrast else 2)), np.zeros(len(pair))
    weights = pair[teachers] * ((looks.a[teachers] != looks.a[:, None]) & (looks.b[teachers] != looks.b[:, None]))
    told = (known_a | known_b) & (weights.sum(axis=1) >= LEARNT_FROM)
    unsure = np.hypot(weight_a * unsure_a, weight_b * unsure_b)[:, :d] / both
    compared, of_ratio = first - second, np.hypot(unsure_a, unsure_b)
    for at in some_of(np.flatnonzero(told), len(teachers)):  # of each of these (k), by its own teachers (t)
        weight, paired = weights[at], known_a[at] & known_b[at]
        n = weight.sum(axis=1)
        slope, slope_sd = _slope(compared[teachers], weight)
        mean, ratio = (_at_one_contrast(of[at], slope)[:, :d] for of in (of_both, compared))
        means, ratios = (_at_one_contrast(np.tile(of[teachers], (len(at), 1, 1)), slope[:, None])[..., :d] for of in (of_both, compared))
        middle = weighted_median(ratios, weight)
        deviation = np.abs(ratios - middle[:, None])
        spread = np.maximum(1.4826 * weighted_median(deviation, weight), LEAST[:d])
        spread = np.sqrt((n[:, None] * spread**2 + USUAL_COUNT * USUAL[:d] ** 2) / (n[:, None] + USUAL_COUNT))
        unlike[at] = (weight * (deviation > FAR * spread[:, None]).any(axis=2)).sum(axis=1)
        width, wide = np.hypot(np.hypot(KIND[:d], unsure[at]), spread / 2), np.hypot(WIDE[:d], unsure[at])
        marker = _of_kinds(mean, means, weight, width, wide)
        models[at] = marker[:, None]
        apart = compared[at, 1] - weighted_median(np.tile(compared[teachers, 1:], (len(at), 1, 1)), weight)[:, 0]
        error = np.hypot(of_ratio[at], np.stack([slope_sd * apart, np.zeros(len(at))], axis=1))[:, :d]
        wider = np.hypot(spread * np.sqrt(1 + 1 / n)[:, None], error)
        agree = log_student((ratio - middle) / wider, np.minimum(n, 4.0)[:, None]) - np.log(wider)
        models[at[paired], 0] += agree[paired].sum(axis=1)
        of_pair = np.hypot(np.hstack([np.tile(KIND[:d], (len(at), 1)), np.minimum(spread, USUAL[:d])]), np.hstack([unsure[at], error]))
        like_one = log_kernels(np.hstack([mean, ratio]), np.concatenate([means, ratios], axis=2), weight, of_pair, n)
        models[at[paired], 1] = like_one[paired]
        if contrast:
            of_size = _of_kinds(mean[:, :1], means[..., :1], weight, width[:, :1], wide[:, :1]) + agree[:, 0]
            # of balls as large as this one: thicker balls take more light away
            alike = weight * np.exp(log_student((mean[:, :1] - means[..., 0]) / width[:, :1], n[:, None]))
            for of_one, sure in ((first[:, 1:], unsure_a), (second[:, 1:], unsure_b)):
                theirs = np.tile(of_one[teachers], (len(at), 1, 1))
                of_size += log_kernels(of_one[at], theirs, alike, np.hypot(KIND[1:], sure[at, 1:]), n)
            models[at[paired], 2] = of_size[paired]
    result = np.logaddexp.reduce(models + np.log(_parts(models, teachers, weights)), axis=1)
    result -= known_a * alone.log_density[looks.a] + known_b * alone.log_density[looks.b]
    return np.where(told, result, 0.0), unlike


def _at_one_contrast(looks: Float, slope: Float) -> Float:
    """Return looks (..., 2) with sizes as they would be at one contrast."""
    return np.stack([looks[..., 0] - slope * looks[..., 1], looks[..., 1]], axis=-1)


def _of_kinds(value: Float, sample: Float, weight: Float, width: Float, wide: Float) -> Float:
    """Return the log density (k,) of what markers look like: like one of the others, or the only one of its kind."""
    n = weight.sum(axis=-1)
    new = NEW_KIND[0] / (NEW_KIND[1] + n)
    of_new = (log_student((value - weighted_median(sample, weight)) / wide, 3.0) - np.log(wide)).sum(axis=-1)
    return np.asarray(np.logaddexp(np.log1p(-new) + log_kernels(value, sample, weight, width, n), np.log(new) + of_new))


def _slope(ratios: Float, weight: Float) -> tuple[Float, Float]:
    """Return how log sizes change with log contrasts, and its error, by the two images (t, 2) of each marker: a ball has one size.

    By every row (k, t) of weights, shape (k,).
    """
    slope, slope_sd = np.zeros(len(weight)), np.full(len(weight), SLOPE)
    n = weight.sum(axis=1)
    for _ in range(TURNS):
        rest = (ratios[:, 0] - slope[:, None] * ratios[:, 1])[..., None]
        deviation = (rest - weighted_median(rest, weight)[:, None])[..., 0]
        spread = np.maximum(1.4826 * weighted_median(np.abs(deviation)[..., None], weight)[:, 0], LEAST[0])
        spread = np.sqrt((n * spread**2 + USUAL_COUNT * USUAL[0] ** 2) / (n + USUAL_COUNT))
        trust = weight * 5 / (4 + (deviation / spread[:, None]) ** 2)  # Student's, of four degrees of freedom
        off = ratios - ((trust @ ratios) / trust.sum(axis=1, keepdims=True))[:, None]
        normal = (trust * off[..., 1] ** 2).sum(axis=1) + (spread / SLOPE) ** 2
        slope, slope_sd = (trust * off[..., 0] * off[..., 1]).sum(axis=1) / normal, spread / np.sqrt(normal)
    return slope, slope_sd


def _parts(models: Float, teachers: Int, weights: Float) -> Float:
    """Return the share of every model among the teachers of each crossing, half a one presumed for each; shape as `models`."""
    parts = np.full(models.shape, 1 / models.shape[1])
    of_teachers = models[teachers]
    for _ in range(TURNS):
        mine = of_teachers + np.log(parts)[:, None]
        mine = np.exp(mine - np.logaddexp.reduce(mine, axis=2)[..., None])
        counts = np.einsum("et,etm->em", weights, mine) + PRESUMED
        parts = counts / counts.sum(axis=1, keepdims=True)
    return parts
