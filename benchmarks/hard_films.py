"""Names on rendered films that are hard: cage, pairs, verdict, held against the truth.

Films of the cages 1A, 1B and 2 with ten to sixteen balls in bones, with screws, wires, staples and letters in the room, dust and scratches
on the film, two fiducial marks and two control points of each focus hidden (others for each focus), half the light, scatter, and foci 4 cm
from nominal; film response and number of balls vary. They are written, read and measured as the program does.

`named`: examinations that need no help with names: a cage without a rival, every used mark right, and every ball of which each focus has a
detection (within 3 px) paired rightly and without doubt. `silent errors`: examinations that are `ok` and hold a mark, or a marker, with the
image of something else. `beyond 6 sd`: that are `ok` and hold a rightly named marker further from the truth than that.
"""

from __future__ import annotations

import argparse
import os
import pickle
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import polars as pl
from review_cases import Case, review_case, write_page

from rsa_vision.cages import Cage, load_cage
from rsa_vision.examination import ExaminationResult, measure_examination, name_and_reconstruct
from rsa_vision.flags import MarkerFlag
from rsa_vision.images import read_film
from rsa_vision.settings import Study
from synthetic.study import RenderedExamination, render_examination

CAGES = ("1A", "1B", "2")
RESPONSES = ("density", "transmission", "linear", "log")
AMBIGUOUS = int(MarkerFlag.AMBIGUOUS)
HIDDEN = 2  # fiducial marks, and control points, of each focus
FOCUS_SHIFT_MM = 40.0
QUANTA = 2000.0  # half of the usual
NEAR_PX = 3.0  # an image within this is that of a mark
BEYOND_SIGMA = 6.0
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "hard_films.md"


@dataclass(frozen=True, slots=True)
class Truth:
    """Where every mark and ball of an examination is."""

    images: pl.DataFrame
    markers: pl.DataFrame

    def place(self, focus: int, role: str, number: str) -> np.ndarray:
        """Return the image of a mark or ball, (col, row), NaN if it has none."""
        here = (pl.col("focus") == focus) & (pl.col("role") == role) & (pl.col("number") == number)
        found = self.images.filter(here).select("col_px", "row_px").to_numpy()
        return found[0] if len(found) else np.full(2, np.nan)

    @property
    def balls(self) -> list[str]:
        """Names of the balls."""
        return [f"{segment}/{marker}" for segment, marker in self.markers.select("segment", "marker").rows()]

    def xyz_mm(self, ball: str) -> np.ndarray:
        """Return the place of a ball."""
        return self.markers.select("x_mm", "y_mm", "z_mm").to_numpy()[self.balls.index(ball)]


def hidden_marks(cage: Cage, rng: np.random.Generator) -> dict[int, set[int]]:
    """Return the marks of each focus that its exposure does not show."""
    hidden: dict[int, set[int]] = {}
    for focus in sorted(cage.foci):
        groups = (cage.marks_of(focus, "fiducial"), cage.marks_of(focus, "control"))
        hidden[focus] = {int(n) for marks in groups for n in rng.choice([m.number for m in marks], HIDDEN, replace=False)}
    return hidden


def render(seed: int, name: str) -> RenderedExamination:
    """Render one hard examination."""
    rng = np.random.default_rng([seed, CAGES.index(name)])
    cage = load_cage(name)
    return render_examination(
        cage,
        rng=rng,
        exam=f"{seed:012d}",
        n_objects=int(rng.integers(10, 17)),
        focus_shift_mm=FOCUS_SHIFT_MM,
        response=RESPONSES[int(rng.integers(len(RESPONSES)))],
        bits=int(rng.choice([12, 16])),
        quanta=QUANTA,
        scatter=float(rng.choice([0.0, 0.2, 0.4])),
        bone=True,
        clutter=True,
        missing_marks=hidden_marks(cage, rng),
    )


def measure(seed: int, name: str, keep: Path | None) -> tuple[ExaminationResult, Truth, list[np.ndarray]]:
    """Render, write, read and measure one examination; with ``keep``, films and detections are kept and used again.

    The third result is the pixels of the films.
    """
    study, cage = Study(), load_cage(name)
    kept = keep / f"{name}_{seed}.pickle" if keep else None
    if kept and kept.exists():
        films, truth = pickle.loads(kept.read_bytes())
        return name_and_reconstruct(films, study, cage), truth, [read_film(film.path).values for film in films]
    rendered = render(seed, name)
    truth = Truth(rendered.images, rendered.markers)
    with tempfile.TemporaryDirectory() as folder:
        paths = rendered.write(keep / f"{name}_{seed}" if keep else Path(folder))
        exposed = [
            (read_film(path), foci[0] if len(foci) == 1 else None) for path, foci in zip(paths, rendered.film_foci.values(), strict=True)
        ]
        result = measure_examination(exposed, study, cage)
    if kept:
        kept.write_bytes(pickle.dumps((result.films, truth)))
    return result, truth, [film.values for film, _ in exposed]


def wrong_names(result: ExaminationResult, truth: Truth) -> Iterator[str]:
    """Describe every used mark and every marker that has an image of something else."""
    if result.reconstruction is None:
        return
    points, used = result.points, result.reconstruction.used
    for row in np.flatnonzero(used & np.isin(points.role, ["fiducial", "control"])):
        focus, role, number = int(points.focus[row]), str(points.role[row]), str(points.number[row])
        away = float(np.hypot(*(points.position_px[row] - truth.place(focus, role, number))))
        if not away < NEAR_PX:
            yield f"focus {focus} {role} {number} is {away:.1f} px away"
    for number, rows in markers_of(result).items():
        if ball_of(result, truth, rows) is None:
            each = [ball for row in rows for ball in [*_balls_at(result, truth, row), "something else"][:1]]
            yield f"{number} is {' with '.join(each)}"


def markers_of(result: ExaminationResult) -> dict[str, list[int]]:
    """Return the rows of every marker."""
    points = result.points
    rows: dict[str, list[int]] = {}
    for row in np.flatnonzero(points.role == "object"):
        rows.setdefault(str(points.number[row]), []).append(int(row))
    return rows


def _balls_at(result: ExaminationResult, truth: Truth, row: int) -> list[str]:
    focus, place = int(result.points.focus[row]), result.points.position_px[row]
    return [ball for ball in truth.balls if np.hypot(*(place - truth.place(focus, "object", ball))) < NEAR_PX]


def ball_of(result: ExaminationResult, truth: Truth, rows: list[int]) -> str | None:
    """Return the ball whose images all the rows show, None if there is none."""
    each = [set(_balls_at(result, truth, row)) for row in rows]
    return next(iter(sorted(set.intersection(*each))), None)


def not_named(result: ExaminationResult, truth: Truth) -> Iterator[str]:
    """Name the balls of which every focus has a detection, and which are not markers without doubt."""
    points = result.points
    rows = markers_of(result)
    doubted = {str(number) for number, flags in zip(points.number, points.flags, strict=True) if flags & AMBIGUOUS}
    named = {ball_of(result, truth, mine) for number, mine in rows.items() if number not in doubted}
    foci = sorted(set(truth.images["focus"].to_list()))
    files = [film.path.name for film in result.films]
    for ball in truth.balls:
        seen = []
        for focus in foci:
            image = truth.images.filter((pl.col("focus") == focus) & (pl.col("role") == "object") & (pl.col("number") == ball))
            if image.height:
                here = points.position_px[points.film == files.index(str(image["file"][0]))]
                seen.append(bool((np.hypot(*(here - truth.place(focus, "object", ball)).T) < NEAR_PX).any()))
        if len(seen) == len(foci) and all(seen) and ball not in named:
            yield ball


def furthest_sigma(result: ExaminationResult, truth: Truth) -> float:
    """Return the largest distance of a rightly named marker from the truth in units of its stated error (Mahalanobis)."""
    if result.reconstruction is None:
        return 0.0
    markers, rows = result.reconstruction.markers, markers_of(result)
    largest = 0.0
    for name, place, covariance in zip(markers.name, markers.position_mm, markers.covariance_mm2, strict=True):
        ball = ball_of(result, truth, rows.get(str(name), [])) if str(name) in rows else None
        if ball is not None and np.isfinite(place).all():
            error = place - truth.xyz_mm(ball)
            largest = max(largest, float(np.sqrt(error @ np.linalg.solve(covariance, error))))
    return largest


def run(task: tuple[int, str, Path | None]) -> dict[str, object]:
    """Render, measure and judge one examination."""
    seed, name, keep = task
    result, truth, values = measure(seed, name, keep)
    wrong, lost = list(wrong_names(result, truth)), list(not_named(result, truth))
    reasons = result.verdict.reasons
    ok, furthest = result.verdict.status == "ok", furthest_sigma(result, truth)
    decided = result.verdict.status != "failed" and "cage-ambiguous" not in reasons
    return {
        "cage": name,
        "seed": seed,
        "status": result.verdict.status,
        "reasons": ";".join(reasons),
        "messages": " | ".join(result.verdict.messages),
        "wrong": " | ".join(wrong),
        "lost": " | ".join(lost),
        "balls": len(truth.balls),
        "markers": len(markers_of(result)),
        "named": decided and not wrong and not lost,
        "silent": ok and bool(wrong),
        "beyond": ok and furthest > BEYOND_SIGMA,
        "furthest": furthest,
        "detections": max(len(film.images) for film in result.films),
        "case": review_case(f"cage {name}, seed {seed}", result, values, lambda row: told(result, truth, row)),
    }


def told(result: ExaminationResult, truth: Truth, row: int) -> str:
    """Say what an image shows, and whether the other foci have a detection of the same."""
    balls = _balls_at(result, truth, row)
    if not balls:
        return "no ball"
    images = truth.images.filter((pl.col("role") == "object") & (pl.col("number") == balls[0]))
    missing = []
    files = [film.path.name for film in result.films]
    for file, focus, col, line in images.select("file", "focus", "col_px", "row_px").rows():
        here = result.points.position_px[result.points.film == files.index(file)]
        if not (np.hypot(*(here - [col, line]).T) < NEAR_PX).any():
            missing.append(f"focus {focus}")
    return f"ball {balls[0]}" + (f", which was not detected of {' and '.join(missing)}" if missing else "")


def summary(name: str, rows: pl.DataFrame) -> dict[str, object]:
    """Return the line of one cage, or of all."""
    status = Counter(rows["status"].to_list())
    return {
        "cage": name,
        "examinations": len(rows),
        "ok": status["ok"],
        "review": status["review"],
        "failed": status["failed"],
        "named": f"{int(rows['named'].sum())} of {len(rows)} ({100 * rows['named'].mean():.0f} %)",
        "silent errors": int(rows["silent"].sum()),
        "beyond 6 sd": int(rows["beyond"].sum()),
        "wrong names in review": len(rows.filter((pl.col("status") == "review") & (pl.col("wrong") != ""))),
        "balls": int(rows["balls"].sum()),
        "markers": int(rows["markers"].sum()),
    }


def main() -> None:
    """Run the benchmark and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=34, help="examinations of each cage")
    parser.add_argument("--seed", type=int, default=0, help="of the first examination")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep", type=Path, help="keep films and detections here, and use them again")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop after the examination that is under way then")
    parser.add_argument("--no-page", action="store_true", help="print only")
    args = parser.parse_args()
    if args.keep:
        args.keep.mkdir(parents=True, exist_ok=True)
    tasks = [(args.seed + k, name, args.keep) for k in range(args.n) for name in CAGES]
    found: list[dict[str, object]] = []
    cases: list[Case] = []
    started = perf_counter()
    with ProcessPoolExecutor(args.jobs) as pool:
        for row in pool.map(run, tasks):
            case = row.pop("case")
            cases += [case] if isinstance(case, Case) else []
            found.append(row)
            print({key: value for key, value in row.items() if value not in ("", False)}, flush=True)
            if perf_counter() - started > 60 * args.minutes:
                pool.shutdown(wait=False, cancel_futures=True)
                break
    rows = pl.DataFrame(found)
    table = pl.DataFrame([*(summary(name, rows.filter(pl.col("cage") == name)) for name in CAGES), summary("all", rows)])
    reasons = Counter(code for text in rows["reasons"] for code in text.split(";") if code)
    text = ["# Names on hard films", "", (__doc__ or "").strip(), ""]
    command = f"python benchmarks/hard_films.py --n {args.n} --seed {args.seed}"
    stopped = "" if len(found) == len(tasks) else f", stopped after {len(found)} of {len(tasks)} examinations"
    text += [f"Made by `{command}`{stopped}. Some that were sent to review: [pictures](review_cases.md).", ""]
    text += ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    text += ["| " + " | ".join(str(v) for v in row) + " |" for row in table.rows()]
    text += ["", "Reasons (an examination may have several):", "", "| reason | examinations |", "|---|---|"]
    text += [f"| `{code}` | {count} |" for code, count in reasons.most_common()]
    if not args.no_page:
        PAGE.write_text("\n".join([*text, ""]), encoding="utf-8")
        write_page(cases, len(found), command)
    print("\n".join(text[5:]))


if __name__ == "__main__":
    main()
