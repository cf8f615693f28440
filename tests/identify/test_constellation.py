"""Markers known again among points: never a wrong name that counts as decisive, whatever is lost, extra, loose, alike or mirrored."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rsa_vision.identify.constellation import Known, match_bodies, match_segments
from rsa_vision.identify.groups import rigid_groups
from rsa_vision.identify.poses import Cloud, place
from tests.identify.bodies import RIGID_MM, STRAY, Found, examination, measured, random_body

POSTERIOR = 0.999
NOISE_MM = (0.01, 0.03, 0.06, 0.1)
SEEDS = st.integers(0, 2**32 - 1)


def wrong(known: list[Known], found: Found) -> list[tuple[int, int]]:
    return [(s, i) for s, one in enumerate(known) for i, a in one.pairs if found.truth[a] != (s, i)]


def match(bodies: list[np.ndarray], found: Found) -> list[Known]:
    return match_segments([Cloud.exact(body) for body in bodies], found.points, POSTERIOR)


@pytest.mark.parametrize(("sizes", "cases", "rate"), [(None, 150, 0.9), ([3], 300, 0.5), ([4], 300, 0.7), ([3, 3, 3, 3], 50, 0.75)])
def test_no_decisive_name_is_wrong_and_most_names_are_decisive(sizes: list[int] | None, cases: int, rate: float) -> None:
    rng = np.random.default_rng(len(sizes or ()) + 11)
    named = present = 0
    for _ in range(cases):
        bodies = [random_body(rng, n) for n in sizes or rng.integers(3, 9, rng.integers(1, 4)).tolist()]
        found = examination(rng, bodies, float(rng.choice(NOISE_MM)))
        known = match(bodies, found)
        assert wrong(known, found) == []
        named += sum(len(one.pairs) for one in known)
        counts = [sum(name[0] == s for name in found.truth) for s in range(len(bodies))]
        present += sum(count for count in counts if count >= 3)
    assert named / present > rate


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(3, 8))
def test_complete_bodies_at_any_pose_are_named_completely(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = [random_body(rng, max(n, 5)), random_body(rng, 5)]
    found = examination(rng, bodies, 0.01, lost=0, loose=0, strays=0)
    known = match(bodies, found)
    assert wrong(known, found) == []
    assert sum(len(one.pairs) for one in known) >= len(found.truth) - 1  # two markers may be alike by chance
    assert sum(len(one.lost) for one in known) <= 1


def test_mirror_images_are_not_recognised() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        bodies = [random_body(rng, 8)]
        (known,) = match(bodies, examination(rng, bodies, 0.02, lost=0, loose=0, strays=0, mirrored=True))
        assert len(known.pairs) <= 4  # four that lie in a plane are their own mirror image
        assert known.lost


TRIANGLE = np.array([[0, 0, 0], [20, 0, 0], [10, 300**0.5, 0]])
KITE = np.array([[0, 0, 0], [20, 0, 0], [10, 25, 0], [10, -8, 0.0]])  # a half turn exchanges the first two
SQUARE = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0.0]])
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 10.0


@pytest.mark.parametrize("body", [TRIANGLE, SQUARE, TETRAHEDRON], ids=["triangle", "square", "tetrahedron"])
@pytest.mark.parametrize("sd_mm", [0.001, 0.05])
def test_symmetric_constellations_are_ambiguous(body: np.ndarray, sd_mm: float) -> None:
    found = examination(np.random.default_rng(1), [body], sd_mm, lost=0, loose=0, strays=0)
    (known,) = match([body], found)
    assert known.pairs == ()
    assert len(known.doubtful) == len(body)


def test_markers_that_could_be_exchanged_within_the_noise_have_no_names() -> None:
    rng = np.random.default_rng(2)
    for lift, decisive in ((0.05, False), (5.0, True)):
        body = KITE.copy()
        body[1, 0] += lift
        names = [match([body], examination(rng, [body], 0.02, lost=0, loose=0, strays=0))[0].pairs for _ in range(20)]
        assert all((len(pairs) == 4) is decisive for pairs in names)
        assert decisive or not any({0, 1} & set(dict(pairs)) for pairs in names)


def test_a_loose_marker_keeps_its_name_with_a_warning_and_a_lost_one_is_listed() -> None:
    rng = np.random.default_rng(3)
    body = random_body(rng, 7)
    moved = body + np.array([5.0, 0, 100])
    moved[2] += [0.9, 0.9, 0]
    (known,) = match_segments([Cloud.exact(body)], measured(rng, moved[:6], 0.01), POSTERIOR)
    assert {pair[0] for pair in known.loose} == {2}
    assert dict([*known.pairs, *known.loose]) == {i: i for i in range(6)}
    assert known.lost == (6,)


def half_turned(rng: np.random.Generator) -> np.ndarray:
    """Return four places of which a half turn makes nearly the same (0.15 mm)."""
    two = random_body(rng, 2, size_mm=10.0, gap_mm=8.0)
    return np.concatenate([two, two * [-1, 1, -1] + rng.normal(0, 0.15, (2, 3))])


def test_a_loose_marker_that_completes_a_half_turn_hardly_ever_exchanges_the_names() -> None:
    rng = np.random.default_rng(4)
    exchanged = []
    for _ in range(400):
        body = half_turned(rng)
        half_turn = place(Cloud.exact(body), Cloud.exact(body), ((0, 2), (2, 0), (3, 1)))
        if half_turn is None:
            continue
        points = body.copy()
        points[3] = half_turn.predict(body[1:2])[0][0]  # where it fits the three others, half turned: the worst of a thousand places
        if 0.25 < np.linalg.norm(points[3] - body[3]) < 1.0:
            (known,) = match_segments([Cloud.exact(body)], measured(rng, points, 0.01), POSTERIOR)
            exchanged.append(any(i != a for i, a in known.pairs))
    assert len(exchanged) > 100
    assert np.mean(exchanged) < 0.02


def test_markers_that_have_not_moved_are_told_by_how_well_they_agree() -> None:
    rng = np.random.default_rng(6)
    named = 0
    for _ in range(50):
        body = half_turned(rng)
        (known,) = match_segments([Cloud.exact(body)], measured(rng, body, 0.005), POSTERIOR)
        assert [(i, a) for i, a in known.pairs if i != a] == []
        named += len(known.pairs)
    assert named > 160, named


def isosceles(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return three places that a half turn brings nearly onto themselves (0.1 to 0.5 mm), and where the third completes the half turn."""
    difference = rng.uniform(0.2, 1.0)
    bone = np.array([[-12.0, 0, 0], [12, 0, 0], [difference / 2, 20, 0]])
    return bone, bone + np.outer([0, 0, 1], [-difference, 0, 0])


@pytest.mark.parametrize("sd_mm", [0.004, 0.02])
def test_of_three_markers_no_loose_one_turns_the_bone_over(sd_mm: float) -> None:
    rng = np.random.default_rng(8)
    known_again = 0
    for _ in range(25):
        bone, completed = isosceles(rng)
        stem = random_body(rng, 5) + np.array([0, 60, 0])
        before, moved = Rotation.random(random_state=rng), Rotation.from_rotvec(rng.normal(0, 0.2, 3))
        bodies, turns = [Cloud.exact(bone), Cloud.exact(stem)], [before.as_matrix()] * 2
        for shape in (bone, completed, bone + np.outer([0, 0, 1], [rng.uniform(-1, -0.3), *rng.normal(0, 0.15, 2)])):
            places = np.concatenate([(moved * before).apply(shape), before.apply(stem)])
            known, other = match_segments(bodies, measured(rng, places, sd_mm), POSTERIOR, turns)
            assert [(i, a) for i, a in known.pairs if i != a] == []
            assert known.pairs == () or shape is not completed
            assert len(other.pairs) == 5
            known_again += len(known.pairs) == 3
    assert known_again >= 15  # most of the 25 that nothing is wrong with


def test_a_rotation_seen_before_makes_no_name_sure_that_the_points_leave_open() -> None:
    found = examination(np.random.default_rng(1), [TRIANGLE], 0.01, lost=0, loose=0, strays=0)
    for turn in Rotation.create_group("O"):
        (known,) = match_segments([Cloud.exact(TRIANGLE)], found.points, POSTERIOR, [turn.as_matrix()])
        assert known.pairs == ()


def test_a_body_that_is_turned_over_keeps_its_names() -> None:
    rng = np.random.default_rng(9)
    for _ in range(20):
        bone = np.array([[0, 0, 0], [30, 0, 0], [9, 9, 0]]) + rng.normal(0, 0.5, (3, 3))
        bodies = [bone, random_body(rng, 4) + np.array([0, 60, 0])]
        over = Rotation.from_rotvec(np.pi * Rotation.random(random_state=rng).as_matrix()[0])
        points = measured(rng, over.apply(np.concatenate(bodies)), 0.005)
        known, _ = match_segments([Cloud.exact(body) for body in bodies], points, POSTERIOR, [np.eye(3)] * 2)
        assert known.pairs == ((0, 0), (1, 1), (2, 2))


def test_a_wrong_constellation_is_not_recognised() -> None:
    rng = np.random.default_rng(4)
    recognised = 0
    for _ in range(200):
        found = examination(rng, [random_body(rng, 6), random_body(rng, 5)], 0.05)
        recognised += sum(len(one.pairs) > 0 for one in match([random_body(rng, 5), random_body(rng, 4)], found))
    assert recognised == 0


@pytest.mark.parametrize(("sizes", "rate"), [([7, 6], 0.9), ([4, 4], 0.6), ([3, 3], 0.15)])
def test_bodies_that_moved_against_each_other_are_found_again_without_knowing_them(sizes: list[int], rate: float) -> None:
    rng = np.random.default_rng(sum(sizes))
    named = both = 0
    for _ in range(15):
        before, after, names = [], [], []
        for index, n in enumerate(sizes):
            body = random_body(rng, n) + np.array([0, 40 * index, 100])
            far = rng.random() < 0.3
            turn = Rotation.from_rotvec(rng.normal(0, 0.5 if far else 0.02, 3))
            before.append(body)
            after.append(turn.apply(body - body.mean(0)) + body.mean(0) + rng.normal(0, 10 if far else 0.7, 3))
            names += [(index, i) for i in range(n)]
        first, second = np.concatenate(before), np.concatenate(after) + rng.normal(0, RIGID_MM, (len(names), 3))
        there, here = rng.random(len(names)) > 0.06, rng.random(len(names)) > 0.06
        old = [name for name, is_there in zip(names, there, strict=True) if is_there]
        new = [name for name, is_here in zip(names, here, strict=True) if is_here] + [STRAY]
        second = np.concatenate([second[here], rng.normal(0, 20, (1, 3)) + np.array([0, 20, 100])])
        sd = float(rng.choice([0.001, 0.02, 0.05]))
        bodies, doubtful = match_bodies(measured(rng, first[there], sd), measured(rng, second, sd), POSTERIOR)
        pairs = [pair for body in bodies for pair in body]
        assert [(old[i], new[a]) for i, a in pairs if old[i] != new[a]] == []
        assert not doubtful[[a for _, a in pairs]].any()
        named += len(pairs)
        both += len(set(old) & set(new))
    assert named / both > rate


def test_the_stated_covariance_of_a_pose_is_that_of_its_errors() -> None:
    rng = np.random.default_rng(6)
    squares = []
    for _ in range(300):
        body = random_body(rng, 5)
        pairs = tuple((i, i) for i in range(5))
        turn, shift = Rotation.random(random_state=rng), rng.normal(0, 50, 3)
        truth = turn.apply(body) + shift
        points = measured(rng, truth + rng.normal(0, 0.05, truth.shape), 0.03)
        fit = place(Cloud.exact(body), points, pairs)
        assert fit is not None
        at, covariance = fit.predict(body[:1])
        error = at[0] - truth[0]
        squares.append(float(error @ np.linalg.solve(covariance[0], error)))
    assert 0.8 < np.mean(squares) / 3 < 1.2


def test_groups_that_move_are_told_apart_and_groups_that_do_not_are_one() -> None:
    rng = np.random.default_rng(7)
    a, b = random_body(rng, 5), random_body(rng, 4) + np.array([0, 60, 0])
    turned = Rotation.from_rotvec([0.05, 0, 0.05]).apply(b - b.mean(0)) + b.mean(0) + [1.0, 1.5, 0]
    still, moved = np.concatenate([a, b]), np.concatenate([a, turned])
    exams = [measured(rng, places, 0.02) for places in (still, moved, still + 3.0)]
    exams[2].position_mm[1] = np.nan  # missing there
    groups = rigid_groups(exams)
    assert [group.members for group in groups] == [(0, 1, 2, 3, 4), (5, 6, 7, 8)]
    assert all(0.5 < group.probability < 1 for group in groups)
    unmoved = rigid_groups([exams[0], exams[2]])  # the one that is missing belongs to none
    assert [group.members for group in unmoved] == [(0, *range(2, 9)), (1,)]
