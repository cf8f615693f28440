"""Hold what was measured against the truth: markers found, missed and invented, errors, and identities that were mixed up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from rsa_vision.types import Float
from synthetic.truth import FOCI, IMAGES, MARKERS

SCHEMA: Final = {
    "exams": dict.fromkeys(("subject", "exam", "status", "reasons"), pl.String),
    "images": IMAGES,
    "foci": FOCI,
    "markers": MARKERS,
}


@dataclass(frozen=True, slots=True)
class ExamComparison:
    """One examination, measured against the truth.

    Attributes
    ----------
    subject, exam : str
    status, reasons : str
        As measured; ``absent`` where it has no row.
    n_true, n_found, n_matched, n_missing, n_false : int
        Markers; found are those with coordinates.
    rms_um, max_um : float
        Of the distances of matched markers; NaN without any.
    rms_x_um, rms_y_um, rms_z_um : float
    error_over_sd : float
        Root mean square of coordinate errors over their stated standard deviations; 1 is honest.
    focus_um : float
        Largest distance of a focus from the true one.
    n_identity_errors : int
        Marker images that were used under the name of another mark, marker or focus.
    """

    subject: str
    exam: str
    status: str
    reasons: str
    n_true: int
    n_found: int
    n_matched: int
    n_missing: int
    n_false: int
    rms_um: float
    max_um: float
    rms_x_um: float
    rms_y_um: float
    rms_z_um: float
    error_over_sd: float
    focus_um: float
    n_identity_errors: int

    @property
    def silently_wrong(self) -> bool:
        """Whether an examination marked ``ok`` has a wrong identity or a marker that does not exist."""
        return self.status == "ok" and (self.n_identity_errors > 0 or self.n_false > 0)


def compare(truth: Path, measured: Path, *, match_mm: float = 1.0, match_px: float = 3.0) -> tuple[ExamComparison, ...]:
    """Compare a folder of results with the truth of its films.

    Parameters
    ----------
    truth : Path
        Folder with ``images.csv``, ``foci.csv``, ``markers.csv`` as :func:`synthetic.study.make_study` writes.
    measured : Path
        Folder with the same tables and ``exams.csv``, as ``rsa-vision measure`` writes.
    match_mm : float
        Markers farther apart are not the same one.
    match_px : float
        An image farther from all true images of its film than this is no image of anything.

    Returns
    -------
    tuple of ExamComparison
        One for every examination of the truth, sorted.
    """
    true_tables = {name: _read(truth / f"{name}.csv") for name in ("images", "foci", "markers")}
    tables = {name: _read(measured / f"{name}.csv") for name in ("exams", "images", "foci", "markers")}
    results = []
    for subject, exam in true_tables["foci"].select("subject", "exam").unique().sort("subject", "exam").rows():
        here = (pl.col("subject") == subject) & (pl.col("exam") == exam)
        want = {name: table.filter(here) for name, table in true_tables.items()}
        got = {name: table.filter(here) for name, table in tables.items()}
        results.append(_compare_exam(subject, exam, want, got, match_mm, match_px))
    return tuple(results)


def match_points(true_mm: Float, found_mm: Float, limit_mm: float) -> tuple[list[int], list[int]]:
    """Return the rows of (n, 3) true and (m, 3) found points that belong together, none beyond the limit: most pairs, least distance."""
    if not (len(true_mm) and len(found_mm)):
        return [], []
    distance = np.linalg.norm(true_mm[:, None] - found_mm[None], axis=-1)
    rows, cols = linear_sum_assignment(np.minimum(distance, 1e3 * limit_mm) + 1e3 * limit_mm * (distance > limit_mm))
    near = distance[rows, cols] <= limit_mm
    return rows[near].tolist(), cols[near].tolist()


def _compare_exam(
    subject: str, exam: str, want: dict[str, pl.DataFrame], got: dict[str, pl.DataFrame], match_mm: float, match_px: float
) -> ExamComparison:
    row = got["exams"].row(0, named=True) if got["exams"].height else {"status": "absent", "reasons": ""}
    found = got["markers"].filter(pl.col("x_mm").is_not_null() & pl.col("x_mm").is_not_nan())
    true_mm, found_mm = (_columns(table, "{}_mm") for table in (want["markers"], found))
    of_true, of_found = match_points(true_mm, found_mm, match_mm)
    error_um = 1e3 * (found_mm[of_found] - true_mm[of_true])
    sd_um = 1e3 * _columns(found, "sd_{}_mm")[of_found]
    length = np.linalg.norm(error_um, axis=1)
    known = np.isfinite(sd_um) & (sd_um > 0)

    names = {_name(found, i): _name(want["markers"], j) for i, j in zip(of_found, of_true, strict=True)}
    foci = want["foci"].join(got["foci"], on="focus", suffix="_got")
    apart = 1e3 * np.linalg.norm(_columns(foci, "{}_mm_got") - _columns(foci, "{}_mm"), axis=1)
    rms_x, rms_y, rms_z = (_rms(error_um[:, axis]) for axis in range(3))
    return ExamComparison(
        subject=subject,
        exam=exam,
        status=str(row["status"]),
        reasons=str(row["reasons"] or ""),
        n_true=len(true_mm),
        n_found=len(found_mm),
        n_matched=len(of_true),
        n_missing=len(true_mm) - len(of_true),
        n_false=len(found_mm) - len(of_found),
        rms_um=_rms(length),
        max_um=float(length.max()) if len(length) else np.nan,
        rms_x_um=rms_x,
        rms_y_um=rms_y,
        rms_z_um=rms_z,
        error_over_sd=_rms(error_um[known] / sd_um[known]),
        focus_um=float(apart.max()) if len(apart) else np.nan,
        n_identity_errors=count_identity_errors(want["images"], got["images"], names, match_px),
    )


def count_identity_errors(true: pl.DataFrame, found: pl.DataFrame, names: dict[str, str], match_px: float) -> int:
    """Return how many used images bear a name that no true image near them has.

    Parameters
    ----------
    true, found : polars.DataFrame
        Columns of ``images.csv``.
    names : dict of str to str
        The true name of every measured marker; markers without one are errors of their own kind and not counted here.
    match_px : float

    Returns
    -------
    int
    """
    wrong = 0
    used = found.filter(pl.col("used") & pl.col("role").is_in(["fiducial", "control", "object"]))
    for file in used["file"].unique():
        here = true.filter(pl.col("file") == Path(str(file)).name)
        tree = KDTree(here.select("col_px", "row_px").to_numpy()) if here.height else None
        identities = [(r["focus"], r["role"], r["number"]) for r in here.iter_rows(named=True)]
        for r in used.filter(pl.col("file") == file).iter_rows(named=True):
            number = names.get(r["number"]) if r["role"] == "object" else r["number"]
            if number is None:
                continue
            near = tree.query_ball_point((r["col_px"], r["row_px"]), match_px) if tree else []
            wrong += (r["focus"], r["role"], number) not in {identities[i] for i in near}
    return wrong


def _read(path: Path) -> pl.DataFrame:
    return pl.read_csv(path, schema_overrides=SCHEMA[path.stem], infer_schema_length=None)


def _columns(table: pl.DataFrame, pattern: str) -> Float:
    return table.select([pl.col(pattern.format(axis)).cast(pl.Float64) for axis in "xyz"]).to_numpy()


def _name(table: pl.DataFrame, index: int) -> str:
    row = table.row(index, named=True)
    return f"{row['segment']}/{row['marker']}" if row["segment"] else str(row["marker"])


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
