"""Tees under scratches, wires, letters and edges: two of their arms are seen, and what most of the pixels agree with is a tee.

What the tees of a film look like is known by then: how large they are, and which way they point. Arms like theirs are looked for one by
one, so that what hides one of them leaves the others as they are. Pixels that a robust fit leaves over are taken out of the film.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import EXPLAINED, MISFIT, SURE
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, arm_images, needle_image, wrapped
from rsa_vision.detect.models.painted import paint
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.crossing import Window, fit_crossing, window_of
from rsa_vision.detect.needles.fits import PROMISING, explains
from rsa_vision.detect.needles.sets import is_apart, on_arms, others_beside
from rsa_vision.detect.needles.templates import SCALE
from rsa_vision.detect.neighbours.foreign import beyond_noise, robust_residual
from rsa_vision.types import Bool, Float, Int

_LIKENESS: Final = 0.5  # correlation coefficient that two arms have to reach
_MOST_LOOKED_AT: Final = 40
_RIM: Final = 2  # pixels of the search around an arm, which tell its background
_FADED: Final = 0.05  # of the highest of an arm
_PASSES: Final = 2  # what was found hides others
_ROUNDS: Final = 3  # the first mask is that of a fit which the foreign thing has pulled
_TIP_ERROR_PX, _SIZE_ERROR, _TURN_ERROR = 1.0, 0.05, 0.03  # of a start: in pixels, in parts, in radians
_TWO_ARMS, _STEM = 0.5, 0.25  # part of two arms, and of the stem, that has to be seen: a bar alone may be anything
_CLOSE: Final = 0.4  # of the misfit that a mark may leave: what hides a tee may pull at it without being seen
_ALIKE, _WIDE = 0.05, 0.2  # radians and parts by which tees of a film differ; half widths more, which stand for depth


def find_covered(
    film: NDArray[Any],
    bare: NDArray[Any],
    known: list[NeedleFit],
    strokes: Float,
    optics: Optics,
    noise: NoiseModel,
    faintest: float,
) -> tuple[NDArray[Any], list[NeedleFit]]:
    """Find tees of which something else hides a part.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bare : ndarray of shape (rows, cols)
        The film, or as :func:`uncovered` returns it.
    known : list of NeedleFit
        Clean tees of the film, all that were found.
    strokes : ndarray of shape (n, 6)
        What may be arms of others: nothing is looked for but around those that are none of these.
    optics : Optics
    noise : NoiseModel
    faintest : float
        Least depth, as a part of that of a known one.

    Returns
    -------
    film : ndarray of shape (rows, cols)
        NaN where something hides them.
    tees : list of NeedleFit
    """
    model, *ends = _sizes(known)
    tees = list(known)
    for _ in range(_PASSES):
        before = len(tees)
        for start in _two_arms(film, strokes[:, :2], tees, model, optics):
            bare = film.astype(np.float32) if bare is film else bare
            if abs(start.depth) < faintest * abs(model.depth) or not is_apart(start, tees):
                continue
            others = others_beside(start, tees, optics)
            tried = [_robust(film, bare, replace(start, shape=end.shape), others, optics, noise) for end in ends]
            fit, hidden = min(tried, key=lambda one: len(one[1][0]))
            uncovered, bare[hidden] = bare[hidden], np.nan
            if _is_one(fit, _seen(bare, fit, optics)) and _is_like(fit, known) and is_apart(fit, tees):
                tees.append(fit)
            else:
                bare[hidden] = uncovered
        if len(tees) == before:
            break
    return bare, tees[len(known) :]


def uncovered(
    film: NDArray[Any], known: list[NeedleFit], disturbed: list[NeedleFit], optics: Optics, noise: NoiseModel
) -> tuple[NDArray[Any], list[NeedleFit | None]]:
    """Fit tees again without what lies over a part of them.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    known : list of NeedleFit
        Clean tees of the film, five or more.
    disturbed : list of NeedleFit
        Others.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    film : ndarray of shape (rows, cols)
        NaN where something hides them.
    tees : list of NeedleFit or None
        Of each of them; None where most of its pixels agree with no tee like the others.
    """
    bare, tees = film, list[NeedleFit | None]()
    for tee in disturbed:
        bare = film.astype(np.float32) if bare is film else bare
        others = others_beside(tee, [*known, *(t for t in disturbed if t is not tee)], optics)
        starts = [replace(tee, shape=end.shape) for end in _sizes(known)[1:]]
        tried = [_robust(film, bare, start, others, optics, noise) for start in starts]
        fit, hidden = min(tried, key=lambda one: len(one[1][0]))
        before, bare[hidden] = bare[hidden], np.nan
        if _is_one(fit, _seen(bare, fit, optics)) and _is_like(fit, known) and not is_apart(fit, [tee]):
            tees.append(fit)
        else:
            bare[hidden] = before
            tees.append(None)
    return bare, tees


def _sizes(known: list[NeedleFit]) -> list[NeedleFit]:
    """Return a tee of middle size, and two that stand for two sizes: fiducial marks and control points may be of two."""
    by_size = sorted(known, key=lambda t: t.shape.length_px)
    return [by_size[part * (len(known) - 1) // 4] for part in (2, 1, 3)]


def _two_arms(film: NDArray[Any], strokes_px: Float, known: list[NeedleFit], model: NeedleFit, optics: Optics) -> list[NeedleFit]:
    """Return starts beside strokes where two arms or more are like those of a known tee, best first."""
    strokes_px = strokes_px[~on_arms(strokes_px, known)]
    if len(strokes_px) == 0:
        return []
    arms, painted = _arms(model, optics), paint([(t, optics) for t in known])
    reach = math.ceil((model.shape.length_px + 3 * optics.sigma_px) / SCALE) + _RIM
    half = math.ceil(model.shape.length_px) + SCALE * reach
    found: dict[tuple[float, float], tuple[float, NeedleFit]] = {}
    for stroke in strokes_px:
        left, top = (max(int(x) - half, 0) // SCALE * SCALE for x in stroke)
        box = film[top : top + 2 * half, left : left + 2 * half]
        n_rows, n_cols = (n // SCALE for n in box.shape)
        whole = cv2.medianBlur(box[: n_rows * SCALE, : n_cols * SCALE], 3)  # scratches are a pixel or two wide
        image = cv2.resize(painted.taken_from(whole, left, top), (n_cols, n_rows), interpolation=cv2.INTER_AREA)
        image = cv2.copyMakeBorder(image, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
        second = _second_likeness(image, arms, (n_rows, n_cols))
        row, col = np.nonzero((second > _LIKENESS) & (second == cv2.dilate(second, np.ones((5, 5), np.uint8))))
        places = SCALE * np.stack([col, row], axis=1) + (SCALE - 1) / 2 + [left, top]
        for r, c, place in zip(row, col, places, strict=True):
            if math.dist(place, stroke) < model.shape.length_px:
                around = image[r : r + 2 * reach + 1, c : c + 2 * reach + 1]
                part = float(np.median([(around[rows, cols] * arm).sum() / np.square(arm).sum() for arm, rows, cols in arms]))
                start = replace(model, position_px=place, depth=part * model.depth, depths=part * model.depths, slants=None)
                found[place[0], place[1]] = float(second[r, c]), start
    return [start for _, start in sorted(found.values(), key=lambda one: -one[0])[:_MOST_LOOKED_AT]]


def _arms(model: NeedleFit, optics: Optics) -> list[tuple[NDArray[np.float32], slice, slice]]:
    """Images of a tee's arms, each alone and less its mean, and where in the box around the tip they are."""
    reach = math.ceil((model.shape.length_px + 3 * optics.sigma_px) / SCALE) + _RIM
    cols_of, rows_of = np.meshgrid(*[SCALE * np.arange(-reach, reach + 1.0)] * 2)
    coarse = optics.pooled(SCALE)
    arms = []
    for k in range(len(model.angles)):
        shape = replace(model.shape, arms=model.shape.arms[k : k + 1] or model.shape.arms)
        one = replace(model, shape=shape, angles=model.angles[[k]], depths=model.depths[[k]], slants=None)
        arm = needle_image(cols_of, rows_of, one, coarse).astype(np.float32)
        under = np.abs(arm) > _FADED * np.abs(arm).max()
        rows, cols = (slice(max(int(at[0]) - _RIM, 0), int(at[-1]) + _RIM + 1) for at in (np.flatnonzero(under.any(a)) for a in (1, 0)))
        arms.append((arm[rows, cols] - arm[rows, cols].mean(), rows, cols))
    return arms


def _second_likeness(image: NDArray[Any], arms: list[tuple[NDArray[np.float32], slice, slice]], shape: tuple[int, int]) -> NDArray[Any]:
    """Return the second best of the arms' correlation coefficients for tips at the pixels of an image, its border left out."""
    likeness = []
    for arm, rows, cols in arms:
        like = cv2.matchTemplate(image, arm, cv2.TM_CCOEFF_NORMED)
        likeness.append(like[rows.start : rows.start + shape[0], cols.start : cols.start + shape[1]])
    return np.ascontiguousarray(np.sort(likeness, axis=0)[-2])


def _robust(
    film: NDArray[Any], bare: NDArray[Any], fit: NeedleFit, others: Images | None, optics: Optics, noise: NoiseModel
) -> tuple[NeedleFit, tuple[Int, Int]]:
    """Fit a tee without what is foreign in its window, and return the pixels (rows, columns) of that; ``bare`` is left as it was."""
    for _ in range(_ROUNDS):
        window = window_of(film, [fit], optics, noise, others)
        off = _foreign(window, fit, optics, noise)
        hidden = window.rows[off].astype(np.intp), window.cols[off].astype(np.intp)
        before, bare[hidden] = bare[hidden], np.nan
        fit = fit_crossing(bare, [fit], optics, noise, others=others)[0]
        bare[hidden] = before
        if not explains(fit, PROMISING, 0.0):
            break
    return fit, hidden


def _foreign(window: Window, fit: NeedleFit, optics: Optics, noise: NoiseModel) -> Bool:
    """Say which pixels of a window are neither tee nor background, and which touch those: what is left of a flank pulls as well."""
    images = arm_images(window.cols - fit.position_px[0], window.rows - fit.position_px[1], fit.angles, fit.shape, optics).sum(1)
    parts = np.concatenate([images[:1], fit.depth * images[1:], window.surface])[None]
    errors = [_TIP_ERROR_PX, _TIP_ERROR_PX, _SIZE_ERROR * fit.shape.half_width_px, _SIZE_ERROR * fit.shape.length_px, _TURN_ERROR]
    precision = np.concatenate([[0.0], np.array(errors) ** -2.0, np.zeros(len(window.surface))])[None]
    weight = 1.0 / noise.variance_at(window.data + window.beside)[None]
    residual = robust_residual(parts, window.data[None], weight, precision)
    found = np.zeros(window.box, np.uint8)
    found.ravel()[window.place] = beyond_noise(np.abs(residual) * np.sqrt(weight), weight > 0)[0]
    return np.asarray(cv2.dilate(found, np.ones((3, 3), np.uint8)).ravel()[window.place] > 0)


def _seen(bare: NDArray[Any], fit: NeedleFit, optics: Optics) -> Float:
    """Return the part of each arm that is seen, pixels counting by the square of its image there."""
    half = math.ceil(fit.shape.length_px + fit.shape.half_width_px + 3 * optics.sigma_px)
    rows, cols = np.rint(fit.position_px[::-1, None]).astype(np.intp) + np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    arms = arm_images(cols - fit.position_px[0], rows - fit.position_px[1], fit.angles, fit.shape, optics, slopes=False)[0]
    inside = (rows >= 0) & (cols >= 0) & (rows < bare.shape[0]) & (cols < bare.shape[1])
    inside &= np.isfinite(bare[rows.clip(0, bare.shape[0] - 1), cols.clip(0, bare.shape[1] - 1)])
    return np.asarray(np.square(arms) @ inside / np.square(arms).sum(1))


def _is_one(fit: NeedleFit, seen: Float) -> bool:
    """Say whether enough of a tee is seen and explained so well that little that is foreign can be left in it: noise is no excuse here."""
    enough = float(np.sort(seen)[-2]) > _TWO_ARMS and seen[0] > _STEM
    close = fit.misfit < _CLOSE * MISFIT and fit.explained > EXPLAINED
    return enough and close and fit.significance > SURE * np.sqrt(max(fit.chi2_ring, 1.0))


def _is_like(fit: NeedleFit, known: list[NeedleFit]) -> bool:
    def unlike(tee: NeedleFit) -> float:
        turn = float(wrapped(fit.angles[0] - tee.angles[0]))
        longer, wider = math.log(fit.shape.length_px / tee.shape.length_px), math.log(fit.shape.half_width_px / tee.shape.half_width_px)
        return max(abs(turn) / _ALIKE, abs(longer) / _ALIKE, abs(wider) / _WIDE)

    return min(map(unlike, known)) < 1.0
