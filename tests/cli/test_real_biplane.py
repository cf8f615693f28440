"""A real biplane pair, unattended: `measure` on two frames of a wrist with 17 implanted beads in three rigid clusters."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from rsa_vision.cameras import load_camera
from rsa_vision.cli import run_app
from rsa_vision.geometry.camera import project
from rsa_vision.types import Float

WRIST = Path(__file__).parents[3] / "shared" / "data" / "real" / "wrist"
FRAMES = ("0099", "0158")
NEAR_PX = 8.0  # the given places are approximate; beads are further apart
LEAST = 15  # of 17 beads
RIGID_MM = 0.25  # a wrong pair is off by millimetres in depth; the image errors of these frames make about 0.05 mm

pytestmark = pytest.mark.skipif(not WRIST.is_dir(), reason="the real films are not beside the project (../shared/data/real/wrist)")


def beads_of(frame: str, markers: pl.DataFrame) -> dict[tuple[int, int], Float]:
    """Return marker places by the bead whose approximate images both lie near its projections."""
    given = pl.read_csv(WRIST / f"beads_{frame}_approx.csv").to_dicts()
    cameras = {focus: load_camera(WRIST / f"calib_f{focus}.txt") for focus in (1, 2)}
    places = markers.filter(pl.col("exam") == frame).drop_nulls("x_mm").select("x_mm", "y_mm", "z_mm").to_numpy()
    seen = {focus: project(camera, places) for focus, camera in cameras.items()}
    found = {}
    for bead in given:
        off = [np.hypot(seen[k][:, 0] - bead[f"col_px_f{k}"], seen[k][:, 1] - bead[f"row_px_f{k}"]) for k in (1, 2)]
        worst = np.maximum(*off)
        if len(worst) and worst.min() < NEAR_PX:
            found[bead["cluster"], bead["bead"]] = places[worst.argmin()]
    return found


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrist")
    study = folder / "study.toml"
    study.write_text("calibration = { " + ", ".join(f'{k} = "{WRIST / f"calib_f{k}.txt"}"' for k in (1, 2)) + " }\n")
    assert run_app(["measure", str(WRIST), "--study", str(study), "-o", str(folder / "out")]) in (0, 1)
    return folder / "out"


def test_beads_are_found_paired_and_rigid(out: Path) -> None:
    markers = pl.read_csv(out / "markers.csv", schema_overrides={"exam": pl.String, "flags": pl.String})
    found = {frame: beads_of(frame, markers) for frame in FRAMES}
    print({frame: len(beads) for frame, beads in found.items()})
    for frame in FRAMES:
        assert len(found[frame]) >= LEAST
        assert len({tuple(place) for place in found[frame].values()}) == len(found[frame])
    first, second = (found[frame] for frame in FRAMES)
    common = sorted(set(first) & set(second))
    pairs = [(a, b) for a, b in combinations(common, 2) if a[0] == b[0]]
    change_mm = [abs(np.linalg.norm(first[a] - first[b]) - np.linalg.norm(second[a] - second[b])) for a, b in pairs]
    assert len(pairs) > LEAST
    assert max(change_mm) < RIGID_MM
