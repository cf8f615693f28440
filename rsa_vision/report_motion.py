"""The motion section of ``report.html``: migration over time, groups, precision and the guideline's checklist, from the tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from rsa_vision.motion_reasons import MOTION_REASONS
from rsa_vision.motion_tables import PARAMETERS, PRECISION, QUALITY, read_motion_tables
from rsa_vision.tables import Row

COLOURS: Final = ("#0b6fa4", "#c25e00", "#3d8f4f", "#8a4fb5", "#a8325e", "#6b6f00", "#257d7d", "#5a5a5a")
PLOT_PX: Final = (260, 175)
MARGIN_PX: Final = (38, 10, 12, 24)  # left, right, top, bottom
MOST_LINES: Final = 24  # subjects that a plot shows one by one
FEW_LINES: Final = 3  # whose bands can be told apart
MOST_ROWS: Final = 200
WITHIN_95: Final = 1.96
TITLES: Final = {"r": "Rotation about {} (deg)", "t": "Translation along {} (mm)", "m": "MTPM (mm)"}
QUALITY_TITLES: Final = {
    "e_rb_mm": "Error of rigid-body fitting, root mean square (e_rb_mm)",
    "mean_error_mm": "Mean error of rigid-body fitting (mean_error_mm)",
    "condition_number": "Condition number",
    "n_markers": "Markers of a segment",
}
ASKED: Final = {
    "implant": "Implant and its marking",
    "surgery_to_first_days": "Days from surgery to the first examination",
    "posture": "Posture of the patient, and side-by-side or crossing set-up",
    "precision_interval": "Time between double examinations, and repositioning",
    "excluded": "Patients lost or excluded, with the reason",
}
"""Items of the guideline (Kaptein 2024) that only the user knows: the table ``[report]`` of the study file."""


def motion_section(out: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return what the template of the section needs, or None where the folder holds no motion.

    Parameters
    ----------
    out : Path
        Results folder.
    settings : mapping
        Of the run, as in ``run.json``.
    """
    tables = read_motion_tables(out)
    motion = tables.get("motion")
    if motion is None or not len(motion):
        return None
    rows = motion.with_columns(pl.col("reference", "reasons", "subject").fill_null("")).to_dicts()
    groups = tables["motion_groups"].with_columns(pl.col("reference").fill_null("")).to_dicts() if "motion_groups" in tables else []
    worst = sorted(rows, key=lambda row: (("failed", "review", "ok").index(row["status"]), not row["reference"]))
    compared = [row for row in groups if row["parameter"] in PARAMETERS and (row["reference"] or not any(g["reference"] for g in groups))]
    codes = dict.fromkeys(code for row in rows for code in row["reasons"].split(";") if code)
    precision = tables["precision"].filter(pl.col("kind") == "motion") if "precision" in tables else pl.DataFrame(schema=dict(PRECISION))
    plots = _plots(rows)
    return {
        "rows": worst[:MOST_ROWS],
        "n": len(rows),
        "counts": {status: sum(row["status"] == status for row in rows) for status in ("ok", "review", "failed")},
        "reasons": {code: MOTION_REASONS[code][1] for code in codes if code in MOTION_REASONS},
        "plots": plots,
        "doubtful": any(panel["doubtful"] for plot in plots for panel in plot["panels"]),
        "groups": [row for row in compared if row["n"]] if any(row["n"] > 1 for row in compared) else [],
        "relative": any(row["reference"] for row in rows),
        "continuous": [row for row in rows if row["continuous"]],
        "precision": [row for row in precision.with_columns(pl.col("reference").fill_null("")).to_dicts() if row["n"]],
        "checklist": _checklist(rows, settings, precision),
    }


def _plots(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the plots of each segment: relative motion where there is any, since the first examination of each subject."""
    first: dict[str, str] = {}
    for row in rows:  # the rows of a subject begin with its first examination
        first.setdefault(row["subject"], row["exam_from"])
    since = [row for row in rows if row["exam_from"] == first[row["subject"]] and row["status"] != "failed"]
    relative = [row for row in since if row["reference"]] or since
    plots = []
    for segment, reference in dict.fromkeys((row["segment"], row["reference"]) for row in relative):
        mine = [row for row in relative if (row["segment"], row["reference"]) == (segment, reference)]
        panels = [_panel(mine, name) for name in PARAMETERS]
        subjects = [(line["subject"], line["colour"]) for line in panels[0]["lines"]]
        legend = subjects if 1 < len(subjects) <= len(COLOURS) else []
        plots.append({"segment": segment, "reference": reference, "panels": panels, "legend": legend})
    return plots


def _panel(rows: Sequence[Row], name: str) -> dict[str, Any]:
    """Return the lines and confidence bands of one parameter, in pixels."""
    dated = all(row["days"] is not None for row in rows)
    lines: dict[str, list[tuple[float, float, float, float]]] = {}
    doubtful: set[tuple[str, float]] = set()
    for row in rows:
        if row[name] is not None:
            line = lines.setdefault(row["subject"], [(0.0, 0.0, 0.0, 0.0)])
            low, high = _band(row, name)
            line.append((row["days"] if dated else float(len(line)), row[name], low, high))
            if row["status"] != "ok":
                doubtful.add((row["subject"], line[-1][0]))
    every = np.array([point for line in lines.values() for point in line] or [(0.0, 0.0, 0.0, 0.0)])
    left, right, top, bottom = MARGIN_PX
    width, height = PLOT_PX
    end = max(float(every[:, 0].max()), 1.0)
    low, high = _range(float(every[:, 1:].min()), float(every[:, 1:].max()))

    def x(value: float) -> float:
        return round(left + (width - left - right) * value / end, 1)

    def y(value: float) -> float:
        return round(height - bottom - (height - top - bottom) * (value - low) / (high - low), 1)

    drawn = []
    opacity = 0.13 if len(lines) <= FEW_LINES else 0.05
    for place, (subject, line) in enumerate(list(lines.items())[:MOST_LINES]):
        points = sorted(line)
        upper, lower = [f"{x(p[0])},{y(p[3])}" for p in points], [f"{x(p[0])},{y(p[2])}" for p in reversed(points)]
        drawn.append(
            {
                "subject": subject,
                "opacity": opacity,
                "colour": COLOURS[place % len(COLOURS)],
                "band": " ".join(upper + lower),
                "line": " ".join(f"{x(p[0])},{y(p[1])}" for p in points),
                "points": [{"x": x(p[0]), "y": y(p[1]), "doubtful": (subject, p[0]) in doubtful} for p in points],
            }
        )
    step = _step(high - low)
    ticks = [{"y": y(value), "label": f"{value + 0.0:g}"} for value in np.round(np.arange(np.ceil(low / step), high / step) * step, 9)]
    return {
        "title": TITLES[name[0]].format(name[1]),
        "width": width,
        "height": height,
        "left": left,
        "right": width - right,
        "bottom": height - bottom,
        "zero": y(0.0),
        "lines": drawn,
        "ticks": ticks,
        "end": f"{end:.0f} days" if dated else "examinations",
        "more": max(len(lines) - MOST_LINES, 0),
        "doubtful": bool(doubtful),
    }


def _band(row: Row, name: str) -> tuple[float, float]:
    if name == "mtpm_mm" and row["mtpm_low_mm"] is not None:
        return row["mtpm_low_mm"], row["mtpm_high_mm"]
    reach = WITHIN_95 * (row[f"sd_{name}"] or 0.0)
    return row[name] - reach, row[name] + reach


def _range(low: float, high: float) -> tuple[float, float]:
    low, high = min(low, 0.0), max(high, 0.0)
    room = 0.06 * (high - low) or 0.5
    return low - room, high + room


def _step(span: float) -> float:
    power = 10.0 ** np.floor(np.log10(span / 3))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= span / 3))


def _checklist(rows: Sequence[Row], settings: Mapping[str, Any], precision: pl.DataFrame) -> list[dict[str, str]]:
    """Return the items of the guideline with what the data tell; those that only the user knows come from ``[report]``."""
    limits, given = settings.get("limits", {}), settings.get("report", {})
    days = [row["days"] for row in rows if row["days"] is not None]
    subjects = {row["subject"] for row in rows}
    references = sorted({row["reference"] for row in rows if row["reference"]})
    left_out = sorted({row["segment"] for row in rows if row["n_markers"] != row["consistent_n_markers"]})
    items = [
        ("Subjects", str(len(subjects))),
        ("Time between examinations", f"{min(days):.0f} to {max(days):.0f} days" if days else "names of examinations are no dates"),
        ("Coordinate system", ", ".join(sorted({row["frame"] for row in rows}))),
        ("Reference segment", ", ".join(references) or "none: absolute motion only"),
        (
            "Marker selection",
            "all common markers; consistent markers beside them" + (f" (they differ for {', '.join(left_out)})" if left_out else ""),
        ),
        ("Translation measured at", "centre of gravity of the segment's markers"),
        ("Rotation sequence", "x, y, z about body-fixed axes"),
        ("Standard deviations from", ", ".join(sorted({row["sd_source"] for row in rows if row["sd_source"]}))),
    ]
    for name, unit in QUALITY.items():
        values = np.array([row[name] for row in rows if row[name] is not None], float)
        limit = f"; limit {limits[name]:g}" if name in limits else ""
        if len(values):
            items.append(
                (
                    QUALITY_TITLES[name],
                    f"median {np.median(values):.3g}, range {values.min():.3g} to {values.max():.3g} {unit}{limit}".strip(),
                )
            )
    doubles = int(precision["n"].max() or 0) if len(precision) else 0  # type: ignore[arg-type]  # a column of integers
    items.append(("Double examinations", str(doubles) if doubles else "none: run rsa-vision precision when there are"))
    items += [(title, given.get(key, f"— set {key} in [report] of study.toml")) for key, title in ASKED.items()]
    items += [(key, value) for key, value in given.items() if key not in ASKED]
    return [{"item": item, "value": value} for item, value in items]
