"""Bodies alike: which is which is not told by how many of their markers both foci show, or showed before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.followup import follow_up
from rsa_vision.segments import Segment
from rsa_vision.settings import Limits
from rsa_vision.sightlines import Sightlines
from rsa_vision.tables import SCHEMAS, Rows
from rsa_vision.types import Float
from tests.cli.conftest import rows_of
from tests.identify.bodies import random_body, seen_from

Marker = tuple[int, int]
"""Body and marker."""


def examination(rng: np.random.Generator, exam: str, bodies: list[Float], single: set[Marker], gone: set[Marker], sd_mm: float) -> Any:
    """Return tables of bodies one above the other that have moved a little, with markers seen from one focus or none, and what is what."""
    whole, shift = Rotation.from_rotvec(rng.normal(0, 0.1, 3)), rng.normal((0, 50, 130), 5)
    place = {
        (k, m): x
        for k, body in enumerate(bodies)
        for m, x in enumerate(whole.apply(Rotation.from_rotvec(rng.normal(0, 0.05, 3)).apply(body) + np.array([0, 75 * k, 0])) + shift)
    }
    full = [marker for marker in place if marker not in single | gone]
    rows = rows_of(exam, np.array([place[marker] for marker in full]) + rng.normal(0, sd_mm, (len(full), 3)), sd_mm=sd_mm)
    rays = seen_from(rng, np.array([place[marker] for marker in sorted(single)]).reshape(-1, 3), np.zeros(len(single), int))
    image = dict.fromkeys(SCHEMAS["images"]) | {"focus": 1, "role": "unassigned", "number": "", "shape": "ball", "flags": ""}
    return {**rows, "images": [image] * len(single), **Sightlines(rays, (), np.zeros(0)).rows()}, full


def segments_of(bodies: list[Float]) -> dict[str, list[Segment]]:
    return {"S": [Segment("AB"[k], tuple("01234"[: len(body)]), body) for k, body in enumerate(bodies)]}


def names_of(rows: Rows, full: list[Marker]) -> dict[Marker, str]:
    """Return the names that an examination gives without doubt."""
    found = [row for row in rows["markers"] if row["x_mm"] is not None and "predicted" not in row["flags"]]
    names = zip(full, found, strict=True)
    return {marker: f"{row['segment'] or 'P'}{row['marker']}" for marker, row in names if row["flags"] not in ("ambiguous", "loose")}


@pytest.mark.parametrize("single", [{(0, 2)}, {(1, 2)}, {(0, 2), (1, 0)}])
def test_segments_alike_are_not_told_by_images_that_one_focus_alone_shows(single: set[Marker]) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 4, 14.0)
        exams = [examination(rng, str(e), [body, body], single, set(), 0.01) for e in range(2)]
        for rows, (_, full) in zip(follow_up([rows for rows, _ in exams], segments_of([body, body]), Limits()), exams, strict=True):
            assert not {name[0] for name in names_of(rows, full).values()} & {"A", "B"}
            assert "constellation-ambiguous" in rows["exams"][0]["reasons"]


@pytest.mark.parametrize("others", [{(0, 0)}, set()])
def test_segments_of_which_one_marker_differs_are_told_by_its_image(others: set[Marker]) -> None:
    named = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 5, 14.0)
        other = body + np.outer(np.arange(5) == 3, [4, -3, 5])
        rows, full = examination(rng, "1", [body, other], {(1, 3)}, others, 0.01)
        (rows,) = follow_up([rows], segments_of([body, other]), Limits())
        names = names_of(rows, full)
        assert all(name == f"{'AB'[k]}{m}" for (k, m), name in names.items())
        named += len(names)
    assert named == 4 * (9 - len(others))


def test_a_segment_is_not_taken_for_one_like_it_that_is_not_known() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 4, 14.0)
        rows, full = examination(rng, "1", [body, body], set(), {(0, 3)}, 0.01)
        (rows,) = follow_up([rows], segments_of([body]), Limits())
        assert "A" not in {name[0] for name in names_of(rows, full).values()}
        assert "constellation-ambiguous" in rows["exams"][0]["reasons"]


def test_one_marker_more_tells_segments_alike() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 5, 14.0)
        rows, full = examination(rng, "1", [body, body[:4]], set(), set(), 0.01)
        (rows,) = follow_up([rows], segments_of([body, body[:4]]), Limits())
        assert rows["exams"][0]["status"] == "ok"
        assert all(name == f"{'AB'[k]}{m}" for (k, m), name in names_of(rows, full).items())


@pytest.mark.parametrize(
    ("first", "second"), [({(1, 3)}, {(0, 3)}), ({(1, 3)}, {(0, 2)}), ({(0, 1), (0, 2)}, {(1, 0)}), ({(0, 1)}, {(1, 0), (1, 2)})]
)
def test_bodies_alike_do_not_change_names_where_markers_were_hidden_before(first: set[Marker], second: set[Marker]) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        body = random_body(rng, 5, 14.0)
        exams = [examination(rng, str(e), [body, body], gone, set(), 0.01) for e, gone in enumerate((first, second, set()))]
        given: dict[str, Marker] = {}
        for rows, (_, full) in zip(follow_up([rows for rows, _ in exams], None, Limits()), exams, strict=True):
            names = names_of(rows, full)
            assert all(given.get(name, marker) == marker for marker, name in names.items())
            given |= {name: marker for marker, name in names.items()}


def test_bodies_that_differ_keep_their_names_where_markers_were_hidden_before() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        bodies = [random_body(rng, 5, 14.0), random_body(rng, 4, 14.0)]
        exams = [examination(rng, str(e), bodies, set(), gone, 0.01) for e, gone in enumerate(({(1, 3)}, {(0, 3)}))]
        first, second = (
            names_of(rows, full) for rows, (_, full) in zip(follow_up([r for r, _ in exams], None, Limits()), exams, strict=True)
        )
        assert sum(first.get(marker) == name for marker, name in second.items()) == 7
        assert not set(second.values()) & {name for marker, name in first.items() if second.get(marker) != name}
