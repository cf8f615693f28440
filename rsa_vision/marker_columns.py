"""Columns of tables of markers as other programs name and arrange them, brought to those of ``markers.csv``."""

from __future__ import annotations

import re
from typing import Final

import polars as pl

from rsa_vision.errors import PointsError

PLACE: Final = ("x_mm", "y_mm", "z_mm")
DEVIATIONS: Final = ("sd_x_mm", "sd_y_mm", "sd_z_mm")
PRODUCTS: Final = {"cov_xy_mm2": (0, 1), "cov_xz_mm2": (0, 2), "cov_yz_mm2": (1, 2)}
SYNONYMS: Final = {
    "subject": ("patient", "patientid", "subjectid", "participant", "case", "caseid"),
    "exam": ("examination", "examid", "examdate", "examinationdate", "date", "studydate", "visit", "timepoint", "followup", "frame"),
    "segment": ("body", "rigidbody", "bone", "component", "segmentname"),
    "marker": ("point", "landmark", "bead", "label", "markername", "markerid", "pointname", "pointid"),
    **{f"{a}_mm": (a, f"{a}coordinate", f"{a}coord", f"coord{a}", f"pos{a}", f"position{a}") for a in "xyz"},
    **{f"sd_{a}_mm": (f"sd{a}", f"std{a}", f"sigma{a}", f"{a}sd", f"{a}std") for a in "xyz"},
}
"""What other programs call a column, in small letters without anything else."""
UNIT: Final = re.compile(r"(?P<name>.+?)(?:\s*[\[(]\s*(?P<bracketed>\w+)\s*[\])]|[\s_](?P<unit>mm|cm|dm|m|um|µm|inch|in))", re.IGNORECASE)
SMALLEST_MM: Final = 0.3  # markers that span less are no markers in mm


def recognise(where: str, table: pl.DataFrame) -> pl.DataFrame:
    """Return a table with the columns of ``markers.csv``, one row for each marker.

    Parameters
    ----------
    where : str
        The file, for messages.
    table : polars.DataFrame
        Of strings. With the columns ``NAME_X``, ``NAME_Y``, ``NAME_Z`` it has a row for each frame, as XMALab and others write points: the
        number of the frame is the examination unless a column tells it. A marker named ``segment/marker`` tells its segment.

    Returns
    -------
    polars.DataFrame

    Raises
    ------
    PointsError
        If several columns may be the same one, or coordinates are not in mm.
    """
    table = _rename(where, table)
    if "marker" not in table.columns:
        table = _long(table)
    if "segment" not in table.columns and "marker" in table.columns and table["marker"].fill_null("").str.contains("/").any():
        parts = [(name or "").rpartition("/") for name in table["marker"].to_list()]
        table = table.with_columns(segment=pl.Series([part[0] for part in parts]), marker=pl.Series([part[2] for part in parts]))
    return _decimal_points(table)


def _rename(where: str, table: pl.DataFrame) -> pl.DataFrame:
    free = [name for name in table.columns if name not in SYNONYMS]
    said = {name: _split_unit(name) for name in free}
    names: dict[str, str] = {}
    for target, synonyms in SYNONYMS.items():
        own = target.removesuffix("_mm").replace("_", "")
        found = [name for name in free if said[name][0] in (own, *synonyms)]
        if target in table.columns or not found:
            continue
        if len(found) > 1:
            raise PointsError(f"{where}: {' and '.join(found)} may both be the column {target}; rename the right one {target}")
        unit = said[found[0]][1]
        if target.endswith("_mm") and unit not in ("", "mm"):
            raise PointsError(f"{where}: {found[0]} is in {unit}; give mm, in a column {target}")
        names[found[0]] = target
    if bare := [name for name, target in names.items() if target in PLACE and not said[name][1]]:
        _check_span(where, table, bare)
    return table.rename(names)


def _split_unit(name: str) -> tuple[str, str]:
    """Return the bare letters of a column's name, and its unit or nothing."""
    match = UNIT.fullmatch(name.strip())
    bare, unit = (match["name"], match["bracketed"] or match["unit"]) if match else (name, "")
    return re.sub(r"[\W_]", "", bare).lower(), unit.lower()


def _check_span(where: str, table: pl.DataFrame, bare: list[str]) -> None:
    """Without a unit in their names coordinates count as mm, unless they span so little that they are likely to be in m."""
    numbers = table.select(pl.col(bare).str.replace(",", ".", literal=True).cast(pl.Float64, strict=False).fill_nan(None))
    span = max(
        (float(high - low) for low, high in zip(numbers.min().row(0), numbers.max().row(0), strict=True) if low is not None), default=0.0
    )
    if 0 < span < SMALLEST_MM:
        raise PointsError(
            f"{where}: {', '.join(bare)} do not say their unit and span {span:.3g}; give mm, in the columns {', '.join(PLACE)}"
        )


def _long(table: pl.DataFrame) -> pl.DataFrame:
    whole = [name[:-2] for name in table.columns if name.endswith("_X") and {f"{name[:-2]}_Y", f"{name[:-2]}_Z"} <= set(table.columns)]
    if not whole:
        return table
    keys = [pl.col(name) for name in ("subject", "exam") if name in table.columns]
    if "exam" not in table.columns:
        keys.append(pl.int_range(1, pl.len() + 1).cast(pl.String).alias("exam"))
    places = [[pl.col(f"{name}_{axis}").alias(f"{axis.lower()}_mm") for axis in "XYZ"] for name in whole]
    return pl.concat(table.select(*keys, pl.lit(name).alias("marker"), *place) for name, place in zip(whole, places, strict=True))


def _decimal_points(table: pl.DataFrame) -> pl.DataFrame:
    """Decimal commas become points if no number has a point: otherwise a comma may separate thousands."""
    numbers = [name for name in (*PLACE, *DEVIATIONS, *PRODUCTS) if name in table.columns]
    if any(table[name].str.contains(".", literal=True).any() for name in numbers):
        return table
    return table.with_columns(pl.col(numbers).str.replace(",", ".", literal=True))
