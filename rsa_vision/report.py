"""``report.html``: one self-contained page made from the files in OUT alone."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import jinja2
import numpy as np
import polars as pl

from rsa_vision.cages import Cage
from rsa_vision.flags import REASONS
from rsa_vision.report_motion import motion_section
from rsa_vision.store import picture_path, read_record, read_run, read_tables, record_path, write_atomic
from rsa_vision.tables import Row
from rsa_vision.types import Float

COLOURS: Final = ("#0a9bff", "#ff8000", "#b45cf0", "#4caf50")  # of the foci; the first two are told apart by colour-blind readers too
MOST_PICTURED: Final = 60  # examinations with pictures; of more, those that are not ok come first
SYMBOL_SHARE: Final = 1 / 130  # size of a symbol on the longest side of a film
LABEL_SHARE: Final = 0.06  # of a film's width, for a label
RUN_KEYS: Final = ("source", "cage", "calibration", "start", "end", "rsa_vision", "host", "system", "python")
PLOT_PX: Final = (460, 330)
LONGEST_ARROW: Final = 0.13  # of the plot's width


def write_report(out: Path) -> Path:
    """Write the report of a results folder.

    Parameters
    ----------
    out : Path
        Folder that ``measure`` or ``reconstruct`` has written.

    Returns
    -------
    Path
        ``OUT/report.html``.

    Raises
    ------
    UsageError
        If there are no results, or the page cannot be written.
    """
    tables, run = read_tables(out), read_run(out)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rsa_vision"), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["number"] = _number
    exams = tables["exams"].to_dicts()
    pictured = _pictured(exams)
    cage = _cage(run)
    sections = [_section(out, exam, tables, cage, index in pictured) for index, exam in enumerate(exams)]
    page = environment.get_template("report.html").render(
        run={**dict.fromkeys(RUN_KEYS), **run},
        exams=sections,
        counts={status: sum(exam["status"] == status for exam in exams) for status in ("ok", "review", "failed")},
        reasons=REASONS,
        colours=COLOURS,
        all_pictured=len(pictured) == len(exams),
        limits=run.get("settings", {}).get("limits", {}),
        motion=motion_section(out, run.get("settings", {})),
    )
    path = out / "report.html"
    write_atomic(path, page.encode())
    return path


def _pictured(exams: Sequence[Row]) -> set[int]:
    order = sorted(range(len(exams)), key=lambda index: (exams[index]["status"] == "ok", index))
    return set(order[:MOST_PICTURED])


def _cage(run: Mapping[str, Any]) -> Cage | None:
    content = run.get("cage", {}).get("content")
    return Cage.model_validate(content).at_temperature(run["settings"].get("temperature_c")) if content else None


def _section(out: Path, exam: Row, tables: Mapping[str, pl.DataFrame], cage: Cage | None, pictured: bool) -> dict[str, Any]:
    mine = {name: _of(table, exam).to_dicts() for name, table in tables.items() if name != "exams"}
    path = record_path(out, exam["subject"], exam["exam"] or "")
    record = (read_record(path) if pictured else None) or {}
    films = [
        _film(about, [row for row in mine["images"] if row["file"] == about["file"]], picture_path(path, index))
        for index, about in enumerate(record.get("films", []))
        if any(about["file"] == name for name in (exam["files"] or "").split(";"))
    ]
    return {
        **exam,
        "anchor": path.stem,
        "codes": [code for code in (exam["reasons"] or "").split(";") if code],
        "messages": [text for text in (exam["message"] or "").split(" | ") if text],
        "foci": mine["foci"],
        "markers": mine["markers"],
        "films": films,
        "plots": _plots(mine["images"], mine["foci"], cage) if cage and pictured else [],
    }


def _of(table: pl.DataFrame, exam: Row) -> pl.DataFrame:
    # an unnamed film has an empty examination, which CSV does not tell from none
    return table.filter((pl.col("subject") == exam["subject"]) & (pl.col("exam").fill_null("") == (exam["exam"] or "")))


def _film(about: Mapping[str, Any], rows: Sequence[Row], picture: Path) -> dict[str, Any]:
    try:
        source = "data:image/jpeg;base64," + base64.b64encode(picture.read_bytes()).decode()
    except OSError:
        source = ""
    size = max(about["rows"], about["cols"]) * SYMBOL_SHARE
    order = {"unassigned": 0, "object": 1, "control": 2, "fiducial": 3}
    symbols = [_symbol(row, size, about["cols"]) for row in sorted(rows, key=lambda row: order[row["role"]]) if row["col_px"] is not None]
    return {**about, "source": source, "size": size, "symbols": symbols}


def _symbol(row: Row, size: float, cols: int) -> dict[str, Any]:
    focus = row["focus"] or 0
    unassigned = row["role"] == "unassigned"
    reach = max(size, (row["radius_px"] or 0.0) * 1.6)
    title = "unassigned" if unassigned else f"{row['role']} {row['number']} of focus {focus}"
    title += f", {row['shape']} at col {_number(row['col_px'], 2)}, row {_number(row['row_px'], 2)} px"
    title += f" (sd {_number(row['sd_col_px'], 3)}, {_number(row['sd_row_px'], 3)})"
    if row["residual_um"] is not None:
        title += f"; residual {_number(row['residual_um'], 0)} um"
    if not unassigned and not row["used"]:
        title += "; not used"
    if row["flags"]:
        title += f"; {row['flags']}"
    # labels of the foci of a shared film stand on different sides, so that they do not cover each other, but on the film
    side = -1 if focus % 2 == 0 else 1
    if not LABEL_SHARE < row["col_px"] / cols < 1 - LABEL_SHARE:
        side = 1 if row["col_px"] < cols / 2 else -1
    return {
        "x": row["col_px"],
        "y": row["row_px"],
        "r": reach,
        "role": row["role"],
        "colour": "#ff4d6d" if unassigned else COLOURS[(focus - 1) % len(COLOURS)],
        "label": "" if unassigned else row["number"],
        "dashed": not unassigned and not row["used"],
        "side": side,
        "title": title,
    }


def _plots(images: Sequence[Row], foci: Sequence[Row], cage: Cage) -> list[dict[str, Any]]:
    plots = []
    for focus in foci:
        rows = [
            row for row in images if row["focus"] == focus["focus"] and row["role"] in ("fiducial", "control") and row["x_mm"] is not None
        ]
        if rows:
            plots.append(_residual_plot(rows, focus, cage))
    return plots


def _residual_plot(rows: Sequence[Row], focus: Row, cage: Cage) -> dict[str, Any]:
    """Arrows from where the marks should be in the fiducial plane to where they were found, enlarged."""
    number = focus["focus"]
    origin, basis = cage.plane_of(number).lab_from_plane()
    place = np.array([focus["x_mm"], focus["y_mm"], focus["z_mm"]])
    given = {(mark.role, str(mark.number)): np.array(mark.xyz) for mark in cage.mark if number in mark.foci}
    known = [row for row in rows if (row["role"], row["number"]) in given]
    found = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in known])
    wanted = np.array([_shadow(given[row["role"], row["number"]], place, origin, basis) for row in known])
    start, shift = (wanted - origin) @ basis.T, (found - wanted) @ basis.T
    width, height = PLOT_PX
    low, high = start.min(axis=0), start.max(axis=0)
    scale = float(min((np.array([width, height]) * 0.74 / np.maximum(high - low, 1.0)).tolist()))
    used = np.array([bool(row["used"]) for row in known])
    lengths = np.linalg.norm(shift, axis=1)
    longest = float(lengths[used].max()) if used.any() else float(lengths.max())
    exaggeration = _round_down(LONGEST_ARROW * width / (max(longest, 1e-9) * scale))
    bar_um = _round_down(0.25 * width / (exaggeration * scale) * 1000)
    middle = (low + high) / 2
    arrows = []
    for row, (u, v), (du, dv), length in zip(known, start, shift, lengths, strict=True):
        x, y = width / 2 + (u - middle[0]) * scale, height / 2 - (v - middle[1]) * scale
        reach = scale * min(exaggeration, LONGEST_ARROW * 2 * width / (max(float(length), 1e-9) * scale))
        state = "" if row["used"] else ", not used"
        title = f"{row['role']} {row['number']}{state}: {length * 1000:.0f} um in the plane"
        arrows.append({"x": x, "y": y, "dx": du * reach, "dy": -dv * reach, "role": row["role"], "label": row["number"], "title": title})
        arrows[-1]["dashed"] = not row["used"]
    return {"focus": number, "arrows": arrows, "width": width, "height": height, "exaggeration": exaggeration} | {
        "colour": COLOURS[(number - 1) % len(COLOURS)],
        "bar_um": bar_um,
        "bar_px": bar_um / 1000 * exaggeration * scale,
    }


def _shadow(point: Float, focus: Float, origin: Float, basis: Float) -> Float:
    """Return where the ray from a focus through a point meets the fiducial plane; a fiducial mark is its own shadow."""
    normal = np.cross(basis[0], basis[1])
    height = float((point - origin) @ normal)
    top = float((focus - origin) @ normal)
    result: Float = point + (point - focus) * (height / (top - height))
    return result


def _round_down(value: float) -> float:
    """Return the next lower of 1, 2, 5, 10, 20 ..."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"  # + 0.0: no "-0"
