"""KINEMA: motion of segments between examinations, absolute and relative to other segments (Selvik, chapters 6 and 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rsa_vision.geometry.euler import euler_from_matrix, euler_jacobian
from rsa_vision.geometry.motion_errors import absolute_transfer, relative_transfer, total_motion
from rsa_vision.geometry.screw import find_screws, screw_jacobians
from rsa_vision.kinematics.consistent import consistent_subsets
from rsa_vision.kinematics.frames import frame_matrix, frame_name, in_frame
from rsa_vision.kinematics.motion_fits import Fits, Pairs, fit_segments
from rsa_vision.kinematics.series import Segment, Series, order_is_unclear
from rsa_vision.motion_reasons import BIT, FAILURE_BITS, REVIEW_BITS, joined, status_of
from rsa_vision.settings import Limits, Motion
from rsa_vision.types import Bool, Float, Int

Columns = dict[str, NDArray[Any]]
PairsOf = Callable[[Series], Pairs]
ANGLE_SIGMA: Final = 5.0  # a rotation within so many standard deviations of zero has no axis: nearer, errors of first order are not true
SINGULAR_SIGMA: Final = 5.0  # psi within so many of +-90 degrees does not tell phi from theta
AXES: Final = "xyz"
ABSOLUTE: Final = -1
UNKNOWN: Final = -2


def follow_up_pairs(series: Series) -> Pairs:
    """Return the pairs of examinations of a follow-up: the first with each, and each with the next."""
    last = len(series.exams)
    return tuple(dict.fromkeys([*((0, b) for b in range(1, last)), *pairwise(range(last))]))


def repeat_pairs(series: Series) -> Pairs:
    """Return the double examinations: each repeated examination with its repeat."""
    return tuple((int(a), b) for b, a in enumerate(series.repeat_of) if a >= 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Which fits make up each motion."""

    series: Int
    pair: Int  # (n, 2)
    segment: Int  # index into all segments
    moved: Int  # row of Fits
    fixed: Int  # row of Fits, ABSOLUTE or UNKNOWN
    reference: list[str]


def motions(
    series: Sequence[Series], settings: Motion, limits: Limits, pairs_of: PairsOf = follow_up_pairs, *, shared_errors: bool = False
) -> Columns:
    """Return every motion of every segment.

    Parameters
    ----------
    series : sequence of Series
    settings : Motion
        Reference segment (default: the first one of each subject), side and frame.
    limits : Limits
    pairs_of : callable, optional
        Which examinations to compare; default: the first with each, and each with the next.
    shared_errors : bool
        The covariances hold errors that all markers of an examination share, such as those of the foci. How much is not told, so absolute
        translations are given the errors that they would have if all were shared. In relative motion shared errors cancel.

    Returns
    -------
    dict of str to ndarray
        The columns of ``motion.csv``. Absolute motion has an empty reference; relative motion is that of the segment when the reference has
        been returned to its place. Every segment of every pair of examinations has a row: what cannot be computed is NaN, with its reason.
    """
    frames = [frame_matrix(one, settings) for one in series]
    placed = [in_frame(one, matrix) for one, matrix in zip(series, frames, strict=True)]
    segments = [segment for one in placed for segment in one.segments]
    owner = np.repeat(np.arange(len(placed)), [len(one.segments) for one in placed])
    pairs = [pairs_of(one) for one in placed]
    each = [pairs[i] for i in owner]
    fits = fit_segments(segments, each, limits)
    rows = _rows(placed, pairs, fits.first, settings.reference)
    found = _results(fits, rows, segments, shared_errors)
    subsets = consistent_subsets(segments, limits.stable_mm)
    others = None if all(subset.all() for subset in subsets) else fit_segments(segments, each, limits, subsets)
    beside = _results(others, rows, segments, shared_errors) if others else found
    columns = _keys(placed, segments, rows) | found
    around = _exam_codes(placed, rows, frames) | np.where(rows.fixed == UNKNOWN, BIT["reference-unknown"], 0)
    codes = columns.pop("codes") | around
    columns |= {f"consistent_{name}": beside[name] for name in BESIDE}
    columns["consistent_markers"] = np.array(
        [";".join(compress(segment.markers, subset)) for segment, subset in zip(segments, subsets, strict=True)], object
    )[rows.segment]
    columns["consistent_status"] = _texts(beside["codes"] | around, status_of)
    columns["frame"] = np.full(len(codes), frame_name(settings), object)
    columns["status"], columns["reasons"] = _texts(codes, status_of), _texts(codes, joined)
    return columns


def _texts(codes: Int, say: Callable[[int], str]) -> NDArray[Any]:
    known, where = np.unique(codes, return_inverse=True)
    result: NDArray[Any] = np.array([say(int(code)) for code in known], object)[where]
    return result


def _rows(series: Sequence[Series], pairs: Sequence[Pairs], first: Int, reference: str | None) -> _Rows:
    """Every segment: absolute, relative to the reference and to the segment before it, all its pairs."""
    parts: list[tuple[int, int, int, int, str]] = []  # series, segment, first row of the moved and of the fixed fit, name
    at = 0
    for i, one in enumerate(series):
        names = [segment.name for segment in one.segments]
        wanted = reference if reference is not None else (names[0] if names else "")
        for j, name in enumerate(names):
            own = at + j
            parts.append((i, own, int(first[own]), ABSOLUTE, ""))
            others = dict.fromkeys([wanted, *names[max(j - 1, 0) : j]])
            parts += [
                (i, own, int(first[own]), int(first[at + names.index(other)]) if other in names else UNKNOWN, other)
                for other in others
                if other != name
            ]
        at += len(names)
    counts = np.array([len(pairs[part[0]]) for part in parts], np.int64)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    owner, segment, moved, fixed = (np.repeat(np.array([part[k] for part in parts], np.int64), counts) for k in range(4))
    ends = [np.array(some, np.int64).reshape(-1, 2) for some in pairs]
    pair = np.concatenate([ends[part[0]] for part in parts]) if parts else np.zeros((0, 2), np.int64)
    reference_names = [part[4] for part, count in zip(parts, counts.tolist(), strict=True) for _ in range(count)]
    return _Rows(owner, pair, segment, moved + step, np.where(fixed >= 0, fixed + step, fixed), reference_names)


def _keys(series: Sequence[Series], segments: Sequence[Segment], rows: _Rows) -> Columns:
    offset = np.concatenate([[0], np.cumsum([len(one.exams) for one in series])])
    exams = np.array([exam for one in series for exam in one.exams], object)
    days = np.concatenate([one.days for one in series]) if series else np.zeros(0)
    a, b = (offset[rows.series] + end for end in rows.pair.T)
    return {
        "subject": np.array([one.subject for one in series], object)[rows.series],
        "exam_from": exams[a],
        "exam_to": exams[b],
        "days": days[b] - days[a],
        "segment": np.array([segment.name for segment in segments], object)[rows.segment],
        "reference": np.array(rows.reference, object),
    }


def _exam_codes(series: Sequence[Series], rows: _Rows, frames: Sequence[Float]) -> Int:
    offset = np.concatenate([[0], np.cumsum([len(one.exams) for one in series])])
    to_code = {"ok": 0, "review": BIT["exam-review"], "failed": BIT["exam-failed"]}
    state = np.array([to_code.get(status, BIT["exam-review"]) for one in series for status in one.status], np.int64)
    days = np.concatenate([one.days for one in series]) if series else np.zeros(0)
    a, b = (offset[rows.series] + end for end in rows.pair.T)
    lost = np.array([not np.isfinite(frame).all() for frame in frames], bool)[rows.series]
    early = np.where(days[b] < days[a], BIT["exams-out-of-order"], 0)
    unclear = np.array([order_is_unclear(one.exams) for one in series], bool)[rows.series]
    early |= np.where(unclear, BIT["exam-order-unclear"], 0)
    result: Int = state[a] | state[b] | early | np.where(lost, BIT["frame-undefined"], 0)
    return result


def _results(fits: Fits, rows: _Rows, segments: Sequence[Segment], shared_errors: bool) -> Columns:
    """Return the numbers of every motion, and its codes."""
    moved, fixed = rows.moved, rows.fixed
    codes = fits.codes[moved].copy()
    relative = fixed >= 0
    other = fits.codes[fixed[relative]]
    codes[relative] |= np.where(other & FAILURE_BITS, BIT["reference-failed"], 0) | np.where(
        other & REVIEW_BITS, BIT["reference-review"], 0
    )
    codes[relative] |= other & BIT["sd-from-residuals"]
    found = {name: np.full(len(moved), np.nan) for name in NUMBERS}
    columns: Columns = {**found, "mtpm_marker": np.full(len(moved), "", object)}
    whole = (fits.group[moved] >= 0) & (fixed != UNKNOWN)
    whole[relative] &= fits.group[fixed[relative]] >= 0
    groups = fits.group[moved]
    for number in np.unique(groups[whole]).tolist():
        at = np.flatnonzero(whole & (groups == number))
        codes[at] |= _fill(columns, at, fits, moved[at], fixed[at], number, segments, rows.segment[at], shared_errors)
    finite = fits.group[moved] >= 0
    for axis, name in enumerate(AXES):
        columns[f"cog_{name}_mm"] = fits.before_mm[moved, axis]
    columns |= {"e_rb_mm": fits.e_rb_mm[moved], "mean_error_mm": fits.mean_error_mm[moved]}
    columns |= {"condition_number": fits.condition_number[moved], "n_markers": fits.count[moved]}
    by_residuals = (codes & BIT["sd-from-residuals"]) > 0
    source = np.where(finite, np.where(by_residuals, "residuals", "covariances"), "")
    columns |= {"sd_source": source.astype(object), "birge": np.where(finite & ~by_residuals, fits.birge[moved], np.nan)}
    columns["unstable_markers"] = np.array(
        [
            ";".join(np.array(segments[s].markers)[bad]) if (bad := fits.unstable[m]) is not None else ""
            for m, s in zip(moved, rows.segment, strict=True)
        ],
        object,
    )
    columns["codes"] = codes
    return columns


def _fill(
    columns: Columns,
    at: Int,
    fits: Fits,
    moved: Int,
    fixed: Int,
    number: int,
    segments: Sequence[Segment],
    segment: Int,
    shared_errors: bool,
) -> Int:
    """Compute the motions of one group of fits into the rows `at`, and return their codes."""
    group, place = fits.groups[number], fits.place[moved]
    rotation, before, after = fits.rotation[moved], fits.before_mm[moved], fits.after_mm[moved]
    transfer = absolute_transfer(len(at))
    relative = fixed >= 0
    shift = after - before
    covariance_fixed = np.zeros_like(transfer)
    if relative.any():
        f = fixed[relative]
        back = fits.rotation[f].transpose(0, 2, 1)
        lever = after[relative] - fits.after_mm[f]
        transfer[relative], of_fixed = relative_transfer(fits.rotation[f], lever)
        covariance_fixed[relative] = of_fixed @ fits.covariance[f] @ of_fixed.transpose(0, 2, 1)
        shift[relative] = (back @ lever[:, :, None])[..., 0] + fits.before_mm[f] - before[relative]
        rotation = rotation.copy()
        rotation[relative] = back @ rotation[relative]
    covariance = transfer @ fits.covariance[moved] @ transfer.transpose(0, 2, 1) + covariance_fixed
    if shared_errors:
        covariance[~relative, 3:6, 3:6] += fits.shared_mm2[moved[~relative]]
    angles = euler_from_matrix(rotation)
    screws = find_screws(rotation, shift, before)
    sd_angles = _sd(euler_jacobian(angles), covariance[:, :3, :3])
    by_screw, by_axis, by_shift, by_foot = screw_jacobians(screws, shift, before)
    sd_screw = _sd(by_screw[:, None], covariance)[:, 0]
    across = np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3)  # of the rotation, where there is no axis
    undefined = ~(screws.angle_rad > ANGLE_SIGMA * across) | ~np.isfinite(screws.axis).all(axis=1)
    singular = ~(np.cos(angles[:, 1]) > SINGULAR_SIGMA * across) | np.isnan(angles).any(axis=1)
    total = total_motion(rotation, shift, group.arm_mm[place], covariance, transfer[:, None] @ group.joint[place], group.marker_mm2[place])

    def put(name: str, values: Float, known: Bool | None = None) -> None:
        columns[name][at] = values if known is None else np.where(known, values, np.nan)

    for k, name in enumerate(AXES):
        put(f"r{name}_deg", np.degrees(angles[:, k]))
        put(f"sd_r{name}_deg", np.degrees(sd_angles[:, k]))
        put(f"t{name}_mm", shift[:, k])
        put(f"sd_t{name}_mm", np.sqrt(covariance[:, 3 + k, 3 + k]))
        put(f"screw_{name}", screws.axis[:, k], ~undefined)
        put(f"sd_screw_{name}", _sd(by_axis, covariance)[:, k], ~undefined)
        put(f"screw_p{name}_mm", screws.foot_mm[:, k], ~undefined)
        put(f"sd_screw_p{name}_mm", _sd(by_foot, covariance)[:, k], ~undefined)
        for j, other in enumerate(AXES):
            if j != k:
                put(f"screw_{name}0_{other}_mm", screws.planes_mm[:, k, j], ~undefined)
    length = np.linalg.norm(shift, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = np.nan_to_num(shift / length[:, None])
    sd_length = np.sqrt(np.maximum((direction * (covariance[:, 3:6, 3:6] @ direction[:, :, None])[..., 0]).sum(axis=1), 0))
    put("screw_angle_deg", np.degrees(screws.angle_rad))
    put("sd_screw_angle_deg", np.degrees(np.where(np.isfinite(sd_screw), sd_screw, across)))
    put("screw_shift_mm", np.where(undefined, length, screws.shift_mm))
    put("sd_screw_shift_mm", np.where(undefined, sd_length, _sd(by_shift[:, None], covariance)[:, 0]))
    put("mtpm_mm", total.length_mm)
    put("sd_mtpm_mm", total.sd_mm)
    put("mtpm_low_mm", total.low_mm)
    put("mtpm_high_mm", total.high_mm)
    column = group.column[place, total.marker]
    columns["mtpm_marker"][at] = [segments[s].markers[c] for s, c in zip(segment.tolist(), column.tolist(), strict=True)]
    codes: Int = undefined.astype(np.int64) * BIT["screw-undefined"] + singular.astype(np.int64) * BIT["euler-singular"]
    return codes


def _sd(jacobian: Float, covariance: Float) -> Float:
    """Return standard deviations, shape (k, m), of results with the derivatives (k, m, s) by errors of the covariance (k, s, s)."""
    result: Float = np.sqrt(np.maximum(((jacobian @ covariance) * jacobian).sum(axis=2), 0.0))
    return result


NUMBERS: Final = tuple(
    [f"{sd}{kind}{axis}_{unit}" for sd in ("", "sd_") for kind, unit in (("r", "deg"), ("t", "mm"), ("screw_p", "mm")) for axis in AXES]
    + [f"{sd}screw_{axis}" for sd in ("", "sd_") for axis in AXES]
    + [f"{sd}{name}" for sd in ("", "sd_") for name in ("screw_angle_deg", "screw_shift_mm", "mtpm_mm")]
    + [f"screw_{axis}0_{other}_mm" for axis in AXES for other in AXES if other != axis]
    + ["mtpm_low_mm", "mtpm_high_mm"]
)
BESIDE: Final = (
    *(f"r{axis}_deg" for axis in AXES), *(f"t{axis}_mm" for axis in AXES),
    "mtpm_mm", "mtpm_marker", "e_rb_mm", "mean_error_mm", "condition_number", "n_markers",
)  # fmt: skip
"""Results that stand beside those of all markers for the consistent ones."""
