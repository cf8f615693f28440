"""Rows of what looks like balls, nearer to each other than markers are put: the crests of a screw's threads, and parts of a bar."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from rsa_vision.detect.film.places import are_within, pairs_within
from rsa_vision.types import Bool, Float, Int

_ROW = 5  # at least so many in line, one as far from the next as all others
_NEAR = 3.0  # diameters between neighbours; crests are two apart, as wide as the grooves between them
_STEADY = 0.15  # of the step, by which one may lie off where the two before it say
_LIKE_DEPTH, _LIKE_SIZE = 2.0, 1.6  # ratios of neighbours: bone and what else lies under a screw change along it
_BEYOND, _BESIDE = 6.0, 6.0  # steps from the ends of a row, and from its line, within which the screw has more crests
_IN_STEP = 0.2  # steps, by which those differ from whole numbers along it, and from each other across it
_NEXT_TO = 0.6  # steps along it, within which others stand beside one
# steps across, of lines next to it; a screw has its core there, and one line on that
_LINES = ((-2.5, -1.5), (-1.5, -0.6), (0.6, 1.5), (1.5, 2.5))
_FELLOWS, _GAP = 2, 4.5  # others of their line, and how many steps they may be away: not every crest is seen
_SCREW, _KIN = 12.0, 3  # diameters from others of a row, and how many of these have its size and depth
_OFF_LINE = 0.2  # of the radius of the middle one of three that are parts of a bar
_SAME_DEPTH, _SAME_SIZE = 1.25, 1.2  # ratios of what one thread leaves here and there


def in_rows(position_px: Float, radius_px: Float, depth: Float) -> Bool:
    """Say which balls stand in a row of five or more, with steps of one length and direction of less than three diameters, or beside one.

    Markers are put into bone one by one and lie as they come; those of cages are in rows, but farther apart. What has its like on either
    side is no screw. Of a screw that shows one row other crests are known by fewer: they lie whole steps from each other, in its line and
    in that of its other side.

    Parameters
    ----------
    position_px : ndarray of shape (n, 2)
    radius_px : ndarray of shape (n,)
    depth : ndarray of shape (n,)
        In film values; those of a row are of one sign.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    out = np.zeros(len(depth), bool)
    if len(depth) < _ROW:
        return out
    begin, end = _steps(position_px, radius_px, depth)
    step = position_px[end] - position_px[begin]
    first, second = _one_after_another(begin, end)
    go_on = np.hypot(*(step[second] - step[first]).T) < _STEADY * np.hypot(*step[first].T)
    linked = coo_array((np.ones(np.count_nonzero(go_on)), (first[go_on], second[go_on])), shape=(len(step),) * 2)
    _, row = connected_components(linked, directed=False)
    size = np.bincount(row, minlength=1)
    for k in np.flatnonzero(size >= _ROW - 1):
        of = row == k
        members = np.unique([begin[of], end[of]])
        if len(members) < _ROW or out[members].all():
            continue
        by_step = _by_step(position_px, members, np.median(step[of], axis=0))
        if not _in_a_crowd(by_step, radius_px, depth, members):
            out[members] = True
            out |= _of_one_screw(by_step, radius_px, depth, members)
    return out


def like_those_in_rows(position_px: Float, radius_px: Float, depth: Float, rowed: Bool, poor: Bool) -> Bool:
    """Say which balls near rows have the size and the depth of several of those in rows, and not of one other ball of the film.

    Of a screw that shows many crests some are seen out of step, or too few beside each other.

    Parameters
    ----------
    position_px : ndarray of shape (n, 2)
    radius_px : ndarray of shape (n,)
    depth : ndarray of shape (n,)
        In film values.
    rowed : ndarray of bool, shape (n,)
        As of :func:`in_rows`.
    poor : ndarray of bool, shape (n,)
        Not described well: these are no marks that others might be like.

    Returns
    -------
    ndarray of bool, shape (n,)
        None of those in rows.
    """

    def like(which: Bool | Int, others: Bool) -> Bool:
        size = _alike(radius_px[which, None], radius_px[others], _SAME_SIZE)
        return size & _alike(depth[which, None], depth[others], _SAME_DEPTH)

    out = np.zeros(len(depth), bool)
    perhaps = np.flatnonzero(~rowed)
    perhaps = perhaps[like(perhaps, rowed).sum(axis=1) >= _KIN]
    place, reach_px = position_px[perhaps], 2 * _SCREW * radius_px[perhaps]
    found = are_within(place, position_px[rowed], 0.0, reach_px)
    one, other = pairs_within(place, place, 0.0, reach_px)
    while (more := ~found & np.isin(np.arange(len(found)), one[found[other]])).any():  # from one to the next along the screw
        found |= more
    of_screw = rowed.copy()
    of_screw[perhaps[found]] = True
    out[perhaps[found]] = ~like(perhaps[found], ~(of_screw | poor)).any(axis=1)
    return out


def in_bars(position_px: Float, radius_px: Float, depth: Float) -> Bool:
    """Say which balls lap over their like on either side, evenly and in line: that is how balls explain a bar, as a stroke of a letter.

    Parameters
    ----------
    position_px : ndarray of shape (n, 2)
    radius_px : ndarray of shape (n,)
    depth : ndarray of shape (n,)
        In film values.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    out = np.zeros(len(depth), bool)
    one, other = pairs_within(position_px, position_px, radius_px, radius_px)
    like = (one != other) & _alike(radius_px[one], radius_px[other], _LIKE_SIZE) & _alike(depth[one], depth[other], _LIKE_DEPTH)
    begin, end = one[like], other[like]
    for middle in np.flatnonzero(np.bincount(begin, minlength=len(out)) >= 2):
        beside = end[begin == middle]
        both = position_px[beside, None] + position_px[beside] - 2 * position_px[middle]
        one, other = np.nonzero(np.hypot(*both.transpose(2, 0, 1)) < 2 * _OFF_LINE * radius_px[middle])
        if (one != other).any():
            out[np.append(beside[one], middle)] = True
    return out


def _steps(position_px: Float, radius_px: Float, depth: Float) -> tuple[Int, Int]:
    """Return from which ball to which others a row may go on, either way."""
    one, other = KDTree(position_px).query_pairs(2 * _NEAR * float(radius_px.max()), output_type="ndarray").T
    near = np.hypot(*(position_px[one] - position_px[other]).T) < _NEAR * (radius_px[one] + radius_px[other])
    alike = near & _alike(radius_px[one], radius_px[other], _LIKE_SIZE) & _alike(depth[one], depth[other], _LIKE_DEPTH)
    return np.append(one[alike], other[alike]), np.append(other[alike], one[alike])


def _one_after_another(begin: Int, end: Int) -> tuple[Int, Int]:
    """Return which steps begin where which others end, as indices of both."""
    order = np.argsort(begin, kind="stable")
    low, high = (np.searchsorted(begin[order], end, side) for side in ("left", "right"))
    count = high - low
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(np.arange(len(end)), count), order[np.repeat(low, count) + within]


def _alike(one: Float, other: Float, ratio: float) -> Bool:
    """Say which figures are of one sign and within this ratio."""
    return np.asarray((one * other > 0) & (np.abs(np.log(np.abs(one / other))) < np.log(ratio)))


def _by_step(position_px: Float, members: Int, step: Float) -> Float:
    """Where balls lie along a row and across it, in its steps from its middle; shape (n, 2)."""
    axes = np.array([step, [-step[1], step[0]]]) / (step @ step)
    return np.asarray((position_px - position_px[members].mean(axis=0)) @ axes.T)


def _in_a_crowd(by_step: Float, radius_px: Float, depth: Float, members: Int) -> bool:
    """Say whether most of a row have others like them beside them: on either side, or in two more lines on one."""
    along, across = (by_step - by_step[members, None]).transpose(2, 0, 1)
    like = _alike(radius_px[members, None], radius_px, _LIKE_SIZE) & _alike(depth[members, None], depth, _LIKE_DEPTH)
    like &= np.abs(along) < _NEXT_TO
    lines = [(like & (across > low) & (across < high)).any(axis=1).mean() > 0.5 for low, high in _LINES]
    return any(one and next_one for one, next_one in pairwise(lines))


def _of_one_screw(by_step: Float, radius_px: Float, depth: Float, members: Int) -> Bool:
    """Say which balls lie in step with each other, along a row or beside it."""
    first, last = by_step[members, 0].min(), by_step[members, 0].max()
    near = np.flatnonzero((by_step[:, 0] > first - _BEYOND) & (by_step[:, 0] < last + _BEYOND) & (np.abs(by_step[:, 1]) < _BESIDE))
    along, across = np.abs(by_step[near, None] - by_step[near]).transpose(2, 0, 1)
    fellows = (across < _IN_STEP) & (np.abs(along - np.rint(along)) < _IN_STEP) & (along > 0.5) & (along < _GAP)
    fellows &= _alike(radius_px[near, None], radius_px[near], _LIKE_SIZE) & _alike(depth[near, None], depth[near], _LIKE_DEPTH)
    out = np.zeros(len(depth), bool)
    out[near[fellows.sum(axis=1) >= _FELLOWS]] = True
    return out
