"""Measure a folder of films and print every marker with its uncertainty.

    python examples/measure_folder.py FOLDER OUT [CAGE]

Without CAGE the folder needs a study.toml that names it.
"""

from __future__ import annotations

import sys

import polars as pl

import rsa_vision


def main(folder: str, out: str, cage: str | None = None) -> int:
    """Measure, print, and return the exit code of the command line."""
    summary = rsa_vision.measure(folder, out, cage=cage)
    for outcome in summary.outcomes:
        print(f"{outcome.subject} {outcome.exam}: {outcome.status} {outcome.reasons}")
    names = {"exam": pl.String, "segment": pl.String, "marker": pl.String, "flags": pl.String}
    for row in pl.read_csv(summary.out / "markers.csv", schema_overrides=names).iter_rows(named=True):
        if row["x_mm"] is None:
            print(f"{row['exam']} {row['marker']}: no coordinates ({row['flags']})")
            continue
        place = "  ".join(f"{axis} {row[f'{axis}_mm']:9.4f} +- {row[f'sd_{axis}_mm']:.4f}" for axis in "xyz")
        print(f"{row['exam']} {row['marker']}: {place} mm")
    return summary.exit_code


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:]))
    except rsa_vision.RsaError as error:  # its message says what to do
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
