"""The commands that start from markers: motion, growth, precision, export."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rsa_vision.api_motion import MotionSummary

Source = Annotated[Path, typer.Argument(metavar="OUT_OR_CSV", help="Folder of results, or a CSV file of markers.")]
Out = Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the results; default: beside the input.")]
Reference = Annotated[str | None, typer.Option("--reference", help="Segment to which the others move; default: the first one.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    for command in (motion, growth, precision, export):
        app.command()(command)


def motion(
    source: Source,
    out: Out = None,
    reference: Reference = None,
    side: Annotated[str | None, typer.Option("--side", help="left or right; x of a left limb is mirrored.", metavar="left|right")] = None,
    study: Annotated[Path | None, typer.Option("--study", help="Study file; default: the settings of the run.")] = None,
) -> int:
    """Motion of segments between examinations: KINEMA."""
    from rsa_vision import api

    summary = api.motion(source, out, reference=reference, side=side, study=study)
    for row in summary.table.filter(summary.table["status"] != "ok").iter_rows(named=True):
        against = f" against {row['reference']}" if row["reference"] else ""
        name = f"{row['subject'] or ''} {row['segment']}{against} {row['exam_from']} -> {row['exam_to']}".strip()
        print(f"{name}: {row['status']} ({row['reasons']})")
    _finish(summary, "motion", "motion.csv")
    return summary.exit_code


def growth(
    source: Source,
    standard: Annotated[Path | None, typer.Option("--standard", help="CSV file with the given coordinates of the points.")] = None,
    out: Out = None,
    temperature_c: Annotated[float | None, typer.Option("--temperature-c", help="Temperature of the cage.")] = None,
    calibrated_at_c: Annotated[float, typer.Option("--calibrated-at-c", help="Temperature of its calibration.")] = 23.5,
    material: Annotated[str, typer.Option("--material", help="Of the cage: plexiglas, mirror-glass, quartz-glass.")] = "plexiglas",
) -> int:
    """All lengths between points, at two times or against a standard: GROWTH."""
    from rsa_vision import api

    summary = api.growth(source, out, standard=standard, temperature_c=temperature_c, calibrated_at_c=calibrated_at_c, material=material)
    for row in summary.table.iter_rows(named=True):
        name = f"{row['subject'] or ''} {row['exam_from']} -> {row['exam_to']}".strip()
        if row["status"] != "ok":
            print(f"{name}: {row['status']} ({row['reasons']})")
        if row["rmsv_um"] is None:
            continue
        more = "" if row["s0_um"] is None else f", s0 {row['s0_um']:.1f} um, scale {row['scale_ppm']:+.0f} ppm"
        print(f"{name}: {row['n_lengths']} lengths, RMSV {row['rmsv_um']:.1f} um{more}")
    print(f"-> {summary.out / 'growth.csv'}")
    return summary.exit_code


def precision(source: Source, out: Out = None, reference: Reference = None) -> int:
    """Precision from double examinations."""
    from rsa_vision import api

    summary = api.precision(source, out, reference=reference)
    for row in summary.table.filter(summary.table["kind"] == "motion").iter_rows(named=True):
        if row["n"]:
            against = f" against {row['reference']}" if row["reference"] else ""
            spread = "" if row["sd"] is None else f"  sd {row['sd']:.4f}  1.96 sd {row['limit_95']:.4f}"
            name = f"{row['segment']}{against} {row['parameter']}"
            print(f"{name}: n {row['n']}  mean {row['mean']:.4f}{spread}  from zero {row['from_zero']:.4f}")
    _finish(summary, "line", "precision.csv")
    return int(bool((summary.table["n_left_out"] > 0).any()))


def export(
    source: Source,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    format_name: Annotated[
        str | None, typer.Option("--format", help="Default: by the suffix of the file.", metavar="trc|c3d|xmalab")
    ] = None,
    subject: Annotated[str | None, typer.Option("--subject", help="Needed where there are several.")] = None,
) -> int:
    """Write markers for programs of motion analysis: each examination is a frame."""
    from rsa_vision import api

    frames = api.export(source, out, format_name=format_name, subject=subject)
    missing = f", {frames.n_missing} places missing" if frames.n_missing else ""
    print(f"{len(frames.names)} markers in {len(frames.exams)} frames{missing} -> {out}")
    return 0


def _finish(summary: MotionSummary, noun: str, file: str) -> None:
    if summary.unnamed:
        print(f"{summary.unnamed} markers without a segment were left out", file=sys.stderr)
    n = len(summary.table)
    if not n:
        print("nothing to compare: no subject has two examinations with the same segment or points", file=sys.stderr)
    counts = [f"{summary.count(status)} {status}" for status in ("ok", "review", "failed")] if "status" in summary.table.columns else []
    print(f"{n} {noun}{'s' if n != 1 else ''}{': ' if counts else ''}{', '.join(counts)} -> {summary.out / file}")
