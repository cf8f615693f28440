"""Pictures of examinations that were sent to review, and why: a page that the benchmark of hard films makes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsa_vision.examination import ExaminationResult
from rsa_vision.flags import REASONS, MarkerFlag
from rsa_vision.overlay import overlay_png
from rsa_vision.types import MarkerImages

MOST = 6  # pictures of a page
HALF_PX = 80  # of the side of a cutting
WHOLE_PX = 520  # longest side of a whole film
PAGE = Path(__file__).parents[1] / "docs" / "benchmarks" / "review_cases.md"

Ball = Callable[[int], str]
"""Say what a row of the examination's points shows, in words."""


@dataclass(frozen=True, slots=True)
class Case:
    """One examination that was not `ok`: its name, reason code, what the program says, what is true, and a picture (PNG)."""

    name: str
    reason: str
    message: str
    truth: str
    png: bytes


def review_case(name: str, result: ExaminationResult, values: Sequence[NDArray[Any]], ball: Ball) -> Case | None:
    """Return the picture of what an examination is reviewed for, None if it is not."""
    reasons, messages = result.verdict.reasons, result.verdict.messages
    if not reasons:
        return None
    if "pair-ambiguous" in reasons:
        points = result.points
        doubted = np.flatnonzero(points.flags & int(MarkerFlag.AMBIGUOUS))
        rows = doubted[points.number[doubted] == points.number[doubted[0]]]
        message = next(text for text in messages if "pairing" in text)
        png = _beside([_cutting(result, values, int(points.film[row]), points.position_px[row]) for row in rows])
        return Case(
            name, "pair-ambiguous", message, " and ".join(f"{ball(int(row))} on the film of focus {points.focus[row]}" for row in rows), png
        )
    if reasons[0] == "marker-one-view" and (found := re.search(r"col (\d+), row (\d+)", messages[0])):
        film = next(k for k, film in enumerate(result.films) if messages[0].startswith(film.path.name))
        place = np.array([float(found[1]), float(found[2])])
        here = np.flatnonzero(result.points.film == film)
        row = int(here[np.argmin(np.hypot(*(result.points.position_px[here] - place).T))])
        return Case(name, reasons[0], messages[0], ball(row), _beside([_cutting(result, values, film, place)]))
    whole = [_whole(pixels, film.images) for pixels, film in zip(values, result.films, strict=True)]
    return Case(name, reasons[0], messages[0], "", _beside(whole))


def _cutting(result: ExaminationResult, values: Sequence[NDArray[Any]], film: int, place: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the overlay of the surroundings of a place."""
    pixels, images = values[film], result.films[film].images
    corner = np.clip(np.rint(place).astype(int) - HALF_PX, 0, np.maximum(np.array(pixels.shape[::-1]) - 2 * HALF_PX, 0))
    window = pixels[corner[1] : corner[1] + 2 * HALF_PX, corner[0] : corner[0] + 2 * HALF_PX]
    return _overlay(window, images, corner)


def _whole(pixels: NDArray[Any], images: MarkerImages) -> NDArray[np.uint8]:
    drawn = _overlay(pixels, images, np.zeros(2))
    scale = WHOLE_PX / max(drawn.shape[:2])
    return np.asarray(cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def _overlay(pixels: NDArray[Any], images: MarkerImages, corner: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the program's overlay of a part of a film."""
    inside = ((images.position_px > corner) & (images.position_px < corner + pixels.shape[::-1])).all(axis=1)
    some = images.rows(inside)
    moved = MarkerImages(some.position_px - corner, *(getattr(some, name) for name in MarkerImages.__slots__[1:]))
    return np.asarray(cv2.imdecode(np.frombuffer(overlay_png(pixels, moved), np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _beside(pictures: Sequence[NDArray[np.uint8]]) -> bytes:
    """Return pictures side by side as PNG, in 32 levels: noise is what makes a file large."""
    height = max(picture.shape[0] for picture in pictures)
    padded = [np.pad(p, ((0, height - len(p)), (0, 6), (0, 0)), constant_values=255) for p in pictures]
    return bytes(cv2.imencode(".png", np.hstack(padded) // 8 * 8, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])


def chosen(cases: Sequence[Case]) -> list[Case]:
    """Choose cases by turns of their reasons, in the order in which they came."""
    ranked = []
    seen: dict[str, int] = {}
    for order, case in enumerate(cases):
        ranked.append((seen.get(case.reason, 0), order, case))
        seen[case.reason] = seen.get(case.reason, 0) + 1
    return [case for _, _, case in sorted(ranked, key=lambda item: item[:2])][:MOST]


def write_page(cases: Sequence[Case], n_examinations: int, command: str, page: Path = PAGE) -> None:
    """Write the page and its pictures; pictures of an earlier run are removed."""
    folder = page.with_suffix("")
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    some = chosen(cases)
    text = ["# Cases sent to review", ""]
    text += [
        f"{len(cases)} of {n_examinations} [hard examinations](hard_films.md) were not `ok`; {len(some)} of them, chosen by turns of their"
    ]
    text += [
        "reasons. Circles: what the detector found, as the overlay draws it. Two cuttings side by side show both images of a pair.",
        "",
    ]
    text += [f"Made by `{command}`.", ""]
    for number, case in enumerate(some, 1):
        file = folder / f"{number}.png"
        file.write_bytes(case.png)
        text += [f"## `{case.reason}`: {case.name}", "", f"![{case.name}]({folder.name}/{file.name})", ""]
        text += [f"*The program*: {case.message} ({REASONS[case.reason]})."]
        text += [f"*The truth*: {case.truth}." if case.truth else "", ""]
    page.write_text("\n".join(text).rstrip() + "\n", encoding="utf-8")
