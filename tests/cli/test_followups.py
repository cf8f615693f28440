"""Names through the examinations of a subject, as a user meets them: segments.csv, P01 ... kept, hidden markers, proposals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

import rsa_vision
from rsa_vision.cli import run_app
from rsa_vision.errors import SettingsError
from rsa_vision.followup import follow_up
from rsa_vision.segments import Segment, read_segments
from rsa_vision.settings import Limits
from rsa_vision.sightlines import Sightlines
from rsa_vision.tables import SCHEMAS
from rsa_vision.types import MarkerImages
from synthetic.study import make_study
from tests.cli.conftest import SD_PX, content, rows_of
from tests.identify.bodies import seen_from

TEXT = {"subject": pl.String, "exam": pl.String, "segment": pl.String, "marker": pl.String, "flags": pl.String, "number": pl.String}
FIRST, SECOND, THIRD = "202601010900", "202601020900", "202601030900"


def read(path: Path) -> pl.DataFrame:
    return pl.read_csv(path, schema_overrides=TEXT)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three examinations of two bodies that move against each other."""
    folder = tmp_path_factory.mktemp("study")
    box = np.array([[-25.0, 40, 60], [45, 130, 140]])
    make_study(
        folder,
        "2",
        rng=np.random.default_rng(5),
        n_exams=3,
        segments={"bone": 6, "implant": 5},
        box_mm=box,
        pitch_mm=0.15,
        fine=1,
        quanta=None,
    )
    return folder


@pytest.fixture
def hide(films: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let examinations see the true images but those of some markers, named by (exam, focus, marker)."""
    import cv2

    truth = read(films / "truth" / "images.csv")

    def hiding(*hidden: tuple[str, int, str]) -> None:
        rng = np.random.default_rng(7)
        known: dict[str, MarkerImages] = {}
        for name in truth["file"].unique(maintain_order=True):
            rows = [r for r in truth.filter(pl.col("file") == name).to_dicts() if (r["exam"], r["focus"], r["number"]) not in hidden]
            n = len(rows)
            known[name] = MarkerImages(
                position_px=np.array([[r["col_px"], r["row_px"]] for r in rows]) + rng.normal(0, SD_PX, (n, 2)),
                covariance_px2=np.tile(np.eye(2) * SD_PX**2, (n, 1, 1)),
                shape=np.array([r["shape"] for r in rows]),
                radius_px=np.full(n, 3.0),
                angle_deg=np.full(n, np.nan),
                contrast=np.full(n, 0.5),
                background=np.full(n, 0.7),
                snr=np.full(n, 50.0),
                flags=np.zeros(n, np.int64),
            )
        by_content = {content(cv2.imread(str(films / name), cv2.IMREAD_UNCHANGED)): images for name, images in known.items()}
        monkeypatch.setattr(
            "rsa_vision.examination.detect_markers",
            lambda values, **_: SimpleNamespace(images=by_content[content(values)]),
        )

    return hiding


def places(table: pl.DataFrame, exam: str) -> dict[str, np.ndarray]:
    rows = table.filter((pl.col("exam") == exam) & pl.col("x_mm").is_not_null()).to_dicts()
    return {f"{r['segment'] or ''}/{r['marker']}".lstrip("/"): np.array([r["x_mm"], r["y_mm"], r["z_mm"]]) for r in rows}


def names_of_truth(films: Path, out: Path) -> dict[str, dict[str, str]]:
    """Return by examination the true name of every name that was given."""
    truth, found = read(films / "truth" / "markers.csv"), read(out / "markers.csv")
    result = {}
    for exam in (FIRST, SECOND, THIRD):
        true = places(truth, exam)
        result[exam] = {
            name: min(true, key=lambda t: float(np.linalg.norm(true[t] - place))) for name, place in places(found, exam).items()
        }
    return result


def exams(out: Path) -> dict[str, tuple[str, str]]:
    return {r["exam"]: (r["status"], r["reasons"] or "") for r in read(out / "exams.csv").to_dicts()}


def test_names_by_segments_are_the_true_ones_in_every_examination(films: Path, hide: Any, tmp_path: Path) -> None:
    hide()
    segments = films / "truth" / "segments.csv"
    assert run_app(["measure", str(films), "-o", str(tmp_path), "--segments", str(segments)]) == 0
    assert all(status == ("ok", "") for status in exams(tmp_path).values())
    for names in names_of_truth(films, tmp_path).values():
        assert len(names) == 11
        assert all(given == true for given, true in names.items())
    images = read(tmp_path / "images.csv").filter(pl.col("role") == "object")
    assert set(images["number"]) == set(names)
    run = (tmp_path / "run.json").read_text()
    assert "segments.csv" in run


def test_films_of_known_segments_end_with_their_true_motion(films: Path, hide: Any, tmp_path: Path) -> None:
    hide()
    assert run_app(["measure", str(films), "-o", str(tmp_path / "out"), "--segments", str(films / "truth" / "segments.csv")]) == 0
    assert run_app(["motion", str(films / "truth" / "markers.csv"), "-o", str(tmp_path / "truth")]) == 0
    found, true = (read(tmp_path / name / "motion.csv").filter(pl.col("reference") == "bone") for name in ("out", "truth"))
    assert found["status"].to_list() == ["ok"] * 3
    names = [f"{kind}{axis}_{unit}" for kind, unit in (("r", "deg"), ("t", "mm")) for axis in "xyz"]
    off = (found.select(names).to_numpy() - true.select(names).to_numpy()) / found.select(f"sd_{name}" for name in names).to_numpy()
    assert np.abs(off).max() < 4.5
    assert 0.3 < np.sqrt((off**2).mean()) < 1.6  # 12 of these 18 are independent
    assert np.allclose(true.filter(pl.col("exam_from") == int(FIRST))[0].select("rx_deg", "ry_deg", "rz_deg"), [1.0, -0.6, 0.4], atol=0.01)
    assert (tmp_path / "out" / "report.html").read_text().count("over time") == 7


def test_names_without_segments_stay_those_of_the_first_examination(films: Path, hide: Any, tmp_path: Path) -> None:
    hide((FIRST, 1, "bone/2"), (FIRST, 2, "bone/2"), (SECOND, 1, "implant/1"), (SECOND, 2, "implant/1"))
    assert run_app(["measure", str(films), "-o", str(tmp_path)]) == 1
    names = names_of_truth(films, tmp_path)
    meaning = names[FIRST] | {name: true for name, true in names[SECOND].items() if name not in names[FIRST]}
    assert sorted(meaning) == [f"P{k:02d}" for k in range(1, 12)]
    assert len(set(meaning.values())) == 11
    for given in names.values():
        assert all(meaning[name] == true for name, true in given.items())
    assert len(names[THIRD]) == 11
    (lost,) = read(tmp_path / "markers.csv").filter(pl.col("x_mm").is_null()).to_dicts()  # what nothing shows has a row that says so
    (implant_1,) = (name for name, true in names[FIRST].items() if true == "implant/1")
    assert (lost["exam"], lost["marker"], lost["flags"], lost["n_views"]) == (SECOND, implant_1, "missing", 0)
    assert exams(tmp_path)[FIRST] == ("ok", "")
    assert exams(tmp_path)[SECOND][0] == "review"  # a marker that the first did not show
    assert exams(tmp_path)[THIRD] == ("ok", "")  # by now it is known
    before = (tmp_path / "markers.csv").read_bytes()
    run_app(["measure", str(films), "-o", str(tmp_path)])  # from the records
    assert (tmp_path / "markers.csv").read_bytes() == before
    segments = tmp_path / "segments.csv"
    assert run_app(["segments", "propose", str(tmp_path), "-o", str(segments)]) == 0
    (proposed,) = read_segments(segments).values()
    bodies = [{meaning[marker].split("/")[0] for marker in segment.markers} for segment in proposed]
    assert sorted(map(sorted, bodies)) == [["bone"], ["implant"]]


def test_a_marker_hidden_from_one_focus_is_predicted_at_its_true_place(films: Path, hide: Any, tmp_path: Path) -> None:
    hide((SECOND, 2, "bone/3"))
    segments = films / "truth" / "segments.csv"
    assert run_app(["measure", str(films), "-o", str(tmp_path), "--segments", str(segments)]) == 1
    found = read(tmp_path / "markers.csv").filter((pl.col("exam") == SECOND) & (pl.col("marker") == "3") & (pl.col("segment") == "bone"))
    (row,) = found.to_dicts()
    assert row["flags"] == "one-view;predicted"
    assert row["n_views"] == 1
    error = places(found, SECOND)["bone/3"] - places(read(films / "truth" / "markers.csv"), SECOND)["bone/3"]
    assert (np.abs(error) < [3 * row[f"sd_{axis}_mm"] for axis in "xyz"]).all()
    assert exams(tmp_path)[SECOND] == ("review", "marker-one-view")
    image = read(tmp_path / "images.csv").filter((pl.col("exam") == SECOND) & (pl.col("number") == "bone/3"))
    assert image["focus"].to_list() == [1]


def test_segments_of_another_object_are_never_ok(films: Path, hide: Any, tmp_path: Path) -> None:
    hide()
    table = read(films / "truth" / "segments.csv").with_columns(pl.col("x_mm") * -1)
    table.write_csv(tmp_path / "mirrored.csv")
    assert run_app(["measure", str(films), "-o", str(tmp_path / "out"), "--segments", str(tmp_path / "mirrored.csv")]) == 1
    assert all(status == "review" and "marker-mismatch" in reasons for status, reasons in exams(tmp_path / "out").values())


def test_names_given_twice_are_the_same_and_too_few_markers_are_never_named() -> None:
    body = np.random.default_rng(1).normal(0, 20, (6, 3))
    exams = [rows_of("1", body), rows_of("2", body[[4, 1]] + 3), rows_of("3", body[:0]), rows_of("4", body[::-1] - 5)]
    for segments in (None, {"": [Segment("a", tuple("123456"), body)]}):
        once = follow_up(exams, segments, Limits())
        twice = follow_up(once, segments, Limits())
        assert [rows["markers"] for rows in twice] == [rows["markers"] for rows in once]
        first, few, none, last = once
        assert first["exams"][0]["status"] == last["exams"][0]["status"] == "ok"
        assert [row["marker"] for row in last["markers"]] == [row["marker"] for row in first["markers"]][::-1]
        assert few["exams"][0]["status"] == "review"
        every = {row["marker"] for row in first["markers"]}
        assert not {row["marker"] for row in few["markers"] if row["x_mm"] is not None} & every
        for exam in (few, none):
            missing = [row for row in exam["markers"] if row["x_mm"] is None]
            assert {row["marker"] for row in missing} == every
            assert all(row["flags"] == "missing" and row["n_views"] == 0 for row in missing)


def test_a_name_that_may_be_a_second_one_is_doubted_as_long_as_the_first_is_missing() -> None:
    body = np.random.default_rng(3).normal(0, 20, (8, 3))
    moved = body + np.outer(np.arange(8) == 5, [0.9, -0.6, 0.8])
    first, second, third, whole = follow_up(
        [rows_of("1", body), rows_of("2", moved + 2), rows_of("3", moved - 3), rows_of("4", np.vstack([body, moved[5]]))], None, Limits()
    )
    assert first["exams"][0]["status"] == "ok"
    for exam in (second, third):
        assert {row["marker"] for row in exam["markers"] if row["x_mm"] is not None} == {f"P{k:02d}" for k in (1, 2, 3, 4, 5, 7, 8, 9)}
        assert (exam["exams"][0]["status"], exam["exams"][0]["reasons"]) == ("review", "constellation-ambiguous")
        assert "P09 may be P06" in exam["exams"][0]["message"]
    assert whole["exams"][0]["status"] == "ok"  # both at once are two


def test_films_of_another_subject_are_reviewed_and_no_others() -> None:
    rng = np.random.default_rng(4)
    body, another = rng.normal(0, 20, (2, 10, 3))
    first, foreign, again, last = follow_up(
        [rows_of("1", body), rows_of("2", another), rows_of("3", body + 4), rows_of("4", another - 2)], None, Limits()
    )
    assert first["exams"][0]["status"] == again["exams"][0]["status"] == "ok"
    assert (foreign["exams"][0]["status"], foreign["exams"][0]["reasons"]) == ("review", "marker-mismatch")
    assert "another subject" in foreign["exams"][0]["message"]
    assert last["exams"][0]["status"] == "review"  # as long as nobody has looked
    assert not {row["marker"] for row in foreign["markers"] if row["x_mm"] is not None} & {row["marker"] for row in first["markers"]}


@pytest.mark.parametrize(("first", "with_ray"), [(0, False), (1, False), (0, True)])
def test_a_bone_of_three_that_a_loose_marker_turns_over_is_reviewed_and_has_no_motion(first: int, with_ray: bool) -> None:
    """In a later examination as in the first, where the other segment tells how it should lie; 24 mm off with nothing said before."""
    bone = np.array([[-12.0, 0, 0], [12, 0, 0], [0.25, 20, 0]])
    stem = np.random.default_rng(6).normal(0, 15, (5, 3)) + np.array([0, 60, 0])
    segments = {"S": [Segment("bone", tuple("123"), bone), Segment("stem", tuple("12345"), stem)]}
    loose = bone + np.outer([0, 0, 1], [-0.5, 0, 0])
    turn = Rotation.from_euler("xyz", [4, -3, 8], degrees=True)
    exams = [rows_of("1", np.concatenate([bone, stem])), rows_of("2", turn.apply(np.concatenate([loose, stem])) + 2)]
    if with_ray:  # another image of the third: it tells nothing more
        image = dict.fromkeys(SCHEMAS["images"]) | {"focus": 1, "role": "unassigned", "number": "", "shape": "ball", "flags": ""}
        ray = seen_from(np.random.default_rng(7), turn.apply(loose[2:]) + 2, np.array([0]))
        exams[1] = {**exams[1], "images": [image], **Sightlines(ray, (), np.zeros(0)).rows()}
    *whole, last = follow_up(exams[first:], segments, Limits())
    assert all(rows["exams"][0]["status"] == "ok" for rows in whole)
    assert last["exams"][0]["status"] == "review"
    assert "constellation-ambiguous" in last["exams"][0]["reasons"]
    assert [row["segment"] for row in last["markers"] if row["segment"] and row["x_mm"] is not None] == ["stem"] * 5


def test_a_marker_that_only_some_of_its_group_would_name_is_loose() -> None:
    """Three of eight agreed with a moved marker of large errors; nothing was said of the others."""
    loose = 0
    for seed in range(30, 45):  # one of them; the others are reviewed
        rng = np.random.default_rng(seed)
        body = rng.uniform(-25, 25, (8, 3))
        turn = Rotation.from_euler("xyz", rng.normal(0, 4, 3), degrees=True)
        moved = turn.apply(body) + rng.normal(0, 5, 3) + rng.normal(0, 0.005, (8, 3))
        way = rng.normal(size=3)
        moved[0] += 0.7 * way / np.linalg.norm(way)
        rows = rows_of("2", moved)
        rows["markers"][0] |= {"sd_x_mm": 0.03, "sd_y_mm": 0.03, "sd_z_mm": 0.08}
        _, second = follow_up([rows_of("1", body), rows], None, Limits())
        if second["markers"][0]["marker"] == "P01":
            assert second["markers"][0]["flags"] == "loose"
            assert second["exams"][0]["reasons"] == "marker-loose"
            loose += 1
        else:
            assert second["exams"][0]["status"] == "review"
    assert loose == 1


def test_doubtful_pairs_that_agree_with_the_segment_stay_in_review_and_it_says_so() -> None:
    body = np.random.default_rng(2).normal(0, 20, (5, 3))
    (named,) = follow_up([rows_of("1", body + 9, "ambiguous", "pair-ambiguous")], {"S": [Segment("a", tuple("12345"), body)]}, Limits())
    assert (named["exams"][0]["status"], named["exams"][0]["reasons"]) == ("review", "pair-ambiguous")
    assert "agree with the constellation" in named["exams"][0]["message"]
    assert all(row["segment"] == "a" for row in named["markers"])


def test_reconstruct_names_points_by_segments(films: Path, tmp_path: Path) -> None:
    points = read(films / "truth" / "images.csv")
    objects = {name: str(101 + k) for k, name in enumerate(sorted(points.filter(pl.col("role") == "object")["number"].unique()))}
    points.filter(pl.col("role") != "unassigned").with_columns(pl.col("number").replace(objects)).write_csv(tmp_path / "points.csv")
    segments = films / "truth" / "segments.csv"
    assert rsa_vision.reconstruct(tmp_path / "points.csv", tmp_path / "out", cage="2", segments=segments).count("failed") == 0
    for names in names_of_truth(films, tmp_path / "out").values():
        assert len(names) == 11
        assert all(given == true for given, true in names.items())


def test_reconstruct_predicts_markers_that_are_named_at_one_focus_only(films: Path, tmp_path: Path) -> None:
    points = read(films / "truth" / "images.csv").filter((pl.col("role") != "unassigned") & (pl.col("exam") == SECOND))
    points = points.filter((pl.col("number") != "bone/3") | (pl.col("focus") == 1))
    objects = {name: str(101 + k) for k, name in enumerate(sorted(points.filter(pl.col("role") == "object")["number"].unique()))}
    points.with_columns(pl.col("number").replace(objects)).write_csv(tmp_path / "points.csv")
    rsa_vision.reconstruct(tmp_path / "points.csv", tmp_path / "out", cage="2", segments=films / "truth" / "segments.csv")
    markers = read(tmp_path / "out" / "markers.csv")
    assert len(markers) == 11
    (row,) = markers.filter(pl.col("flags").str.contains("predicted")).to_dicts()
    assert (row["segment"], row["marker"], row["flags"]) == ("bone", "3", "one-view;predicted")
    error = places(markers, SECOND)["bone/3"] - places(read(films / "truth" / "markers.csv"), SECOND)["bone/3"]
    assert (np.abs(error) < [3 * row[f"sd_{axis}_mm"] for axis in "xyz"]).all()
    assert exams(tmp_path / "out")[SECOND] == ("review", "marker-one-view")


HEAD = "subject,segment,marker,x_mm,y_mm,z_mm\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("subject,segment,x_mm,y_mm,z_mm\n", ["marker is missing"]),
        (HEAD, ["no marker"]),
        (
            HEAD + "S,a,1,0,0,zero\nS,a,1,nan,0,0\n,b/c,,0,0,0\nS,a\n",
            ["line 2: z_mm", "line 3: x_mm", "stands there", "slash", "marker is empty", "2 values"],
        ),
    ],
)
def test_segments_that_cannot_be_used_are_refused_with_every_error(text: str, said: list[str], tmp_path: Path) -> None:
    path = tmp_path / "segments.csv"
    path.write_text(text)
    with pytest.raises(SettingsError) as error:
        read_segments(path)
    assert all(part in str(error.value) for part in said)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("{},a,1,0,0,0\n{},a,2,10,0,0\n", "2 markers"),
        ("{},a,1,0,0,0\n{},a,2,10,0,0\n{},a,3,20,0,0.1\n", "in line"),
        ("{},a,1,0,0,0\n{},a,2,10,0,0\n{},a,3,0,20,0\n{},a,4,0,20,0.1\n", "3 and 4 are the same place"),
    ],
)
@pytest.mark.parametrize("whose", ["S", ""])
def test_a_segment_that_determines_no_pose_is_an_error_of_its_subject_alone(lines: str, said: str, whose: str, tmp_path: Path) -> None:
    body, path = np.random.default_rng(1).normal(0, 20, (2, 6, 3)), tmp_path / "segments.csv"
    good = [f"{subject},b,{k},{','.join(map(str, place))}\n" for subject, at in zip("ST", body, strict=True) for k, place in enumerate(at)]
    path.write_text(HEAD + lines.replace("{}", whose) + "".join(good))
    first, last, other = rows_of("1", body[0]), rows_of("2", body[0] + 3), rows_of("1", body[1])
    for row in (*other["exams"], *other["markers"]):
        row["subject"] = "T"
    *mine, foreign = follow_up([first, last, other], read_segments(path), Limits())
    for rows in (*mine, *([] if whose else [foreign])):
        assert (rows["exams"][0]["status"], rows["exams"][0]["reasons"]) == ("review", "constellation-ambiguous")
        assert said in rows["exams"][0]["message"]
    if whose:
        assert foreign["exams"][0]["status"] == "ok"
    assert all((row["segment"], row["flags"]) == ("b", "") for rows in (*mine, foreign) for row in rows["markers"])  # nothing is lost by it


def test_proposals_need_two_examinations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["segments", "propose", str(tmp_path)]) == 2
    assert "no results" in capsys.readouterr().err


def test_a_marker_hidden_without_segments_has_no_place_where_bodies_moved(films: Path, hide: Any, tmp_path: Path) -> None:
    hide((SECOND, 2, "bone/3"))
    assert run_app(["measure", str(films), "-o", str(tmp_path)]) == 1
    (lost,) = read(tmp_path / "markers.csv").filter(pl.col("x_mm").is_null()).to_dicts()  # nothing tells with which body it moved
    assert (lost["exam"], lost["flags"]) == (SECOND, "missing")


def test_a_marker_hidden_without_segments_is_predicted_where_nothing_moved() -> None:
    rng = np.random.default_rng(3)
    body, turn = rng.normal([0, 100, 150], 20, (6, 3)), Rotation.from_rotvec([0.1, -0.2, 0.1])
    moved = turn.apply(body) + np.array([3, -2, 1])
    first, second = rows_of("1", body), rows_of("2", moved[:5])
    ray = seen_from(rng, moved[5:], np.array([0]), 0.01)
    image = dict.fromkeys(SCHEMAS["images"]) | {"focus": 1, "role": "unassigned", "number": "", "shape": "ball", "flags": ""}
    for shift, names in ((0.0, {"P01", "P02", "P03", "P04", "P05", "P06"}), (1.0, {"P01", "P02", "P03", "P04", "P05"})):
        shifted = replace(ray, through_mm=ray.through_mm + np.array([shift, 0, 0]))
        seen = {**second, "images": [image], **Sightlines(shifted, (), np.zeros(0)).rows()}
        _, named = follow_up([first, seen], None, Limits())
        assert {row["marker"] for row in named["markers"] if row["x_mm"] is not None} == names
        (row,) = (row for row in named["markers"] if row["marker"] == "P06")
        assert row["flags"] == ("missing" if shift else "one-view;predicted")
        assert named["exams"][0]["status"] == ("ok" if shift else "review")
        assert shift or np.abs(np.array([row["x_mm"], row["y_mm"], row["z_mm"]]) - moved[5]).max() < 0.3
