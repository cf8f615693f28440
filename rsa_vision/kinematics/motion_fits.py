"""Rigid fits of many segments between many examinations at once, with their errors and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.geometry.motion_errors import fit_errors
from rsa_vision.geometry.rigid import COLLINEAR, LEAST_POINTS, fit_rigid_many, line_spread
from rsa_vision.kinematics.series import Segment
from rsa_vision.motion_reasons import BIT, FAILURE_BITS
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, Int

Pairs = tuple[tuple[int, int], ...]
IN_LINE_SIGMA: Final = 3.0  # markers closer to a line than this many errors of one do not determine the rotation about it
MIRROR_RATIO: Final = 4.0  # a mirror image that fits so much better (sums of squares) is the truth
BIRGE_LIMIT: Final = 4.0  # residuals larger than so many times their stated errors are no chance
DISTANCE_SIGMA: Final = 3.0  # a change of a distance within so many standard deviations is noise
CHUNK: Final = 100_000  # markers at once: bounds the memory
PER_M: Final = 1000.0
LEFT_OUT: Final = ("duplicate", "predicted", "doubtful")  # why a marker that has coordinates is not used


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Fits with the same number of markers: what their results need of each marker.

    Attributes
    ----------
    arm_mm : ndarray of shape (k, c, 3)
        Markers before the motion, about their centre of gravity.
    joint : ndarray of shape (k, c, 9, 3)
        Covariance of the fit with each marker before the motion.
    marker_mm2 : ndarray of shape (k, c, 3, 3)
        Covariance of the markers before the motion.
    column : ndarray of int, shape (k, c)
        Which markers of the segment they are.
    """

    arm_mm: Float
    joint: Float
    marker_mm2: Float
    column: Int


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """R fits: segment i of the list, pair p of its pairs, has the row ``first[i] + p``.

    Attributes
    ----------
    rotation : ndarray of shape (R, 3, 3)
    before_mm, after_mm : ndarray of shape (R, 3)
        Centres of gravity.
    covariance : ndarray of shape (R, 9, 9)
        Of (rotation, centre of gravity before, after).
    shared_mm2 : ndarray of shape (R, 3, 3)
        What the covariance of the translation of the centre of gravity would gain if markers of one examination had all errors in common.
    e_rb_mm, mean_error_mm, condition_number, birge : ndarray of shape (R,)
        Root mean square and mean of the residual distances; 1/m; factor on the stated errors.
    count : ndarray of int, shape (R,)
        Markers used.
    codes : ndarray of int, shape (R,)
        Sum of the ``BIT`` of every reason.
    unstable : ndarray of object, shape (R,)
        Indices of markers whose distances to the others have changed.
    group, place : ndarray of int, shape (R,)
        Where in `groups` the markers of the fit are; -1 if there is no fit.
    groups : tuple of Group
    first : ndarray of int
        Row of the first pair of each segment.
    """

    rotation: Float
    before_mm: Float
    after_mm: Float
    covariance: Float
    shared_mm2: Float
    e_rb_mm: Float
    mean_error_mm: Float
    condition_number: Float
    birge: Float
    count: Int
    codes: Int
    unstable: NDArray[np.object_]
    group: Int
    place: Int
    groups: tuple[Group, ...]
    first: Int


def fit_segments(segments: Sequence[Segment], pairs: Sequence[Pairs], limits: Limits, subsets: Sequence[Bool] | None = None) -> Fits:
    """Fit the motion of every segment between every of its pairs of examinations.

    Parameters
    ----------
    segments : sequence of Segment
    pairs : sequence of Pairs
        Examinations from and to, for each segment.
    limits : Limits
        Of the error of fitting, the condition number and the change of distances.
    subsets : sequence of ndarray of bool, optional
        Which markers of each segment to use; default all.

    Returns
    -------
    Fits
        With the codes ``segment-missing``, ``too-few-markers``, ``markers-in-line`` or ``mirrored`` there is no motion: NaN.
    """
    lengths = [len(some) for some in pairs]
    first = np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)])
    total = int(first[-1])
    empty = np.full(total, np.nan)
    fits = Fits(
        np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan), np.full((total, 3), np.nan), np.full((total, 9, 9), np.nan),
        np.zeros((total, 3, 3)), empty, empty.copy(), empty.copy(), np.ones(total), np.zeros(total, np.int64), np.zeros(total, np.int64),
        np.full(total, None, object), np.full(total, -1), np.full(total, -1), (), first[:-1],
    )  # fmt: skip
    groups: list[Group] = []
    for common, members in alike(segments, pairs):
        block = [segments[i] for i in members]
        chosen = None if subsets is None else np.stack([subsets[i] for i in members])
        rows = first[members][:, None] + np.arange(len(common))
        _fit_block(fits, groups, block, np.array(common), rows, chosen, limits)
    return Fits(**{name: getattr(fits, name) for name in Fits.__dataclass_fields__ if name != "groups"}, groups=tuple(groups))


def alike(segments: Sequence[Segment], pairs: Sequence[Pairs]) -> Iterator[tuple[Pairs, list[int]]]:
    """Yield pairs of examinations with all segments, by their indices, that have these pairs and as many markers: one array holds them."""
    blocks: dict[tuple[Pairs, int], list[int]] = {}
    for i, segment in enumerate(segments):
        if pairs[i]:
            blocks.setdefault((pairs[i], len(segment.markers)), []).append(i)
    for (common, _), members in blocks.items():
        yield common, members


def _fit_block(
    fits: Fits, groups: list[Group], block: Sequence[Segment], pairs: Int, rows: Int, chosen: Bool | None, limits: Limits
) -> None:
    """Fit segments with as many markers and the same pairs; fills the rows of `fits`."""
    position, covariance = np.stack([s.position_mm for s in block]), np.stack([s.covariance_mm2 for s in block])
    left_out = {name: np.stack([getattr(s, name) for s in block]) for name in LEFT_OUT}
    if chosen is not None:
        position = np.where(chosen[:, None, :, None], position, np.nan)
        left_out = {name: flagged & chosen[:, None] for name, flagged in left_out.items()}
    present: Bool = np.all(np.isfinite(position), axis=3)
    a, b = pairs.T
    seen_a, seen_b = present[:, a], present[:, b]
    common = seen_a & seen_b
    count = common.sum(axis=2)
    codes = np.zeros(count.shape, np.int64)
    some = ~seen_a.any(axis=2) | ~seen_b.any(axis=2)
    codes |= np.where(some & (count < LEAST_POINTS), BIT["segment-missing"], 0)
    codes |= np.where(~some & (count < LEAST_POINTS), BIT["too-few-markers"], 0)
    lost = ~common if chosen is None else ~common & chosen[:, None]
    for name, flagged in left_out.items():
        either = flagged[:, a] | flagged[:, b]
        codes |= np.where(either.any(axis=2), BIT[f"marker-{name}"], 0)
        lost &= ~either
    codes |= np.where(lost.any(axis=2) & ~some, BIT["marker-missing"], 0)
    fits.count[rows], fits.codes[rows] = count, codes
    order = np.argsort(~common, axis=2, kind="stable")
    for size in np.unique(count[count >= LEAST_POINTS]).tolist():
        body, pair = np.nonzero(count == size)
        for part in _chunks(len(body), size):
            s, p = body[part], pair[part]
            columns = order[s, p, :size]
            place = s[:, None], a[p][:, None], columns
            onto = s[:, None], b[p][:, None], columns
            groups.append(
                _fit_group(
                    fits, len(groups), rows[s, p], columns, (position[place], position[onto]), (covariance[place], covariance[onto]), limits
                )
            )


def _chunks(count: int, size: int) -> Iterator[slice]:
    step = max(1, CHUNK // size)
    return (slice(start, start + step) for start in range(0, count, step))


def _fit_group(
    fits: Fits, number: int, rows: Int, columns: Int, points: tuple[Float, Float], errors: tuple[Float, Float], limits: Limits
) -> Group:
    (source, target), (source_mm2, target_mm2) = points, errors
    size = source.shape[1]
    rigid = fit_rigid_many(source, target)
    distances = np.linalg.norm(rigid.residual_mm, axis=2)
    squares = (distances**2).sum(axis=1)
    e_rb = np.sqrt(squares / size)
    spreads = [line_spread(some) for some in (source, target)]
    known = (np.isfinite(source_mm2) & np.isfinite(target_mm2)).all(axis=(1, 2, 3))
    one = np.sqrt(np.trace(source_mm2 + target_mm2, axis1=2, axis2=3).max(axis=1) / 6)
    # of markers that are mirrored the fit itself tells no errors
    one = np.where(known, one, np.sqrt(np.maximum(squares - rigid.mirror_gain_mm2, 0.0) / size))
    in_line = np.zeros(len(rows), bool)
    for along, about in spreads:
        in_line |= ~(about > np.maximum(COLLINEAR * along, IN_LINE_SIGMA * one))
    with np.errstate(invalid="ignore", divide="ignore"):
        condition = PER_M / spreads[0][1]
    found = fit_errors(rigid, source_mm2, target_mm2)
    birge = found.birge
    beyond = (e_rb > limits.e_rb_mm) | (birge > 1)
    mirrored = (rigid.mirror_gain_mm2 > squares * (1 - 1 / MIRROR_RATIO)) & beyond & ~in_line
    codes = np.where(in_line, BIT["markers-in-line"], 0) | np.where(mirrored, BIT["mirrored"], 0)
    codes |= np.where(e_rb > limits.e_rb_mm, BIT["fit-error"], 0)
    codes |= np.where(birge > BIRGE_LIMIT, BIT["residual-large"], 0)
    codes |= np.where(condition > limits.condition_number, BIT["condition-number"], 0)
    codes |= np.where(known, 0, BIT["sd-from-residuals"])
    for i, members in _unstable(source, target, source_mm2, target_mm2, limits.stable_mm).items():
        codes[i] |= BIT["marker-unstable"]
        fits.unstable[rows[i]] = columns[i, members]
    determined = ((codes & FAILURE_BITS) == 0)[:, None]
    fits.codes[rows] |= codes
    fits.e_rb_mm[rows], fits.mean_error_mm[rows], fits.condition_number[rows] = e_rb, distances.mean(axis=1), condition
    fits.before_mm[rows] = rigid.source_cog_mm
    fits.rotation[rows] = np.where(determined[..., None], rigid.rotation, np.nan)
    fits.after_mm[rows] = np.where(determined, rigid.target_cog_mm, np.nan)
    fits.birge[rows] = birge
    fits.covariance[rows] = np.where(determined[..., None], found.covariance, np.nan)
    own = found.marker_mm2[..., :3, :3] + found.marker_mm2[..., 3:, 3:]
    fits.shared_mm2[rows] = own.mean(axis=1) * (1 - 1 / size)
    fits.group[rows], fits.place[rows] = np.where(determined[:, 0], number, -1), np.arange(len(rows))
    return Group(rigid.centred_mm, found.gain @ found.marker_mm2[..., :3], found.marker_mm2[..., :3, :3], columns)


def distance_changes(source: Float, target: Float, source_mm2: Float, target_mm2: Float) -> tuple[Float, Float]:
    """Return changes of the distances between markers, and their standard deviations: both of shape (k, c, c).

    Parameters
    ----------
    source, target : ndarray of shape (k, c, 3)
    source_mm2, target_mm2 : ndarray of shape (k, c, 3, 3)
        Independent errors; NaN gives a standard deviation of 0.
    """
    lengths, variances = [], []
    for points, errors in ((source, source_mm2), (target, target_mm2)):
        between = points[:, :, None] - points[:, None]
        length = np.linalg.norm(between, axis=3)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = np.nan_to_num(between / length[..., None])
        own = np.einsum("kija,kiab,kijb->kij", unit, np.nan_to_num(errors), unit)
        lengths.append(length)
        variances.append(own + own.transpose(0, 2, 1))
    return lengths[1] - lengths[0], np.sqrt(variances[0] + variances[1])


def loose(broken: Bool) -> list[int]:
    """Return which markers to leave out until no distance of the rest is broken: always the one with most broken distances.

    Parameters
    ----------
    broken : ndarray of bool, shape (c, c)
        Symmetric.
    """
    left, out = broken.copy(), []
    while left.any():
        worst = int(left.sum(axis=1).argmax())
        left[worst] = left[:, worst] = False
        out.append(worst)
    return sorted(out)


def _unstable(source: Float, target: Float, source_mm2: Float, target_mm2: Float, tolerance_mm: float) -> dict[int, list[int]]:
    change, sd = distance_changes(source, target, source_mm2, target_mm2)
    broken = np.abs(change) > np.maximum(tolerance_mm, DISTANCE_SIGMA * sd)
    return {int(i): loose(broken[i]) for i in np.flatnonzero(broken.any(axis=(1, 2)))}
