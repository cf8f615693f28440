"""Motions of exact markers are those of independent mathematics; every row of bad input says what is wrong with it."""

from __future__ import annotations

import numpy as np
import pytest
from pytransform3d import rotations as pr
from pytransform3d import transformations as pt
from scipy.spatial.transform import Rotation

from rsa_vision.flags import MarkerFlag
from rsa_vision.kinematics.series import MarkerTable, order_is_unclear
from rsa_vision.settings import Limits

from .bodies import analyse, exam_name, pick, subject, table, vector

EXACT = 1e-9  # deg and mm


def truth(one, a: int, b: int, segment: str, reference: str):
    """Return rotation, translation of the segment's centre of gravity, and centre of gravity, by scipy's rotations alone."""
    motion = one.rotation[b, segment] * one.rotation[a, segment].inv()
    shift = one.shift[b, segment] - motion.apply(one.shift[a, segment])
    if reference:
        fixed = one.rotation[b, reference] * one.rotation[a, reference].inv()
        offset = one.shift[b, reference] - fixed.apply(one.shift[a, reference])
        motion, shift = fixed.inv() * motion, fixed.inv().apply(shift - offset)
    cog = one.place(a, segment).mean(axis=0)
    return motion, motion.apply(cog) + shift - cog, cog


def test_sixty_subjects_with_motions_up_to_170_degrees_move_as_scipy_and_pytransform3d_say() -> None:
    rng = np.random.default_rng(60)
    subjects = [subject(rng, angle_deg=170, shift_mm=60) for _ in range(60)]
    found = analyse(table(subjects), "bone", Limits(condition_number=1e6))
    assert set(found["status"]) == {"ok"}
    for row in range(len(found["status"])):
        one = subjects[int(found["subject"][row][1:]) - 1]
        a, b = (int(found[name][row][4:6]) - 1 for name in ("exam_from", "exam_to"))
        segment = found["segment"][row]
        motion, shift, cog = truth(one, a, b, segment, found["reference"][row])
        assert np.allclose(vector(found, "r?_deg", row), motion.as_euler("XYZ", degrees=True), rtol=0, atol=EXACT)
        assert np.allclose(vector(found, "t?_mm", row), shift, rtol=0, atol=EXACT)
        assert np.allclose(vector(found, "cog_?_mm", row), cog, rtol=0, atol=EXACT)
        moved = np.linalg.norm(motion.apply(one.place(a, segment) - cog) + cog + shift - one.place(a, segment), axis=1)
        assert found["mtpm_mm"][row] == pytest.approx(moved.max(), abs=EXACT)
        assert found["mtpm_marker"][row] == str(moved.argmax() + 1)
        # the screw, by pytransform3d
        foot, axis, pitch, angle = pt.screw_parameters_from_dual_quaternion(
            pt.dual_quaternion_from_transform(pt.transform_from(motion.as_matrix(), shift + cog - motion.apply(cog)))
        )
        if angle > np.pi:
            axis, pitch, angle = -axis, -pitch, 2 * np.pi - angle
        assert found["screw_angle_deg"][row] == pytest.approx(np.degrees(angle), abs=1e-7)  # its angle comes from an arccosine
        assert np.allclose(vector(found, "screw_?", row), axis, rtol=0, atol=1e-8)
        assert found["screw_angle_deg"][row] == pytest.approx(np.degrees(motion.magnitude()), abs=EXACT)
        assert np.allclose(vector(found, "screw_?", row), motion.as_rotvec() / motion.magnitude(), rtol=0, atol=EXACT)
        assert found["screw_shift_mm"][row] == pytest.approx(pitch * angle, abs=1e-6)
        feet = vector(found, "screw_p?_mm", row)
        assert np.allclose(feet, foot, rtol=1e-7, atol=1e-6)
        back = motion.apply(feet - cog) + cog + shift - feet  # every point of the axis moves along it alone
        assert np.allclose(back, found["screw_shift_mm"][row] * vector(found, "screw_?", row), rtol=0, atol=1e-8)
        for k, plane in enumerate("xyz"):
            hit = np.array([0.0 if other == plane else found[f"screw_{plane}0_{other}_mm"][row] for other in "xyz"])
            assert np.linalg.norm(np.cross(hit - feet, vector(found, "screw_?", row))) < 1e-8 * max(1.0, np.abs(hit).max()), k


def test_the_angles_are_those_of_selvik_whose_matrix_pytransform3d_multiplies_out() -> None:
    one = subject(np.random.default_rng(3), exams=1, segments=("bone",))
    angles = np.radians([10.0, -20.0, 30.0])
    matrix = np.eye(3)
    for axis, angle in enumerate(angles):
        matrix = matrix @ pr.active_matrix_from_angle(axis, angle)
    one.rotation[1, "bone"], one.shift[1, "bone"] = Rotation.from_matrix(matrix), np.zeros(3)
    found = analyse(table([one]))
    assert np.allclose(vector(found, "r?_deg", 0), [10, -20, 30], rtol=0, atol=EXACT)


def test_every_segment_moves_from_the_first_and_from_the_preceding_examination_absolutely_and_against_both_references() -> None:
    found = analyse(table([subject(np.random.default_rng(4), exams=4)]), "stem")
    pairs = {(a, b) for a, b in zip(found["exam_from"], found["exam_to"], strict=True)}
    assert pairs == {(exam_name(a), exam_name(b)) for a, b in [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]}
    kinds = {(s, r) for s, r in zip(found["segment"], found["reference"], strict=True)}
    assert kinds == {("bone", ""), ("cup", ""), ("stem", ""), ("bone", "stem"), ("cup", "stem"), ("cup", "bone"), ("stem", "cup")}
    assert len(found["status"]) == len(pairs) * len(kinds)
    assert found["days"][pick(found, exam_from=exam_name(0), exam_to=exam_name(2), segment="cup", reference="stem")] == 59


def test_examinations_are_put_in_order_of_time_whatever_the_order_of_rows() -> None:
    markers = table([subject(np.random.default_rng(5))])
    shuffled = markers.rows(np.random.default_rng(6).permutation(len(markers)))
    one, other = analyse(markers), analyse(shuffled)
    assert all(np.array_equal(one[name], other[name]) for name in ("exam_from", "exam_to", "segment", "mtpm_marker"))
    assert np.allclose(one["rx_deg"], other["rx_deg"], rtol=0, atol=EXACT)


def test_a_left_limb_has_the_signs_of_a_right_one() -> None:
    one = subject(np.random.default_rng(7), exams=2)
    right, left = analyse(table([one])), analyse(table([one]), side="left")
    for axis, sign in (("tx_mm", -1), ("ty_mm", 1), ("tz_mm", 1), ("rx_deg", 1), ("ry_deg", -1), ("rz_deg", -1), ("cog_x_mm", -1)):
        assert np.allclose(left[axis], sign * right[axis], rtol=0, atol=EXACT), axis
    assert np.allclose(left["screw_shift_mm"], -right["screw_shift_mm"], rtol=0, atol=EXACT)
    assert np.allclose(left["mtpm_mm"], right["mtpm_mm"], rtol=0, atol=EXACT)
    assert set(left["frame"]) == {"cage, x mirrored"}


def test_an_anatomical_frame_turns_the_results_by_matrix_or_by_axes_through_markers() -> None:
    one = subject(np.random.default_rng(8), exams=2)
    plain, frame = analyse(table([one])), Rotation.random(random_state=1).as_matrix()
    turned = analyse(table([one]), rotation=tuple(map(tuple, frame)))
    p = one.place(0, "bone")
    y = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
    x = (p[2] - p[0]) - (p[2] - p[0]) @ y * y
    x /= np.linalg.norm(x)
    axes = np.array([x, y, np.cross(x, y)])
    marked = analyse(table([one]), axes={"x": ("bone/1", "bone/3"), "y": ("bone/1", "bone/2")})
    for found, matrix in ((turned, frame), (marked, axes)):
        for row in range(len(plain["status"])):
            assert np.allclose(vector(found, "t?_mm", row), matrix @ vector(plain, "t?_mm", row), rtol=0, atol=EXACT)
            assert np.allclose(vector(found, "screw_?", row), matrix @ vector(plain, "screw_?", row), rtol=0, atol=EXACT)
    lost = analyse(table([one]), axes={"x": ("bone/1", "bone/9"), "y": ("bone/1", "bone/2")})
    assert set(lost["status"]) == {"failed"}
    assert all("frame-undefined" in reasons for reasons in lost["reasons"])
    assert np.isnan(lost["tx_mm"]).all()


def changed(markers: MarkerTable, where: np.ndarray, **columns: np.ndarray) -> MarkerTable:
    """Return a table with some rows changed."""
    new = {}
    for name in MarkerTable.__dataclass_fields__:
        values = getattr(markers, name).copy()
        if name in columns:
            values = values.astype(object) if values.dtype.kind == "U" else values
            values[where] = columns[name]
            values = values.astype(str) if values.dtype == object else values
        new[name] = values
    return MarkerTable(**new)


def two_segments(markers: int = 4) -> tuple[MarkerTable, np.ndarray]:
    """Return a table of bone and stem in two examinations with covariances, and which rows are the stem in the second one."""
    rng = np.random.default_rng(9)
    made = table([subject(rng, exams=2, segments=("bone", "stem"), markers=markers)], rng, np.eye(3) * 0.02**2)
    return made, np.flatnonzero((made.segment == "stem") & (made.exam == exam_name(1)))


@pytest.mark.parametrize(
    ("damage", "status", "reason", "computed"),
    [
        (lambda t, at: t.rows(~np.isin(np.arange(len(t)), at[2:])), "failed", "too-few-markers", False),
        (lambda t, at: t.rows(~np.isin(np.arange(len(t)), at)), "failed", "segment-missing", False),
        (lambda t, at: changed(t, at[:2], position_mm=np.nan), "failed", "too-few-markers", False),
        (lambda t, at: changed(t, at[:1], position_mm=np.nan), "ok", "marker-missing", True),
        (lambda t, at: changed(t, at[:1], flags=MarkerFlag.PREDICTED), "ok", "marker-predicted", True),
        (lambda t, at: changed(t, at[:1], flags=MarkerFlag.LOOSE, position_mm=t.position_mm[at[0]] + 2), "ok", "marker-doubtful", True),
        (lambda t, at: changed(t, at[:1], flags=MarkerFlag.AMBIGUOUS), "ok", "marker-doubtful", True),
        (lambda t, at: changed(t, at, position_mm=t.position_mm[at] * [-1, 1, 1]), "failed", "mirrored", False),
        (lambda t, at: changed(t, at[:1], marker="2"), "failed", "too-few-markers", False),
        (lambda t, at: changed(t, at[:1], position_mm=t.position_mm[at[0]] + 2), "review", "marker-unstable", True),
        (
            lambda t, at: changed(t, np.flatnonzero(t.segment == "stem"), position_mm=np.outer(np.tile(np.arange(4.0), 2), [9, 5, 1])),
            "failed",
            "markers-in-line",
            False,
        ),
    ],
)
def test_bad_input_is_a_row_with_its_reason_and_the_others_are_computed(damage, status: str, reason: str, computed: bool) -> None:
    markers, at = two_segments()
    found = analyse(damage(markers, at), limits=Limits(condition_number=1000))
    row = pick(found, segment="stem", reference="")
    assert found["status"][row] == status
    assert reason in found["reasons"][row].split(";")
    assert np.isfinite(found["tx_mm"][row]) == computed
    relative = pick(found, segment="stem", reference="bone")
    assert found["status"][relative] == status
    other = pick(found, segment="bone", reference="")
    assert found["status"][other] == "ok"
    assert np.isfinite([found[name][other] for name in ("tx_mm", "sd_tx_mm", "rx_deg", "sd_rx_deg", "mtpm_mm")]).all()


def test_a_mirror_image_is_told_without_covariances_too() -> None:
    """The residuals of the fit, which stand in for errors, were those of the wrong hand: the markers were said to lie in line."""
    markers, at = two_segments()
    bare = changed(markers, np.arange(len(markers)), covariance_mm2=np.nan)
    stem = np.flatnonzero(markers.segment == "stem")
    bare = changed(bare, stem, position_mm=np.tile([[-11, -8, -5], [6, 16, -2], [20, -10, 5], [14, 1, -11.0]], (2, 1)))
    found = analyse(changed(bare, at, position_mm=bare.position_mm[at] * [-1, 1, 1]), limits=Limits())
    row = pick(found, segment="stem", reference="")
    assert found["status"][row] == "failed"
    assert {"mirrored", "markers-in-line"} & set(found["reasons"][row].split(";")) == {"mirrored"}


def test_a_marker_that_stands_twice_is_left_out_and_said() -> None:
    markers, at = two_segments(5)
    double = changed(markers, at[:1], marker="2")
    found = analyse(double, limits=Limits())
    row = pick(found, segment="stem", reference="")
    assert found["status"][row] == "review"
    assert {"marker-duplicate", "marker-missing"} <= set(found["reasons"][row].split(";"))
    assert found["n_markers"][row] == 3


def test_an_unknown_reference_fails_the_motions_relative_to_it_alone() -> None:
    found = analyse(two_segments()[0], "femur", Limits(condition_number=1000))
    unknown = found["reference"] == "femur"
    assert set(found["reasons"][unknown]) == {"reference-unknown"}
    assert np.isnan(found["tx_mm"][unknown].astype(float)).all()
    assert set(found["status"][~unknown]) == {"ok"}


def test_two_markers_in_line_within_their_errors_do_not_determine_a_motion() -> None:
    rng = np.random.default_rng(10)
    markers, _ = two_segments()
    stem = markers.segment == "stem"
    line = np.outer(np.tile(np.arange(4.0), 2), [9, 5, 1]) + rng.normal(0, 0.02, (8, 3))
    found = analyse(changed(markers, np.flatnonzero(stem), position_mm=line), limits=Limits())
    assert found["reasons"][pick(found, segment="stem", reference="")].split(";")[0] == "markers-in-line"


def test_a_rotation_of_90_degrees_about_y_is_said_to_be_singular_and_its_screw_is_given() -> None:
    one = subject(np.random.default_rng(11), exams=1, segments=("bone",))
    one.rotation[1, "bone"], one.shift[1, "bone"] = Rotation.from_euler("y", 90, degrees=True), np.zeros(3)
    found = analyse(table([one]))
    assert found["reasons"][0] == "euler-singular;sd-from-residuals"
    assert found["status"][0] == "review"
    assert found["ry_deg"][0] == pytest.approx(90, abs=EXACT)
    assert np.isnan([found["rx_deg"][0], found["rz_deg"][0]]).all()
    assert found["screw_angle_deg"][0] == pytest.approx(90, abs=EXACT)
    assert np.allclose(vector(found, "screw_?", 0), [0, 1, 0], atol=EXACT)


def test_a_translation_has_no_screw_axis_but_its_length() -> None:
    one = subject(np.random.default_rng(12), exams=1, segments=("bone",))
    one.rotation[1, "bone"], one.shift[1, "bone"] = Rotation.identity(), np.array([3.0, 0.0, 4.0])
    found = analyse(table([one]))
    assert "screw-undefined" in found["reasons"][0]
    assert found["status"][0] == "ok"
    assert np.isnan(vector(found, "screw_?", 0)).all()
    assert np.isnan(vector(found, "screw_p?_mm", 0)).all()
    assert found["screw_shift_mm"][0] == pytest.approx(5, abs=EXACT)
    assert found["tx_mm"][0] == pytest.approx(3, abs=EXACT)


def test_a_loose_marker_is_named_and_left_out_of_the_consistent_markers() -> None:
    rng = np.random.default_rng(13)
    markers = table([subject(rng, exams=3, segments=("bone",))], rng, np.eye(3) * 0.02**2)
    loose = (markers.marker == "4") & (markers.exam == exam_name(2))
    found = analyse(changed(markers, np.flatnonzero(loose), position_mm=markers.position_mm[loose] + [0, 1.5, 0]), limits=Limits())
    last = pick(found, exam_from=exam_name(0), exam_to=exam_name(2))
    assert found["unstable_markers"][last] == "4"
    assert found["status"][last] == "review"
    assert (found["n_markers"][last], found["consistent_n_markers"][last]) == (5, 4)
    assert set(found["consistent_markers"]) == {"1;2;3;5"}
    assert found["consistent_status"][last] == "ok"
    assert found["e_rb_mm"][last] > 5 * found["consistent_e_rb_mm"][last]
    assert found["mean_error_mm"][last] < found["e_rb_mm"][last]


def test_the_status_of_examinations_reaches_their_motions() -> None:
    from rsa_vision.kinematics.kinema import motions
    from rsa_vision.kinematics.series import make_series
    from rsa_vision.settings import Motion

    markers, _ = two_segments()
    for status, code in (("review", "exam-review"), ("failed", "exam-failed")):
        found = motions(make_series(markers, {("S001", exam_name(1)): status}), Motion(), Limits())
        assert set(found["status"]) == {status}
        assert all(code in reasons.split(";") for reasons in found["reasons"])


@pytest.mark.parametrize(
    ("exams", "unclear"),
    [
        (("preop", "1y"), True),
        (("1y", "6m"), True),
        (("post", "3months", "1year"), True),
        (("3/4/2026", "4/4/2026"), True),
        (("6m", "12m", "12mb"), False),
        (("1", "2", "2b"), False),
        (("1a", "1b", "2a"), False),
        (("A", "B"), False),
        (("202601150900", "2026-02-15", "202602150900b"), False),
        (("visit 2", "visit 10"), False),
    ],
)
def test_names_that_do_not_tell_the_order_of_examinations_are_known(exams: tuple[str, ...], unclear: bool) -> None:
    assert order_is_unclear(exams) is unclear
