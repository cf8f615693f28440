"""Rendered films in, markers out, compared with the truth.

Films of 0.1 mm pitch, 4,000 quanta a pixel, blur sigma 0.1 mm, focal spot 0.7 mm, foci moved by 1 cm, 13 object balls of 0.8 mm. Every
examination is one run of the command line, its processor time that of the whole process.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from synthetic.compare import ExamComparison, compare
from synthetic.study import render_examination

CAGES = ("1A", "1B", "2")
LIMIT_UM = {"1A": 18.0, "1B": 12.0, "2": 6.0}
BACKGROUNDS = {"plain": {}, "bone": {"bone": True, "scatter": 0.2}}
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "reach.md"


def one(cage: str, seed: int, options: dict[str, object], folder: Path) -> tuple[ExamComparison, float]:
    """Render, measure and compare one examination; return the comparison and the CPU seconds of the process."""
    exam = render_examination(cage, rng=np.random.default_rng(seed), **options)  # type: ignore[arg-type]  # a table of keyword options
    films, truth, out = folder / "films", folder / "truth", folder / "out"
    exam.write(films)
    truth.mkdir()
    for name in ("images", "foci", "markers"):
        getattr(exam, name).write_csv(truth / f"{name}.csv")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "rsa_vision", "measure", str(films), "-o", str(out), "--cage", cage]
    subprocess.run(command, check=False, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (result,) = compare(truth, out)
    return result, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Run the benchmark and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--films", type=int, default=10, help="examinations of each cage and background")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    rows = []
    for cage in CAGES:
        for background, options in BACKGROUNDS.items():
            results = []
            for k in range(args.films):
                with tempfile.TemporaryDirectory() as folder:
                    results.append(one(cage, args.seed + k, dict(options), Path(folder)))
            exams = [r for r, _ in results]
            measured = [e for e in exams if e.n_matched]
            squares = sum(e.rms_um**2 * e.n_matched for e in measured)
            matched = sum(e.n_matched for e in measured)
            rows.append(
                {
                    "cage": cage,
                    "background": background,
                    "examinations": len(exams),
                    "ok": sum(e.status == "ok" for e in exams),
                    "reasons of the others": ", ".join(sorted({r for e in exams if e.status != "ok" for r in e.reasons.split(";")})),
                    "silently wrong": sum(e.silently_wrong for e in exams),
                    "markers": f"{matched} of {sum(e.n_true for e in exams)}",
                    "false": sum(e.n_false for e in exams),
                    "RMS 3-D error, um (limit)": f"{np.sqrt(squares / max(matched, 1)):.1f} ({LIMIT_UM[cage]:.0f})",
                    "largest RMS of one": f"{max((e.rms_um for e in measured), default=float('nan')):.1f}",
                    "error / stated sd": f"{np.sqrt(np.mean([e.error_over_sd**2 for e in measured])):.2f}",
                    "CPU s, median (largest)": f"{np.median([s for _, s in results]):.1f} ({max(s for _, s in results):.1f})",
                }
            )
            print(rows[-1], flush=True)
    table = pl.DataFrame(rows)
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    lines += ["| " + " | ".join(str(v) for v in row) + " |" for row in table.rows()]
    PAGE.parent.mkdir(exist_ok=True)
    command = f"python benchmarks/reach.py --films {args.films} --seed {args.seed}"
    text = ["# The main job", "", (__doc__ or "").strip(), "", f"Made by `{command}`.", "", *lines, ""]
    PAGE.write_text("\n".join(text), encoding="utf-8")


if __name__ == "__main__":
    main()
