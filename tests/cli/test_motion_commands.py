"""`motion`, `growth` and `precision` from tables of markers: what they write, how they end, what they say to bad input."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import rsa_vision
from rsa_vision.cli import run_app
from rsa_vision.motion_tables import MOTION_SCHEMAS
from tests.motion.bodies import Subject, subject, table

PUBLISHED = (
    "subject exam_from exam_to segment reference rx_deg ry_deg rz_deg tx_mm ty_mm tz_mm sd_rx_deg sd_ry_deg sd_rz_deg sd_tx_mm sd_ty_mm "
    "sd_tz_mm screw_angle_deg screw_x screw_y screw_z screw_shift_mm screw_px_mm screw_py_mm screw_pz_mm cog_x_mm cog_y_mm cog_z_mm "
    "mtpm_mm mtpm_marker e_rb_mm mean_error_mm condition_number n_markers status reasons"
)
SD_MM = 0.03
FIVE_SIGMA = 5.0


def write(path: Path, subjects: list[Subject], rng: np.random.Generator, rename: dict[str, str] | None = None) -> Path:
    """Write markers of subjects with noise as a CSV."""
    made = table(subjects, rng, np.eye(3) * SD_MM**2)
    columns = {"subject": made.subject, "exam": made.exam, "segment": made.segment, "marker": made.marker}
    columns |= {f"{axis}_mm": made.position_mm[:, k] for k, axis in enumerate("xyz")} | {
        f"sd_{axis}_mm": [SD_MM] * len(made) for axis in "xyz"
    }
    frame = pl.DataFrame(columns).with_columns(pl.col("exam").replace(rename or {}))
    frame.write_csv(path)
    return path


@pytest.fixture
def markers(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    subjects = [subject(rng, segments=("bone", "stem"), markers=6, angle_deg=3, shift_mm=1) for _ in range(4)]
    return write(tmp_path / "markers.csv", subjects, rng)


def read(path: Path) -> pl.DataFrame:
    return pl.read_csv(path, schema=dict(MOTION_SCHEMAS[path.stem]))


def test_motion_writes_the_published_columns_beside_its_input_or_into_out(markers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["motion", str(markers), "--reference", "bone"]) == 0
    assert "36 motions: 36 ok, 0 review, 0 failed" in capsys.readouterr().out
    found = read(markers.with_name("motion.csv"))
    assert set(PUBLISHED.split()) <= set(found.columns)
    assert set(found["reference"].fill_null("")) == {"", "bone"}
    assert found["status"].to_list() == ["ok"] * 36
    out = markers.parent / "out"
    assert run_app(["motion", str(markers.parent), "-o", str(out), "--side", "left"]) == 0
    for name in ("motion", "rigidity", "motion_groups"):
        assert read(out / f"{name}.csv").equals(pl.read_parquet(out / "results.parquet" / f"{name}.parquet")), name
    left = read(out / "motion.csv")
    assert np.allclose(left["tx_mm"], -found["tx_mm"])
    assert not set(left["frame"]) & set(found["frame"])


def test_markers_that_are_flagged_are_read_as_such(markers: Path) -> None:
    table = pl.read_csv(markers, infer_schema=False)
    third = (pl.col("subject") == "S001") & (pl.col("segment") == "stem") & (pl.col("marker") == "3") & (pl.col("exam") == "202602010900")
    for flag, reason in (("predicted", "predicted"), ("overlap;loose", "doubtful"), ("ambiguous", "doubtful")):
        flags = pl.when(third).then(pl.lit(flag)).otherwise(pl.lit(""))
        table.with_columns(flags=flags).write_csv(markers)
        found = rsa_vision.motion(markers).table.filter(pl.col("reasons").fill_null("").str.contains(f"marker-{reason}"))
        assert set(found["n_markers"]) == {5}, flag
        assert set(found["subject"]) == {"S001"}
        assert set(found["status"]) == {"ok"}


def test_rigidity_has_every_side_of_the_closed_polygon(markers: Path) -> None:
    rsa_vision.motion(markers)
    sides = read(markers.with_name("rigidity.csv"))
    one = sides.filter((pl.col("subject") == "S001") & (pl.col("segment") == "bone") & (pl.col("exam_to") == "202602010900"))
    assert list(zip(one["marker"], one["marker_next"], strict=True)) == [(str(k), str(k % 6 + 1)) for k in range(1, 7)]
    assert not sides["changed"].any()
    ratio = (sides["side_change_um"] / sides["sd_side_change_um"]).to_numpy()
    assert 0.85 < np.sqrt((ratio**2).mean()) < 1.15


def test_groups_summarise_the_subjects_at_each_follow_up(markers: Path) -> None:
    table = rsa_vision.motion(markers).table
    groups = read(markers.with_name("motion_groups.csv"))
    row = groups.filter(
        (pl.col("segment") == "stem") & (pl.col("reference") == "bone") & (pl.col("follow_up") == 2) & (pl.col("parameter") == "ty_mm")
    ).to_dicts()[0]
    key = (pl.col("segment") == "stem") & (pl.col("reference") == "bone") & (pl.col("exam_from") == "202601010900")
    values = table.filter(key & (pl.col("exam_to") == "202603010900"))["ty_mm"].to_numpy()
    assert (row["n"], row["median_days"]) == (4, 59)
    assert row["mean"] == pytest.approx(values.mean())
    assert row["sd"] == pytest.approx(values.std(ddof=1))
    assert row["mean_high"] - row["mean"] == pytest.approx(3.182446 * values.std(ddof=1) / 2, rel=1e-6)  # Student, 3 degrees of freedom
    assert (row["low"], row["high"], row["median"]) == pytest.approx((values.min(), values.max(), np.median(values)))


def test_a_motion_that_is_not_ok_is_said_and_ends_with_1(markers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["motion", str(markers), "--reference", "femur"]) == 1
    assert "reference-unknown" in capsys.readouterr().out
    assert rsa_vision.motion(markers, reference="femur").exit_code == 1


def test_an_eos_style_table_with_semicolons_decimal_commas_and_a_byte_order_mark_is_read(markers: Path) -> None:
    header, *lines = [line.replace(",", ";").replace(".", ",") for line in markers.read_text().splitlines()]
    assert header.startswith("subject;exam;segment;marker;x_mm;y_mm;z_mm;")
    other = markers.with_name("eos.csv")
    names = "Patient ID;Exam date;Body;Point;X [mm];Y [mm];Z [mm];" + header.split(";", 7)[7]
    other.write_bytes("\r\n".join(["\ufeff" + names, *lines, ""]).encode())
    assert rsa_vision.motion(other).table.equals(rsa_vision.motion(markers).table)


def test_a_table_with_tabs_is_read(markers: Path) -> None:
    other = markers.with_name("other.csv")
    other.write_text(markers.read_text().replace(",", "\t"))
    assert rsa_vision.motion(other).table.equals(rsa_vision.motion(markers).table)


@pytest.mark.parametrize(
    "header",
    [
        "Patient,Examination,Body,Point,X,Y,Z,SD X,SD Y,SD Z",
        "patient id;exam date;rigid body;landmark;X [mm];Y [mm];Z [mm];std_x;std_y;std_z",
        "Case\tVisit\tComponent\tBead\tx (mm)\ty (mm)\tz (mm)\tsigma x [mm]\tsigma y [mm]\tsigma z [mm]",
    ],
)
def test_columns_are_recognised_by_the_names_that_other_programs_give_them(header: str, markers: Path) -> None:
    separator = max(",;\t", key=header.count)
    _, *lines = markers.read_text().splitlines()
    other = markers.with_name("other.csv")
    other.write_text("\n".join([header, *(line.replace(",", separator) for line in lines)]))
    found, expected = rsa_vision.motion(other).table, rsa_vision.motion(markers).table
    assert found.equals(expected)


def test_a_marker_can_tell_its_segment(markers: Path) -> None:
    expected = rsa_vision.motion(markers).table
    joined = pl.read_csv(markers, infer_schema=False).with_columns(point=pl.col("segment") + "/" + pl.col("marker"))
    joined.drop("segment", "marker").write_csv(markers)
    assert rsa_vision.motion(markers).table.equals(expected)


def test_dates_of_unclear_order_are_to_be_reviewed_and_others_have_their_days(markers: Path) -> None:
    table = pl.read_csv(markers, infer_schema=False)
    months = table["exam"].unique().sort().to_list()
    table.with_columns(pl.col("exam").replace({name: f"{k}/4/2026" for k, name in enumerate(months, 1)})).write_csv(markers)
    found = rsa_vision.motion(markers).table
    assert found["reasons"].str.contains("exam-order-unclear").all()
    assert set(found["status"]) == {"review"}
    table.with_columns(pl.col("exam").replace({name: f"2026/04/1{k} 09:30:00" for k, name in enumerate(months)})).write_csv(markers)
    found = rsa_vision.motion(markers).table
    assert set(found["status"]) == {"ok"}
    assert set(found["days"]) == {1.0, 2.0}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("exam,segment,marker,x [cm],y [cm],z [cm]\n1,a,1,0,0,0\n", "x [cm] is in cm; give mm, in a column x_mm"),
        ("exam,segment,marker,x,y,z\n1,a,1,0.01,0.2,0\n1,a,2,0.01,0,0.1\n", "x, y, z do not say their unit and span 0.2; give mm"),
        ("exam,segment,point,bead,x,y,z\n1,a,1,0,0,0\n", "point and bead may both be the column marker; rename the right one"),
        ("exam;segment;marker;x;y;z\n1;a;1;0,5;1,234;1.5\n", "y_mm is '1,234', not a number"),
        ("", "not a readable CSV"),
        ("exam,segment,marker,x_mm,y_mm\n1,a,1,0,0\n", "missing columns: z_mm"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n", "no marker in it"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n1,a,1,0,zero,0\n", "line 2: y_mm is 'zero', not a number"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n1,a,1,0,inf,0\n", "line 2: y_mm is 'inf', not a number"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n1,a,1,0,1e300,0\n", "line 2: y_mm is '1e300', not a number of mm"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n,a,,0,0,0\n", "line 2: marker is empty"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n1,,1,0,0,0\n", "no marker has a segment"),
        ("exam,segment,marker,x_mm,x_mm,z_mm\n1,a,1,0,0,0\n", "stand twice: x_mm"),
        ("exam,segment,marker,x_mm,y_mm,z_mm,sd_x_mm,sd_y_mm,sd_z_mm\n1,a,1,0,0,0,1,-1,1\n", "no covariance"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n1,a,1,0,0,0,7\n", "not a readable CSV"),
        ("exam,segment,marker,x_mm,y_mm,z_mm\n\xff\xfe".encode("latin-1"), "save it as UTF-8"),
    ],
)
@pytest.mark.parametrize("command", ["motion", "precision"])
def test_a_table_that_cannot_be_used_is_refused_with_its_lines(
    content: str | bytes, said: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert run_app([command, str(path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == [path]


def test_wrong_usage_is_refused(markers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["motion", str(tmp_path / "nothing")], "no such file"),
        (["motion", str(markers), "--side", "front"], "side"),
        (["precision", str(markers)], "no double examination"),
        (["growth", str(markers), "--material", "wood"], "material 'wood' is not known"),
        (["growth", str(markers), "--temperature-c", "74"], "temperature 74 is none of a room"),
    ):
        assert run_app(arguments) == 2
        assert said in capsys.readouterr().err


def test_precision_of_double_examinations_tells_the_spread_that_they_have(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    subjects = [subject(rng, exams=2, segments=("bone", "stem"), markers=6, angle_deg=0, shift_mm=0) for _ in range(60)]
    path = write(tmp_path / "markers.csv", subjects, rng, {"202602010900": "202601010900b"})
    found = rsa_vision.precision(path, reference="bone").table
    rows = {row["parameter"]: row for row in found.filter((pl.col("segment") == "stem") & (pl.col("reference") == "")).to_dicts()}
    expected = SD_MM * np.sqrt(2 / 6)  # of the centre of gravity of six markers
    for axis in "xyz":
        row = rows[f"t{axis}_mm"]
        assert row["n"] + row["n_left_out"] == 60
        assert row["from_zero"] == pytest.approx(expected, rel=0.3)
        assert row["limit_95"] == pytest.approx(1.96 * row["sd"])
        assert row["single"] == pytest.approx(row["from_zero"] / np.sqrt(2))
        assert abs(row["mean"]) < FIVE_SIGMA * expected / np.sqrt(row["n"])
    model = found.filter((pl.col("kind") == "model") & (pl.col("segment") == "stem"))
    assert np.allclose(model["single"], 1000 * SD_MM, rtol=0.2)  # Selvik (5:3): error of one coordinate
    assert model["n"].to_list() == [360] * 3


def test_growth_of_a_rod_finds_its_scale_and_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rod = np.outer(np.arange(11) * 20.0, [0, 1, 0])
    rows = []
    for k in range(40):
        turned = (rod * (1 - 75e-6)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.normal(0, 0.005, rod.shape) + [5, 6, 7]
        rows += [{"exam": str(k), "marker": str(i), "x_mm": x, "y_mm": y, "z_mm": z} for i, (x, y, z) in enumerate(turned)]
    pl.DataFrame(rows).with_columns(segment=pl.lit("")).write_csv(tmp_path / "rod.csv")
    pl.DataFrame({"marker": [str(i) for i in range(11)]} | {f"{a}_mm": rod[:, k] for k, a in enumerate("xyz")}).write_csv(
        tmp_path / "given.csv"
    )
    assert run_app(["growth", str(tmp_path / "rod.csv"), "--standard", str(tmp_path / "given.csv"), "-o", str(tmp_path / "out")]) == 0
    found, lengths = read(tmp_path / "out" / "growth.csv"), read(tmp_path / "out" / "lengths.csv")
    assert set(found["form"]) == {"rod"}
    assert set(found["n_lengths"]) == {55}
    assert np.sqrt((found["s0_um"].to_numpy() ** 2).mean()) == pytest.approx(5.0, rel=0.1)
    assert found["scale_ppm"].mean() == pytest.approx(-75, abs=4 * 5e-3 / 209.8 * 1e6 / np.sqrt(40))
    assert len(lengths) == 40 * 55
    one = lengths.filter(pl.col("exam_to") == "0")["difference_um"].to_numpy()
    assert found["rmsv_um"][0] == pytest.approx(np.sqrt((one**2).mean()))
    # a cage one degree warmer than it was calibrated: the correction takes the scale away
    warm = rsa_vision.growth(tmp_path / "rod.csv", tmp_path / "warm", standard=tmp_path / "given.csv", temperature_c=24.5).table
    assert warm["scale_ppm"].mean() == pytest.approx(found["scale_ppm"].mean() + 75, abs=0.1)


def test_growth_between_two_times_has_stated_errors_that_are_true(markers: Path) -> None:
    rigid = rsa_vision.growth(markers).table
    assert len(rigid) == 4 * 3
    assert set(rigid["reasons"]) == {"segments-together"}  # the stem's motion is no growth
    lengths = read(markers.with_name("lengths.csv")).filter(pl.col("segment_a") == pl.col("segment_b"))
    ratio = (lengths["difference_um"] / lengths["sd_um"]).to_numpy()
    assert 0.9 < np.sqrt((ratio**2).mean()) < 1.1


def test_growth_has_no_scale_for_a_mirror_image_and_says_which_markers_stand_twice(
    markers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = pl.read_csv(markers)
    last = table["exam"].unique().sort()[-1]
    flipped = table.with_columns(x_mm=pl.when(pl.col("exam") == last).then(-pl.col("x_mm")).otherwise("x_mm"))
    flipped.write_csv(tmp_path / "flipped.csv")
    assert run_app(["growth", str(tmp_path / "flipped.csv"), "-o", str(tmp_path / "flipped")]) == 1
    found = read(tmp_path / "flipped" / "growth.csv")
    mirrored = found.filter(pl.col("exam_to") == str(last))
    assert set(mirrored["reasons"]) == {"mirrored;segments-together"}
    assert mirrored["scale_ppm"].null_count() == mirrored["s0_um"].null_count() == len(mirrored)
    assert mirrored["rmsv_um"].null_count() == 0  # lengths are the same in a mirror
    assert set(found.filter(pl.col("exam_to") != str(last))["status"]) == {"ok"}
    pl.concat([table, table.filter(pl.col("exam") == last).head(1)]).write_csv(tmp_path / "twice.csv")
    assert run_app(["growth", str(tmp_path / "twice.csv"), "-o", str(tmp_path / "twice")]) == 1
    assert "review (marker-duplicate;segments-together)" in capsys.readouterr().out


def test_growth_of_points_in_one_place_is_not_determined(markers: Path, tmp_path: Path) -> None:
    pl.read_csv(markers).with_columns(x_mm=1.0, y_mm=2.0, z_mm=3.0).write_csv(tmp_path / "one.csv")
    found = rsa_vision.growth(tmp_path / "one.csv").table  # warnings are errors here
    assert found["scale_ppm"].null_count() == len(found)


def test_ten_thousand_motions_take_a_second(tmp_path: Path) -> None:
    from rsa_vision.kinematics.kinema import motions
    from rsa_vision.kinematics.rigidity import rigidity
    from rsa_vision.kinematics.series import make_series
    from rsa_vision.settings import Limits, Motion

    rng = np.random.default_rng(4)
    one = subject(rng, exams=2, segments=("bone",))
    series = make_series(table([one] * 10_000, rng, np.eye(3) * 1e-4))
    started = time.process_time()
    found = motions(series, Motion(), Limits(condition_number=1e4))
    sides = rigidity(series, 0.35)
    assert time.process_time() - started < 2.0  # 0.7 s where nothing else runs
    assert len(sides["marker"]) == 50_000
    assert len(found["status"]) == 10_000


def test_a_run_with_known_segments_ends_with_motion_in_its_report(markers: Path, tmp_path: Path) -> None:
    from rsa_vision import api
    from rsa_vision.settings import Study
    from rsa_vision.store import write_run
    from rsa_vision.tables import SCHEMAS, frame

    out = tmp_path / "out"
    out.mkdir()
    for name in SCHEMAS:
        frame([], SCHEMAS[name]).write_csv(out / f"{name}.csv")
    study = Study.model_validate({"motion": {"reference": "bone"}, "report": {"implant": "a <stem>"}})
    assert api.write_motion(out, study) is None
    assert not (out / "motion.csv").exists()
    (out / "markers.csv").write_bytes(markers.read_bytes())
    assert api.write_motion(out, study) is not None
    far = pl.read_csv(markers, infer_schema=False).with_columns(y_mm=pl.when(pl.col("marker") == "1").then(pl.lit("1e9")).otherwise("y_mm"))
    far.write_csv(out / "markers.csv")
    lost = api.write_motion(out, study)  # a marker far off does not end a run
    assert lost is not None
    assert all("marker-missing" in reasons for reasons in lost.table["reasons"])
    (out / "markers.csv").write_bytes(markers.read_bytes())
    api.write_motion(out, study)
    frame([], SCHEMAS["markers"]).write_csv(out / "markers.csv")
    write_run(out, {"settings": study.model_dump(mode="json")})
    page = api.report(out).read_text()
    assert page.count("over time") == 7  # stem against bone: six parameters and MTPM
    assert "a &lt;stem&gt;" in page
    assert "36 motions: 36 ok" in page
    assert "set posture in [report]" in page
    assert "Groups" in page
    assert "open circles" not in page
    loosened = pl.read_csv(markers, infer_schema=False)
    third = (pl.col("subject") == "S001") & (pl.col("segment") == "stem") & (pl.col("marker") == "3") & (pl.col("exam") == "202602010900")
    loosened = loosened.with_columns(x_mm=pl.when(third).then(pl.lit("500")).otherwise("x_mm")).filter(pl.col("subject") == "S001")
    loosened.write_csv(out / "markers.csv")
    api.write_motion(out, study)
    frame([], SCHEMAS["markers"]).write_csv(out / "markers.csv")
    page = api.report(out).read_text()
    assert "open circles are motions to be reviewed" in page
    assert "Groups" not in page  # of one subject


def test_continuous_migration_is_told_of_motions_that_are_ok_alone(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    exams = {"202601010900": "20240101", "202602010900": "20250101", "202603010900": "20260101"}
    bodies = subject(rng, exams=3, segments=("bone", "stem"), markers=5, angle_deg=0, shift_mm=0)
    bodies.shift[1, "stem"][1], bodies.shift[2, "stem"][1] = -1.0, -2.5
    path = write(tmp_path / "markers.csv", [bodies], rng, exams)

    def told() -> dict[tuple[str, str], bool | None]:
        table = rsa_vision.motion(path, reference="bone").table
        rows = table.filter((pl.col("segment") == "stem") & (pl.col("reference") == "bone"))
        return {(row["exam_from"], row["exam_to"]): row["continuous"] for row in rows.to_dicts()}

    late = ("20250101", "20260101")
    assert told() == {("20240101", "20250101"): None, ("20240101", "20260101"): None, late: True}
    table = pl.read_csv(path, infer_schema=False)
    first = (pl.col("segment") == "stem") & (pl.col("marker") == "1") & (pl.col("exam") == "20260101")
    table.with_columns(y_mm=pl.when(first).then(pl.lit("99")).otherwise("y_mm")).write_csv(path)
    assert told()[late] is None


def test_a_table_with_a_row_for_each_frame_is_read_as_xmalab_writes_it(markers: Path) -> None:
    long = pl.read_csv(markers, schema_overrides={"exam": pl.String}).filter(pl.col("subject") == "S001")
    frames = []
    for _, exam in long.group_by("exam", maintain_order=True):
        names = [f"{row['segment']}/{row['marker']}" for row in exam.to_dicts()]
        frames.append({f"{name}_{a.upper()}": exam[f"{a}_mm"][k] for k, name in enumerate(names) for a in "xyz"})
    wide = markers.with_name("wide.csv")
    pl.DataFrame(frames).write_csv(wide)
    found, expected = rsa_vision.motion(wide).table, rsa_vision.motion(markers).table.filter(pl.col("subject") == "S001")
    assert set(found["exam_to"]) == {"2", "3"}
    assert np.allclose(found["tx_mm"], expected["tx_mm"])
    assert np.allclose(found["mtpm_mm"], expected["mtpm_mm"])
