"""What is unlike the other marks of a film: of a size of its own, or paler than they are wherever they lie."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.alike import robust_sd
from rsa_vision.detect.balls.decide import LEAST_KNOWN
from rsa_vision.types import Bool, Float, Int

COMPANY = 6  # marks of one kind that tell what is unlike them
_ALIKE, _APART = 0.035, 3.0  # of radii of one kind, where curve and background differ; standard deviations
_ALONE, _SURELY_ALONE = 0.1, 2.0  # logarithm, and standard deviations, by which not one other has the size of what is alone: two in one
_SMALL, _FEW, _TIMES = 0.65, 6, 3  # of the usual size; fewer have that, and so many times as many do not: dust, dots of a date
_OF_ONE_SIZE, _OF_ONE_DEPTH, _MOST = 0.1, 0.4, 0.8  # logarithms; part of those like one, beyond which they tell what it is
_BESIDE = 5  # known balls nearest in background, on either side
_ENOUGH = 3  # of them, whose median is theirs
_SCATTERED = 0.6  # the part of one and the same film value that is primary radiation differs by no more: from 0.5 to 0.8 of it
_CHANCE = 2.0  # standard deviations of two depths, each


def of_odd_size(size_px: Float, variance_px2: Float, alike: float = _ALIKE) -> Bool:
    """Say which have a size that hardly another of the film has, where there are enough of one: dots, screw tips, dust, two in one.

    Subjects have beads of one size in one bone and of another elsewhere, but not three of half the size of a few dozen.

    Parameters
    ----------
    size_px, variance_px2 : ndarray of shape (n,)
        Radii of the balls of a film, or half widths of its pins or tees; their variances.
    alike : float
        Standard deviation of the logarithms of the sizes of one kind.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    size, variance = np.log(size_px), variance_px2 / size_px**2
    differ = np.abs(size[:, None] - size)
    apart = differ / np.sqrt(variance[:, None] + variance + alike**2)
    company = (apart < _APART).sum(axis=1)
    alone = ((differ < _ALONE) | (apart < _SURELY_ALONE)).sum(axis=1) == 1
    most = company.max(initial=0)
    if most < COMPANY:
        return np.zeros(len(size), bool)
    small = size < np.log(_SMALL) + size[company.argmax()]
    fellows = (differ < -np.log(_SMALL)).sum(axis=1)
    return np.asarray((company < LEAST_KNOWN) | alone | (small & (fellows < _FEW) & (_TIMES * fellows <= np.count_nonzero(~small))))


def like_poor_ones(size_px: Float, depth: Float, poor: Bool) -> Bool:
    """Say which balls are like many that the model does not describe, and like hardly any others: noise hides what they leave.

    Two balls that lie over each other have the size of no single one; where most of them are seen to be no ball, one that is not is none.

    Parameters
    ----------
    size_px : ndarray of shape (n,)
        Radii.
    depth : ndarray of shape (n,)
        In film values.
    poor : ndarray of bool, shape (n,)
        Not described.

    Returns
    -------
    ndarray of bool, shape (n,)
        None of those.
    """
    size, deep = np.log(size_px), np.log(np.maximum(np.abs(depth), 1e-9))
    alike = (np.abs(size[:, None] - size) < _OF_ONE_SIZE) & (np.abs(deep[:, None] - deep) < _OF_ONE_DEPTH)
    of_poor = (alike & poor).sum(axis=1)
    return np.asarray(~poor & (of_poor >= COMPANY) & (of_poor > _MOST * (alike.sum(axis=1) - 1)))


def too_pale(depth: Float, variance: Float, background: Float, known: Bool) -> Bool:
    """Say which balls are paler than those of the film on darker and on lighter values let expect: staples, letters, tips of screws.

    What balls of one metal take away goes with the light that there is and the gradient of the film: on linear films with the value, on
    others with an arch over the values, highest where the film is steepest. Between two others in background, then, a ball is at least as
    deep as the chord between them, but for scattered light, noise, and what the film's balls scatter by in this very figure. Of several
    neighbours on one side the deepest one stands for marks: a row of staples has more corners than there are balls beside it.

    Parameters
    ----------
    depth, variance : ndarray of shape (n,)
        Depths of balls, without sign, and their variances.
    background : ndarray of shape (n,)
    known : ndarray of bool, shape (n,)
        Nothing speaks against these as yet.

    Returns
    -------
    ndarray of bool, shape (n,)
        None where too few are known.
    """
    doubt = _CHANCE * np.sqrt(variance)
    pale = np.zeros(len(depth), bool)
    while True:
        marks = known & ~pale
        usual = np.array([_between(depth - doubt, background, marks, i) for i in range(len(depth))])
        told = marks & (usual > 0)
        if np.count_nonzero(told) < COMPANY:
            return pale
        part = np.log(depth[told] / usual[told])
        paler = depth + doubt < min(_SCATTERED, np.exp(float(np.median(part)) - _APART * robust_sd(part))) * usual
        if not (paler & ~pale).any():
            return pale
        pale |= paler


def too_deep(depth: Float, variance: Float, background: Float, known: Bool) -> Bool:
    """Say which balls are deeper than those of the film on darker and on lighter values by more than scatter explains: dust on the film.

    No ball of their metal can be, however small: depths are those of full opacity.

    Parameters
    ----------
    depth, variance, background, known
        As of :func:`too_pale`.

    Returns
    -------
    ndarray of bool, shape (n,)
        None where too few are known.
    """
    if np.count_nonzero(known) < COMPANY:
        return np.zeros(len(depth), bool)
    usual = np.full(len(depth), np.inf)
    for i in range(len(depth)):
        nearest = _beside(background, known, i)
        if min(map(len, nearest)) >= _ENOUGH:
            usual[i] = max(float(np.median(depth[side])) for side in nearest)
    return np.asarray(_SCATTERED * (depth - _CHANCE * np.sqrt(variance)) > usual)


def _between(depth: Float, background: Float, marks: Bool, i: int) -> float:
    """Depth that a mark has at least on a background between those of others; 0 where it lies between none."""
    nearest = _beside(background, marks, i)
    if min(map(len, nearest)) == 0:
        return 0.0
    ends = [side[np.argmax(depth[side])] for side in nearest]
    return max(float(np.interp(background[i], background[ends], depth[ends])), 0.0)


def _beside(background: Float, marks: Bool, i: int) -> list[Int]:
    """Indices of the few marks next to one in background, on the darker side and on the lighter one."""
    offset = background - background[i]
    others = marks & (np.arange(len(background)) != i)
    sides = [np.flatnonzero(others & side) for side in (offset <= 0, offset > 0)]
    return [side[np.argsort(np.abs(offset[side]), kind="stable")[:_BESIDE]] for side in sides]
