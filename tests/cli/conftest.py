"""Rendered films, and a detector that knows their truth: commands are tested without waiting for, or depending on, detection."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsa_vision.tables import SCHEMAS
from rsa_vision.types import MarkerImages
from synthetic.study import RenderedExamination, render_examination

SD_PX = 0.02


def content(values: Any) -> str:
    """Return a hash of the pixels."""
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def rows_of(exam: str, places_mm: np.ndarray, flags: str = "", reasons: str = "", *, sd_mm: float = 0.01) -> Any:
    """The tables of an examination with markers at places, without images."""
    markers = [
        dict.fromkeys(SCHEMAS["markers"])
        | {"subject": "S", "exam": exam, "segment": "", "marker": f"P{k + 1:02d}", "n_views": 2, "flags": flags}
        | dict(zip(("x_mm", "y_mm", "z_mm"), place.tolist(), strict=True))
        | {f"sd_{axis}_mm": sd_mm for axis in "xyz"}
        for k, place in enumerate(places_mm)
    ]
    about = {"subject": "S", "exam": exam, "status": "review" if reasons else "ok", "reasons": reasons, "message": ""}
    return {"exams": [about], "images": [], "foci": [], "markers": markers}


@pytest.fixture(scope="session")
def exams() -> list[RenderedExamination]:
    """Two examinations with cage 2 (the smallest films), one film for each focus."""
    rng = np.random.default_rng(20260101)
    few: dict[str, Any] = {"n_objects": 6, "pitch_mm": 0.15, "fine": 2}
    first = render_examination("2", rng=rng, exam="202601010900", **few)
    moved = [marker.moved(np.eye(3), np.array([4.0, -3.0, 2.0]), np.zeros(3)) for marker in first.scene.markers]  # the object, not changed
    return [first, render_examination("2", rng=rng, exam="202602010900", **few, markers=moved)]


@pytest.fixture
def folder(exams: list[RenderedExamination], tmp_path: Path) -> Path:
    """A study folder of the two examinations."""
    folder = tmp_path / "study"
    for exam in exams:
        exam.write(folder)
    (folder / "study.toml").write_text('cage = "2"\n')
    return folder


@pytest.fixture
def count_detections(exams: list[RenderedExamination], monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Let examinations see the true marker images, with noise of the stated size; returns how many films have been looked at."""
    known: dict[str, MarkerImages] = {}
    rng = np.random.default_rng(7)
    for exam in exams:
        for name, values in exam.films.items():
            rows = exam.images.filter(exam.images["file"] == name)
            n = len(rows)
            known[content(values)] = MarkerImages(
                position_px=rows.select("col_px", "row_px").to_numpy() + rng.normal(0, SD_PX, (n, 2)),
                covariance_px2=np.tile(np.eye(2) * SD_PX**2, (n, 1, 1)),
                shape=rows["shape"].to_numpy().astype(str),
                radius_px=np.full(n, 3.0),
                angle_deg=np.full(n, np.nan),
                contrast=np.full(n, 0.5),
                background=np.full(n, 0.7),
                snr=np.full(n, 50.0),
                flags=np.zeros(n, np.int64),
            )
    calls: list[str] = []

    def detect(values: Any, **_: Any) -> Any:
        calls.append(content(values))
        return SimpleNamespace(images=known.get(calls[-1], MarkerImages.empty()))

    monkeypatch.setattr("rsa_vision.examination.detect_markers", detect)
    return lambda: len(calls)


@pytest.fixture
def other_film(folder: Path) -> Callable[[str, str], Path]:
    """Copy a film of the folder under another name."""

    def copy(name: str, other: str) -> Path:
        return Path(shutil.copy(folder / name, folder / other))

    return copy
