"""A follow-up whose film was turned where the cage looks the same, from image coordinates: the subject's markers tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

import rsa_vision
from rsa_vision.cage_symmetry import symmetries, turns
from rsa_vision.cages import load_cage
from rsa_vision.turned import with_turned_reviewed
from rsa_vision.types import Float
from tests.cli.test_followups import rows_of
from tests.xray.exposures import disturbed, exposure, with_sd

HALF_TURN = np.diag([-1.0, -1, 1])
BODIES = np.random.default_rng(1).uniform(-30, 30, (9, 3))


def verdicts(*places: Float, cage: str = "1B") -> list[tuple[str, str]]:
    exams = [rows_of(str(k), some) for k, some in enumerate(places)]
    return [(rows["exams"][0]["status"], rows["exams"][0]["reasons"]) for rows in with_turned_reviewed(exams, turns(load_cage(cage)))]


def test_the_turns_of_the_cages() -> None:
    (half,) = turns(load_cage("1B"))
    np.testing.assert_allclose(half, HALF_TURN, atol=1e-9)
    assert not any(turns(load_cage(name)) for name in ("1A", "1B-420", "2"))


def test_a_film_that_was_turned_is_reviewed_and_those_after_it_are_not() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        moved = BODIES @ Rotation.from_euler("xyz", rng.normal(0, 8, 3), degrees=True).as_matrix().T + rng.normal(0, 5, 3)
        moved[:4] += rng.normal(0, 1, 3)  # one body against the other
        turned = moved @ HALF_TURN + [0, 400, 0]
        assert verdicts(BODIES, turned, moved) == [("ok", ""), ("review", "cage-ambiguous"), ("ok", "")]
        assert verdicts(BODIES, turned, cage="1A") == [("ok", "")] * 2


@pytest.mark.parametrize("axis", [[0, 0, 1], [1, 0, 0], [1, 1, 1]])
@pytest.mark.parametrize("angle_deg", [30, 90, 130])
def test_a_patient_who_lies_otherwise_is_not_a_turned_film(axis: list[float], angle_deg: float) -> None:
    turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    assert verdicts(BODIES, BODIES @ turn.T + [4, -3, 2]) == [("ok", "")] * 2


def test_too_few_markers_in_common_tell_nothing() -> None:
    line = np.outer(np.arange(4), [1.0, 2, 3])
    assert verdicts(BODIES[:2], BODIES[:2] @ HALF_TURN) == [("ok", "")] * 2
    assert verdicts(line, line @ HALF_TURN) == [("ok", "")] * 2


def test_points_of_a_film_that_was_turned_are_reviewed_and_their_motion_is_not_ok(tmp_path: Path) -> None:
    """The marks have the names that they seem to have on such a film; where it lay is the projection's."""
    rng = np.random.default_rng(3)
    cage, _, _, exact = exposure("1B", rng)
    (half,) = [symmetry for symmetry in symmetries(cage) if symmetry.kind == "rotation"]
    tables = []
    for exam, is_turned in (("1", False), ("2", True), ("3", False)):
        points = with_sd(disturbed(exact, 0.02, rng), 0.02)
        named = zip(points.focus.tolist(), points.number.tolist(), points.role.tolist(), strict=True)
        names = [number if role == "object" or not is_turned else str(half.number_to[focus, int(number)]) for focus, number, role in named]
        foci = [half.focus_to[focus] if is_turned else focus for focus in points.focus.tolist()]
        places = dict(zip(("col_px", "row_px"), points.position_px.T, strict=True)) | {"sd_col_px": 0.02, "sd_row_px": 0.02}
        about = {"subject": "S", "exam": exam, "focus": foci, "role": points.role, "number": names, "shape": "ball"}
        tables.append(pl.DataFrame(about | places | {"cov_col_row_px2": 0.0}))
    pl.concat(tables).write_csv(tmp_path / "points.csv")
    done = rsa_vision.reconstruct(tmp_path / "points.csv", tmp_path / "out", cage="1B")
    assert [(one.status, one.reasons) for one in done.outcomes] == [("ok", ""), ("review", "cage-ambiguous"), ("ok", "")]
    motion = pl.read_csv(tmp_path / "out" / "motion.csv", schema_overrides={"exam_from": pl.String, "exam_to": pl.String})
    assert dict(motion.filter(pl.col("exam_from") == "1").select("exam_to", "status").iter_rows()) == {"2": "review", "3": "ok"}
