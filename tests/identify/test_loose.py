"""Rigid groups with markers far from where the others say: loose ones are told, two bodies found as one are not called loose."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rsa_vision.identify.constellation import LOOSE_SIGMA
from rsa_vision.identify.loose import loose_pairs
from rsa_vision.identify.poses import Cloud, place
from rsa_vision.types import Float
from tests.identify.bodies import measured, random_body

POSTERIOR = 0.999


def moved(rng: np.random.Generator, bodies: list[Float], degrees: float, shift_mm: float) -> Float:
    """Return the bodies, all but the first moved against it."""
    result = [bodies[0]]
    for body in bodies[1:]:
        axis, way = rng.normal(size=(2, 3))
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
        result.append(turn.apply(body - body.mean(axis=0)) + body.mean(axis=0) + shift_mm * way / np.linalg.norm(way))
    return Rotation.from_rotvec(rng.normal(0, 0.05, 3)).apply(np.concatenate(result))


def everything(rng: np.random.Generator, before: Float, after: Float) -> tuple[tuple[tuple[int, int], ...], Cloud, Cloud]:
    return tuple((i, i) for i in range(len(before))), measured(rng, before, 0.015), measured(rng, after, 0.015)


def test_markers_of_two_bodies_found_as_one_group_are_not_loose() -> None:
    cases = called = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        bodies = [random_body(rng, 6), random_body(rng, 6) + np.array([0, 60, 0])]
        pairs, before, points = everything(rng, np.concatenate(bodies), moved(rng, bodies, 1.0, 0.8))
        placement = place(before, points, pairs)
        assert placement is not None
        cases += bool((placement.sigmas > LOOSE_SIGMA).any())
        called += bool(loose_pairs([pairs], before, points, POSTERIOR))
    assert cases > 20  # the group alone would call some loose
    assert called < cases / 4


def test_a_marker_that_moved_in_its_bone_is_loose_however_its_bone_could_be_parted() -> None:
    told = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 9)
        way = rng.normal(size=3)
        after = body + np.outer(np.arange(9) == 3, way / np.linalg.norm(way))
        pairs, before, points = everything(rng, body, moved(rng, [after], 0, 0))
        told += (3, 3) in loose_pairs([pairs], before, points, POSTERIOR)
    assert told == 30


def test_a_loose_marker_beside_two_bodies_found_as_one_is_still_loose() -> None:
    told = 0
    for seed in range(30):
        rng = np.random.default_rng(100 + seed)
        bodies = [random_body(rng, 7), random_body(rng, 6) + np.array([0, 60, 0])]
        way = rng.normal(size=3)
        after = [bodies[0] + np.outer(np.arange(7) == 3, 1.5 * way / np.linalg.norm(way)), bodies[1]]
        pairs, before, points = everything(rng, np.concatenate(bodies), moved(rng, after, 1.0, 0.8))
        told += (3, 3) in loose_pairs([pairs], before, points, POSTERIOR)
    assert told == 30
