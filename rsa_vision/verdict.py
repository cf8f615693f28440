"""When an examination is `ok`: only if its names are decisive and every residual is within its statistics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, Literal

import numpy as np

from rsa_vision.flags import REASONS, MarkerFlag
from rsa_vision.settings import Limits
from rsa_vision.types import Float, FocusSolution, ImagePoints, Markers, Reconstruction

Status = Literal["ok", "review", "failed"]

BIRGE_LIMIT: Final = 4.0  # residuals four times as large as stated are no noise but another model: a bent film, a wrong mark, another cage
_EXPLAINED: Final = "image errors and the cage's marks explain; how well these are known is `sd` in the cage file"
BEND_SIGMA: Final = 3.0
COMMON_SIGMA: Final = 3.0  # RMS of all crossing errors over their sd; they share the errors of the foci and do not average out
STRETCH_LIMIT: Final = 0.035  # scanners differ by 1 % between rows and columns; the builds of cage 1B by 5 %
LEAST_ALIKE, ALIKE_PX = 3, 2.0  # markers that lie alike on two films, and by how much their images may differ
FAILURES: Final = frozenset(
    {"film-unreadable", "film-format", "film-name", "film-missing", "film-unexpected", "pitch-missing", "no-markers", "cage-not-found"}
    | {"geometry", "calibration-invalid", "cage-film-differs", "internal", "timeout"}
)
"""Reasons that leave no coordinates."""

Finding = tuple[str, str]
"""Reason code and what was found, with its figures."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Status of an examination, its reason codes without repetition, and a message for every finding."""

    status: Status
    reasons: tuple[str, ...]
    messages: tuple[str, ...]


def conclude(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that findings lead to.

    Parameters
    ----------
    findings : iterable of (code, message)
        Codes of :data:`rsa_vision.flags.REASONS`.

    Returns
    -------
    Verdict
        ``ok`` only without any finding.
    """
    every = list(findings)
    codes = tuple(dict.fromkeys(code for code, _ in every))
    status: Status = "failed" if FAILURES & set(codes) else "review" if codes else "ok"
    return Verdict(status, codes, tuple(dict.fromkeys(message or REASONS[code] for code, message in every)))


def judge(reconstruction: Reconstruction, nominal_mm: Mapping[int, Sequence[float]], limits: Limits) -> list[Finding]:
    """Return what speaks against a reconstruction.

    Parameters
    ----------
    reconstruction : Reconstruction
    nominal_mm : mapping
        Nominal foci; empty for calibrated cameras.
    limits : Limits

    Returns
    -------
    list of (code, message)
    """
    with_cage = [focus for focus in reconstruction.foci if focus.focus in nominal_mm]
    findings = [finding for focus in with_cage for finding in _judge_focus(focus, nominal_mm, limits)]
    findings += [finding for focus in with_cage for finding in _judge_images(reconstruction, focus.focus)]
    return findings + _judge_films(reconstruction.points) + _judge_markers(reconstruction.markers, limits)


def _judge_films(points: ImagePoints) -> list[Finding]:
    """Find films that show one picture: scanned twice, a film names the marks of two equal cassettes and crosses in one plane."""
    findings: list[Finding] = []
    named = points.rows(points.role != "unassigned")
    for one, other in combinations(sorted(set(named.focus[named.role == "object"].tolist())), 2):
        mine, theirs = (named.rows(named.focus == focus) for focus in (one, other))
        if mine.film[0] != theirs.film[0] and _is_one_picture(mine, theirs):
            findings.append(("film-duplicate", f"the films of focus {one} and {other} show one picture: was one scanned twice?"))
    return findings


def _is_one_picture(one: ImagePoints, other: ImagePoints) -> bool:
    """Say whether images of markers and marks lie alike on two films, but for turn, shift and scale: foci apart show depths differently."""
    objects = [{str(p.number[i]): complex(*p.position_px[i]) for i in np.flatnonzero(p.role == "object")} for p in (one, other)]
    both = sorted(objects[0].keys() & objects[1].keys())
    if len(both) < LEAST_ALIKE:
        return False
    start, end = (np.array([of[number] for number in both]) for of in objects)
    design = np.column_stack([start, np.ones(len(start))])
    turn = np.linalg.lstsq(design, end, rcond=None)[0]
    if np.abs(design @ turn - end).max() > ALIKE_PX:
        return False
    moved, there = (p.position_px @ [1, 1j] for p in (one, other))
    away = np.abs((turn[0] * moved + turn[1])[:, None] - there).min(axis=1)
    return bool(np.median(away) < ALIKE_PX)


def film_stretch(plane_from_film: Float, position_px: Float, pitch_mm: tuple[float, float]) -> float:
    """Return how much larger the scale of a film is in one direction than across it, by its cage and its pixel pitch.

    Parameters
    ----------
    plane_from_film : ndarray of shape (3, 3)
    position_px : ndarray of shape (2,)
        Where on the film.
    pitch_mm : tuple of two floats
        (row, column).

    Returns
    -------
    float
        Ratio of the singular values of the local scale, minus 1. An affine stretch is absorbed by the projective transformation: a cage
        of another length fits its fiducial marks exactly, and only this figure tells.
    """
    large, small = np.linalg.svd(_jacobian(plane_from_film, position_px) / [pitch_mm[1], pitch_mm[0]], compute_uv=False)
    return float(large / small - 1)


def local_scale(plane_from_film: Float, position_px: Float) -> float:
    """Return the mean scale of the fiducial plane at a place of the film, mm/px."""
    return float(np.sqrt(abs(np.linalg.det(_jacobian(plane_from_film, position_px)))))


def _jacobian(plane_from_film: Float, position_px: Float) -> Float:
    u, v, w = plane_from_film @ np.append(position_px, 1.0)
    result: Float = (plane_from_film[:2, :2] - np.outer([u / w, v / w], plane_from_film[2, :2])) / w
    return result


def _judge_focus(focus: FocusSolution, nominal_mm: Mapping[int, Sequence[float]], limits: Limits) -> list[Finding]:
    name, findings = f"focus {focus.focus}", []
    if focus.n_fiducials <= 4:
        findings.append(("few-fiducials", f"{name}: {focus.n_fiducials} fiducial marks used, no redundancy"))
    if focus.n_controls <= 2:
        findings.append(("few-controls", f"{name}: {focus.n_controls} control points used, little redundancy"))
    if not focus.fiducial_max_um <= limits.fiducial_um:
        largest = f"{focus.fiducial_max_um:.0f} um (limit {limits.fiducial_um:.0f})"
        findings.append(("fiducial-residual", f"{name}: a fiducial mark is off by {largest}"))
    elif focus.fiducial_birge > BIRGE_LIMIT:
        findings.append(("fiducial-residual", f"{name}: fiducial residuals {focus.fiducial_birge:.1f} times what {_EXPLAINED}"))
    if not focus.line_max_um <= 1000 * limits.line_mm:
        largest = f"{focus.line_max_um:.0f} um (limit {1000 * limits.line_mm:.0f})"
        findings.append(("control-residual", f"{name}: the line of a control point misses the focus by {largest}"))
    elif focus.control_birge > BIRGE_LIMIT:
        findings.append(("control-residual", f"{name}: control residuals {focus.control_birge:.1f} times what {_EXPLAINED}"))
    away = float(np.linalg.norm(focus.position_mm - np.asarray(nominal_mm[focus.focus])))
    if not away <= limits.focus_mm:
        findings.append(("focus-far", f"{name}: {away:.0f} mm from nominal (limit {limits.focus_mm:.0f})"))
    return findings


def _judge_images(reconstruction: Reconstruction, focus: int) -> list[Finding]:
    """Control points that are all shifted alike fit another focus exactly: no residual shows that, their flags do."""
    points = reconstruction.points
    controls = (points.role == "control") & (points.focus == focus) & reconstruction.used
    lapped = np.count_nonzero(controls & ((points.flags & MarkerFlag.OVERLAP) != 0))
    if 2 * lapped <= np.count_nonzero(controls):
        return []
    return [("control-doubled", f"focus {focus}: {lapped} of {np.count_nonzero(controls)} control points used overlap other images")]


def _judge_markers(markers: Markers, limits: Limits) -> list[Finding]:
    findings: list[Finding] = []
    large = markers.name[(markers.flags & MarkerFlag.LARGE_RESIDUAL) != 0]
    ratio = markers.crossing_um / markers.crossing_sd_um
    rms = float(np.sqrt(np.mean(ratio[np.isfinite(ratio)] ** 2))) if np.isfinite(ratio).any() else 0.0
    if len(large):
        findings.append(("crossing-large", f"crossing errors beyond {limits.crossing_sigma:g} sd: {', '.join(map(str, large))}"))
    elif rms > COMMON_SIGMA:
        findings.append(("crossing-large", f"RMS of all crossing errors is {rms:.1f} times their standard deviation"))
    parallax = markers.parallax_um
    known = np.isfinite(parallax)
    if known.sum() > 1:
        mean, spread = float(parallax[known].mean()), float(parallax[known].std(ddof=1))
        # what all markers have in common, as the errors of the foci, is no more than the least of their errors
        chance = np.hypot(float(np.nanmin(markers.crossing_sd_um[known])), spread / np.sqrt(known.sum()))
        if abs(mean) > limits.parallax_um and not abs(mean) < BEND_SIGMA * chance:
            findings.append(("film-bend", f"mean y-parallax {mean:.0f} um (limit {limits.parallax_um:.0f})"))
    one_view = markers.name[(markers.flags & MarkerFlag.ONE_VIEW) != 0]
    if len(one_view):
        findings.append(("marker-one-view", f"seen from one focus only: {', '.join(map(str, one_view))}"))
    if not np.isfinite(markers.position_mm).all(axis=1).any():
        causes = "no object on the films, films exchanged, turned, or given twice, or a patient who moved"
        told = f"no image of one focus meets one of another: {causes}"
        findings.append(("no-object-markers", told))
    return findings
