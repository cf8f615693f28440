"""Names of simulated examinations at the level of points: cage, foci, pairs, verdict, held against the truth.

Each examination draws its cage (1A, 1B, 1B-420, 2, or a user cage of 4 to 12 fiducial marks and 2 to 9 control points at random places),
foci up to 150 mm from nominal, films turned up to 45 deg (one in ten mirrored, and told so; where the cage decides, one in five turned by
any angle, with `orientation = "any"`), gap, tilt, stretch and scale of the film, noise of 0.02 to 0.1 px, up to a third of the fiducial
marks and of the control points of each focus missing, up to 150 false detections (balls, pins and tees, scattered or in lines and heaps),
images that coincide, and 5 to 20 object balls, some hidden from one focus. One film in ten is of another cage, or of none.

`marks suffice` is told from the truth: two thirds of the marks of every focus have an image, at least four and two, the fiducial marks not
nearly on a line; those with an image of their own (not melted with another's, nor where it might be) fix every focus to 10 mm (one sd, by
linear propagation of the true image errors through Selvik's two equations, without any prior); and two coordinates of a film are left over
when the unknowns of the film (nine) and of its foci (three each) are taken away: four and two marks on the film of one focus leave none to
test their names by. `few-fiducials` and `few-controls` are no want of names: four and two marks are all that they were.
`cage named`: of those, examinations whose cage was found without a rival. `markers paired`: of those, examinations without an ambiguous
pair. `silent errors`: examinations that are `ok` and hold a mark or a marker with the image of another one. `beyond 6 sd`: examinations
that are `ok` and hold a marker further from the truth than that. A false detection that looks like a marker is `marker-one-view`: `review`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import polars as pl

from rsa_vision.cages import Cage, Mark, Plane, load_cage
from rsa_vision.examination import ExaminationResult, name_and_reconstruct
from rsa_vision.identify.cage import identify_cage
from rsa_vision.readings import FilmReading
from rsa_vision.settings import Study
from rsa_vision.threads import THREAD_VARIABLES
from rsa_vision.types import MarkerImages
from synthetic.point_films import Exposure, FilmTruth, Objects, Rng, expose, random_exposure, random_objects
from synthetic.sufficient import coordinates_over, focus_sd_mm

CAGES = ("1A", "1B", "1B-420", "2", "user")
KINDS = ("right", "other cage", "no cage")
STRANGE = 0.1  # of the examinations show another cage or none
HIDDEN = 0.02  # chance of a ball to be seen by one focus only, in a third of the examinations; five times that in another third
MOST_FALSE = 150  # half of the films have less than an eighth of them
SLACKS_MM = (0.0, 0.005, 0.01)  # errors of the film that the detector cannot state
PITCH_MM = 0.1
TIMED_DETECTIONS = 300
FOCUS_SD_MM = 10.0  # marks suffice if they tell every focus as well as this
LEAST_OVER = 2  # and if as many coordinates are left over to test their names
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "identification.md"


@dataclass(frozen=True, slots=True)
class Examination:
    """A simulated examination: what is told about it, and what is true."""

    seed: int
    name: str
    kind: str
    cage: Cage
    study: Study
    exposures: tuple[Exposure, ...]
    films: tuple[tuple[int | None, FilmTruth], ...]
    objects: Objects

    @property
    def suffices(self) -> bool:
        """Whether the images that there are can tell the names in principle (see the page), by the truth alone."""
        for (told, film), exposure in zip(self.films, self.exposures, strict=True):
            foci = sorted(self.cage.foci) if told is None else [told]
            error = float(np.hypot(exposure.noise_px * exposure.pitch_mm, exposure.slack_mm))
            alone = {f: film.alone(f) for f in foci}
            for f in foci:
                for role, least in (("fiducial", 4), ("control", 2)):
                    count = len(self.cage.marks_of(f, role))  # type: ignore[arg-type]  # a literal of two
                    if film.visible(f, role) < max(least, count - count // 3):
                        return False
                if film.in_line(self.cage, f) or focus_sd_mm(self.cage, f, exposure.foci_mm[f], alone[f], error) > FOCUS_SD_MM:
                    return False
            if coordinates_over(sum(map(len, alone.values())), len(foci)) < LEAST_OVER:
                return False
        return True


def user_cage(rng: Rng) -> Cage:
    """Return a cage of random marks, no two too close, no three of the first four fiducial marks near a line."""
    shared = rng.random() < 0.5
    shape = str(rng.choice(["ball", "tee"], p=[0.8, 0.2]))
    half, height, post = rng.uniform(60, 130), rng.uniform(150, 350), rng.uniform(100, 200)
    arms = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)) if shape == "tee" else ()

    def places(count: int) -> np.ndarray:
        while True:
            points = np.column_stack([rng.uniform(-half, half, count), rng.uniform(0, height, count)])
            apart = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + 1e3 * np.eye(count)
            wide = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] > 0.6 * half * np.sqrt(count / 4)
            corners = [points[list(t)] for t in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))] if count > 3 else []
            flat = any(abs(np.linalg.det(np.column_stack([c, np.ones(3)]))) < 0.1 * half * height for c in corners)
            if apart.min() > 15 and (count < 4 or (wide and not flat)):
                return points

    def marks(foci: tuple[int, ...], first: int) -> list[Mark]:
        fiducials, controls = places(int(rng.integers(4, 13))), places(int(rng.integers(2, 10)))
        heights = post + rng.uniform(-15, 15, len(controls)) * rng.integers(0, 2)
        xyz = [(x, y, 0.0) for x, y in fiducials] + [(x, y, z) for (x, y), z in zip(controls, heights, strict=True)]
        return [
            Mark(
                number=first + i,
                role="fiducial" if i < len(fiducials) else "control",
                foci=foci,
                shape=shape,  # type: ignore[arg-type]  # a literal
                xyz=(float(p[0]), float(p[1]), float(p[2])),
                diameter=0.8 if shape == "ball" else 0.5,
                length=2.0 if arms else None,
                arms=arms,
            )
            for i, p in enumerate(xyz)
        ]

    base, far = rng.uniform(150, 350), rng.uniform(900, 1400)
    return Cage(
        name="user",
        film="shared" if shared else "separate",
        material="plexiglas",
        calibrated_at_c=23.5,
        foci={1: (-base, height / 2, far), 2: (base, height / 2, far)},
        plane=(Plane(foci=(1, 2), origin=(0.0, 0.0, 0.0), u=(1.0, 0.0, 0.0), v=(0.0, 1.0, 0.0)),),
        mark=tuple(marks((1, 2), 1)),
    )


def draw(seed: int, name: str) -> Examination:
    """Return a random examination."""
    rng = np.random.default_rng([seed, CAGES.index(name)])
    told = user_cage(rng) if name == "user" else load_cage(name)
    kind = str(rng.choice(KINDS, p=[1 - STRANGE, STRANGE / 2, STRANGE / 2]))
    true = told
    if kind == "other cage":
        other = str(rng.choice([c for c in CAGES if c != name or c == "user"]))
        true = user_cage(rng) if other == "user" else load_cage(other)
    objects = random_objects(true, int(rng.integers(5, 21)), rng, hidden=float(rng.choice([0.0, HIDDEN, 5 * HIDDEN])))
    orientation, fixed = "upright", {}
    if rng.random() < 0.1:
        orientation, fixed = "mirrored", {"mirrored": True}
    elif name in ("1A", "user") and rng.random() < 0.2:
        orientation, fixed = "any", {"turn_deg": rng.uniform(-180, 180)}
    foci = random_exposure(rng, true).foci_mm
    films: list[tuple[int | None, FilmTruth]] = []
    exposures = []
    for told_foci in (None,) if told.film == "shared" else tuple(sorted(told.foci)):
        false, slack = int(MOST_FALSE * rng.random() ** 3), float(rng.choice(SLACKS_MM))
        exposure = random_exposure(rng, true, foci_mm=foci, pitch_mm=PITCH_MM, false_images=false, slack_mm=slack, **fixed)
        exposed = tuple(sorted(true.foci)) if true.film == "shared" else ((told_foci or 1),)
        film = expose(true, exposed, exposure, rng, objects)
        if kind == "no cage":
            rows = np.array([source[0] in ("false", "object") for source in film.source], bool)
            film = replace(film, images=film.images.rows(rows), source=[s for s, keep in zip(film.source, rows, strict=True) if keep])
        films.append((told_foci, film))
        exposures.append(exposure)
    study = Study(orientation=orientation)  # type: ignore[arg-type]  # a literal
    return Examination(seed, name, kind, told, study, tuple(exposures), tuple(films), objects)


def measure(exam: Examination) -> ExaminationResult:
    """Name and reconstruct an examination as the program does."""
    films = [
        FilmReading(Path(f"{exam.name}_{exam.seed}_f{focus or ''}"), focus, film.shape, (PITCH_MM, PITCH_MM), "auto", film.images)
        for focus, film in exam.films
    ]
    return name_and_reconstruct(films, exam.study, exam.cage)


def wrong_names(exam: Examination, result: ExaminationResult) -> Iterator[str]:
    """Describe every used mark and every marker that has an image of something else."""
    if result.reconstruction is None or result.source is None:
        return
    points, used = result.points, result.reconstruction.used
    markers: dict[str, list[int]] = {}
    for row in np.flatnonzero(used & (points.role != "unassigned")):
        focus, role, film, image = int(points.focus[row]), str(points.role[row]), exam.films[points.film[row]][1], int(result.source[row])
        if role == "object":
            markers.setdefault(str(points.number[row]), []).append(int(row))
        elif not film.lies_at(image, (focus, role, int(points.number[row]))):
            yield f"focus {focus} {role} {points.number[row]} is {film.source[image]}"
    for number, rows in markers.items():
        if ball_of(exam, result, rows) is None:
            yield f"{number} is {[exam.films[points.film[row]][1].source[int(result.source[row])] for row in rows]}"


def ball_of(exam: Examination, result: ExaminationResult, rows: list[int]) -> int | None:
    """Return the ball whose images all the rows show, None if there is none."""
    points, source = result.points, result.source
    assert source is not None
    for ball in range(len(exam.objects.xyz_mm)):
        names = [(int(points.focus[row]), "object", ball) for row in rows]
        places = [(exam.films[points.film[row]][1], int(source[row])) for row in rows]
        if all(film.lies_at(image, name) and film.shows(image, name) for (film, image), name in zip(places, names, strict=True)):
            return ball
    return None


def furthest_sigma(exam: Examination, result: ExaminationResult) -> float:
    """Return the largest distance of a rightly named marker from the truth in units of its stated error (Mahalanobis)."""
    if result.reconstruction is None:
        return 0.0
    markers, points = result.reconstruction.markers, result.points
    largest = 0.0
    for name, place, covariance in zip(markers.name, markers.position_mm, markers.covariance_mm2, strict=True):
        ball = ball_of(exam, result, np.flatnonzero((points.role == "object") & (points.number == name)).tolist())
        if ball is not None and np.isfinite(place).all():
            error = place - exam.objects.xyz_mm[ball]
            largest = max(largest, float(np.sqrt(error @ np.linalg.solve(covariance, error))))
    return largest


def run(task: tuple[int, str]) -> dict[str, object]:
    """Draw, measure and judge one examination."""
    exam = draw(*task)
    started = time.process_time()
    result = measure(exam)
    seconds = time.process_time() - started
    wrong = list(wrong_names(exam, result)) if exam.kind == "right" else []
    ok = result.verdict.status == "ok"
    return {
        "seed": exam.seed,
        "cage": exam.name,
        "kind": exam.kind,
        "suffices": exam.kind == "right" and exam.suffices,
        "status": result.verdict.status,
        "reasons": ";".join(result.verdict.reasons),
        "messages": " | ".join(result.verdict.messages),
        "wrong": " | ".join(wrong),
        "silent": ok and (bool(wrong) or exam.kind != "right"),
        "beyond": ok and exam.kind == "right" and furthest_sigma(exam, result) > 6,
        "seconds": seconds,
        "detections": max(len(film.images) for _, film in exam.films),
    }


def identification_seconds(name: str, count: int, seed: int) -> list[float]:
    """Return the processor time of naming the cage on films with 300 detections."""
    seconds: list[float] = []
    while len(seconds) < count:
        rng = np.random.default_rng([seed, len(seconds), 7])
        cage = user_cage(rng) if name == "user" else load_cage(name)
        foci = tuple(sorted(cage.foci)) if cage.film == "shared" else (1,)
        film = expose(cage, foci, random_exposure(rng, cage, false_images=400), rng)
        false = np.array([source[0] == "false" for source in film.source])
        few = np.concatenate([np.flatnonzero(~false), np.flatnonzero(false)])[:TIMED_DETECTIONS]
        images: MarkerImages = film.images.rows(rng.permutation(few))
        started = time.process_time()
        identify_cage(images, cage, foci, pitch_mm=(PITCH_MM, PITCH_MM), film_shape=film.shape)
        seconds.append(time.process_time() - started)
    return seconds


def percentage(part: int, whole: int) -> str:
    """Return a part in words and per cent."""
    return f"{part} of {whole} ({100 * part / whole:.1f} %)" if whole else "none"


def summary(name: str, rows: pl.DataFrame, seconds: list[float]) -> dict[str, object]:
    """Return the line of one cage, or of all."""
    right, strange = rows.filter(pl.col("kind") == "right"), rows.filter(pl.col("kind") != "right")
    enough = right.filter(pl.col("suffices"))
    named = enough.filter(~pl.col("reasons").str.contains("cage-") & (pl.col("status") != "failed"))
    status = Counter(right["status"].to_list())
    return {
        "cage": name,
        "examinations": len(right),
        "ok": status["ok"],
        "review": status["review"],
        "failed": status["failed"],
        "silent errors": int(right["silent"].sum()),
        "beyond 6 sd": int(right["beyond"].sum()),
        "marks suffice": len(enough),
        "cage named": percentage(len(named), len(enough)),
        "markers paired": percentage(len(named.filter(~pl.col("reasons").str.contains("pair-"))), len(named)),
        "of another cage or none: ok": f"{int(strange['silent'].sum())} of {len(strange)}",
        "s with 300 detections, median (largest)": f"{np.median(seconds):.2f} ({max(seconds):.2f})",
    }


def main() -> None:
    """Run the benchmark and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=10_000, help="examinations in all")
    parser.add_argument("--seed", type=int, default=0, help="of the first examination of each cage")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--timed", type=int, default=20, help="films of each cage whose time is taken")
    parser.add_argument("--minutes", type=float, default=np.inf, help="stop then; the page says after how many examinations")
    parser.add_argument("--rows", type=Path, help="write what was found of every examination to this CSV file")
    args = parser.parse_args()
    tasks = [(args.seed + k // len(CAGES), CAGES[k % len(CAGES)]) for k in range(args.n)]
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))  # read by the workers' BLAS: threads that wait would count as processor time
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:  # before all else: the others would slow it
        seconds = {name: pool.submit(identification_seconds, name, args.timed, args.seed).result() for name in CAGES}
    found = []
    started = time.perf_counter()
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(run, tasks, chunksize=5):
            found.append(row)
            if row["silent"] or row["beyond"]:
                print(row, flush=True)
            if len(found) % max(args.n // 20, 1) == 0:
                print(f"{len(found)} of {args.n}", flush=True)
            if time.perf_counter() - started > 60 * args.minutes:
                pool.shutdown(wait=False, cancel_futures=True)
                break
    rows = pl.DataFrame(found)
    if args.rows:
        rows.write_csv(args.rows)
    lines = [summary(name, rows.filter(pl.col("cage") == name), seconds[name]) for name in CAGES]
    lines.append(summary("all", rows, [s for some in seconds.values() for s in some]))
    reasons = Counter(code for text in rows.filter(pl.col("suffices"))["reasons"] for code in text.split(";") if code)
    table = pl.DataFrame(lines)
    text = ["# Names at the level of points", "", (__doc__ or "").strip(), ""]
    stopped = "" if len(found) == args.n else f", stopped after {len(found)} of them"
    text += [f"Made by `python benchmarks/identification.py --n {args.n} --seed {args.seed}`{stopped}.", ""]
    text += ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    text += ["| " + " | ".join(str(v) for v in row) + " |" for row in table.rows()]
    text += ["", "Reasons where the marks suffice (an examination may have several):", "", "| reason | examinations |", "|---|---|"]
    text += [f"| `{code}` | {count} |" for code, count in reasons.most_common()]
    PAGE.parent.mkdir(exist_ok=True)
    PAGE.write_text("\n".join([*text, ""]), encoding="utf-8")
    print("\n".join(text[-3 - len(lines) - len(reasons) - 2 :]))


if __name__ == "__main__":
    main()
