"""The tables of motion, growth and precision: their columns, and how they are written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from rsa_vision.kinematics.growth import compare_lengths
from rsa_vision.kinematics.kinema import BESIDE, NUMBERS, Columns, follow_up_pairs, motions, repeat_pairs
from rsa_vision.kinematics.precision import summarise
from rsa_vision.kinematics.rigidity import rigidity
from rsa_vision.kinematics.series import Series
from rsa_vision.motion_reasons import BIT, joined, status_of
from rsa_vision.settings import Limits, Motion
from rsa_vision.store import parquet_bytes, to_csv, write_atomic
from rsa_vision.tables import NUMBER, TEXT, TRUTH, WHOLE, Row, frame

_TEXTS: Final = frozenset({"mtpm_marker", "sd_source", "unstable_markers", "markers", "status"})
_KEY: Final = {"subject": TEXT, "exam_from": TEXT, "exam_to": TEXT}
_AFTER: Final = ("cog_x_mm", "cog_y_mm", "cog_z_mm", "mtpm_mm", "sd_mtpm_mm", "mtpm_low_mm", "mtpm_high_mm", "mtpm_marker", "e_rb_mm")
_MORE: Final = ("mean_error_mm", "condition_number", "n_markers", "birge", "sd_source", "unstable_markers", "continuous")


def _kind(name: str) -> pl.DataType:
    return WHOLE if name == "n_markers" else TRUTH if name == "continuous" else TEXT if name in _TEXTS else NUMBER


MOTION: Final[Mapping[str, pl.DataType]] = {
    **_KEY, "segment": TEXT, "reference": TEXT, "days": NUMBER,
    **{name: _kind(name) for name in (*(name for name in NUMBERS if name not in _AFTER), *_AFTER, *_MORE)},
    **{f"consistent_{name}": _kind(name) for name in (*BESIDE, "markers", "status")},
    "frame": TEXT, "status": TEXT, "reasons": TEXT,
}  # fmt: skip
"""Columns of ``motion.csv``."""
RIGIDITY: Final[Mapping[str, pl.DataType]] = {
    **_KEY, "segment": TEXT, "marker": TEXT, "marker_next": TEXT, "side_from_mm": NUMBER, "side_to_mm": NUMBER, "side_change_um": NUMBER,
    "sd_side_change_um": NUMBER, "angle_from_deg": NUMBER, "angle_to_deg": NUMBER, "angle_change_deg": NUMBER, "changed": TRUTH,
}  # fmt: skip
LENGTHS: Final[Mapping[str, pl.DataType]] = {
    **_KEY, "segment_a": TEXT, "marker_a": TEXT, "segment_b": TEXT, "marker_b": TEXT,
    "length_from_mm": NUMBER, "length_to_mm": NUMBER, "difference_um": NUMBER, "sd_um": NUMBER,
}  # fmt: skip
GROWTH: Final[Mapping[str, pl.DataType]] = {
    **_KEY, "days": NUMBER, "n_points": WHOLE, "n_lengths": WHOLE, "rmsv_um": NUMBER, "s0_um": NUMBER, "scale_ppm": NUMBER, "form": TEXT,
    "status": TEXT, "reasons": TEXT,
}  # fmt: skip
PRECISION: Final[Mapping[str, pl.DataType]] = {
    "kind": TEXT, "segment": TEXT, "reference": TEXT, "parameter": TEXT, "unit": TEXT, "n": WHOLE, "mean": NUMBER, "sd": NUMBER,
    "limit_95": NUMBER, "from_zero": NUMBER, "single": NUMBER, "median": NUMBER, "low": NUMBER, "high": NUMBER, "mean_low": NUMBER,
    "mean_high": NUMBER, "n_left_out": WHOLE,
}  # fmt: skip
GROUPS: Final[Mapping[str, pl.DataType]] = {
    "segment": TEXT, "reference": TEXT, "follow_up": WHOLE, "median_days": NUMBER, "parameter": TEXT, "unit": TEXT, "n": WHOLE,
    "mean": NUMBER,    "sd": NUMBER, "mean_low": NUMBER, "mean_high": NUMBER, "median": NUMBER, "low": NUMBER, "high": NUMBER,
    "n_left_out": WHOLE,
}  # fmt: skip
MOTION_SCHEMAS: Final[Mapping[str, Mapping[str, pl.DataType]]] = {
    "motion": MOTION, "rigidity": RIGIDITY, "motion_groups": GROUPS, "lengths": LENGTHS, "growth": GROWTH, "precision": PRECISION,
}  # fmt: skip
"""Tables that ``motion``, ``growth`` and ``precision`` write, by file name."""
PARAMETERS: Final = {f"r{axis}_deg": "deg" for axis in "xyz"} | {f"t{axis}_mm": "mm" for axis in "xyz"} | {"mtpm_mm": "mm"}
QUALITY: Final = {"e_rb_mm": "mm", "mean_error_mm": "mm", "condition_number": "1/m", "n_markers": ""}
YEAR_DAYS: Final = 365.25
SETTLED_DAYS: Final = 300  # migration of the first year is settling in
INTERVAL_DAYS: Final = 300  # between examinations from which continuous migration is told
STANDARD: Final = "standard"
UM: Final = 1000.0


def motion_table(series: Sequence[Series], settings: Motion, limits: Limits, *, shared_errors: bool = False) -> pl.DataFrame:
    """Return ``motion.csv`` of subjects."""
    columns = motions(series, settings, limits, shared_errors=shared_errors)
    first = {(one.subject, exam): day for one in series for exam, day in zip(one.exams, one.days.tolist(), strict=True)}
    start = np.array([first[key] for key in zip(columns["subject"], columns["exam_from"], strict=True)], float)
    return _table(columns | {"continuous": _continuous(columns, start, limits.continuous_mm)}, MOTION)


def _continuous(columns: Columns, start: np.ndarray[Any, Any], limit_mm: float) -> np.ndarray[Any, Any]:
    """After the first year: whether the motion of a year is above the limit beyond its error (MTPM, after Ryd 1995)."""
    asked = (start >= SETTLED_DAYS) & (columns["days"] >= INTERVAL_DAYS) & (columns["reference"] != "") & (columns["status"] == "ok")
    per_year = columns["mtpm_low_mm"] * YEAR_DAYS / np.where(asked, columns["days"], np.nan)
    return np.array([bool(value > limit_mm) if ask else None for value, ask in zip(per_year, asked, strict=True)], object)


def _table(columns: Mapping[str, Any], schema: Mapping[str, pl.DataType]) -> pl.DataFrame:
    made = {}
    for name, kind in schema.items():
        values = columns[name]
        made[name] = pl.Series(name, values if kind == NUMBER else values.tolist(), dtype=kind, nan_to_null=kind == NUMBER)
    return pl.DataFrame(made).with_columns(pl.col([name for name, kind in schema.items() if kind == NUMBER]).fill_nan(None))


def rigidity_table(series: Sequence[Series], stable_mm: float) -> pl.DataFrame:
    """Return ``rigidity.csv``."""
    return _table(rigidity(series, stable_mm), RIGIDITY)


def group_table(motion: pl.DataFrame, series: Sequence[Series]) -> pl.DataFrame:
    """Return the statistics over subjects of the motion since the first examination, at every follow-up (repeats left out)."""
    number: dict[tuple[str, str], int] = {}
    for one in series:
        exams = [exam for exam, original in zip(one.exams, one.repeat_of.tolist(), strict=True) if original < 0]
        number |= {(one.subject, exam): place for place, exam in enumerate(exams)}
    begins = {(one.subject, one.exams[0]) for one in series}
    groups: dict[tuple[str, str, int], list[Row]] = {}
    for row in motion.iter_rows(named=True):
        follow_up = number.get((row["subject"], row["exam_to"]))
        if follow_up and (row["subject"], row["exam_from"]) in begins:
            groups.setdefault((row["segment"], row["reference"] or "", follow_up), []).append(row)
    return frame((row for key in sorted(groups) for row in _group_rows(key, groups[key])), GROUPS)


def _group_rows(key: tuple[str, str, int], rows: Sequence[Row]) -> Iterable[Row]:
    segment, reference, follow_up = key
    used = [row for row in rows if row["status"] == "ok"]
    days = np.array([row["days"] for row in rows if row["days"] is not None])
    head = {"segment": segment, "reference": reference, "follow_up": follow_up, "n_left_out": len(rows) - len(used)}
    head["median_days"] = float(np.median(days)) if len(days) else None
    for parameter, unit in (PARAMETERS | QUALITY).items():
        values = np.array([np.nan if row[parameter] is None else row[parameter] for row in used], float)
        yield head | {"parameter": parameter, "unit": unit} | asdict(summarise(values))


def growth_tables(series: Sequence[Series], standard: Sequence[Series] | None, scale: float = 1.0) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return ``lengths.csv`` and ``growth.csv``.

    Parameters
    ----------
    series : sequence of Series
    standard : sequence of Series or None
        One series for all subjects (subject empty), or one of each; None: the examinations are compared with each other.
    scale : float
        Factor on the coordinates of the examinations, for temperature.
    """
    lengths: list[Row] = []
    growth: list[Row] = []
    given = {one.subject: one for one in standard or ()}
    for one in series:
        places = _places(one)
        twice = {exam for segment in one.segments for exam, some in zip(one.exams, segment.duplicate, strict=True) if some.any()}
        if standard is None:
            pairs = [(one.exams[a], one.exams[b], places[a], places[b], one.days[b] - one.days[a], scale) for a, b in follow_up_pairs(one)]
        else:
            known = given.get(one.subject) or given.get("")
            fixed = _places(known, exact=True)[0] if known else {}
            pairs = [(STANDARD, exam, fixed, place, np.nan, 1.0) for exam, place in zip(one.exams, places, strict=True)]
        for start, end, before, after, days, factor in pairs:
            key: Row = {"subject": one.subject, "exam_from": start, "exam_to": end}
            common = [name for name in before if name in after]
            summary: Row = {"days": days, "n_points": len(common), "n_lengths": len(common) * (len(common) - 1) // 2}
            if len(common) < 2:
                growth.append(key | summary | {"status": "failed", "reasons": "too-few-markers"})
                continue
            first, second = (np.stack([some[name][0] for name in common]) for some in (before, after))
            errors = [np.stack([some[name][1] for name in common]) for some in (before, after)]
            found = compare_lengths(first * factor, second * scale, *errors)
            summary |= {"rmsv_um": found.rmsv_um, "s0_um": found.s0_um, "scale_ppm": found.scale_ppm, "form": found.form}
            growth.append(key | summary | _growth_verdict(found.form, common, twice & {start, end}))
            for k, (i, j) in enumerate(zip(found.first, found.second, strict=True)):
                ends = dict(zip(("segment_a", "marker_a", "segment_b", "marker_b"), (*common[i], *common[j]), strict=True))
                numbers = {name: getattr(found, name)[k] for name in ("length_from_mm", "length_to_mm", "difference_um", "sd_um")}
                lengths.append(key | ends | numbers)
    return frame(lengths, LENGTHS), frame(growth, GROWTH)


def _growth_verdict(form: str, common: Sequence[tuple[str, str]], twice: set[str]) -> Row:
    """Return status and reasons: lengths are the same in a mirror, so that only here it shows."""
    bits = (BIT["mirrored"] if form == "mirrored" else 0) | (BIT["marker-duplicate"] if twice else 0)
    bits |= BIT["segments-together"] if len({segment for segment, _ in common}) > 1 else 0
    reasons = ["too-few-markers"] if len(common) < 3 else []  # for a scale; the one length is determined
    return {"status": status_of(bits), "reasons": ";".join([*filter(None, [joined(bits)]), *reasons])}


def _places(series: Series, exact: bool = False) -> list[dict[tuple[str, str], tuple[Any, Any]]]:
    """Return place and covariance of each marker, for every examination."""
    found: list[dict[tuple[str, str], tuple[Any, Any]]] = [{} for _ in series.exams]
    for segment in series.segments:
        covariance = np.nan_to_num(segment.covariance_mm2) if exact else segment.covariance_mm2
        for e, k in zip(*np.nonzero(segment.present), strict=True):
            found[e][segment.name, segment.markers[k]] = segment.position_mm[e, k], covariance[e, k]
    return found


def precision_table(series: Sequence[Series], settings: Motion, limits: Limits, images: pl.DataFrame | None) -> pl.DataFrame:
    """Return ``precision.csv``: motion between double examinations, and Selvik's (5:3) for model and image coordinates."""
    columns = motions(series, settings, limits, repeat_pairs)
    rows: list[Row] = []
    keys = sorted(dict.fromkeys(zip(columns["segment"].tolist(), columns["reference"].tolist(), strict=True)))
    for segment, reference in keys:
        at = (columns["segment"] == segment) & (columns["reference"] == reference)
        ok = at & (columns["status"] == "ok")
        head: Row = {"kind": "motion", "segment": segment, "reference": reference, "n_left_out": int(at.sum() - ok.sum())}
        rows += [head | {"parameter": name, "unit": unit} | asdict(summarise(columns[name][ok])) for name, unit in PARAMETERS.items()]
    rows += _model_rows(series)
    rows += _image_rows(series, images) if images is not None else []
    return frame(rows, PRECISION)


def _model_rows(series: Sequence[Series]) -> list[Row]:
    found: dict[str, list[np.ndarray[Any, Any]]] = {}
    for one in series:
        for segment in one.segments:
            for a, b in repeat_pairs(one):
                found.setdefault(segment.name, []).append((segment.position_mm[b] - segment.position_mm[a]) * UM)
    rows = []
    for segment_name, parts in sorted(found.items()):
        change = np.concatenate(parts)
        head: Row = {"kind": "model", "segment": segment_name, "n_left_out": int((~np.isfinite(change).all(axis=1)).sum()), "unit": "um"}
        rows += [head | {"parameter": f"{axis}_um"} | asdict(summarise(change[:, k])) for k, axis in enumerate("xyz")]
    return rows


def _image_rows(series: Sequence[Series], images: pl.DataFrame) -> list[Row]:
    pairs = {(one.subject, one.exams[b]): one.exams[a] for one in series for a, b in repeat_pairs(one)}
    key = ["subject", "exam", "focus", "role", "number"]
    values = ("col_px", "row_px", "x_mm", "y_mm", "z_mm")
    table = images.filter(pl.col("number").fill_null("") != "")
    known = {row[:5]: row[5:] for row in table.select(*key, *values).iter_rows()}
    found: dict[str, list[list[float]]] = {}
    for (subject, exam, focus, role, number), second in known.items():
        first = known.get((subject, pairs.get((subject, exam)), focus, role, number))
        if first is not None:
            found.setdefault(role, []).append([np.nan if None in pair else pair[1] - pair[0] for pair in zip(first, second, strict=True)])
    rows = []
    for role, parts in sorted(found.items()):
        change = np.array(parts, float)
        for k, name in enumerate(values):
            unit, factor = ("px", 1.0) if name.endswith("_px") else ("um", UM)
            head: Row = {"kind": "image", "segment": role, "parameter": name.replace("_mm", "_um"), "unit": unit}
            rows.append(head | {"n_left_out": int((~np.isfinite(change[:, k])).sum())} | asdict(summarise(change[:, k] * factor)))
    return rows


def write_motion_tables(out: Path, tables: Mapping[str, pl.DataFrame]) -> None:
    """Write tables as CSV and Parquet, each whole or not at all."""
    for name, table in tables.items():
        write_atomic(out / f"{name}.csv", to_csv(table))
        write_atomic(out / "results.parquet" / f"{name}.parquet", parquet_bytes(table))


def remove_motion_tables(out: Path) -> None:
    """Remove the tables of motion, growth and precision that a folder holds."""
    for name in MOTION_SCHEMAS:
        (out / f"{name}.csv").unlink(missing_ok=True)
        (out / "results.parquet" / f"{name}.parquet").unlink(missing_ok=True)


def read_motion_tables(out: Path) -> dict[str, pl.DataFrame]:
    """Read those tables of motion that a folder holds."""
    found = {}
    for name, schema in MOTION_SCHEMAS.items():
        try:
            found[name] = pl.read_csv(out / f"{name}.csv", schema=dict(schema))
        except (OSError, pl.exceptions.PolarsError):
            continue
    return found
