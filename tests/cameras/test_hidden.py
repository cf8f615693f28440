"""Hidden markers with calibrated cameras, two and three: predicted by their segment at their true places, with true stated errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.cameras import Camera
from rsa_vision.examination import name_and_reconstruct
from rsa_vision.followup import follow_up
from rsa_vision.identify.poses import TOLERANCE_MM
from rsa_vision.readings import FilmReading
from rsa_vision.segments import Segment
from rsa_vision.settings import Limits, Study
from rsa_vision.tables import examination_rows
from rsa_vision.types import Float, MarkerImages
from tests.identify.bodies import random_body

SIZE, FOCAL_PX, DISTANCE_MM, SD_PX = 1000, 5000.0, 900.0, 0.05
TURNS_DEG = {1: 0.0, 2: 70.0, 3: -60.0}
MATRIX = np.array([[FOCAL_PX, 0, 499.5], [0, FOCAL_PX, 499.5], [0, 0, 1]])


def seen(places: Float, turn_deg: float) -> Float:
    """Project by hand: turn about y, divide by depth."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    x, y, z = places.T
    u, w = c * x + s * z, -s * x + c * z + DISTANCE_MM
    return np.column_stack([FOCAL_PX * u / w + 499.5, FOCAL_PX * y / w + 499.5])


def examine(rng: np.random.Generator, foci: int, places: Float, hidden: set[tuple[int, int]], segments: list[Segment]) -> Any:
    """Return the tables of an examination whose markers are hidden from some foci, (focus, marker), named by segments."""
    films, cameras = [], {}
    for focus in range(1, foci + 1):
        rows = [m for m in range(len(places)) if (focus, m) not in hidden]
        px, n = seen(places[rows], TURNS_DEG[focus]) + rng.normal(0, SD_PX, (len(rows), 2)), len(rows)
        covariance = np.tile(np.eye(2) * SD_PX**2, (n, 1, 1))
        look = (np.full(n, "ball"), np.full(n, 2.5), np.full(n, np.nan), *np.full((2, n), 0.5), np.full(n, 40.0), np.zeros(n, np.int64))
        films.append(FilmReading(Path(f"f{focus}"), focus, (SIZE, SIZE), None, "auto", MarkerImages(px, covariance, *look)))
        turn = Rotation.from_euler("y", TURNS_DEG[focus], degrees=True).as_matrix()
        cameras[focus] = Camera((SIZE, SIZE), MATRIX, turn, np.array([0, 0, DISTANCE_MM]))
    result = name_and_reconstruct(films, Study(), cameras)
    return follow_up([examination_rows("S", "1", [], result, 0.0)], {"S": segments}, Limits())[0]


def two_bodies(rng: np.random.Generator) -> tuple[Float, list[Segment]]:
    """Return places of the markers of two segments, seven and six, and these in frames of their own."""
    places, segments = [], []
    for index, n in enumerate((7, 6)):
        body = random_body(rng, n, 12.0)
        at = Rotation.random(random_state=rng).apply(body) + np.array([0, 50 * index - 25, 0])
        places.append(at + rng.normal(0, TOLERANCE_MM, at.shape))
        segments.append(Segment(f"s{index}", tuple(map(str, range(n))), body))
    return np.concatenate(places), segments


def squares_of_predicted(rows: Any, places: Float) -> dict[str, float]:
    """Return for every predicted marker its squared error in units of the stated one."""
    index = {**{f"s0/{i}": i for i in range(7)}, **{f"s1/{i}": 7 + i for i in range(6)}}
    squares = {}
    for row in rows["markers"]:
        if "predicted" in row["flags"]:
            name = f"{row['segment']}/{row['marker']}"
            error = np.array([row["x_mm"], row["y_mm"], row["z_mm"]]) - places[index[name]]
            xy, xz, yz = row["cov_xy_mm2"], row["cov_xz_mm2"], row["cov_yz_mm2"]
            covariance = np.array([[row["sd_x_mm"] ** 2, xy, xz], [xy, row["sd_y_mm"] ** 2, yz], [xz, yz, row["sd_z_mm"] ** 2]])
            squares[name] = float(error @ np.linalg.solve(covariance, error))
    return squares


@pytest.mark.parametrize("foci", [2, 3])
def test_markers_that_one_camera_sees_are_predicted_with_true_errors(foci: int) -> None:
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        places, segments = two_bodies(rng)
        lost = rng.choice(13, 2, replace=False).tolist()
        rows = examine(rng, foci, places, {(focus, m) for m in lost for focus in range(2, foci + 1)}, segments)
        assert rows["exams"][0]["status"] == "review"
        found = squares_of_predicted(rows, places)
        assert len(found) <= 2
        squares += found.values()
        assert all(row["x_mm"] is None for row in rows["images"])  # there is no plane in which images had coordinates
    assert len(squares) > 18
    assert 0.5 < np.mean(squares) / 3 < 1.7


@pytest.mark.parametrize("foci", [2, 3])
def test_a_segment_that_one_camera_alone_sees_is_placed_by_its_rays(foci: int) -> None:
    squares, segments_found = [], 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        places, segments = two_bodies(rng)
        rows = examine(rng, foci, places, {(focus, m) for m in range(7, 13) for focus in range(2, foci + 1)}, segments)
        assert rows["exams"][0]["status"] == "review"
        found = squares_of_predicted(rows, places)
        segments_found += len(found) >= 5
        squares += found.values()
    assert segments_found >= 3
    assert max(squares) < 25
