"""Pins that may be what was seen of a tee, by tees beside them or what meets at their tips; tees that may be letters or edges of plates."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.places import gaps
from rsa_vision.detect.models.needles import NeedleFit, wrapped
from rsa_vision.detect.needles.pointed import LEAST_OF_A_KIND
from rsa_vision.types import Bool, Float

_FEW_PINS, _PARALLEL = 3, 0.25  # times as many tees as pins, beside which these may be what is seen of a tee; radians
_GAP = 0.6  # of their length, between tips of arms of which film hides the middle
_AT_TIP = 0.35  # of a pin's length, from its tip to where three arms meet
_AWAY = np.array([0.35, 0.5, 0.65])  # of a pin's length from its tip, where another is sought
_AS_WIDE = 0.35  # logarithms of the half widths of the tees of a set, which stand for depth
# logarithms of lengths that are alike; explained of tees, from which several, and each alone, are no letters
_AS_LONG, _CLOSELY, _TO_THE_LAST = 0.2, 0.99, 0.995
_WORSE, _BADLY = 4.0, 0.1  # times its half width over what a tee stands above noise; parts of that width
_WAYS, _BESIDE, _OWN = 72, 6, 9  # directions; steps of these to what lies beside an arm, and within which all is the pin itself
_AS_HIGH = 0.5  # of the pin's own height there


def perhaps_arms(needles: list[NeedleFit], junctions: Float) -> Bool:
    """Say which pins may be what is seen of a tee: an edge may hide the rest.

    Those at whose tips three arms meet, one of them along the pin, those that begin at one place or point at each other's tips across a
    gap, where film may show nothing of three, and those parallel to an arm of the nearest tee, where they are few.
    """
    pin = np.array([len(f.angles) == 1 for f in needles], bool)
    tip, half = np.array([f.position_px for f in needles]).reshape(-1, 2), np.array([f.shape.half_width_px for f in needles])
    together = pin & pin[:, None] & ((gaps(tip, tip) < half + half[:, None]) | _face_each_other(needles))
    out = np.asarray(together.sum(axis=1) > 1)  # a pin is at its own place
    tees = [f for f, single in zip(needles, pin, strict=True) if not single]
    place = np.array([t.position_px for t in tees]).reshape(-1, 2)
    few = 0 < np.count_nonzero(pin) * _FEW_PINS <= len(tees)
    for k in np.flatnonzero(pin):
        angle = needles[k].angles[0]
        near = junctions[np.hypot(*(junctions[:, :2] - tip[k]).T) < _AT_TIP * needles[k].shape.length_px]
        arms = (near[:, 2, None] + [0.0, np.pi / 2, -np.pi / 2]).ravel()
        if few:
            arms = np.append(arms, tees[int(np.hypot(*(place - tip[k]).T).argmin())].angles)
        out[k] |= np.abs(wrapped(arms - angle)).min(initial=np.inf) < _PARALLEL
    return out


def _face_each_other(needles: list[NeedleFit]) -> Bool:
    """Say which have the tips of which before their own, and point at them, shape (n, n)."""
    tip, way = np.array([[f.position_px, f.way] for f in needles]).reshape(-1, 2, 2).transpose(1, 0, 2)
    length, gap = np.array([f.shape.length_px for f in needles]), tip - tip[:, None]
    apart = np.hypot(*gap.transpose(2, 0, 1))
    ahead = -(way[:, None] * gap).sum(axis=2) > math.cos(_PARALLEL) * apart
    return np.asarray(ahead & ahead.T & (apart < _GAP * np.minimum(length, length[:, None])))


def meet_others(film: NDArray[Any], needles: list[NeedleFit]) -> Bool:
    """Say at the tips of which pins something else begins that is half as high as they are and as narrow: one of their arms, most likely.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    needles : list of NeedleFit
        Tees among them have their arms.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    return np.array([len(f.angles) == 1 and _meets_others(film, f) for f in needles], bool)


def _meets_others(film: NDArray[Any], pin: NeedleFit) -> bool:
    turn = pin.angles[0] + 2 * np.pi * np.arange(_WAYS) / _WAYS
    out = pin.shape.length_px * _AWAY[:, None]
    at = pin.position_px[:, None, None] + np.array([out * np.cos(turn), -out * np.sin(turn)])
    low = np.clip(np.floor(at.min((1, 2))).astype(int) - 2, 0, None)
    high = np.ceil(at.max((1, 2))).astype(int) + 3
    around = np.sign(pin.depth) * film[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    cols, rows = (np.asarray(of - first, np.float32) for of, first in zip(at, low, strict=True))
    seen = cv2.remap(np.asarray(cv2.blur(around, (3, 3))), cols, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    above = seen - np.maximum(np.roll(seen, _BESIDE, axis=1), np.roll(seen, -_BESIDE, axis=1))
    as_high: Bool = np.all(above > _AS_HIGH * above[:, :1], axis=0)
    return bool(above[:, 0].min() > 0 and as_high[_OWN : 1 - _OWN].any())


def lone_tees(needles: list[NeedleFit], sure: Bool) -> Bool:
    """Say which tees have not two sure ones beside them that are about as wide and parallel, as those of a set are.

    Of those that are explained closely, it is enough that they are as long: of letters no model of pointed arms explains so much. What is
    explained more closely still, needs no company.

    Parameters
    ----------
    needles : list of NeedleFit
        Pins are none.
    sure : ndarray of bool, shape (n,)

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    tee = np.array([len(f.angles) > 1 for f in needles], bool)
    width, angle = np.log([f.shape.half_width_px for f in needles]), np.array([f.angles[0] for f in needles])
    length, form = np.log([f.shape.length_px for f in needles]), np.where(sure, [f.explained for f in needles], 0.0)
    close = form > _CLOSELY
    of_a_set = np.abs(wrapped(angle[:, None] - angle)) < _PARALLEL
    of_a_set |= close[:, None] & close & (np.abs(length[:, None] - length) < _AS_LONG)
    alike = of_a_set & (np.abs(width[:, None] - width) < _AS_WIDE) & tee & sure
    alike[np.diag_indices(len(tee))] = True
    return np.asarray(tee & (alike.sum(axis=1) < LEAST_OF_A_KIND) & (form < _TO_THE_LAST))


def badly_placed(covariance_px2: Float, half_width_px: Float, snr: Float) -> Bool:
    """Say of which tees the place is known badly, and far worse than noise lets it be: something else that has three arms.

    The edges of its arms tell where a tip is to about their half width over what they stand above noise.

    Parameters
    ----------
    covariance_px2 : ndarray of shape (n, 2, 2)
    half_width_px : ndarray of shape (n,)
    snr : ndarray of shape (n,)
        What the arms stand above noise, in its standard deviations in a pixel.

    Returns
    -------
    ndarray of bool, shape (n,)
        Not those of which no place is known at all.
    """
    known = np.asarray(np.isfinite(covariance_px2).all(axis=(1, 2)))
    sd_px = np.zeros(len(covariance_px2))
    sd_px[known] = np.sqrt(np.linalg.eigvalsh(covariance_px2[known])[:, -1])
    return np.asarray(sd_px > half_width_px * np.maximum(_WORSE / snr, _BADLY))
