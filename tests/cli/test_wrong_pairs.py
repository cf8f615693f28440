"""Two markers, each hidden on one film, of which the first examination makes one: a later one that shows both tells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

import rsa_vision
from rsa_vision.followup import follow_up
from rsa_vision.settings import Limits
from rsa_vision.tables import AXES, SCHEMAS
from rsa_vision.types import Float
from rsa_vision.wrong_pairs import with_wrong_pairs_reviewed
from tests.cli.test_followups import rows_of
from tests.identify.bodies import FOCI_MM
from tests.xray.exposures import disturbed, expose, exposure, film_from_plane, with_sd

SD_MM = 0.01


def passed_for_one(rng: np.random.Generator, a: Float, foci_mm: Float) -> tuple[Float, Float]:
    """Return where a ray of the first focus through `a` meets one of the second, and another marker on that."""

    def along(focus_mm: Float, place: Float) -> Float:
        way = place - focus_mm
        return place + way / np.linalg.norm(way) * rng.uniform(4, 30) * rng.choice([-1, 1])

    met = along(foci_mm[0], a)
    return met, along(foci_mm[1], met)


def two_bodies(rng: np.random.Generator) -> tuple[Float, Float]:
    bone, stem = rng.uniform(-25, 25, (2, 6, 3)) + np.array([[[0, 120, 120]], [[0, 80, 100]]])
    return bone, stem


def moved(rng: np.random.Generator, *bodies: Float, by_deg: float = 4.0) -> Float:
    """Return bodies that have moved against each other."""
    parts = []
    for body in bodies:
        turn = Rotation.from_euler("xyz", rng.normal(0, by_deg, 3), degrees=True)
        parts.append(turn.apply(body - 100) + 100 + rng.normal(0, by_deg, 3))
    return np.vstack(parts)


def seen(exam: str, places: Float, rng: np.random.Generator, sd_mm: float = SD_MM) -> Any:
    """The tables of an examination whose films show markers at both foci."""
    rows = rows_of(exam, places + rng.normal(0, sd_mm, places.shape))
    for row in rows["markers"]:
        row |= {f"sd_{axis}_mm": sd_mm for axis in "xyz"}
    image = dict.fromkeys(SCHEMAS["images"]) | {"role": "object", "shape": "ball", "flags": ""}
    images = [image | {"focus": focus, "number": row["marker"]} for focus in (1, 2) for row in rows["markers"]]
    foci = [{"focus": k + 1} | dict(zip(AXES, place.tolist(), strict=True)) for k, place in enumerate(FOCI_MM)]
    return rows | {"images": images, "foci": foci}


def named(*exams: Any) -> list[Any]:
    return with_wrong_pairs_reviewed(follow_up(exams, None, Limits()), Limits())


def verdicts(exams: Any) -> list[tuple[str, str]]:
    return [(rows["exams"][0]["status"], rows["exams"][0]["reasons"]) for rows in exams]


def flagged(rows: Any) -> set[str]:
    return {row["marker"] for row in rows["markers"] if "ambiguous" in row["flags"]}


@pytest.mark.parametrize("seed", range(20))
def test_two_markers_that_passed_for_one_are_told_by_a_later_examination(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bone, stem = two_bodies(rng)
    met, other = passed_for_one(rng, stem[0], FOCI_MM)
    first = seen("1", np.vstack([bone, stem[1:], met]), rng)
    home = (bone, np.vstack([stem, other])) if seed % 2 else (np.vstack([bone, other]), stem)  # the two may be of two bodies
    second, third = (seen(exam, moved(rng, *home), rng) for exam in "23")
    exams = named(first, second, third)
    assert verdicts(exams)[0] == ("review", "pair-ambiguous")
    assert flagged(exams[0]) == {"P12"}
    assert sum(row["flags"] == "ambiguous" for row in exams[0]["images"]) == 2
    assert "the images of P12 are, by later examinations, of P13 and P14" in exams[0]["exams"][0]["message"]
    assert verdicts(named(first)) == [("ok", "")]  # alone it cannot tell


def test_they_are_told_where_bodies_hardly_moved_and_pass_for_one() -> None:
    told = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        bone, stem = two_bodies(rng)
        met, other = passed_for_one(rng, stem[0], FOCI_MM)
        first = seen("1", np.vstack([bone, stem[1:], met]), rng, 0.05)
        second = seen("2", moved(rng, bone, np.vstack([stem, other]), by_deg=0.1), rng, 0.05)
        told += flagged(named(first, second)[0]) == {"P12"}
    assert told >= 27  # 25 by whole groups alone


def test_each_of_the_two_may_be_shown_by_another_examination() -> None:
    rng = np.random.default_rng(1)
    bone, stem = two_bodies(rng)
    met, other = passed_for_one(rng, stem[0], FOCI_MM)
    first = seen("1", np.vstack([bone, stem[1:], met]), rng)
    one, two = seen("2", moved(rng, bone, stem), rng), seen("3", moved(rng, bone, np.vstack([stem[1:], other])), rng)
    assert verdicts(named(first, one))[0] == ("ok", "")  # one ray alone may be chance
    assert flagged(named(first, one, two)[0]) == {"P12"}


def test_markers_that_come_and_go_are_no_wrong_pairs() -> None:
    for seed in range(15):
        rng = np.random.default_rng(seed)
        bone, stem = two_bodies(rng)
        new = rng.uniform(-25, 25, (4, 3)) + np.array([0, 80, 100])
        exams = named(seen("1", np.vstack([bone, stem]), rng), seen("2", moved(rng, bone[:5], np.vstack([stem[1:], new])), rng))
        assert verdicts(exams)[0] == ("ok", "")
        loose = stem + np.outer(np.arange(6) == 2, rng.normal(0, 1.5, 3))
        exams = named(seen("1", np.vstack([bone, stem]), rng), *(seen(exam, moved(rng, bone, loose), rng) for exam in "23"))
        assert verdicts(exams)[0] == ("ok", "")


def test_points_of_such_a_study_are_reviewed(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    cage, foci, objects, _ = exposure("1A", rng)
    met, other = passed_for_one(rng, objects[0], np.array([foci[1], foci[2]]))
    turn = Rotation.from_euler("xyz", [3, -2, 4], degrees=True)
    later = turn.apply(np.vstack([objects[1:], objects[0], other]) - [0, 100, 60]) + np.array([2, 99, 62])
    tables = []
    for exam, places, last in (("1", np.vstack([objects[1:], met]), {13: 99}), ("2", later, {})):
        points = with_sd(disturbed(expose(cage, foci, places, {focus: film_from_plane(rng) for focus in foci}), 0.02, rng), 0.02)
        names = [f"bone/{last.get(int(number[5:]), number[5:])}" if number.startswith("bone") else number for number in points.number]
        at = dict(zip(("col_px", "row_px"), points.position_px.T, strict=True)) | {"sd_col_px": 0.02, "sd_row_px": 0.02}
        about = {"subject": "S", "exam": exam, "focus": points.focus, "role": points.role, "number": names, "shape": "ball"}
        tables.append(pl.DataFrame(about | at | {"cov_col_row_px2": 0.0}))
    pl.concat(tables).write_csv(tmp_path / "points.csv")
    done = rsa_vision.reconstruct(tmp_path / "points.csv", tmp_path / "out", cage="1A")
    assert [(one.status, one.reasons) for one in done.outcomes] == [("review", "pair-ambiguous"), ("ok", "")]
