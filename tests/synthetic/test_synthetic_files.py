"""Rendered films as files, truth tables, studies, and the comparison with what was measured."""

import csv
import tomllib

import imagecodecs
import numpy as np
import polars as pl
import pydicom
import pytest
import tifffile

from rsa_vision.settings import Study
from synthetic.compare import compare, match_points
from synthetic.demo import CAGES
from synthetic.study import make_study, render_examination
from synthetic.write import write_film

PITCH = (0.1, 0.125)
QUICK = {"pitch_mm": 0.4, "n_objects": 4, "fine": 2}


@pytest.fixture(scope="module")
def values():
    return (np.random.default_rng(0).random((30, 41)) * 4095).astype(np.uint16)


@pytest.mark.parametrize("bits", [12, 16])
@pytest.mark.parametrize("white_is_zero", [False, True])
def test_tiff_is_read_by_tifffile_with_its_pitch(tmp_path, values, bits, white_is_zero):
    path = tmp_path / "film.tif"
    write_film(path, values, bits=bits, pitch_mm=PITCH, white_is_zero=white_is_zero)
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        stored = page.asarray()
        x, y = (num / den for num, den in (page.tags["XResolution"].value, page.tags["YResolution"].value))
        assert page.tags["ResolutionUnit"].value == 3  # centimetre
        assert page.bitspersample == bits
        assert page.photometric == (0 if white_is_zero else 1)
    assert (10 / y, 10 / x) == pytest.approx(PITCH)
    assert np.array_equal(2**bits - 1 - stored if white_is_zero else stored, values)


def test_png_has_its_pitch(tmp_path, values):
    path = tmp_path / "film.png"
    write_film(path, values, bits=16, pitch_mm=PITCH)
    data = path.read_bytes()
    assert np.array_equal(imagecodecs.png_decode(data), values)
    start = data.index(b"pHYs") + 4
    assert (int.from_bytes(data[start + 4 : start + 8]), int.from_bytes(data[start : start + 4]), data[start + 8]) == (10000, 8000, 1)


@pytest.mark.parametrize("white_is_zero", [False, True])
def test_dicom_says_what_it_is(tmp_path, values, white_is_zero):
    path = tmp_path / "S7_202601020900_f2.dcm"
    write_film(path, values, bits=12, pitch_mm=PITCH, white_is_zero=white_is_zero)
    data = pydicom.dcmread(path)
    assert [float(x) for x in data.ImagerPixelSpacing] == list(PITCH)
    assert (data.BitsStored, data.PatientID, data.AcquisitionDate) == (12, "S7", "20260102")
    assert data.PhotometricInterpretation == ("MONOCHROME1" if white_is_zero else "MONOCHROME2")
    stored = data.pixel_array
    assert np.array_equal(4095 - stored if white_is_zero else stored, values)


def test_other_extensions_are_refused(tmp_path, values):
    with pytest.raises(ValueError, match="tif, png"):
        write_film(tmp_path / "film.gif", values, bits=16, pitch_mm=None)


def test_same_seed_same_films_and_other_seed_other_films():
    films = [next(iter(render_examination("2", rng=np.random.default_rng(s), **QUICK).films.values())) for s in (1, 1, 2)]
    assert np.array_equal(films[0], films[1])
    assert films[0].shape != films[2].shape or not np.array_equal(films[0], films[2])


def test_object_balls_stay_apart_and_on_the_film():
    shot = render_examination("1A", rng=np.random.default_rng(4), **{**QUICK, "n_objects": 13})
    rows = shot.images.filter(pl.col("role") == "object")
    assert rows.height == 26
    position = rows.select("col_px", "row_px").to_numpy() * 0.4
    gap = np.linalg.norm(position[:, None] - position, axis=-1) + 1e9 * np.eye(26)
    assert gap.min() > 3 * 0.8


def test_missing_and_foreign_marks():
    shot = render_examination("1B", rng=np.random.default_rng(5), missing_marks={1: [3, 14]}, film_size_mm=(500, 500), **QUICK)
    of = {f: shot.images.filter(pl.col("focus") == f) for f in (1, 2)}
    assert not {"3", "14"} & set(of[1]["number"])
    assert {"3", "14"} <= set(of[2]["number"])
    foreign = of[1].filter(pl.col("flags") == "foreign-mark")
    assert set(foreign["role"]) == {"unassigned"}
    assert {"15", "16", "17"} <= set(foreign["number"])
    bare = render_examination("1B", rng=np.random.default_rng(5), foreign_marks=False, film_size_mm=(500, 500), **QUICK)
    assert bare.images.filter(pl.col("flags") != "").height == 0


def test_every_option_renders():
    options = {"bone": True, "clutter": True, "scatter": 0.3, "scanner_noise": 0.002, "double_peaked": True, "inverted": True}
    shot = render_examination("1A", rng=np.random.default_rng(6), **options, **QUICK)
    plain = render_examination("1A", rng=np.random.default_rng(6), **QUICK)
    film, bare = (next(iter(s.films.values())).astype(float) for s in (shot, plain))
    assert film.std() > 5 * bare.std()
    assert film.mean() > bare.mean()  # inverted


def header(path):
    with path.open(newline="", encoding="utf-8") as file:
        return next(csv.reader(file))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    films = make_study(folder, "2", rng=np.random.default_rng(7), n_exams=2, segments={"bone": 4, "implant": 3}, **QUICK)
    return folder, films


def test_study_has_films_settings_and_truth(study):
    folder, films = study
    assert [p.name for p in films] == [f"S01_2026010{day}0900_f{focus}.tif" for day in (1, 2) for focus in (1, 2)]
    assert all(p.is_file() for p in films)
    assert Study.model_validate(tomllib.loads((folder / "study.toml").read_text())).cage == "2"
    images = (
        "subject exam focus role number shape col_px row_px sd_col_px sd_row_px cov_col_row_px2 x_mm y_mm z_mm residual_um used flags file"
    )
    assert header(folder / "truth" / "images.csv") == images.split()
    foci = "subject exam focus x_mm y_mm z_mm sd_x_mm sd_y_mm sd_z_mm fiducial_rmse_um fiducial_max_um line_rmsv_um line_max_um"
    assert header(folder / "truth" / "foci.csv") == [*foci.split(), "n_fiducials", "n_controls"]
    markers = "subject exam segment marker x_mm y_mm z_mm sd_x_mm sd_y_mm sd_z_mm cov_xy_mm2 cov_xz_mm2 cov_yz_mm2 crossing_um parallax_um"
    assert header(folder / "truth" / "markers.csv") == [*markers.split(), "n_views", "flags"]
    assert header(folder / "truth" / "segments.csv") == ["subject", "segment", "marker", "x_mm", "y_mm", "z_mm"]


def test_segments_move_rigidly_and_the_implant_migrates(study):
    table = pl.read_csv(study[0] / "truth" / "markers.csv", schema_overrides={"exam": pl.String})
    exams = [part.sort("segment", "marker") for _, part in sorted(table.group_by("exam"), key=lambda item: item[0])]
    before, after = (part.select("x_mm", "y_mm", "z_mm").to_numpy() for part in exams)
    lengths = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (before, after)]
    change = np.abs(lengths[1] - lengths[0])
    bone = (exams[0]["segment"] == "bone").to_numpy()
    assert change[np.ix_(bone, bone)].max() < 1e-9
    assert change[np.ix_(~bone, ~bone)].max() < 1e-9
    assert change[np.ix_(bone, ~bone)].max() > 0.2  # mm


def measured(study, folder, change=lambda name, table: table):
    """The truth as if it had been measured, with a change."""
    for name in ("images", "foci", "markers"):
        change(name, pl.read_csv(study[0] / "truth" / f"{name}.csv", schema_overrides={"exam": pl.String, "number": pl.String})).write_csv(
            folder / f"{name}.csv"
        )
    exams = [{"subject": "S01", "exam": f"2026010{day}0900", "status": "ok", "reasons": ""} for day in (1, 2)]
    pl.DataFrame(exams).write_csv(folder / "exams.csv")
    return compare(study[0] / "truth", folder)


def test_comparing_the_truth_with_itself(study, tmp_path):
    for result in measured(study, tmp_path):
        assert (result.n_true, result.n_matched, result.n_missing, result.n_false, result.n_identity_errors) == (7, 7, 0, 0, 0)
        assert result.rms_um == pytest.approx(0, abs=1e-9)
        assert not result.silently_wrong


def test_comparison_finds_shifts_losses_and_inventions(study, tmp_path):
    def change(name, table):
        if name == "markers":
            table = table.with_columns(pl.col("x_mm") + 0.03, sd_x_mm=0.01, sd_y_mm=0.01, sd_z_mm=0.01)[1:]
            table = pl.concat([table, table[:1].with_columns(z_mm=pl.lit(77.0), marker=pl.lit("9").cast(pl.Int64))])
        return table

    first, second = measured(study, tmp_path, change)
    assert (first.n_matched, first.n_missing, first.n_false) == (6, 1, 1)
    assert second.rms_um == second.rms_x_um == pytest.approx(30)
    assert second.error_over_sd == pytest.approx(np.sqrt((3**2 + 0 + 0) / 3))
    assert first.silently_wrong
    assert not second.silently_wrong


def test_comparison_finds_swapped_identities(study, tmp_path):
    def change(name, table):
        if name == "images":
            swap = pl.col("number").replace({"11": "12", "12": "11"})
            table = table.with_columns(number=pl.when(pl.col("exam") == "202601020900").then(swap).otherwise(pl.col("number")))
        return table

    first, second = measured(study, tmp_path, change)
    assert (first.n_identity_errors, second.n_identity_errors) == (0, 4)  # two marks of each focus


def test_match_prefers_many_pairs_and_keeps_to_the_limit():
    true, found = np.array([[0.0, 0, 0], [0.6, 0, 0]]), np.array([[-0.7, 0, 0], [0.1, 0, 0], [9, 9, 9]])
    assert match_points(true, found, 1.0) == ([0, 1], [0, 1])
    assert match_points(true, found, 0.3) == ([0], [1])
    assert match_points(true, np.zeros((0, 3)), 1.0) == ([], [])


def test_demo_covers_the_three_cages():
    assert set(CAGES) == {"1A", "1B", "2"}
