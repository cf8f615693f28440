"""Which films belong together."""

import os
from pathlib import Path

import pytest

from rsa_vision.errors import SettingsError, UsageError
from rsa_vision.study_files import ExamFiles, Grouping, group_films


def group(folder: Path, *names: str, **options: object) -> Grouping:
    for name in names:
        (folder / name).write_bytes(b"x")
    return group_films(folder, (1, 2), **options)  # type: ignore[arg-type]


def only(grouping: Grouping) -> ExamFiles:
    (exam,) = grouping.exams
    return exam


@pytest.mark.parametrize(
    ("name", "subject", "exam", "focus", "cage"),
    [
        ("S01_202601010900.tif", "S01", "202601010900", None, False),
        ("S01_202601010900b.TIFF", "S01", "202601010900b", None, False),
        ("S01_202601010900_f2.png", "S01", "202601010900", 2, False),
        ("left_knee_7_pre_f1.dcm", "left_knee_7", "pre", 1, False),
        ("S01_a_cage.tif", "S01", "a", None, True),
        ("S01_a_f1_cage.tif", "S01", "a", 1, True),
        ("S.1_2.5_f1.jp2", "S.1", "2.5", 1, False),
    ],
)
def test_name_rule(tmp_path: Path, name: str, subject: str, exam: str, focus: int | None, cage: bool) -> None:
    found = only(group(tmp_path, name))
    assert (found.subject, found.exam) == (subject, exam)
    assert [(film.focus, film.cage_only) for film in found.films] == [(focus, cage)]


@pytest.mark.parametrize("name", ["S01.tif", "S01_f1.tif", "S01_cage.tif", "_a.tif", "S01_a_cage_f1.tif"])
def test_a_film_of_another_name_is_a_failed_examination_not_a_guess(tmp_path: Path, name: str) -> None:
    found = only(group(tmp_path, name))
    assert found.problem is not None
    assert found.problem[0] == "film-name"
    assert "file_pattern" in found.problem[1]


def test_a_name_that_is_no_utf8_fails_alone_and_can_be_written(tmp_path: Path) -> None:
    try:
        (tmp_path / os.fsdecode(b"\xff\xfeX_1_f1.tif")).write_bytes(b"x")
    except OSError:
        pytest.skip("this file system has no such names")
    bad, good = sorted(group(tmp_path, "S_1_f1.tif", "S_1_f2.tif").exams, key=lambda exam: exam.problem is None)
    assert (good.subject, good.problem) == ("S", None)
    assert bad.problem is not None
    assert bad.problem[0] == "film-name"
    assert bad.subject.encode() == b"\\udcff\\udcfeX_1_f1"
    assert "rename" in bad.problem[1].encode().decode()


def test_figures_that_are_no_numbers_do_not_stop_the_sorting(tmp_path: Path) -> None:
    assert [exam.subject for exam in group(tmp_path, "5\u00b23_1.tif", "5_1.tif").exams] == ["5", "5\u00b23"]


def test_examinations_sort_by_number_and_repeats_follow(tmp_path: Path) -> None:
    names = [f"{s}_{e}.tif" for s in ("S10", "S9") for e in ("10", "9", "9b")]
    assert [(e.subject, e.exam) for e in group(tmp_path, *names).exams] == [(s, e) for s in ("S9", "S10") for e in ("9", "9b", "10")]


@pytest.mark.parametrize(
    ("names", "options", "code"),
    [
        (["S_a_f1.tif"], {}, "film-missing"),
        (["S_a_f1.tif", "S_a_f2.tif"], {"film_mode": "shared"}, "film-unexpected"),
        (["S_a.tif"], {"film_mode": "separate"}, "film-missing"),
        (["S_a.tif"], {"shared_possible": False}, "film-missing"),
        (["S_a.tif", "S_a_f1.tif"], {}, "film-unexpected"),
        (["S_a_f1.tif", "S_a_f2.tif", "S_a_f3.tif"], {}, "film-unexpected"),
        (["S_a_f1.tif", "S_a_f1.png", "S_a_f2.tif"], {}, "film-unexpected"),
        (["S_a_f1.tif", "S_a_f2.tif", "S_a_f1_cage.tif"], {}, "film-missing"),
        (["S_a_f1.tif", "S_a_f2.tif"], {}, None),
        (["S_a.tif"], {}, None),
        (["S_a_f1.tif", "S_a_f2.tif", "S_a_f1_cage.tif", "S_a_f2_cage.tif"], {}, None),
    ],
)
def test_films_must_make_up_an_examination(tmp_path: Path, names: list[str], options: dict[str, object], code: str | None) -> None:
    problem = only(group(tmp_path, *names, **options)).problem
    assert (problem[0] if problem else None) == code


def test_what_is_no_film_is_listed_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    ignored = group(tmp_path, "S_a.tif", ".S_b.tif", "study.toml", "images.csv", "LICENSE").ignored
    assert {path.name: why for path, why in ignored} == {
        ".S_b.tif": "hidden",
        "study.toml": "no film by its extension",
        "images.csv": "no film by its extension",
        "LICENSE": "no DICOM file",
        "truth": "folder",
    }


def test_a_folder_without_films_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "S01").mkdir()
    with pytest.raises(UsageError, match=r"no film in it.*1 sub-folders"):
        group_films(tmp_path, (1, 2))
    with pytest.raises(UsageError, match="not a folder"):
        group_films(tmp_path / "nowhere", (1, 2))


def test_file_pattern(tmp_path: Path) -> None:
    pattern = r"(?P<exam>\d+)-(?P<subject>\w+)-(?P<focus>\d)\.png"
    found = only(group(tmp_path, "7-anna-1.png", "7-anna-2.png", file_pattern=pattern))
    assert (found.subject, found.exam, [film.focus for film in found.films], found.problem) == ("anna", "7", [1, 2], None)


@pytest.mark.parametrize(("pattern", "message"), [("(", "not a regular expression"), ("(?P<subject>.*)", r"\(\?P<exam>")])
def test_a_wrong_pattern_is_refused(tmp_path: Path, pattern: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        group(tmp_path, "S_a.tif", file_pattern=pattern)


def test_dicom_tags_name_what_file_names_do_not(tmp_path: Path) -> None:
    tags = {
        f"1.2.3.{k}": {"patient_id": "P7", "acquisition_date": "20260101", "acquisition_time": "090012", "view": f"F{k}"} for k in (1, 2)
    }
    found = only(group(tmp_path, "README", *tags, read_tags=lambda path: tags.get(path.name)))
    assert (found.subject, found.exam, [film.focus for film in found.films], found.problem) == ("P7", "202601010900", [1, 2], None)
