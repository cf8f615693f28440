"""Films that are given twice: the same pixels, or one exposure exported again with other ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import ceil
from typing import Final

import numpy as np
from scipy.special import betainc

from rsa_vision.batch import Outcome
from rsa_vision.followup import judged
from rsa_vision.study_files import ExamFiles, printable
from rsa_vision.tables import Row
from rsa_vision.types import Bool, Float
from rsa_vision.verdict import Finding

TOO_WIDE: Final = 2.0  # stated errors may be that many times the true ones; bone, which both exposures show, is in them and no noise
BY_CHANCE: Final = 1e-3  # two exposures agree so well with errors so wide; where they are as stated, below 1e-7
AGREE: Final = 0.75  # part of the images that must agree; the fit of another may change with a few grey values
LEAST_IMAGES: Final = 10  # fewer agree by chance sooner; a turn, a scale and a shift take up two


@dataclass(frozen=True, slots=True)
class _Shown:
    """A film with an object: its examination, its name, its pixels, and the images on it that have a name and no flag."""

    index: int
    name: str
    subject: str
    content: str
    images: Mapping[tuple[int, str, str], Row]


def with_copies_reviewed(exams: Sequence[ExamFiles], outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Have those examinations reviewed whose films are given twice.

    No two exposures have the same pixels, whatever their files say besides, nor noise that displaces their images alike: that is one
    exposure exported again, with other grey values, cropped or resampled. The latter is looked for among the films of a subject.

    Parameters
    ----------
    exams : sequence of ExamFiles
    outcomes : sequence of Outcome
        In the same order, named.

    Returns
    -------
    list of Outcome
        With the reason ``film-duplicate``; films of the cage alone may serve several examinations.
    """
    films = [film for k, (files, outcome) in enumerate(zip(exams, outcomes, strict=True)) for film in _shown(k, files, outcome)]
    others: dict[tuple[int, str], set[str]] = {}
    for one, other in _pairs(films):
        others.setdefault((one.index, one.name), set()).add(other.name)
        others.setdefault((other.index, other.name), set()).add(one.name)
    findings: dict[int, list[Finding]] = {}
    for (k, name), same in others.items():
        told = f"{printable(name)} is the same film as {', '.join(sorted(map(printable, same)))}"
        findings.setdefault(k, []).append(("film-duplicate", told))

    def judged_again(outcome: Outcome, found: Sequence[Finding]) -> Outcome:
        return replace(outcome, rows={**outcome.rows, "exams": [judged(outcome.rows["exams"][0], found)]})

    return [judged_again(outcome, findings[k]) if k in findings else outcome for k, outcome in enumerate(outcomes)]


def _shown(index: int, files: ExamFiles, outcome: Outcome) -> Iterator[_Shown]:
    for film in files.films if outcome.status != "failed" else ():
        name = film.path.name
        content = outcome.pixels.get(name) or outcome.inputs.get(name)  # older results have files only
        if not film.cage_only and content:
            rows = [row for row in outcome.rows["images"] if row.get("file") == name and row["role"] != "unassigned" and not row["flags"]]
            yield _Shown(index, name, files.subject, content, {(row["focus"], row["role"], row["number"]): row for row in rows})


def _pairs(films: Sequence[_Shown]) -> Iterator[tuple[_Shown, _Shown]]:
    alike: dict[str, list[_Shown]] = {}
    subjects: dict[str, list[_Shown]] = {}
    for film in films:
        alike.setdefault(film.content, []).append(film)
        subjects.setdefault(film.subject, []).append(film)
    yield from (pair for same in alike.values() for pair in combinations(same, 2))
    for one, other in (pair for own in subjects.values() for pair in combinations(own, 2)):
        if one.index != other.index and one.content != other.content and _exported_again(one, other):
            yield one, other


def _exported_again(one: _Shown, other: _Shown) -> bool:
    names = one.images.keys() & other.images.keys()
    # an image that serves several foci is one
    both = list({(one.images[n]["col_px"], one.images[n]["row_px"]): n for n in sorted(names)}.values())
    if len(both) < LEAST_IMAGES:
        return False
    rows = [[film.images[name] for name in both] for film in (one, other)]
    start, end = (np.array([(row["col_px"], row["row_px"]) for row in some]) for some in rows)
    before, after = (np.array([_covariance(row) for row in some]) for some in rows)
    return is_one_exposure(start, end, before, after, np.array([role == "object" for _, role, _ in both]))


def _covariance(row: Row) -> tuple[tuple[float, float], tuple[float, float]]:
    across = row["cov_col_row_px2"]
    return (row["sd_col_px"] ** 2, across), (across, row["sd_row_px"] ** 2)


def is_one_exposure(start: Float, end: Float, before: Float, after: Float, is_object: Bool) -> bool:
    """Tell whether images on two films agree so much better than their errors that their noise is the same.

    Parameters
    ----------
    start, end : ndarray of shape (n, 2)
        Places of the same marks and markers on both films, px.
    before, after : ndarray of shape (n, 2, 2)
        Their covariances, px².
    is_object : ndarray of bool, shape (n,)
        Which are markers: the marks of a cage that stands still may agree without noise to tell exposures apart.

    Returns
    -------
    bool

    Notes
    -----
    A turn, a scale and a shift are fitted to all images, and again to the nearer half of them. Of independent errors the squared distance
    by the covariances of both is chi-squared with two degrees of freedom, and below d² with the probability ``1 - exp(-d²/2)``; that three
    of four are below it has that of an order statistic (a beta distribution).
    """
    n = len(start)
    distance = _distances(start, end, before, after, np.ones(n, bool))
    distance = _distances(start, end, before, after, distance <= np.median(distance))
    least = max(np.sort(some)[ceil(AGREE * len(some)) - 1] for some in (distance[is_object], distance[~is_object]) if len(some))
    k = ceil(AGREE * n)
    return bool(betainc(k, n - k + 1, -np.expm1(-(TOO_WIDE**2) * least / 2)) < BY_CHANCE)


def _distances(start: Float, end: Float, before: Float, after: Float, used: Bool) -> Float:
    """Return the squared distances of moved images from their places, by their covariances, shape (n,)."""
    sd = np.sqrt(np.trace(before + after, axis1=1, axis2=2))
    design, places = np.column_stack([start @ [1, 1j], np.ones(len(start))]) / sd[:, None], end @ [1, 1j] / sd
    turn, shift = np.linalg.lstsq(design[used], places[used], rcond=None)[0]
    matrix = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    off = end - start @ matrix.T - [shift.real, shift.imag]
    squared: Float = np.einsum("ni,nij,nj->n", off, np.linalg.inv(after + matrix @ before @ matrix.T), off)
    return squared
