"""How long motion takes: 10,000 segment pairs, their closed polygons, and the whole command. Processor time, the best of several runs."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from rsa_vision.kinematics.kinema import motions
from rsa_vision.kinematics.rigidity import rigidity
from rsa_vision.kinematics.series import MarkerTable, make_series
from rsa_vision.settings import Limits, Motion

RUNS = 5
SD_MM = 0.03


def table(subjects: int, exams: int, segments: int, markers: int, rng: np.random.Generator) -> MarkerTable:
    """Return rigid segments that have moved by about a millimetre from each examination to the next."""
    shape = (subjects, exams, segments, markers)
    bodies = rng.normal(0, 15, (subjects, 1, segments, markers, 3)) + rng.normal(0, 60, (subjects, 1, segments, 1, 3))
    position = bodies + rng.normal(0, 1, (subjects, exams, segments, 1, 3)) + rng.normal(0, SD_MM, (*shape, 3))
    keys = [index.ravel() for index in np.indices(shape)]
    named = [np.char.add(prefix, key.astype(str)) for prefix, key in zip(("S", "20260101090", "segment", "M"), keys, strict=True)]
    covariance = np.tile(np.eye(3) * SD_MM**2, (position[..., 0].size, 1, 1))
    return MarkerTable(*named, position.reshape(-1, 3), covariance, np.zeros(len(covariance), np.int64))


def best(action: Callable[[], object]) -> float:
    """Return the least processor time of several runs, s."""

    def once() -> float:
        started = time.process_time()
        action()
        return time.process_time() - started

    return min(once() for _ in range(RUNS))


def command(*arguments: str) -> float:
    """Return the least processor time of a command of the program, s."""

    def once() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", "rsa_vision", *arguments], check=False, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    return min(once() for _ in range(RUNS))


def write(path: Path, markers: MarkerTable) -> int:
    """Write a table of markers; return its number of rows."""
    path.parent.mkdir()
    columns = {"subject": markers.subject, "exam": markers.exam, "segment": markers.segment, "marker": markers.marker}
    columns |= {f"{axis}_mm": markers.position_mm[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"sd_{axis}_mm": np.full(len(markers), SD_MM) for axis in "xyz"}
    pl.DataFrame(columns).write_csv(path)
    return len(markers)


def main() -> None:
    """Print the figures."""
    rng = np.random.default_rng(1)
    pairs = make_series(table(10_000, 2, 1, 5, rng))
    limits = Limits(condition_number=1e4)
    print(f"{len(pairs)} segment pairs: {best(lambda: motions(pairs, Motion(), limits)):.2f} s")
    print(f"their closed polygons: {best(lambda: rigidity(pairs, limits.stable_mm)):.2f} s")
    with tempfile.TemporaryDirectory() as folder:
        for subjects in (900, 1):
            path = Path(folder) / f"{subjects}" / "markers.csv"
            rows = write(path, table(subjects, 4, 3, 6, rng))
            whole = command("motion", str(path))
            found = pl.read_csv(path.with_name("motion.csv"), infer_schema=False)
            print(f"rsa-vision motion, {rows} rows, {len(found)} motions: {whole:.2f} s")


if __name__ == "__main__":
    main()
