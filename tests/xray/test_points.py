from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exposures import exposure

from rsa_vision.cages import Cage, load_cage
from rsa_vision.errors import PointsError
from rsa_vision.flags import MarkerFlag, flag_names
from rsa_vision.points import read_points
from rsa_vision.settings import Limits
from rsa_vision.types import ImagePoints
from rsa_vision.xray import reconstruct

NAMED = "subject,exam,focus,role,number,col_px,row_px"
BY_ID = "subject,exam,id,col_px,row_px"


def written(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "points.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def selvik(points: ImagePoints) -> list[str]:
    objects = {name: str(101 + index) for index, name in enumerate(dict.fromkeys(points.number[points.role == "object"]))}
    return [
        f"s,7301021530,{objects.get(str(number), number)}{focus},{float(col)!r},{float(row)!r}"
        for focus, number, (col, row) in zip(points.focus, points.number, points.position_px, strict=True)
    ]


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
def test_identification_numbers_give_the_same_points(tmp_path: Path, name: str) -> None:
    cage, _, objects, points = exposure(name, np.random.default_rng(41))
    read = read_points(written(tmp_path, BY_ID, *selvik(points)), cage)
    assert list(read) == [("s", "7301021530")]
    found = read["s", "7301021530"]
    assert found.role.tolist() == points.role.tolist()
    assert found.focus.tolist() == points.focus.tolist()
    markers = reconstruct(found, cage, Limits()).markers
    np.testing.assert_allclose(markers.position_mm, objects, atol=1e-6)
    assert markers.name.tolist()[:2] == ["101", "102"]


def test_columns_of_images_csv(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "\ufeff" + NAMED + ",sd_col_px,sd_row_px,cov_col_row_px2,shape,flags,file,residual_um",
        "a,1,1,fiducial,01,10.5,20,0.1,0.2,0.01,tee,overlap;edge,x.tif,3",
        "a,1,2,object,bone/1,-1e2,3,,,,,,y.tif,",
        "",
        "a,2,,unassigned,,1,2,nan,nan,nan,ball,,x.tif,",
        "a,1,1,unassigned,,1,2,0.1,0.1,,ball,,x.tif,",
        "a,1,1,unassigned,,1,2,0.1,0.1,,ball,,x.tif,",
    )
    read = read_points(path)
    assert list(read) == [("a", "1"), ("a", "2")]
    first = read["a", "1"]
    assert first.number.tolist() == ["1", "bone/1", "", ""]
    assert first.focus.tolist() == [1, 2, 1, 1]
    assert first.film.tolist() == [0, 1, 0, 0]
    np.testing.assert_allclose(first.position_px[:2], [[10.5, 20], [-100, 3]])
    np.testing.assert_allclose(first.covariance_px2[0], [[0.01, 0.01], [0.01, 0.04]])
    assert np.isnan(first.covariance_px2[1]).all()
    np.testing.assert_allclose(first.covariance_px2[2], 0.01 * np.eye(2))
    assert flag_names(int(first.flags[0])) == "overlap;edge"
    assert first.flags[0] == MarkerFlag.OVERLAP | MarkerFlag.EDGE
    assert read["a", "2"].focus.tolist() == [0]
    assert np.isnan(read["a", "2"].covariance_px2).all()


def test_all_errors_are_listed_with_their_lines(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        NAMED + ",sd_col_px,sd_row_px,cov_col_row_px2,shape,flags",
        "a,1,1,fiducial,1,10,20,,,,,",
        "a,1,1,fiducial,01,11,21,,,,,",
        "a,1,1,fiducial,x,nan,inf,,,,,",
        ",1,one,control,11,1,,,,,,",
        "a,1,0,object,bone/1,1,1,,,,,",
        "a,1,1,object,,1,1,,,,,",
        "a,1,1,marker,4,1,1,,,,,",
        "a,1,1,object,bone/1,1,1,0.1,,,,",
        "a,1,1,object,bone/1,1,1,0.1,0.1,0.5,,",
        "a,1,1,object,bone/2,1,1,-1,0.1,0,cube,blue",
        "a,1,1,object",
    )
    with pytest.raises(PointsError) as caught:
        read_points(path)
    text = str(caught.value)
    for expected in (
        "line 3: fiducial 1 of focus 1 stands already in line 2",
        "line 4: number 'x'",
        "line 4: col_px is 'nan'",
        "line 4: row_px is 'inf'",
        "line 5: subject is empty",
        "line 5: focus 'one'",
        "line 5: row_px is ''",
        "line 6: focus '0'",
        "line 7: number of an object point is empty",
        "line 8: role 'marker'",
        "line 9: sd_col_px and sd_row_px must both be given",
        "line 10: sd_col_px 0.1, sd_row_px 0.1, cov_col_row_px2 0.5 are no covariance",
        "line 11: shape 'cube'",
        "line 11: flag 'blue'",
        "line 11: sd_col_px -1",
        "line 12: 4 values for 12 columns",
    ):
        assert expected in text
    assert text.count("\n") == 16


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([""], "missing columns: subject, exam, col_px, row_px, focus, role, number; instead"),
        ([NAMED], "no point"),
        ([BY_ID.replace("exam,", ""), "a,11,1,1"], "missing columns: exam$"),
        ([NAMED + ",id", "a,1,1,fiducial,1,1,1,11"], "not both"),
        ([NAMED + ",col_px", "a,1,1,fiducial,1,1,1,1"], "col_px stands twice"),
        ([NAMED, 'a,"1"x,1,fiducial,1,1,1'], "not a readable CSV"),
    ],
)
def test_a_table_that_cannot_be_read_is_said(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(PointsError, match=message):
        read_points(written(tmp_path, *lines))


def test_unreadable_files_are_said(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="not a readable CSV"):
        read_points(tmp_path / "missing.csv")
    (tmp_path / "film.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(PointsError, match="not a readable CSV"):
        read_points(tmp_path / "film.csv")


def renumbered(cage: Cage, numbers: dict[int, int]) -> Cage:
    marks = tuple(mark.model_copy(update={"number": numbers.get(mark.number, mark.number)}) for mark in cage.mark)
    return cage.model_copy(update={"mark": marks})


@pytest.mark.parametrize(
    ("cage", "text", "role", "number"),
    [
        (None, "11", "fiducial", "1"),
        (None, "992", "control", "99"),
        (None, "1011", "object", "101"),
        (load_cage("1B"), "101", "fiducial", "10"),
        (load_cage("1B"), "111", "control", "11"),
        (load_cage("1B"), "142", "control", "14"),
        (load_cage("1B"), "1111", "object", "111"),
        (renumbered(load_cage("1A"), {11: 30, 9: 40}), "401", "fiducial", "40"),
    ],
)
def test_meaning_of_identification_numbers(tmp_path: Path, cage: Cage | None, text: str, role: str, number: str) -> None:
    found = read_points(written(tmp_path, BY_ID, f"a,1,{text},1,2"), cage)["a", "1"]
    assert (found.role[0], found.number[0], found.focus[0]) == (role, number, int(text[-1]))


@pytest.mark.parametrize(
    ("cage", "text", "message"),
    [
        (None, "101", "give the cage"),
        (None, "7", "not an identification number"),
        (None, "-11", "not an identification number"),
        (None, "1.5", "not an identification number"),
        (None, "10", "not an identification number"),
        (None, "120", "no focus"),
        (load_cage("1A"), "13", "no focus of cage 1A"),
        (load_cage("1A"), "301", "has no mark 30"),
        (renumbered(load_cage("1A"), {11: 111}), "1111", "more than one point"),
    ],
)
def test_identification_numbers_that_stay_ambiguous_are_refused(tmp_path: Path, cage: Cage | None, text: str, message: str) -> None:
    with pytest.raises(PointsError, match=message):
        read_points(written(tmp_path, BY_ID, f"a,1,{text},1,2"), cage)


def test_unit_of_the_coordinates_does_not_matter() -> None:
    cage, _, objects, points = exposure("1A", np.random.default_rng(42))
    found = reconstruct(replace(points, position_px=points.position_px * 100.0), cage, Limits())  # micrometres
    np.testing.assert_allclose(found.markers.position_mm, objects, atol=1e-6)
