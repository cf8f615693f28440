"""Exact probabilities of assignments: which groups of images belong together, every image in one group at most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rsa_vision.types import Bool, Float

LARGEST: Final = 40_000  # states of one component that are enumerated
PER_IMAGE: Final = 3  # groups of an image that are kept in a component larger than that


@dataclass(frozen=True, slots=True, eq=False)
class Packing:
    """The best assignment and what speaks for each group.

    Attributes
    ----------
    chosen : ndarray of bool, shape (g,)
        Groups of the best assignment.
    posterior : ndarray of shape (g,)
        Sum of the probabilities of all assignments that hold the group; NaN where there were too many to sum.
    """

    chosen: Bool
    posterior: Float


class _TooLargeError(Exception):
    """More states than :data:`LARGEST`."""


def pack(groups: Sequence[tuple[int, ...]], gain: Float) -> Packing:
    """Sum over all assignments, component by component.

    Parameters
    ----------
    groups : sequence of tuple of int
        Images of every group.
    gain : ndarray of shape (g,)
        Logarithm of the odds of a group against its images being unrelated.

    Returns
    -------
    Packing
    """
    chosen, posterior = np.zeros(len(groups), bool), np.full(len(groups), np.nan)
    for members in components(groups):
        try:
            _solve(groups, gain, members, chosen, posterior)
        except _TooLargeError:
            # too dense to be sure of anything here: the best of the likelier groups, all of them without a posterior
            ranked = sorted(members, key=lambda g: -gain[g])
            seen: dict[int, int] = {}
            few = []
            for g in ranked:
                if all(seen.get(i, 0) < PER_IMAGE for i in groups[g]):
                    few.append(g)
                    for i in groups[g]:
                        seen[i] = seen.get(i, 0) + 1
            taken: set[int] = set()
            for g in few:
                if gain[g] > 0 and not taken & set(groups[g]):
                    chosen[g] = True
                    taken |= set(groups[g])
    return Packing(chosen, posterior)


def components(groups: Sequence[tuple[int, ...]]) -> list[list[int]]:
    """Return the groups that are linked by common images, each part for itself."""
    parent: dict[int, int] = {}

    def root(i: int) -> int:
        while parent.setdefault(i, i) != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for group in groups:
        for i in group[1:]:
            parent[root(i)] = root(group[0])
    parts: dict[int, list[int]] = {}
    for g, group in enumerate(groups):
        parts.setdefault(root(group[0]), []).append(g)
    return list(parts.values())


def _solve(groups: Sequence[tuple[int, ...]], gain: Float, members: list[int], chosen: Bool, posterior: Float) -> None:
    images = sorted({i for g in members for i in groups[g]})
    bit = {image: 1 << k for k, image in enumerate(images)}
    masks = {g: sum(bit[i] for i in groups[g]) for g in members}
    at: dict[int, list[int]] = {1 << k: [] for k in range(len(images))}
    for g in members:
        at[masks[g] & -masks[g]].append(g)  # by its lowest image: each assignment is met once
    memo: dict[int, tuple[float, float, int]] = {0: (0.0, 0.0, -1)}

    def value(left: int) -> tuple[float, float, int]:
        """Log of the sum over assignments of these images, log of the best one, and its group at the lowest image (-1: none)."""
        if left in memo:
            return memo[left]
        if len(memo) > LARGEST:
            raise _TooLargeError
        lowest = left & -left
        total, best, _ = value(left ^ lowest)
        which = -1
        for g in at[lowest]:
            if masks[g] & left == masks[g]:
                rest_total, rest_best, _ = value(left ^ masks[g])
                total = float(np.logaddexp(total, gain[g] + rest_total))
                if gain[g] + rest_best > best:
                    best, which = gain[g] + rest_best, g
        memo[left] = (total, best, which)
        return memo[left]

    everything = (1 << len(images)) - 1
    if len(images) > 400:
        raise _TooLargeError
    whole = value(everything)[0]
    for g in members:
        posterior[g] = np.exp(gain[g] + value(everything ^ masks[g])[0] - whole)
    left = everything
    while left:
        g = value(left)[2]
        if g < 0:
            left ^= left & -left
        else:
            chosen[g] = True
            left ^= masks[g]
