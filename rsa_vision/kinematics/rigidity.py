"""The check before KINEMA: the closed polygon of a segment's markers keeps its sides and angles (Selvik, chapter 7)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rsa_vision.kinematics.kinema import follow_up_pairs
from rsa_vision.kinematics.motion_fits import DISTANCE_SIGMA, distance_changes
from rsa_vision.kinematics.series import Segment, Series
from rsa_vision.types import Float


def rigidity(series: Sequence[Series], stable_mm: float) -> Iterator[dict[str, Any]]:
    """Yield the sides and angles of every segment's polygon against the first and the preceding examination.

    Parameters
    ----------
    series : sequence of Series
    stable_mm : float
        Change of a side beyond which, and beyond three standard deviations, it is ``changed``.

    Yields
    ------
    dict
        A row of ``rigidity.csv``: the side from ``marker`` to ``marker_next``, and the angle at ``marker``. The polygon joins the markers
        that both examinations show, in numerical order.
    """
    for one in series:
        for segment in one.segments:
            for a, b in follow_up_pairs(one):
                key = {"subject": one.subject, "exam_from": one.exams[a], "exam_to": one.exams[b], "segment": segment.name}
                yield from ({**key, **row} for row in _polygon(segment, a, b, stable_mm))


def _polygon(segment: Segment, a: int, b: int, stable_mm: float) -> Iterator[dict[str, Any]]:
    common = np.flatnonzero(segment.present[a] & segment.present[b])
    if len(common) < 2:
        return
    points = segment.position_mm[[a, b]][:, common]
    errors = segment.covariance_mm2[[a, b]][:, common]
    change, sd = distance_changes(points[:1], points[1:], errors[:1], errors[1:])
    known = np.isfinite(errors).all()
    ahead = np.roll(np.arange(len(common)), -1)
    sides = np.linalg.norm(points[:, ahead] - points, axis=2)
    angles = _angles(points) if len(common) > 2 else np.full((2, len(common)), np.nan)
    for k in range(len(common) if len(common) > 2 else 1):
        error = float(sd[0, k, ahead[k]]) if known else np.nan
        moved = abs(float(change[0, k, ahead[k]])) > max(stable_mm, DISTANCE_SIGMA * error if known else 0.0)
        yield {
            "marker": segment.markers[common[k]],
            "marker_next": segment.markers[common[ahead[k]]],
            "side_from_mm": sides[0, k],
            "side_to_mm": sides[1, k],
            "side_change_um": 1000 * (sides[1, k] - sides[0, k]),
            "sd_side_change_um": 1000 * error,
            "angle_from_deg": angles[0, k],
            "angle_to_deg": angles[1, k],
            "angle_change_deg": angles[1, k] - angles[0, k],
            "changed": moved,
        }


def _angles(points: Float) -> Float:
    """Return the angles, deg, at the corners of closed polygons, shape (k, n, 3) to (k, n)."""
    ahead, behind = np.roll(points, -1, axis=1) - points, np.roll(points, 1, axis=1) - points
    cross = np.linalg.norm(np.cross(ahead, behind), axis=2)
    result: Float = np.degrees(np.arctan2(cross, (ahead * behind).sum(axis=2)))
    return result
