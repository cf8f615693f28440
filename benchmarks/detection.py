"""Marker images against the Cramér-Rao bound, stated against true errors, and against the detectors that others use.

Films of 1500 x 1500 pixels with 49 marks (pairs: 36 sites) at random fractions of a pixel, blur sigma 0.8 to 1.5 px, half of the
exposure scattered. Balls are of 0.8 mm tantalum, pins and tees those of cage 1A (0.5 mm, full cones of 2 mm), at the pitch that gives the
radius; among pins, tees and pairs every fourth mark is a single ball, which is not measured. CNR: largest departure of a mark from its
background over the noise of one pixel. RMS errors are of one coordinate. The bound is that of the noise model with position, amplitude, the
background's level and slopes, and for balls the radius, for pins and tees direction, half width and length estimated; other variants have
their columns. On bone the bound knows nothing of the background's curvature, and real estimators cannot reach it.

*robust*: the same ratio from the median instead of the mean square. *flagged*: with any flag but `overlap`; *beyond 4 sd, unflagged*: the
confident wrong ones. Rivals measure the first film only. On pins and tees they are given the direction and the constant part of their
error, so that their ratio can be below 1, and only detections beyond one for each pin, arm and ball count as false.

Of the pig's beads, labelled by hand in half pixels, *SD about the epipolar geometry* is that of one coordinate in all frames, with one
fundamental matrix for them: no label enters ours, and what it comes to over what we state should be one.
From labels that scatter by *s* in each coordinate a detector without any error is 1.18 *s* away in the median.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from marker_films import VARIANTS, Case, Float, TestFilm, make_film
from real_films import real_tables
from rivals import RIVALS, Rival, eight_bit

from rsa_vision.detect import detect_markers
from rsa_vision.flags import MarkerFlag

DOCS = Path(__file__).parents[1] / "docs" / "benchmarks"
NEAR_PX = 2.0  # farther than this, or than half the radius, from every mark: not that mark
CNRS = (50.0, 20.0, 10.0, 5.0)
RADII = (2.5, 3.5, 5.0, 8.0, 12.0)


@dataclass(frozen=True, eq=False)
class Score:
    """What one detector did on one film; errors and bounds of the marks that it found."""

    film: TestFilm
    error_px: Float  # (n, 2)
    bound_px2: dict[str, Float]
    covariance_px2: Float | None
    flags: Float
    n_true: int
    n_false: int
    n_misnamed: int
    seconds: float


def match(film: TestFilm, found: Float) -> tuple[Float, Float, int]:
    """Pair marks and detections that are each other's nearest; return the indices of both and how many detections are near no mark."""
    every = np.vstack([film.position_px, film.companions_px])
    near = max(NEAR_PX, 0.5 * film.case.radius_px) if film.case.shape in ("ball", "pair") else film.case.length_px / 3
    if len(found) == 0:
        return np.zeros(0, int), np.zeros(0, int), 0
    gap = np.hypot(*(every[:, None] - found[None]).transpose(2, 0, 1))
    mark, nearest = np.arange(len(every)), gap.argmin(1)
    mutual = (gap.argmin(0)[nearest] == mark) & (gap[mark, nearest] < near)
    own = mutual[: len(film.position_px)]
    return np.nonzero(own)[0], nearest[: len(own)][own], len(found) - int(mutual.sum())


def ours(film: TestFilm) -> Score:
    """Score ``detect_markers``, which is told nothing but the bits."""
    start = time.process_time()
    images = detect_markers(film.values, bits=film.case.bits).images
    seconds = time.process_time() - start
    marks, rows, n_false = match(film, images.position_px)
    shape = "ball" if film.case.shape == "pair" else film.case.shape
    return Score(
        film,
        images.position_px[rows] - film.position_px[marks],
        {name: bound[marks] for name, bound in film.bound_px2.items()},
        images.covariance_px2[rows],
        images.flags[rows],
        len(film.position_px),
        n_false,
        int((images.shape[rows] != shape).sum()),
        seconds,
    )


def theirs(film: TestFilm, rival: Rival) -> Score:
    """Score a rival; of pins and the stems of tees it sees the thick end, and is given its constant offset from the tip."""
    case = film.case
    start = time.process_time()
    found = rival(film.values, case.radius_px, film.brighter)
    seconds = time.process_time() - start
    pointed = case.shape in ("pin", "tee")
    if pointed:
        found = found - 0.75 * case.length_px * np.array([np.cos(film.turn), -np.sin(film.turn)])
    marks, rows, n_false = match(film, found)
    error = found[rows] - film.position_px[marks]
    if pointed and len(error):
        error = error - np.median(error, axis=0)
        n_false = max(0, n_false - len(film.companions_px) - (2 * len(film.position_px) if case.shape == "tee" else 0))
    bound = {name: b[marks] for name, b in film.bound_px2.items()}
    return Score(film, error, bound, None, np.zeros(len(rows)), len(film.position_px), n_false, 0, seconds)


def summary(scores: list[Score]) -> dict[str, object]:
    """Return the figures of one row: pooled over films."""
    error = np.vstack([s.error_px for s in scores])
    n, n_true, n_false = len(error), sum(s.n_true for s in scores), sum(s.n_false for s in scores)
    out: dict[str, object] = {"found": f"{n} of {n_true}", "false a film": f"{n_false / len(scores):.2f}"}
    if n < 5:
        return out
    for k, name in enumerate(VARIANTS[scores[0].film.case.shape]):
        bound = np.vstack([s.bound_px2[name] for s in scores])
        trace = float(np.trace(bound, axis1=1, axis2=2).mean())
        if k == 0:
            out |= {"bound, px": f"{np.sqrt(trace / 2):.4f}", "RMS, px": f"{np.sqrt((error**2).mean()):.4f}"}
            out["RMS / bound"] = f"{np.sqrt((error**2).sum(1).mean() / trace):.2f}"
            out["robust"] = f"{np.sqrt(np.median(_squares(error, bound)) / (2 * np.log(2))):.2f}"
        else:
            out[f"RMS / bound ({name})"] = f"{np.sqrt((error**2).sum(1).mean() / trace):.2f}"
    if all(s.covariance_px2 is not None for s in scores):
        covariance = np.vstack([s.covariance_px2 for s in scores if s.covariance_px2 is not None])
        square = _squares(error, covariance)
        flagged = np.concatenate([s.flags for s in scores]).astype(int) & ~int(MarkerFlag.OVERLAP) != 0
        out["error / sd"] = f"{np.sqrt(square.mean() / 2):.2f}"
        out["robust e/sd"] = f"{np.sqrt(np.median(square) / (2 * np.log(2))):.2f}"
        out["beyond 4 sd, unflagged"] = int((square[~flagged] > 16).sum())
        out["flagged"] = int(flagged.sum())
        out["other shape"] = sum(s.n_misnamed for s in scores)
    out["CPU s"] = f"{np.median([s.seconds for s in scores]):.2f}"
    return out


def _squares(error: Float, covariance: Float) -> Float:
    return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0]))


Rows = list[dict[str, object]]


def sweep(cases: Iterable[tuple[dict[str, object], Case]], films: int, seed: int, rivals_at: Callable[[Case], bool]) -> Rows:
    """Score all cases, where wanted also the rivals, on the first film; every row begins with its own labels."""
    rows: Rows = []
    for label, case in cases:
        made = [make_film(case, seed + k) for k in range(films)]
        rows.append({**label, "detector": "ours", **summary([ours(f) for f in made])})
        print(rows[-1], flush=True)
        for name, rival in RIVALS.items() if rivals_at(case) else ():
            rows.append({**label, "detector": name, **summary([theirs(f, rival) for f in made[:1]])})
            print(rows[-1], flush=True)
    return rows


LARGE = {
    "64 balls": Case("ball", 4.0, 20.0, "bone", "screen", "density", 16, side_px=(4000, 4750), across=8),
    "48 tees and 16 balls": Case("tee", 2.5, 20.0, "bone", "screen", "density", 16, side_px=(4000, 4750), across=8, companions=True),
    "48 pins and 16 balls": Case("pin", 2.5, 20.0, "bone", "screen", "density", 16, side_px=(4000, 4750), across=8, companions=True),
}


def _large_film(name: str) -> TestFilm:
    return make_film(LARGE[name], 1)


def speed(repeats: int) -> Rows:
    """Time large films on one thread, against SimpleBlobDetector as OpenCV sets it up, and measure memory in processes of their own.

    The first run on a film makes the tables of its blur and attenuation; the others find them ready.
    """

    def seconds(what: Callable[[], object]) -> float:
        times = []
        for _ in range(repeats):
            start = time.process_time()
            what()
            times.append(time.process_time() - start)
        return min(times)

    rows: Rows = []
    for name in LARGE:
        film = _large_film(name)
        image = eight_bit(film.values)
        p = cv2.SimpleBlobDetector_Params()
        p.blobColor = 255 if film.brighter else 0
        blob = cv2.SimpleBlobDetector_create(p)
        score = ours(film)
        best = seconds(partial(detect_markers, film.values, bits=16))
        rows.append({"film": name, "detector": "ours", "s": f"{best:.2f}", "s, first run": f"{score.seconds:.2f}"})
        rows[-1] |= {"found": f"{len(score.error_px)} of {score.n_true}", "false": score.n_false}
        peak = int(subprocess.run([sys.executable, __file__, "--memory", name], check=True, capture_output=True, text=True).stdout)
        ratio = peak / film.values.nbytes
        rows[-1] |= {"memory it adds / stored film": f"{ratio:.2f}", "film and that / stored film": f"{1 + ratio:.2f}"}
        given = seconds(partial(blob.detect, image))
        rows.append({"film": name, "detector": "SimpleBlobDetector, 8-bit film given", "s": f"{given:.2f}"})

        def both(blob: cv2.SimpleBlobDetector = blob, film: TestFilm = film) -> object:
            return blob.detect(eight_bit(film.values))

        whole = seconds(both)
        rows.append({"film": name, "detector": "SimpleBlobDetector, with the way to 8 bits", "s": f"{whole:.2f}"})
    for row in rows:
        print(row, flush=True)
    return rows


def memory(name: str) -> None:
    """Print the bytes by which the peak of this process grows while a large film is measured."""
    path = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path.cwd()
    path = path / f"large_film_{time.time_ns()}.npy"
    make = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import detection, numpy; "
    make += f"numpy.save({str(path)!r}, detection._large_film({name!r}).values)"
    subprocess.run([sys.executable, "-c", make], check=True)  # rendering takes more memory than measuring: in a process of its own
    try:
        detect_markers(make_film(Case(side_px=(300, 300), across=2), 1).values, bits=16)  # what is loaded once is not the film's
        film = np.load(path)
    finally:
        path.unlink()
    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts anew; ru_maxrss would still hold that of the parent
    before = _status_bytes("VmRSS")
    detect_markers(film, bits=16)
    print(_status_bytes("VmHWM") - before)


def _status_bytes(name: str) -> int:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


def table(rows: Rows) -> str:
    """Return a Markdown table whose columns are the union of the rows' keys."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    columns.sort(key=lambda c: ["CPU s"].count(c))
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join(lines + ["| " + " | ".join(str(row.get(c, "")) for c in columns) + " |" for row in rows])


def figure(balls: Rows, path: Path) -> None:
    """Draw RMS errors against CNR, with the bound, a panel for each radius."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "detection"
    from matplotlib import pyplot as plt

    radii = list(dict.fromkeys(row["radius, px"] for row in balls))
    fig, axes = plt.subplots(1, len(radii), figsize=(2.4 * len(radii) + 1.5, 3.2), sharey=True, squeeze=False)
    for ax, radius in zip(axes[0], radii, strict=True):
        mine = [row for row in balls if row["radius, px"] == radius and "RMS, px" in row]
        for name in dict.fromkeys(row["detector"] for row in mine):
            points = [(float(str(r["CNR"])), float(str(r["RMS, px"]))) for r in mine if r["detector"] == name]
            ax.loglog(*zip(*points, strict=True), "o-", markersize=3, label=name)
        limit = [(float(str(r["CNR"])), float(str(r["bound, px"]))) for r in mine if r["detector"] == "ours"]
        ax.loglog(*zip(*limit, strict=True), "k--", label="Cramér-Rao bound")
        ax.set(title=f"radius {radius} px", xlabel="CNR", xticks=CNRS, xticklabels=[f"{c:.0f}" for c in CNRS])
        ax.minorticks_off()
    axes[0, 0].set_ylabel("RMS error of a coordinate, px")
    axes[0, -1].legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    fig.savefig(path, bbox_inches="tight", metadata={"Date": None})


def main() -> None:
    """Run the benchmark and write its page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one film each, fewer conditions; less than two minutes")
    parser.add_argument("--films", type=int, default=2, help="films of each condition")
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--real", type=Path, default=Path(__file__).parents[2] / "shared" / "data" / "real", help="folder of real films")
    parser.add_argument("--page", type=Path, default=DOCS / "detection.md")
    parser.add_argument("--memory", choices=LARGE, help=argparse.SUPPRESS)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if args.memory:
        memory(args.memory)
        return
    films, seed, quick = 1 if args.quick else args.films, args.seed, args.quick
    cnrs, radii = (CNRS[1::2], (2.5, 5.0)) if quick else (CNRS, RADII)
    begin = time.process_time()

    def run(cases: Iterable[tuple[dict[str, object], Case]], films: int, rivals_at: Callable[[Case], bool] = lambda _: False) -> Rows:
        return sweep(cases, films, seed, rivals_at)

    balls = run((({"radius, px": r, "CNR": c}, Case("ball", r, c)) for r in radii for c in cnrs), films, lambda _: True)
    backgrounds = ("gradient", "bone") if quick else ("flat", "gradient", "bone")
    grounds = run((({"background": b, "CNR": c}, Case("ball", 4.0, c, b)) for b in backgrounds for c in cnrs), films)
    responses = run(
        (
            ({"response": r, "bits": b}, Case("ball", 4.0, 20.0, "gradient", response=r, bits=b))
            for r in ("linear", "density", "log", "transmission")
            for b in ((8,) if quick else (8, 16))
        ),
        1,
    )
    noises = run((({"noise": n, "CNR": c}, Case("ball", 4.0, c, noise=n)) for n in ("quantum", "screen", "fine scan") for c in cnrs), films)
    pins = {
        shape: run(
            (
                ({"half width, px": r, "CNR": c, "balls beside": "yes" if b else "no"}, Case(shape, r, c, companions=b))
                for r, b in (((2.5, True), (2.5, False)) if quick else ((2.0, True), (2.5, True), (4.0, True), (2.5, False)))
                for c in (cnrs if b else (20.0,))
            ),
            films if quick else 3 * films,  # part of their errors is common to all on a film
            lambda case: case.companions and (case.radius_px, case.cnr) == (2.5, 20.0),
        )
        for shape in ("tee", "pin")
    }
    bent = run(
        (
            ({"shape": s, "response": r, "CNR": c}, Case(s, 2.5, c, companions=True, response=r))
            for s in ("tee", "pin")
            for r in ("log", "density", "transmission")
            for c in ((20.0,) if quick else (50.0, 20.0))
        ),
        films,
    )
    over_bone = run(
        (
            ({"shape": s, "half width, px": r, "CNR": c}, Case(s, r, c, "bone", companions=True))
            for s in ("tee", "pin")
            for r, c in (((2.5, 20.0),) if quick else ((2.5, 50.0), (2.5, 20.0), (2.5, 10.0), (4.0, 20.0)))
        ),
        films,
    )
    pairs = run(
        (
            ({"apart, diameters": a, "CNR": c}, Case("pair", 4.0, c, apart=a, companions=True, across=6))
            for a in ((0.5, 1.0) if quick else (0.5, 0.6, 0.8, 1.0, 1.2))
            for c in ((20.0,) if quick else (50.0, 20.0, 10.0))
        ),
        films,
    )
    bent_pairs = run(
        (
            ({"response": r, "apart, diameters": a, "CNR": c}, Case("pair", 4.0, c, apart=a, companions=True, across=6, response=r))
            for r in ("log", "density", "transmission")
            for a in ((0.8,) if quick else (0.6, 0.8, 1.0))
            for c in ((20.0,) if quick else (50.0, 20.0))
        ),
        films,
    )
    clock = speed(1 if quick else 3)
    real = real_tables(args.real)

    DOCS.mkdir(exist_ok=True)
    args.page.parent.mkdir(exist_ok=True)
    figure(balls, args.page.with_suffix(".svg"))
    command = "python benchmarks/detection.py" + (" --quick" if quick else f" --films {films}") + f" --seed {seed}"
    text = ["# Marker images", "", (__doc__ or "").strip(), ""]
    text += [f"Made by `{command}` in {(time.process_time() - begin) / 60:.0f} minutes of one processor.", ""]
    text += [f"![RMS error against CNR for balls of {len(radii)} radii]({args.page.stem}.svg)", ""]
    text += [
        "Rivals are told the radius and the polarity, and of pins and tees where the thick end of the pin or stem lies from the tip:",
        "",
    ]
    text += [f"- {' '.join((f.__doc__ or '').split())}" for f in RIVALS.values()] + [""]
    for title, rows in {
        "Balls, flat background, white noise": balls,
        "Backgrounds (balls of radius 4 px)": grounds,
        "Film responses and bit depths (radius 4 px, CNR 20, gradient)": responses,
        "Quantum noise, and noise that the screen correlates (radius 4 px)": noises,
        "Tees": pins["tee"],
        "Pins": pins["pin"],
        "Film responses (tees and pins of half width 2.5 px, balls beside)": bent,
        "Bone (tees and pins, balls beside)": over_bone,
        "Neighbours: two balls of radius 4 px side by side": pairs,
        "Neighbours on film responses": bent_pairs,
        "Films of 4000 x 4750 pixels, one thread": clock,
        **real,
    }.items():
        text += [f"## {title}", "", table(rows) if rows else "Not here when this page was made.", ""]
    args.page.write_text("\n".join(text), encoding="utf-8")


if __name__ == "__main__":
    main()
