"""One exposure exported twice is told from two exposures, at the level of images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.batch import Outcome
from rsa_vision.copies import is_one_exposure, with_copies_reviewed
from rsa_vision.study_files import ExamFiles, FilmFile
from rsa_vision.types import Bool, Float

SD_PX = 0.04
N_MARKS = 18


@dataclass(frozen=True)
class Pair:
    """Images of one object that stands still on two films."""

    start: Float
    end: Float
    before: Float
    after: Float
    is_object: Bool

    @property
    def one_exposure(self) -> bool:
        return is_one_exposure(self.start, self.end, self.before, self.after, self.is_object)


def pair(rng: np.random.Generator, n_objects: int, *, common: float, own: float, still: bool = True) -> Pair:
    """Return images with common noise and noise of each film, in units of the stated errors; the second film is turned and cropped."""
    n = N_MARKS + n_objects
    is_object = np.arange(n) >= N_MARKS
    sd = SD_PX * np.exp(rng.normal(0, 0.5, (n, 2)))
    places = rng.uniform(200, 1800, (n, 2))
    start = places + sd * (common * rng.normal(size=(n, 2)))
    seen = start if common else places
    if not still:
        seen = seen + np.outer(is_object, [30.0, -20])
    turn = Rotation.from_euler("z", 2.0, degrees=True).as_matrix()[:2, :2]
    covariance = sd[:, :, None] ** 2 * np.eye(2)
    first, second = (sd * (own * rng.normal(size=(n, 2))) for _ in range(2))
    return Pair(start + first, (seen + second) @ turn.T - [5, 7], covariance, turn @ covariance @ turn.T, is_object)


@pytest.mark.parametrize("n_objects", [0, 3, 12])
@pytest.mark.parametrize("own", [1.0, 0.6])
def test_two_exposures_of_what_stands_still_are_two(n_objects: int, own: float) -> None:
    """Also where the stated errors are too wide by more than those of films ever were."""
    rng = np.random.default_rng(1)
    assert not any(pair(rng, n_objects, common=0.0, own=own).one_exposure for _ in range(500))


@pytest.mark.parametrize("n_objects", [0, 12])
def test_one_exposure_exported_again_is_one(n_objects: int) -> None:
    """Also where two of its images are fitted otherwise."""
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(100):
        films = pair(rng, n_objects, common=1.0, own=0.1)
        films.end[rng.integers(len(films.end), size=2)] += rng.normal(0, 1.0, 2)
        found += films.one_exposure
    assert found >= 90


def test_marks_without_noise_do_not_make_one_exposure_of_two() -> None:
    rng = np.random.default_rng(3)
    assert not any(pair(rng, 6, common=0.0, own=0.001, still=False).one_exposure for _ in range(50))


def outcome(exam: str, name: str, places: Float, pixels: str) -> Outcome:
    images: list[dict[str, Any]] = [
        {"focus": 1, "role": "fiducial" if k < N_MARKS else "object", "number": str(k), "file": name, "flags": ""}
        | {"col_px": col, "row_px": row, "sd_col_px": SD_PX, "sd_row_px": SD_PX, "cov_col_row_px2": 0.0}
        for k, (col, row) in enumerate(places)
    ]
    about = {"subject": "S", "exam": exam, "status": "ok", "reasons": "", "message": "", "seconds": 0.0}
    return Outcome("S", exam, {"exams": [about], "images": images, "foci": [], "markers": []}, pixels={name: pixels})


def test_an_exposure_exported_again_is_reviewed_in_both_examinations() -> None:
    rng = np.random.default_rng(4)
    true = rng.uniform(200, 1800, (N_MARKS + 6, 2))
    first, second = (true + rng.normal(0, SD_PX, true.shape) for _ in range(2))
    again = first - [5, 7] + rng.normal(0, 0.003, true.shape)
    places = {"1": first, "2": second, "3": again}
    exams = [ExamFiles("S", exam, (FilmFile(Path(f"S_{exam}.tif"), None),)) for exam in places]
    outcomes = [outcome(exam, f"S_{exam}.tif", some, exam) for exam, some in places.items()]
    judged = with_copies_reviewed(exams, outcomes)
    assert [(one.status, one.reasons) for one in judged] == [("review", "film-duplicate"), ("ok", ""), ("review", "film-duplicate")]
    assert "S_1.tif is the same film as S_3.tif" in judged[0].rows["exams"][0]["message"]
