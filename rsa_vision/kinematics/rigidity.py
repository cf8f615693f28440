"""The check before KINEMA: the closed polygon of a segment's markers keeps its sides and angles (Selvik, chapter 7)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsa_vision.kinematics.kinema import Columns, follow_up_pairs
from rsa_vision.kinematics.motion_fits import DISTANCE_SIGMA, alike
from rsa_vision.kinematics.series import Segment, Series
from rsa_vision.types import Bool, Float, Int

UM = 1000.0


def rigidity(series: Sequence[Series], stable_mm: float) -> Columns:
    """Return the sides and angles of every segment's polygon against the first and the preceding examination.

    Parameters
    ----------
    series : sequence of Series
    stable_mm : float
        Change of a side beyond which, and beyond three standard deviations, it is ``changed``.

    Returns
    -------
    dict of str to ndarray
        The columns of ``rigidity.csv``: the side from ``marker`` to ``marker_next``, and the angle at ``marker``. The polygon joins the
        markers that both examinations show, in numerical order; two markers make one side and no angle.
    """
    bodies = [(one, segment, follow_up_pairs(one)) for one in series for segment in one.segments]
    keys = [(one.subject, one.exams[a], one.exams[b], segment.name) for one, segment, pairs in bodies for a, b in pairs]
    lengths = [len(pairs) for *_, pairs in bodies]
    first = np.cumsum([0, *lengths], dtype=np.int64)
    size = max((len(segment.markers) for _, segment, _ in bodies), default=0)
    all_polygons = _Polygons.empty(len(keys), size)
    for pairs, members in alike([segment for _, segment, _ in bodies], [pairs for *_, pairs in bodies]):
        rows = first[members][:, None] + np.arange(len(pairs))
        _fill(all_polygons, [bodies[i][1] for i in members], np.array(pairs), rows)
    p, real = all_polygons, all_polygons.corner
    where = np.repeat(np.arange(len(keys)), real.sum(axis=1))
    columns: Columns = {
        name: np.array([key[k] for key in keys], object)[where] for k, name in enumerate(("subject", "exam_from", "exam_to", "segment"))
    }
    names = np.array([marker for _, segment, _ in bodies for marker in segment.markers], object)
    begin = np.repeat(np.cumsum([0, *(len(segment.markers) for _, segment, _ in bodies)])[:-1], lengths)[where]
    columns |= {"marker": names[begin + p.column[real]], "marker_next": names[begin + p.ahead[real]]}
    side, angle, sd = p.side_mm[:, real], p.angle_deg[:, real], p.sd_change_mm[real]
    columns |= {"side_from_mm": side[0], "side_to_mm": side[1], "side_change_um": UM * (side[1] - side[0]), "sd_side_change_um": UM * sd}
    columns |= {"angle_from_deg": angle[0], "angle_to_deg": angle[1], "angle_change_deg": angle[1] - angle[0]}
    columns["changed"] = np.abs(side[1] - side[0]) > np.fmax(stable_mm, DISTANCE_SIGMA * sd)
    return columns


@dataclass(frozen=True, slots=True, eq=False)
class _Polygons:
    """R polygons of up to n corners: ``corner`` says which places are used, ``column`` and ``ahead`` which markers a side joins."""

    corner: Bool
    column: Int
    ahead: Int
    side_mm: Float  # (2, R, n): before and after
    angle_deg: Float  # (2, R, n)
    sd_change_mm: Float  # NaN where covariances are not known

    @classmethod
    def empty(cls, count: int, size: int) -> _Polygons:
        shape = (count, size)
        numbers = (np.full((*lead, *shape), np.nan) for lead in ((2,), (2,), ()))
        return cls(np.zeros(shape, bool), np.zeros(shape, np.int64), np.zeros(shape, np.int64), *numbers)


def _fill(polygons: _Polygons, block: Sequence[Segment], pairs: Int, rows: Int) -> None:
    """Compute the polygons of segments with as many markers and the same pairs into `rows`, shape (segments, pairs)."""
    position, covariance = np.stack([s.position_mm for s in block]), np.stack([s.covariance_mm2 for s in block])
    present: Bool = np.all(np.isfinite(position), axis=3)
    common = present[:, pairs[:, 0]] & present[:, pairs[:, 1]]
    count = common.sum(axis=2)
    order = np.argsort(~common, axis=2, kind="stable")
    for size in np.unique(count[count >= 2]).tolist():
        body, pair = np.nonzero(count == size)
        column = order[body, pair, :size]
        at = (body[:, None], pairs[pair].T[..., None], column)  # before and after, polygon, corner
        points, errors = position[at], covariance[at]
        row, corners = rows[body, pair], slice(size if size > 2 else 1)
        towards = np.roll(points, -1, axis=2) - points
        side = np.linalg.norm(towards, axis=3)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = np.nan_to_num(towards / side[..., None])
        variance = np.einsum("ekca,ekcab,ekcb->kc", unit, errors + np.roll(errors, -1, axis=2), unit)
        known = np.asarray(np.isfinite(errors).all(axis=(0, 2, 3, 4)))
        polygons.corner[row, corners] = True
        polygons.column[row, :size], polygons.ahead[row, :size] = column, np.roll(column, -1, axis=1)
        polygons.side_mm[:, row, :size] = side
        polygons.sd_change_mm[row, :size] = np.where(known[:, None], np.sqrt(np.maximum(variance, 0)), np.nan)
        if size > 2:
            polygons.angle_deg[:, row, :size] = _angles(towards)


def _angles(towards: Float) -> Float:
    """Return the angles, deg, at the corners of closed polygons with these sides, shape (..., c, 3) to (..., c)."""
    behind = -np.roll(towards, 1, axis=-2)
    cross = np.linalg.norm(np.cross(towards, behind), axis=-1)
    result: Float = np.degrees(np.arctan2(cross, (towards * behind).sum(axis=-1)))
    return result
