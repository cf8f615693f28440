"""Real films with labelled beads, and films without any, for ``detection.py``."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import cv2
import numpy as np
from epipolar import scatter
from numpy.typing import NDArray

from rsa_vision.detect import detect_markers
from rsa_vision.images import read_film
from rsa_vision.types import MarkerImages

Float = NDArray[np.float64]
Rows = list[dict[str, object]]
NEAR_PX = 2.0
MIDDLE_PX = 20.0  # the ball of a Winston-Lutz film lies this near to the isocentre, the film's middle


def _images(path: Path) -> MarkerImages:
    film = read_film(path)
    return detect_markers(film.values, bits=film.bits).images


def _found(path: Path) -> Float:
    return _images(path).position_px


def _labels(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def _match(truth: Float, found: Float) -> tuple[NDArray[np.intp], Float, int]:
    """Return for every label its nearest detection (-1 where none is near) and distance, and how many detections are left over."""
    if len(found) == 0:
        return np.full(len(truth), -1), np.full(len(truth), np.inf), 0
    gap = np.hypot(*(truth[:, None] - found[None]).transpose(2, 0, 1))
    nearest, distance = gap.argmin(1), gap.min(1)
    nearest = np.where(distance < NEAR_PX, nearest, -1)
    return nearest, distance, len(found) - len(set(nearest[nearest >= 0].tolist()))


def _point(row: dict[str, str], view: int) -> list[float]:
    return [float(row[f"{c}_px_f{view}"]) for c in ("col", "row")]


def _pig(folder: Path) -> Rows:
    rows = _labels(folder / "labels.csv")
    hits, total, extra, distances = 0, 0, [], []
    labels, points, stated = [], [], []  # of either view, every frame
    for path in sorted(folder.glob("pig_*_f?.png")):
        frame, view = (int(v) for v in re.findall(r"_(\d+)_f(\d)", path.name)[0])
        truth = np.array([_point(r, view) for r in rows if int(r["frame"]) == frame])
        images = _images(path)
        nearest, distance, more = _match(truth, images.position_px)
        hits, total = hits + int((nearest >= 0).sum()), total + len(truth)
        extra.append(more)
        distances += distance[nearest >= 0].tolist()
        labels.append(truth)
        points.append(np.where(nearest[:, None] >= 0, images.position_px[nearest], np.nan))
        stated.append(images.covariance_px2[nearest])

    def between(of: list[Float], covariance: list[Float] | None = None) -> float:
        both = np.isfinite(np.concatenate(points[::2]) + np.concatenate(points[1::2])).all(axis=1)
        unit = [np.tile(np.eye(2), (len(o), 1, 1)) for o in of]
        views = [np.concatenate(x[k::2])[both] for x in (of, covariance or unit) for k in (0, 1)]
        return scatter(*views)

    return [
        {
            "films": "pig",
            "found": f"{hits} of {total} ({100 * hits / total:.1f} %)",
            "more than labelled, by film": ", ".join(map(str, extra)),
            "median distance to the labels, px": f"{np.median(distances):.2f}",
            "SD about the epipolar geometry, px": f"{between(points):.3f} (labels {between(labels):.3f})",
            "the same over what is stated": f"{between(points, stated):.2f}",
        }
    ]


def _camera(path: Path) -> Float:
    """Return the 3 x 4 projection matrix of a calibration file."""
    blocks = [block.strip().splitlines()[1:] for block in path.read_text().split("\n\n") if block.strip()]
    _, camera, rotation, translation = (np.array([[float(v) for v in line.split(",")] for line in block]) for block in blocks[:4])
    return np.asarray(camera @ np.hstack([rotation, translation.reshape(3, 1)]))


def _wrist(folder: Path) -> Rows:
    out: Rows = []
    cameras = [_camera(folder / f"calib_f{view}.txt") for view in (1, 2)]
    points: list[Float] = []
    for frame in ("0099", "0158"):
        rows, images = _labels(folder / f"beads_{frame}_approx.csv"), []
        for view in (1, 2):
            found = _found(folder / f"wrist_{frame}_f{view}.tif")
            nearest, _, more = _match(np.array([_point(r, view) for r in rows]), found)
            hits = int((nearest >= 0).sum())
            out.append({"films": f"wrist {frame}, view {view}", "found": f"{hits} of {len(rows)}", "more than labelled, by film": more})
            images.append(np.where(nearest[:, None] >= 0, found[nearest], np.nan))
        lab = cv2.triangulatePoints(cameras[0], cameras[1], images[0].T, images[1].T)
        points.append((lab[:3] / lab[3]).T)
    cluster = np.array([r["cluster"] for r in rows])
    first, second = np.nonzero(np.triu(cluster[:, None] == cluster[None], 1))
    apart = np.array([np.linalg.norm(p[first] - p[second], axis=1) for p in points])
    change = np.diff(apart, axis=0)[0]
    change = change[np.isfinite(change)]
    out[-1]["SD of distances inside rigid clusters, mm"] = f"{np.sqrt((change**2).mean() / 2):.4f} ({len(change)} distances, two frames)"
    return out


def _winston_lutz(folder: Path) -> Rows:
    out: Rows = []
    for path in sorted(folder.glob("*.dcm")):
        found = _found(path)
        rows, cols = read_film(path).values.shape
        near = int((np.hypot(*(found - [(cols - 1) / 2, (rows - 1) / 2]).T) < MIDDLE_PX).sum()) if len(found) else 0
        out.append({"films": f"winston_lutz {path.stem}", "found": f"{near} of 1", "more than labelled, by film": len(found) - near})
    return out


def _negatives(folder: Path) -> Rows:
    return [{"films": f"negative {p.stem}", "more than labelled, by film": len(_found(p))} for p in sorted(folder.glob("*.dcm"))]


def real_tables(folder: Path) -> dict[str, Rows]:
    """Return the table of the real films, empty where they are not there."""
    parts = {"pig": _pig, "wrist": _wrist, "winston_lutz": _winston_lutz, "negatives": _negatives}
    rows: Rows = []
    for name, part in parts.items():
        if (folder / name).is_dir():
            rows += part(folder / name)
        else:
            print(f"real films skipped: no folder {folder / name}")
    for row in rows:
        print(row, flush=True)
    return {"Real films": rows}
