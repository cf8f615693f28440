"""Doubtful pairs of an examination settled by its known segments: tables in, tables with the pairs that the segments make sure out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from rsa_vision.flags import MarkerFlag, flag_names, flag_value
from rsa_vision.identify.contested import settle
from rsa_vision.identify.poses import Cloud
from rsa_vision.settings import Limits
from rsa_vision.sightlines import Sightlines
from rsa_vision.tables import AXES, SCHEMAS, Row, Rows, marker_rows, name_of, plain
from rsa_vision.types import Float, Int, Markers
from rsa_vision.verdict import conclude
from rsa_vision.xray import intersect

CODE: Final = "pair-ambiguous"


def cloud_of(markers: Sequence[Row]) -> Cloud:
    """Return rows of ``markers.csv`` that have coordinates as points with their covariances (0 where there is none)."""
    position = np.array([[row[axis] for axis in AXES] for row in markers], dtype=np.float64).reshape(-1, 3)
    covariance = np.zeros((len(markers), 3, 3))
    for i, row in enumerate(markers):
        sd = np.array([row[f"sd_{axis}"] or 0.0 for axis in AXES])
        xy, xz, yz = (row[f"cov_{pair}_mm2"] or 0.0 for pair in ("xy", "xz", "yz"))
        covariance[i] = np.diag(sd**2) + np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
    return Cloud(position, covariance)


def settle_pairs(rows: Rows, bodies: Sequence[Cloud], limits: Limits) -> Rows:
    """Decide doubtful pairs by known segments.

    Parameters
    ----------
    rows : dict
        Tables of one examination, with what its films leave open (:class:`rsa_vision.sightlines.Sightlines`).
    bodies : sequence of Cloud
        The known segments.
    limits : Limits
        ``posterior`` and ``crossing_sigma`` are used.

    Returns
    -------
    dict
        With the pairs that the segments make sure: some of those that stood there, which lose the flag ``ambiguous``, and others instead.
        Without ``pair-ambiguous`` among the reasons if no doubt is left: each image in question is in a pair that is sure, and each such
        pair crosses within its statistics.
    """
    contest = Sightlines.read(rows)
    if CODE not in rows["exams"][0]["reasons"].split(";") or not contest.contested:
        return rows
    image = contest.rays.image.tolist()
    seen_by = [tuple(image[ray] for ray in group) for group in contest.contested]
    doubted = sorted({i for one in seen_by for i in one})
    names = {rows["images"][i]["number"] for i in doubted} - {""}
    markers, _, _ = _intersected(rows, contest, range(len(seen_by)), limits)
    here = np.flatnonzero(np.isfinite(markers.position_mm).all(axis=1))
    chances = settle(
        bodies,
        cloud_of([row for row in rows["markers"] if row["x_mm"] is not None and name_of(row) not in names]),
        Cloud(markers.position_mm[here], markers.covariance_mm2[here]),
        [seen_by[c] for c in here],
        contest.log_odds[here],
    )
    sure = here[chances >= limits.posterior].tolist()
    return _with_pairs(rows, contest, sure, names, limits) if sure else rows


def _intersected(rows: Rows, contest: Sightlines, groups: Iterable[int], limits: Limits) -> tuple[Markers, Float, Int]:
    """Return markers of contested groups, and distances and flags of all images, as the examination has those of its markers."""
    flags = np.array([flag_value(row["flags"] or "") for row in rows["images"]], np.int64) & ~int(MarkerFlag.AMBIGUOUS)
    rays = {f"contested-{c}": list(contest.contested[c]) for c in groups}
    markers, distance_um, flags = intersect(rays, contest.rays, flags, limits)
    has_parallax = any(row["parallax_um"] is not None for row in rows["markers"])
    parallax = markers.parallax_um if has_parallax else np.full(len(markers), np.nan)  # calibrated cameras have none
    return replace(markers, parallax_um=parallax), distance_um, flags


def _with_pairs(rows: Rows, contest: Sightlines, sure: Sequence[int], names: set[str], limits: Limits) -> Rows:
    """Return the rows with the groups that are sure, instead of all that they contradict."""
    image, focus = contest.rays.image.tolist(), contest.rays.focus.tolist()
    found, distance_um, flags = _intersected(rows, contest, sure, limits)
    before = {name: {i for i, row in enumerate(rows["images"]) if row["number"] == name} for name in names}
    by_images = {frozenset(image[ray] for ray in contest.contested[c]): str(name) for c, name in zip(sure, found.name, strict=True)}
    taken = {i for one in by_images for i in one}
    kept = {name for name, one in before.items() if frozenset(one) in by_images}
    gone = {name for name, one in before.items() if one & taken} - kept
    key = {name: rows["exams"][0][name] for name in ("subject", "exam")}
    new = [row for row in marker_rows(found) if row["marker"] not in {by_images[frozenset(before[name])] for name in kept}]
    markers = [_sure(row) if name_of(row) in kept else row for row in rows["markers"] if name_of(row) not in gone]
    markers += [{**dict.fromkeys(SCHEMAS["markers"]), **key, **{name: plain(value) for name, value in row.items()}} for row in new]
    images = [_sure(row) if row["number"] in kept else row for row in rows["images"]]
    freed = {i for name in gone for i in before[name]} - taken
    for i in freed:
        several = len({focus[ray] for ray, of in enumerate(image) if of == i}) > 1  # on a shared film it is of no focus
        none: Row = {"role": "unassigned", "number": "", "residual_um": None, "used": False}
        images[i] = _sure(images[i]) | none | ({"focus": 0} if several else {})
    with_plane = any(row["role"] == "fiducial" for row in rows["images"])
    fresh = {row["marker"] for row in new}
    for c, name in zip(sure, found.name, strict=True):
        for ray in contest.contested[c] if name in fresh else ():
            i = image[ray]
            named = {"role": "object", "number": str(name), "focus": focus[ray], "residual_um": plain(distance_um[i]), "used": True}
            through = dict(zip(AXES, contest.rays.through_mm[ray].tolist(), strict=True)) if with_plane else {}
            images[i] = {**images[i], **named, **through, "flags": flag_names(int(flags[i]))}
    about = rows["exams"][0]
    settled = not freed and not (found.flags & MarkerFlag.LARGE_RESIDUAL).any() and not names - kept - gone
    reasons = [code for code in about["reasons"].split(";") if code != CODE or not settled]
    parallax = [row["parallax_um"] for row in markers if row["parallax_um"] is not None]
    figures = {
        "n_markers": sum(row["x_mm"] is not None for row in markers),
        "mean_parallax_um": float(np.mean(parallax)) if parallax else None,
        "reasons": ";".join(reasons),
        "status": conclude([(code, "") for code in reasons]).status,
    }
    return {**rows, "exams": [{**about, **figures}], "images": images, "markers": markers, "contested": []}


def _sure(row: Row) -> Row:
    return {**row, "flags": flag_names(flag_value(row["flags"] or "") & ~int(MarkerFlag.AMBIGUOUS))}
