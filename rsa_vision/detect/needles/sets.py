"""The pins and tees of a film fitted beside each other: those whose arms cross in one go, the others subtracted."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import gaps
from rsa_vision.detect.models.needles import NeedleFit, middle, needle_image, wrapped
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.crossing import fit_crossing
from rsa_vision.detect.needles.pointed import LEAST_OF_A_KIND
from rsa_vision.types import Bool, Float

TAPERS = (1.0, 0.5, 0.25)  # part of a pin's length that is its point: a full cone, or a cylinder with a point
MOST_TOGETHER = 4  # in one fit; larger sets are cut where they overlap least
NEAREST_PX = 3.0  # two tips nearer than this are one
_ABOUT_AS_WELL = 1.5  # of the standard deviation along that tips of a film have
_LOCATED = 1.5  # half widths: standard deviation of a tip from which it marks nothing
_BESIDE_PX = 10.0  # from the ends of arms, a little longer than they are, within which others are beside them


def fit_all(film: NDArray[Any], needles: list[NeedleFit], optics: Optics, noise: NoiseModel, *, again: int = 0) -> list[NeedleFit]:
    """Fit every set whose arms cross in one go, with the images of the others subtracted.

    ``again``: sets of up to so many were fitted in the same way before, so that what has come to rest and has no neighbours stays as it is.
    """
    out: list[NeedleFit] = []
    sets = [[needles[i] for i in index] for index in clusters(needles)]
    for members, others in zip(sets, beside_each(sets, optics), strict=True):
        at_rest = len(members) <= again and others is None and all(m.converged for m in members)
        out += members if at_rest else fit_crossing(film, members, optics, noise, others=others)
    return out


def clusters(needles: list[NeedleFit]) -> list[list[int]]:
    """Return which needles make up the sets whose arms may cross, as far as one fit can hold them."""
    if not needles:
        return []
    position = np.array([t.position_px for t in needles])
    gap = gaps(position, position)
    length = np.array([t.shape.length_px for t in needles])
    reach = (length[:, None] + length[None]) * 1.02
    while True:  # arms that only just touch can do with subtraction, if joining them all would make too large a fit
        n, label = connected_components(csr_array(gap < reach), directed=False)
        if n == len(needles) or np.bincount(label).max() <= MOST_TOGETHER:
            return [np.flatnonzero(label == k).tolist() for k in range(n)]
        reach = reach * 0.85


def beside_each(sets: list[list[NeedleFit]], optics: Optics) -> list[Images | None]:
    """Return, for each set of the needles of a film, the images of those beside its members, as of :func:`others_beside`."""
    needles, sizes = [t for members in sets for t in members], [len(members) for members in sets]
    belongs = np.repeat(np.arange(len(sets)), sizes)
    near = _reaches(needles, needles) & (belongs[:, None] != belongs)
    parts = [near[end - size : end].any(axis=0) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
    return [_images([needles[i] for i in np.flatnonzero(part)], optics) for part in parts]


def others_beside(members: NeedleFit | list[NeedleFit], rest: list[NeedleFit], optics: Optics) -> Images | None:
    """Return the images of those beside the members, for the fits to subtract; None where there are none."""
    near = _reaches(members if isinstance(members, list) else [members], rest).any(axis=0)
    return _images([rest[i] for i in np.flatnonzero(near)], optics)


def _reaches(some: list[NeedleFit], others: list[NeedleFit]) -> Bool:
    """Say which of others may be seen among the pixels of some needles, shape (some, others)."""
    (x, y, length), (at_x, at_y, reach) = (
        np.array([(*t.position_px, t.shape.length_px) for t in these]).reshape(-1, 3).T for these in (some, others)
    )
    gap = np.hypot(x[:, None] - at_x, y[:, None] - at_y) - 1.3 * (length[:, None] + reach)
    return np.asarray(gap < _BESIDE_PX)


def _images(near: list[NeedleFit], optics: Optics) -> Images | None:
    if not near:
        return None

    def images(cols: Float, rows: Float) -> Float:
        total: Float = np.sum([needle_image(cols - t.position_px[0], rows - t.position_px[1], t, optics) for t in near], axis=0)
        return total

    return images


def is_located(needle: NeedleFit) -> bool:
    """Say whether the tip is known better than the needle is wide: the rim of something large is as long as one likes and marks nothing."""
    return bool(np.linalg.eigvalsh(needle.covariance_px2)[-1] < (_LOCATED * needle.shape.half_width_px) ** 2)


def located(needles: list[NeedleFit]) -> list[NeedleFit]:
    """Keep needles whose tips are located, and where some are, all whose tips are known about as well: blur and curve hide them alike.

    Parameters
    ----------
    needles : list of NeedleFit

    Returns
    -------
    list of NeedleFit
    """
    kept = np.array([is_located(f) for f in needles], bool)
    if np.count_nonzero(kept) >= LEAST_OF_A_KIND:
        variance = np.array([np.linalg.eigvalsh(f.covariance_px2)[-1] for f in needles])
        kept |= variance < _ABOUT_AS_WELL**2 * np.median(variance[kept])
    return [f for f, of in zip(needles, kept, strict=True) if of]


def as_usual(tee: NeedleFit, others: list[NeedleFit]) -> NeedleFit:
    """Return a tee of the usual size of others, its arms meeting at the usual angles: something on one of them turns and stretches it."""
    if len(others) < LEAST_OF_A_KIND:
        return tee
    usual = np.median([wrapped(t.angles - t.angles[0]) for t in others], axis=0)
    first = tee.angles[0] + np.median(wrapped(tee.angles - tee.angles[0] - usual))
    half_width, length = np.median([[t.shape.half_width_px, t.shape.length_px] for t in others], axis=0).tolist()
    shape = replace(others[0].shape, half_width_px=half_width, length_px=length)
    return replace(tee, angles=first + usual, shape=shape)


def on_arms(places: Float, needles: list[NeedleFit]) -> Bool:
    """Say which places (n, 2) lie on an arm of a needle."""
    return np.asarray(np.any([np.zeros(len(places), bool), *(_on_arm(places, needle) for needle in needles)], axis=0))


def _on_arm(places: Float, needle: NeedleFit) -> Bool:
    """Say which places (n, 2) lie on one of a needle's arms or just beyond its ends, shape (n,)."""
    dx, dy = (places - needle.position_px).T[:, :, None]
    c, s = np.cos(needle.angles), -np.sin(needle.angles)
    along, across = (dx * c + dy * s) / needle.shape.length_px, np.abs(dy * c - dx * s) / needle.shape.half_width_px
    on: Bool = ((along > -0.3) & (along < 1.2) & (across < 2)).any(axis=1)
    return on


def is_apart(needle: NeedleFit, others: list[NeedleFit], gap_px: float = NEAREST_PX) -> bool:
    """Say whether the tip of a needle is that of none of others."""
    return all(math.dist(needle.position_px, other.position_px) > gap_px for other in others)


def same_body(a: NeedleFit, b: NeedleFit) -> bool:
    """Say whether two fits lie on the same stroke, perhaps the other way round."""
    return math.dist(middle(a), middle(b)) < 0.25 * a.shape.length_px
