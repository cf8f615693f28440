"""The tables in OUT: their columns (docs/files.md) and the rows of one examination."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import polars as pl

from rsa_vision.flags import flag_names
from rsa_vision.types import FocusSolution, ImagePoints, MarkerImages, Markers

if TYPE_CHECKING:
    from rsa_vision.examination import ExaminationResult  # tables are read without the mathematics

Row = dict[str, Any]
Rows = dict[str, list[Row]]

METHOD: Final = "selvik"
AXES: Final = ("x_mm", "y_mm", "z_mm")

TEXT, NUMBER, WHOLE, TRUTH = pl.String(), pl.Float64(), pl.Int64(), pl.Boolean()


def _schema(text: str) -> dict[str, pl.DataType]:
    kinds = {"s": TEXT, "f": NUMBER, "i": WHOLE, "b": TRUTH}
    return {name: kinds[kind] for name, kind in (column.split(":") for column in text.split())}


_POINT: Final = "shape:s col_px:f row_px:f sd_col_px:f sd_row_px:f cov_col_row_px2:f"
SCHEMAS: Final[Mapping[str, Mapping[str, pl.DataType]]] = {
    "exams": _schema("subject:s exam:s status:s reasons:s files:s method:s n_markers:i mean_parallax_um:f seconds:f message:s"),
    "images": _schema(
        f"subject:s exam:s focus:i role:s number:s {_POINT} x_mm:f y_mm:f z_mm:f residual_um:f used:b flags:s file:s radius_px:f "
        "angle_deg:f contrast:f snr:f"
    ),
    "foci": _schema(
        "subject:s exam:s focus:i x_mm:f y_mm:f z_mm:f sd_x_mm:f sd_y_mm:f sd_z_mm:f fiducial_rmse_um:f fiducial_max_um:f line_rmsv_um:f "
        "line_max_um:f n_fiducials:i n_controls:i"
    ),
    "markers": _schema(
        "subject:s exam:s segment:s marker:s x_mm:f y_mm:f z_mm:f sd_x_mm:f sd_y_mm:f sd_z_mm:f cov_xy_mm2:f cov_xz_mm2:f cov_yz_mm2:f "
        "crossing_um:f crossing_sd_um:f parallax_um:f n_views:i flags:s"
    ),
}
"""Columns and types of every table that ``measure`` and ``reconstruct`` write."""

DETECTIONS: Final = _schema(f"file:s {_POINT} radius_px:f angle_deg:f contrast:f snr:f flags:s")
"""Columns of the table of ``detect``."""


def frame(rows: Iterable[Row], schema: Mapping[str, pl.DataType]) -> pl.DataFrame:
    """Return rows as a table in the order and with the types of a schema; NaN and infinity become empty.

    Parameters
    ----------
    rows : iterable of dict
    schema : mapping of str to polars type

    Returns
    -------
    polars.DataFrame
    """
    finite = ({name: plain(row.get(name)) for name in schema} for row in rows)
    return pl.DataFrame(list(finite), schema=dict(schema), orient="row")


def examination_rows(subject: str, exam: str, files: Iterable[str], result: ExaminationResult, seconds: float) -> Rows:
    """Return the rows of all tables for one examination.

    Parameters
    ----------
    subject, exam : str
    files : iterable of str
        Names of its films.
    result : ExaminationResult
    seconds : float
        Time that it took.

    Returns
    -------
    dict of str to list of dict
        By table, values as plain Python numbers, empty as None; and, for :mod:`rsa_vision.followup`, what the films leave open.
    """
    key = {"subject": subject, "exam": exam}
    markers = result.reconstruction.markers if result.reconstruction else None
    parallax = markers.parallax_um[np.isfinite(markers.parallax_um)] if markers else np.zeros(0)
    determined = int(np.isfinite(markers.position_mm).all(axis=1).sum()) if markers else 0
    row = {
        "status": result.verdict.status,
        "reasons": ";".join(result.verdict.reasons),
        "files": ";".join(files),
        "method": METHOD,
        "n_markers": determined,
        "mean_parallax_um": float(parallax.mean()) if parallax.size else None,
        "seconds": round(seconds, 3),
        "message": " | ".join(result.verdict.messages),
    }
    tables: Rows = {"exams": [key | row], "images": [key | point for point in _image_rows(result)], "foci": [], "markers": []}
    if result.reconstruction:
        tables["foci"] = [key | _focus_row(focus) for focus in result.reconstruction.foci]
        tables["markers"] = [key | marker for marker in marker_rows(result.reconstruction.markers)]
    finite = {name: [{column: plain(value) for column, value in row.items()} for row in rows] for name, rows in tables.items()}
    return finite | result.sightlines.rows()


def failed_rows(subject: str, exam: str, files: Iterable[str], code: str, message: str, seconds: float = 0.0) -> Rows:
    """Return the rows of an examination of which nothing is known but why it failed."""
    row: Row = {"subject": subject, "exam": exam, "status": "failed", "reasons": code, "files": ";".join(files), "method": METHOD}
    row |= {"n_markers": 0, "mean_parallax_um": None, "seconds": round(seconds, 3), "message": message}
    return {"exams": [row], "images": [], "foci": [], "markers": []}


def detection_rows(file: str, images: MarkerImages) -> list[Row]:
    """Return the rows of ``detect`` for one film."""
    return [
        {"file": file} | _point_row(images, i) | _look_row(images, i) | {"flags": flag_names(int(images.flags[i]))}
        for i in range(len(images))
    ]


def split_name(name: str) -> tuple[str, str]:
    """Split ``segment/marker``; the segment of a plain name is empty."""
    segment, _, marker = name.rpartition("/")
    return segment, marker


def name_of(marker: Row) -> str:
    """Return the name of a row of ``markers.csv`` as images have it, the inverse of :func:`split_name`."""
    return f"{marker['segment']}/{marker['marker']}" if marker["segment"] else str(marker["marker"])


def plain(value: Any) -> Any:
    """Return a value of numpy as Python's, what is not finite as None."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _point_row(points: ImagePoints | MarkerImages, i: int) -> Row:
    (col, row), cov = points.position_px[i], points.covariance_px2[i]
    sd_col, sd_row = np.sqrt(np.diagonal(cov))
    position = {"shape": str(points.shape[i]), "col_px": col, "row_px": row}
    return position | {"sd_col_px": sd_col, "sd_row_px": sd_row, "cov_col_row_px2": cov[0, 1]}


def _look_row(images: MarkerImages, i: int) -> Row:
    return {name: getattr(images, name)[i] for name in ("radius_px", "angle_deg", "contrast", "snr")}


def _image_rows(result: ExaminationResult) -> Iterable[Row]:
    points, reconstruction = result.points, result.reconstruction
    for i in range(len(points)):
        row = _point_row(points, i) | {"focus": points.focus[i], "role": str(points.role[i]), "number": str(points.number[i])}
        row["flags"] = flag_names(int(points.flags[i]))
        row["used"] = bool(reconstruction.used[i]) if reconstruction else False
        if reconstruction:
            row |= dict(zip(("x_mm", "y_mm", "z_mm"), reconstruction.plane_mm[i], strict=True))
            row["residual_um"] = reconstruction.residual_um[i]
        if result.films:
            row["file"] = result.films[points.film[i]].path.name
            if result.source is not None:
                row |= _look_row(result.films[points.film[i]].images, int(result.source[i]))
        yield row


def _focus_row(focus: FocusSolution) -> Row:
    row = {name: getattr(focus, name) for name in FocusSolution.__dataclass_fields__ if name in SCHEMAS["foci"]}
    row |= dict(zip(("x_mm", "y_mm", "z_mm"), focus.position_mm, strict=True))
    return row | dict(zip(("sd_x_mm", "sd_y_mm", "sd_z_mm"), np.sqrt(np.diagonal(focus.covariance_mm2)), strict=True))


def marker_rows(markers: Markers) -> Iterable[Row]:
    """Return the columns of ``markers.csv`` for every marker, but for subject and examination."""
    for i, name in enumerate(markers.name):
        segment, marker = split_name(str(name))
        cov = markers.covariance_mm2[i]
        row: Row = {"segment": segment, "marker": marker, "n_views": markers.n_views[i], "flags": flag_names(int(markers.flags[i]))}
        row |= dict(zip(("x_mm", "y_mm", "z_mm"), markers.position_mm[i], strict=True))
        row |= dict(zip(("sd_x_mm", "sd_y_mm", "sd_z_mm"), np.sqrt(np.diagonal(cov)), strict=True))
        row |= {"cov_xy_mm2": cov[0, 1], "cov_xz_mm2": cov[0, 2], "cov_yz_mm2": cov[1, 2]}
        yield row | {column: getattr(markers, column)[i] for column in ("crossing_um", "crossing_sd_um", "parallax_um")}
