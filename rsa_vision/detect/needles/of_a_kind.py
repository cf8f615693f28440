"""Pins of the kind that a film's clear ones show.

Noise may hide the point of a pin, and bone its form, not its size: where a film has shown a few clear ones, all that looks like them is
asked whether it is one. Those on the edges of bones are fitted with the edge.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import Box
from rsa_vision.detect.models.needles import NeedleFit, turned, unexplained
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.detect.needles.fits import LINE_PX, explains, fit_needles
from rsa_vision.detect.needles.laid_over import LIKENESS, LaidOver, laid_over
from rsa_vision.detect.needles.pointed import (
    LEAST_OF_A_KIND,
    RATHER_THAN_TURNED,
    SIGNIFICANT,
    STANDS_OUT_ROUGHLY,
    is_pin,
    surer_than_rod,
    worse_by,
)
from rsa_vision.detect.needles.sets import on_arms, same_body
from rsa_vision.types import Float, Int

_MOST_IN_VAIN = 50  # places in a row at which there are none
_ROUGHLY = 0.5  # of what a pin must have, for a closer look
_ODD = 6.0  # half the chi2 by which chance makes a pin of the known size worse than a rod, or a pin, of free size
_PALE = 0.5  # of the typical depth
# logarithms of half width and length: how far first looks of one kind differ, and pins of one; part of a film's pins that are of one
_ROUGHLY_ALIKE, _ALIKE, _MOST = 0.35, 0.12, 0.6
_AS_THICK = 0.2  # logarithm of half width: of pins aslant, that look shorter the more they are so
_AT_ALL_ALIKE = float(np.log(2.0))  # the same of pins in much noise
_TELL, _SAME_LENGTH = 6, 0.05  # pins of a film that tell what is odd; logarithm of the lengths of one kind


def others_like(film: NDArray[Any], known: list[NeedleFit], places: Float, optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Find at places the pins of the size of the clear ones.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    known : list of NeedleFit
        Pins.
    places : ndarray of shape (n, 2)
        Where others may be, (col, row).
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        None of the known ones; none at all if these are not of a kind.
    """
    typical = typical_of(known, noise)
    if typical is None:
        return []
    out: list[NeedleFit] = []
    tried, in_vain = np.zeros((0, 2)), 0
    for start in laid_over(film, places[~on_arms(places, known)], [typical], optics):
        tip = start.pin.position_px
        if not _is_as_deep(start.pin, typical, _ROUGHLY * _PALE):
            continue
        if on_arms(start.place[None], out).any() or (np.hypot(*(tried - tip).T) < typical.shape.half_width_px).any():
            continue  # from so near a fit ends at the same pin
        tried, in_vain = np.append(tried, tip[None], axis=0), in_vain + 1
        if in_vain > _MOST_IN_VAIN:
            break
        found = _fit_like(film, start.pin, optics, noise)
        if found and _is_like(film, found, typical, optics, noise) and not any(same_body(found, k) for k in (*known, *out)):
            out.append(found)
            in_vain = 0
    return out


def typical_of(known: list[NeedleFit], noise: NoiseModel) -> NeedleFit | None:
    """Return a pin of the size and depth of a film's clear ones; None if these are not of a kind."""
    clear = [f for f in known if is_pin(f, noise)]
    if not are_of_a_kind(clear):
        return None
    width, length = np.exp(np.median(_log_sizes(clear), axis=0)).tolist()
    return replace(
        clear[0],
        shape=replace(clear[0].shape, half_width_px=width, length_px=length),
        depth=float(np.median([f.depth for f in clear])),
        background=float(np.median([f.background for f in clear])),
    )


def starts_like(
    looks: Iterable[tuple[Box, Float]],
    masked: Callable[[Float], Box],
    typical: NeedleFit,
    known: list[NeedleFit],
    optics: Optics,
    noise: NoiseModel,
) -> list[NeedleFit]:
    """Find where something looks like a typical pin of the film, whatever else may lie there.

    Parameters
    ----------
    looks : iterable of (Box, ndarray of shape (n, 2))
        Parts of the film where they are sought, and places on such pins there, (col, row) on the film.
    masked : callable
        The film around a place, where they are fitted: NaN where they are hidden.
    typical : NeedleFit
        As of :func:`typical_of`.
    known : list of NeedleFit
        Nothing is looked for on these.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        Of the typical size, likest first.
    """
    starts = list[tuple[LaidOver, Int]]()
    for box, places in looks:
        free = places[~on_arms(places, known)] - box.corner_px
        starts += [(start, box.corner_px) for start in laid_over(box.values, free, [typical], optics)]
    out: list[NeedleFit] = []
    in_vain = 0
    for start, corner in sorted(starts, key=lambda of: -of[0].likeness):
        if start.likeness < LIKENESS or in_vain == _MOST_IN_VAIN:
            break
        place = start.place + corner
        if on_arms(place[None], out).any():
            continue
        box = masked(place)
        tip, noise_there = start.pin.position_px + corner - box.corner_px, noise.of_box(box.corner_px)
        fit = fit_needles(box.values, tip, start.pin.angles, typical.shape, optics, noise_there, quick=True, sized=True)
        in_vain += 1
        if fit.depth * typical.depth > 0 and fit.significance > _ROUGHLY * SIGNIFICANT and explains(fit, _ROUGHLY):
            out.append(replace(fit, position_px=fit.position_px + box.corner_px))
            in_vain = 0
    return out


def _fit_like(film: NDArray[Any], typical: NeedleFit, optics: Optics, noise: NoiseModel) -> NeedleFit | None:
    """Fit a pin of the typical size, one of its own where noise allows no other, and with an edge where that is none; None for no pin."""
    first = fit_needles(film, typical.position_px, typical.angles, typical.shape, optics, noise, quick=True, sized=True)
    if first.significance < _ROUGHLY * SIGNIFICANT or not explains(first, _ROUGHLY):
        return None
    ways = (first.position_px, first.angles), turned(first)
    best, other = sorted((fit_needles(film, *way, typical.shape, optics, noise, sized=True) for way in ways), key=unexplained)
    if worse_by(film, best, other, optics, noise) < RATHER_THAN_TURNED:
        return None
    free = fit_needles(film, best.position_px, best.angles, typical.shape, optics, noise)
    best = free if worse_by(film, best, free, optics, noise) < -_ODD else best
    if is_pin(best, noise, STANDS_OUT_ROUGHLY):
        return best
    return replace(fit_crossing(film, [best], optics, noise, edge=True)[0], edged=True)


def _is_like(film: NDArray[Any], fit: NeedleFit, typical: NeedleFit, optics: Optics, noise: NoiseModel) -> bool:
    """Say whether a fit is of the typical kind, and no rod."""
    return is_of_kind(fit, typical, noise) and (fit.edged or surer_than_rod(film, fit, optics, noise) > -_ODD)


def is_of_kind(fit: NeedleFit, typical: NeedleFit, noise: NoiseModel) -> bool:
    """Say whether a fit looks like a pin of the typical size and is as deep, or of as large a part of what is there."""
    return bool(is_pin(fit, noise, STANDS_OUT_ROUGHLY) and are_of_one_size(fit, typical) and _is_as_deep(fit, typical, _PALE))


def of_usual_width(pins: list[NeedleFit]) -> list[NeedleFit]:
    """Widen pins that fits have made lines, as deep as one likes, where most have kept their width: from there no fit of all comes back.

    Parameters
    ----------
    pins : list of NeedleFit

    Returns
    -------
    list of NeedleFit
        In the same order; those are of the usual width, and as much deeper than they show as others.
    """
    line = np.array([f.shape.half_width_px <= LINE_PX for f in pins], bool)
    lines = int(np.count_nonzero(line))
    if len(pins) - lines < max(LEAST_OF_A_KIND, lines):
        return pins
    kept = [f for f, is_line in zip(pins, line, strict=True) if not is_line]
    width, rise = (float(of) for of in np.median([(f.shape.half_width_px, f.depth / f.height) for f in kept], axis=0))

    def widened(fit: NeedleFit) -> NeedleFit:
        depth = rise * fit.height
        return replace(fit, shape=replace(fit.shape, half_width_px=width), depth=depth, depths=np.full(fit.angles.shape, depth))

    return [widened(f) if is_line else f for f, is_line in zip(pins, line, strict=True)]


def are_of_one_size(one: NeedleFit, other: NeedleFit) -> bool:
    """Say whether two fits are nearly as large as each other."""
    return bool((np.abs(np.diff(_log_sizes([one, other]), axis=0)) < _ALIKE).all())


def _is_as_deep(fit: NeedleFit, typical: NeedleFit, part: float) -> bool:
    """Say whether the depth of a fit, or the part of the background that it is, is that of a typical one, to a factor of ``part``."""
    deep = fit.depth / typical.depth
    of_background = deep * max(typical.background, 1.0) / max(fit.background, 1.0)
    return any(part < ratio < 1 / part for ratio in (deep, of_background))


def are_alike(pins: list[NeedleFit]) -> bool:
    """Say whether more first looks than make a kind are of about one size, so that they are worth another."""
    return bool(pins) and _count_alike(pins, _ROUGHLY_ALIKE) > LEAST_OF_A_KIND


def are_of_a_kind(pins: list[NeedleFit]) -> bool:
    """Say whether several pins, and most, are nearly as large as each other: trabeculae are of any size."""
    return bool(pins) and _count_alike(pins, _ALIKE) >= max(LEAST_OF_A_KIND, _MOST * len(pins))


def are_as_thick(pins: list[NeedleFit]) -> bool:
    """Say whether several pins, and most, are about as thick as each other: in a limb they lie aslant, and look as long as that leaves."""
    if not pins:
        return False
    thick = _log_sizes(pins)[:, 0]
    alike = np.abs(thick - np.median(thick)) < _AS_THICK
    return bool(np.count_nonzero(alike) >= max(LEAST_OF_A_KIND, _MOST * len(pins)))


def without_company(pins: list[NeedleFit]) -> list[bool]:
    """Say of which pins there are too few of about their size to make a kind: those are what they are by themselves."""
    if not pins:
        return []
    sizes = _log_sizes(pins)
    alike = (np.abs(sizes[:, None] - sizes) < _AT_ALL_ALIKE).all(axis=2)
    return [bool(few) for few in alike.sum(axis=1) < LEAST_OF_A_KIND]


def _count_alike(pins: list[NeedleFit], within: float) -> int:
    sizes = _log_sizes(pins)
    return int((np.abs(sizes - np.median(sizes, axis=0)) < within).all(axis=1).sum())


def odd_lengths(pins: list[NeedleFit]) -> list[float]:
    """Return by how much each pin is longer or shorter than a film's pins, zero where there are others of its length, or none of a kind.

    What ends elsewhere than the others do may begin elsewhere as well.
    """
    if len(pins) < _TELL:
        return [0.0] * len(pins)
    length = np.array([f.shape.length_px for f in pins])
    apart = np.abs(np.log(length[:, None] / length))
    alone = (apart < _SAME_LENGTH).sum(axis=1) < LEAST_OF_A_KIND
    odd = alone if np.median(np.abs(np.log(length / np.median(length)))) < _SAME_LENGTH / 2 else np.zeros_like(alone)
    return [float(by) if is_odd else 0.0 for by, is_odd in zip(np.abs(length - np.median(length)), odd, strict=True)]


def _log_sizes(pins: list[NeedleFit]) -> Float:
    """Logarithms of half widths and lengths, shape (n, 2)."""
    return np.log([[f.shape.half_width_px, f.shape.length_px] for f in pins])
