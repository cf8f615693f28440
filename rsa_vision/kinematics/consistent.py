"""Which markers of a segment are seen in all examinations of a subject, and hold their mutual distances: the consistent markers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rsa_vision.kinematics.motion_fits import DISTANCE_SIGMA, distance_changes, loose
from rsa_vision.kinematics.series import Segment
from rsa_vision.types import Bool


def consistent_subsets(segments: Sequence[Segment], tolerance_mm: float) -> list[Bool]:
    """Return which markers of each segment are consistent; the common case, that all are, is seen for many segments at once."""
    subsets = [np.ones(len(segment.markers), bool) for segment in segments]
    alike: dict[tuple[int, ...], list[int]] = {}
    for i, segment in enumerate(segments):
        alike.setdefault(segment.position_mm.shape, []).append(i)
    for members in alike.values():
        position = np.stack([segments[i].position_mm for i in members])
        change = np.linalg.norm(position[:, :, :, None] - position[:, :, None], axis=4)
        change -= change[:, :1].copy()
        whole = (np.abs(change) <= tolerance_mm).all(axis=(1, 2, 3))  # NaN is not
        for k in np.flatnonzero(~whole):
            subsets[members[k]] = _consistent(segments[members[k]], tolerance_mm)
    return subsets


def _consistent(segment: Segment, tolerance_mm: float) -> Bool:
    """Return which markers are seen in every examination that shows the segment, and hold their mutual distances in all of them."""
    present = segment.present
    shown = present.any(axis=1)
    subset: Bool = np.all(present[shown], axis=0) & shown.any()
    at, exams = np.flatnonzero(subset), np.flatnonzero(shown)
    if len(at) > 1 and len(exams) > 1:
        position, covariance = segment.position_mm[np.ix_(exams, at)], segment.covariance_mm2[np.ix_(exams, at)]
        change, sd = distance_changes(position[:1], position[1:], covariance[:1], covariance[1:])
        broken: Bool = np.any(np.abs(change) > np.maximum(tolerance_mm, DISTANCE_SIGMA * sd), axis=0)
        subset[at[loose(broken)]] = False
    return subset
