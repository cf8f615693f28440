"""Known segments whose coordinates have errors, as from CT: told in segments.csv, they neither hide what moves nor make names surer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.errors import SettingsError
from rsa_vision.followup import follow_up
from rsa_vision.identify.known_bodies import Seen, as_measured
from rsa_vision.identify.poses import Cloud, place
from rsa_vision.kinematics.series import MarkerTable
from rsa_vision.segments import Segment, read_segments
from rsa_vision.settings import Limits
from rsa_vision.sightlines import Sightlines
from rsa_vision.tables import SCHEMAS
from tests.cli.conftest import rows_of
from tests.identify.bodies import random_body, seen_from
from tests.motion.bodies import analyse

CT_MM = 0.15  # what CT tells places of markers to
SD_MM = 0.02  # of measured coordinates
HEAD = "subject,segment,marker,x_mm,y_mm,z_mm,"
BONE = "S,a,1,0,0,0,{}\nS,a,2,10,0,0,{}\nS,a,3,0,20,0,{}\n"


def segments_of(rng: np.random.Generator, bodies: dict[str, np.ndarray], *, told: bool = True, ct_mm: float = CT_MM) -> Any:
    """Return segments as CT shows them."""
    return {
        "": [
            Segment(name, labels(body), body + rng.normal(0, ct_mm, body.shape), np.full(body.shape, ct_mm) if told else None)
            for name, body in bodies.items()
        ]
    }


def labels(body: np.ndarray) -> tuple[str, ...]:
    return tuple(str(k + 1) for k in range(len(body)))


def two_bodies(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"bone": random_body(rng, 6), "stem": random_body(rng, 5) + np.array([0, 60, 0])}


def moved(rng: np.random.Generator, bodies: dict[str, np.ndarray]) -> np.ndarray:
    """Return true places of all markers, one body turned a little against the other."""
    turn, shift = Rotation.from_rotvec(rng.normal(0, 0.1, 3)), rng.normal(0, 5, 3)
    own = [Rotation.from_rotvec(rng.normal(0, 0.02, 3)) for _ in bodies]
    return np.concatenate([turn.apply(by.apply(body)) + shift for by, body in zip(own, bodies.values(), strict=True)])


def named(rows: Any) -> list[str]:
    return [f"{row['segment']}/{row['marker']}" for row in rows["markers"] if row["x_mm"] is not None]


def reasons(rows: Any) -> str:
    return str(rows["exams"][0]["reasons"])


def clean(n: int, *, told: bool) -> Iterator[tuple[list[Any], list[np.ndarray], list[str]]]:
    """Yield n subjects with two examinations each, named, with the true places and names."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        bodies = two_bodies(rng)
        true = [moved(rng, bodies), moved(rng, bodies)]
        segments = segments_of(rng, bodies, told=told)
        exams = [rows_of(str(e + 1), at + rng.normal(0, SD_MM, at.shape), sd_mm=SD_MM) for e, at in enumerate(true)]
        yield follow_up(exams, segments, Limits()), true, [f"{name}/{k}" for name, body in bodies.items() for k in labels(body)]


def test_clean_examinations_are_ok_where_errors_of_segments_are_told_and_motions_have_the_errors_stated() -> None:
    rows, places, truth = [], [], []
    for subject, (exams, true, names) in enumerate(clean(40, told=True)):
        for exam, at in zip(exams, true, strict=True):
            assert reasons(exam) == ""
            assert named(exam) == names
            rows += [(f"S{subject}", f"20260{exam['exams'][0]['exam']}010900", *name.split("/")) for name in names]
            places.append([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in exam["markers"]])
            truth.append(at)
    names = np.array(rows).T
    covariance = np.tile(np.eye(3) * SD_MM**2, (len(rows), 1, 1))
    none = np.zeros(len(rows), np.int64)
    noisy, exact = (analyse(MarkerTable(*names, np.concatenate(at), covariance, none), limits=Limits()) for at in (places, truth))
    ratios = [
        (noisy[n].astype(float) - exact[n].astype(float)) / noisy[f"sd_{n}"].astype(float) for n in ("rx_deg", "ry_deg", "tx_mm", "tz_mm")
    ]
    assert 0.9 < np.sqrt(np.mean(np.square(ratios))) < 1.1


def test_without_their_errors_told_such_segments_are_reviewed() -> None:
    """What the columns are for: some place is half a millimetre off."""
    assert sum("marker-loose" in reasons(exam) for exams, _, _ in clean(5, told=False) for exam in exams) > 5


def test_a_marker_that_moved_by_less_than_the_errors_of_segments_tell_is_loose_against_the_first_examination() -> None:
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        bodies = two_bodies(rng)
        segments = segments_of(rng, bodies, ct_mm=0.3)
        way = rng.normal(size=3)
        loose = {
            **bodies,
            "bone": bodies["bone"] + np.outer(np.arange(6) == 2, 0.7 * way / np.linalg.norm(way)),
        }  # 4.5 times 0.3 would hide it
        true = [moved(rng, bodies), moved(rng, loose), moved(rng, loose)]
        exams = [rows_of(str(e + 1), at + rng.normal(0, SD_MM, at.shape), sd_mm=SD_MM) for e, at in enumerate(true)]
        first, *later = follow_up(exams, segments, Limits())
        assert reasons(first) == ""
        for exam in later:
            assert reasons(exam) == "marker-loose"
            assert "bone/3" in [f"{row['segment']}/{row['marker']}" for row in exam["markers"] if "loose" in row["flags"]]


def test_a_marker_far_beyond_the_errors_of_segments_is_loose_in_a_first_examination() -> None:
    for seed in range(10):
        rng = np.random.default_rng(200 + seed)
        bodies = two_bodies(rng)
        loose = {**bodies, "stem": bodies["stem"] + np.outer(np.arange(5) == 4, [1.4, -1.0, 1.0])}
        (exam,) = follow_up([rows_of("1", moved(rng, loose))], segments_of(rng, bodies), Limits())
        assert "marker-loose" in reasons(exam)


def test_names_that_the_errors_of_segments_make_ambiguous_are_told() -> None:
    """Turned over, the triangle is 0.7 mm off: that tells where the places are exact, and not where they are known to 0.3 mm."""
    bone = np.array([[-12.0, 0, 0], [12, 0, 0], [0.7, 20, 0]])
    stem = random_body(np.random.default_rng(6), 5) + np.array([0, 60, 0])
    exams = [rows_of("1", np.concatenate([bone, stem]) + 3)]
    for sd_mm in (None, np.full((3, 3), 0.3)):
        (exam,) = follow_up(exams, {"": [Segment("bone", tuple("123"), bone, sd_mm), Segment("stem", tuple("12345"), stem)]}, Limits())
        assert ("constellation-ambiguous" in reasons(exam)) == (sd_mm is not None)
        assert (named(exam)[:3] == ["bone/1", "bone/2", "bone/3"]) == (sd_mm is None)


def test_predicted_places_have_the_errors_that_the_segments_give_them() -> None:
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 6)
        true = Rotation.random(random_state=rng).apply(body) + np.array([0, 100, 150])
        image = dict.fromkeys(SCHEMAS["images"]) | {"focus": 1, "role": "unassigned", "number": "", "shape": "ball", "flags": ""}
        ray = seen_from(rng, true[5:], np.array([0]), SD_MM)
        seen = rows_of("1", true[:5] + rng.normal(0, SD_MM, (5, 3)), sd_mm=SD_MM)
        seen = {**seen, "images": [image], **Sightlines(ray, (), np.zeros(0)).rows()}
        (exam,) = follow_up([seen], segments_of(rng, {"bone": body}, ct_mm=0.1), Limits())
        (row,) = (row for row in exam["markers"] if row["marker"] == "6")
        if row["flags"] == "missing":  # an image alone is not sure to be of a place known to no more than this
            assert exam["exams"][0]["status"] == "review"
            continue
        squares.append(((row["z_mm"] - true[5, 2]) / row["sd_z_mm"]) ** 2)  # along the ray, which tells the other two
    assert len(squares) > 40
    assert 0.75 < np.sqrt(np.mean(squares)) < 1.25  # 50: 10 %; where the segment counts as exact it is 2


def test_a_body_as_measured_agrees_with_later_points_as_its_covariances_say() -> None:
    """Two examinations show it in parts; the third is compared with what they made of it."""
    sigmas = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        true = random_body(rng, 8)
        body = Cloud.independent(true + rng.normal(0, 0.5, true.shape), np.full(true.shape, 0.5))
        seen: list[Seen] = []
        for markers in ((0, 1, 2, 3, 4), (2, 3, 4, 5, 6)):
            at = Rotation.random(random_state=rng).apply(true) + rng.normal(0, 20, 3)
            points = Cloud.independent(at + rng.normal(0, 0.3, at.shape), np.full(at.shape, 0.3))
            pairs = tuple((i, i) for i in markers)
            placement = place(as_measured(body, seen), points, pairs)
            assert placement is not None
            seen.append(Seen(placement, pairs, points))
        last = Cloud.independent(true + rng.normal(0, 0.3, true.shape), np.full(true.shape, 0.3))
        known = as_measured(body, seen)
        fit = place(known, last, tuple((i, i) for i in range(8)))
        assert fit is not None
        sigmas.append(fit.sigmas)
        assert (np.sqrt(np.diagonal(known.covariance_mm2[:5], axis1=1, axis2=2)) < 0.301).all()
        assert (np.diagonal(known.covariance_mm2[7]) > 0.25).all()
    assert 0.9 < np.sqrt(np.mean(np.square(sigmas))) < 1.1


def test_an_examination_whose_markers_are_all_doubtful_tells_nothing_of_a_body() -> None:
    body = Cloud.independent(np.diag([10.0, 20, 30]), np.full((3, 3), 0.1))
    placement = place(body, body, ((0, 0), (1, 1), (2, 2)))
    assert placement is not None
    once, again = (as_measured(body, [Seen(placement, (), body)] * n + [Seen(placement, ((0, 0),), body)]) for n in (0, 2))
    np.testing.assert_array_equal(again.covariance_mm2, once.covariance_mm2)


def test_standard_deviations_are_read_and_zeros_are_as_good_as_none(tmp_path: Path) -> None:
    path = tmp_path / "segments.csv"
    path.write_text(HEAD + "sd_x_mm,sd_y_mm,sd_z_mm\n" + BONE.format("0.1,0.1,0.2", "0.1,0.1,0.2", "0,0,0.5"))
    (segment,) = read_segments(path)["S"]
    assert segment.sd_mm is not None
    assert segment.sd_mm.tolist() == [[0.1, 0.1, 0.2], [0.1, 0.1, 0.2], [0, 0, 0.5]]
    path.write_text(HEAD + "sd_x_mm,sd_y_mm,sd_z_mm\n" + BONE.format("0,0,0", "0,0,0", "0,0,0"))
    (segment,) = read_segments(path)["S"]
    assert segment.sd_mm is None


@pytest.mark.parametrize(
    ("columns", "values", "said"),
    [
        ("sd_x_mm,sd_y_mm", "0.1,0.1", ["column sd_z_mm is missing"]),
        ("sd_x_mm,sd_y_mm,sd_y_mm,sd_z_mm", "0.1,0.1,0.1,0.1", ["column sd_y_mm stands twice"]),
        ("sd_x_mm,sd_y_mm,sd_z_mm", "-0.1,0.1,0.1", ["line 3: sd_x_mm of a/2 is '-0.1'"]),
        ("sd_x_mm,sd_y_mm,sd_z_mm", "0.1,wide,", ["line 3: sd_y_mm of a/2 is 'wide'", "line 3: sd_z_mm of a/2 is ''"]),
        ("sd_x_mm,sd_y_mm,sd_z_mm", "nan,0.1,150", ["line 3: sd_x_mm of a/2 is 'nan'", "line 3: sd_z_mm of a/2 is '150'", "0.5 mm"]),
    ],
)
def test_impossible_standard_deviations_are_refused_by_marker(columns: str, values: str, said: list[str], tmp_path: Path) -> None:
    path = tmp_path / "segments.csv"
    good = ",".join(["0.1"] * (columns.count(",") + 1))
    path.write_text(HEAD + columns + "\n" + BONE.format(good, values, good))
    with pytest.raises(SettingsError) as error:
        read_segments(path)
    assert all(part in str(error.value) for part in said)
