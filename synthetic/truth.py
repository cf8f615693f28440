"""The truth of an examination in the columns of ``images.csv``, ``foci.csv`` and ``markers.csv`` (docs/files.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import polars as pl

from rsa_vision.types import Float
from synthetic.film import FilmPlane
from synthetic.scene import Scene

_T, _R, _I = pl.String, pl.Float64, pl.Int64
IMAGES: Final[dict[str, Any]] = {
    "subject": _T, "exam": _T, "focus": _I, "role": _T, "number": _T, "shape": _T, "col_px": _R, "row_px": _R,
    "sd_col_px": _R, "sd_row_px": _R, "cov_col_row_px2": _R, "x_mm": _R, "y_mm": _R, "z_mm": _R,
    "residual_um": _R, "used": pl.Boolean, "flags": _T, "file": _T,
}  # fmt: skip
FOCI: Final[dict[str, Any]] = {
    "subject": _T, "exam": _T, "focus": _I, "x_mm": _R, "y_mm": _R, "z_mm": _R, "sd_x_mm": _R, "sd_y_mm": _R, "sd_z_mm": _R,
    "fiducial_rmse_um": _R, "fiducial_max_um": _R, "line_rmsv_um": _R, "line_max_um": _R, "n_fiducials": _I, "n_controls": _I,
}  # fmt: skip
MARKERS: Final[dict[str, Any]] = {
    "subject": _T, "exam": _T, "segment": _T, "marker": _T, "x_mm": _R, "y_mm": _R, "z_mm": _R,
    "sd_x_mm": _R, "sd_y_mm": _R, "sd_z_mm": _R, "cov_xy_mm2": _R, "cov_xz_mm2": _R, "cov_yz_mm2": _R,
    "crossing_um": _R, "parallax_um": _R, "n_views": _I, "flags": _T,
}  # fmt: skip


def truth_tables(scene: Scene, films: Mapping[str, FilmPlane], subject: str, exam: str) -> dict[str, pl.DataFrame]:
    """Return what an examination without any error would measure.

    Images are exact projections from the centroids of the focal spots. Images of cage marks that a focus is not meant to see have the role
    ``unassigned`` and the flag ``foreign-mark``, with their cage number; images off the film have no row.

    Parameters
    ----------
    scene : Scene
    films : mapping of str to FilmPlane
        By file name.
    subject, exam : str

    Returns
    -------
    dict of str to polars.DataFrame
        ``images``, ``foci``, ``markers``; standard deviations and residuals are 0, the covariance of image coordinates too.
    """
    images: list[dict[str, Any]] = []
    foci: list[dict[str, Any]] = []
    seen: dict[tuple[str, str], int] = {}
    who = {"subject": subject, "exam": exam}
    exact_image = dict.fromkeys(("sd_col_px", "sd_row_px", "cov_col_row_px2", "residual_um"), 0.0)
    exact_point = dict.fromkeys(("sd_x_mm", "sd_y_mm", "sd_z_mm"), 0.0)
    for file, film in films.items():
        for focus in film.foci:
            rows: list[dict[str, Any]] = []
            for mark in scene.marks_shown(focus):
                own = focus in mark.foci
                identity = {"role": mark.role if own else "unassigned", "number": str(mark.number), "shape": mark.shape}
                rows.append({**identity, "used": own, "flags": "" if own else "foreign-mark", "point": np.array(mark.xyz, float)})
            for marker in scene.markers:
                identity = {"role": "object", "number": f"{marker.segment}/{marker.marker}", "shape": marker.shape}
                rows.append({**identity, "used": True, "flags": "", "point": marker.position_mm})
            source = scene.foci_mm[focus]
            shown = []
            for row in rows:
                point = row.pop("point")
                if (point - film.origin_mm) @ film.axes[2] >= (source - film.origin_mm) @ film.axes[2]:
                    continue  # behind the focus
                position = film.project(source, point)
                if film.holds(position):
                    plane = _on_plane(scene, focus, source, point)
                    shown.append({**who, "focus": focus, **row, **_xyz(plane), **exact_image, "file": file})
                    shown[-1] |= {"col_px": float(position[0]), "row_px": float(position[1])}
            images += shown
            for row in shown:
                if row["role"] == "object":
                    segment, marker_name = row["number"].split("/")
                    seen[segment, marker_name] = seen.get((segment, marker_name), 0) + 1
            counts = {f"n_{role}s": sum(row["role"] == role for row in shown) for role in ("fiducial", "control")}
            none = dict.fromkeys(("fiducial_rmse_um", "fiducial_max_um", "line_rmsv_um", "line_max_um"), 0.0)
            foci.append({**who, "focus": focus, **_xyz(source), **exact_point, **none, **counts})
    no_covariance = dict.fromkeys(("cov_xy_mm2", "cov_xz_mm2", "cov_yz_mm2", "crossing_um", "parallax_um"), 0.0)
    markers = [
        {**who, "segment": marker.segment, "marker": marker.marker, **_xyz(marker.position_mm), **exact_point, **no_covariance}
        | {"n_views": seen.get((marker.segment, marker.marker), 0), "flags": ""}
        for marker in scene.markers
    ]
    tables = {"images": (images, IMAGES), "foci": (foci, FOCI), "markers": (markers, MARKERS)}
    return {name: pl.DataFrame(rows, schema=schema) for name, (rows, schema) in tables.items()}


def _xyz(point: Float) -> dict[str, float]:
    return {f"{axis}_mm": float(value) for axis, value in zip("xyz", point, strict=True)}


def _on_plane(scene: Scene, focus: int, source: Float, point: Float) -> Float:
    plane = scene.cage.plane_of(focus)
    normal = np.cross(plane.u, plane.v)
    reach = (np.array(plane.origin) - source) @ normal / ((point - source) @ normal)
    return np.asarray(source + reach * (point - source))
