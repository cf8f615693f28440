"""Cages of few marks: named, doubted or refused, never wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsa_vision.cages import Cage, Mark
from rsa_vision.identify.cage import identify_cage
from synthetic.point_films import expose, random_exposure, random_foci
from tests.identify.test_cage import identify, small_cage


def test_smallest_cage_is_named_or_doubted_but_never_wrong() -> None:
    cage = small_cage(2)
    named = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage, missing=0, false_images=int(rng.integers(0, 60)), objects=int(rng.integers(0, 6)))
        film = expose(cage, (1,), exposure, rng)
        result = identify(film, cage, (1,))
        if result and "cage-ambiguous" not in result.reasons:
            assert film.errors(result.assignments) == [], f"seed {seed}"
            assert {"few-fiducials", "few-controls"} <= set(result.reasons)
            named += 1
    assert named >= 10


def test_two_of_three_control_points_are_enough_wherever_they_stand() -> None:
    few = small_cage(3)
    more = [(10.0, 20.0), (-20.0, 110.0), (40.0, 120.0), (5.0, 190.0)]
    added = [Mark(number=21 + i, role="fiducial", foci=(1,), shape="ball", xyz=(x, y, 0.0), diameter=0.8) for i, (x, y) in enumerate(more)]
    cage = few.model_copy(update={"mark": (*few.mark, *added)})
    for lost in (11, 12, 13):
        rng = np.random.default_rng(lost)
        film = expose(cage, (1,), random_exposure(rng, cage, missing=0, false_images=10, noise_px=0.03, turn_deg=5.0), rng)
        rows = np.array([source[2:4] != ("control", lost) for source in film.source])
        images, sources = film.images.rows(rows), [s for s, keep in zip(film.source, rows, strict=True) if keep]
        result = identify_cage(images, cage, (1,), pitch_mm=(0.1, 0.1), film_shape=film.shape)
        assert "few-controls" in result.reasons
        assert replace(film, images=images, source=sources).errors(result.assignments) == []
        assert sum(role == "control" for role, _ in result.assignments[1]) == 2


def test_small_cage_is_not_made_of_clutter() -> None:
    cage = small_cage(4)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1,), random_exposure(rng, cage, false_images=int(rng.integers(0, 290))), rng)
        images = film.images.rows(np.array([name[0] in ("false", "object") for name in film.source]))
        result = identify_cage(images, cage, (1,), pitch_mm=(0.1, 0.1), film_shape=film.shape)
        assert not result or "cage-ambiguous" in result.reasons, f"seed {seed}"


def cage_with(fiducials: int, controls: list[tuple[float, float]]) -> Cage:
    corners = [m for m in small_cage(2).mark if m.role == "fiducial"]
    more = [(10.0, 20.0), (-20.0, 110.0), (40.0, 120.0), (5.0, 190.0), (-75.0, 90.0), (85.0, 100.0)][: fiducials - 4]
    added = [Mark(number=21 + i, role="fiducial", foci=(1,), shape="ball", xyz=(x, y, 0.0), diameter=0.8) for i, (x, y) in enumerate(more)]
    added += [
        Mark(number=11 + i, role="control", foci=(1,), shape="ball", xyz=(x, y, 160.0), diameter=0.8) for i, (x, y) in enumerate(controls)
    ]
    return small_cage(2).model_copy(update={"mark": (*corners, *added)})


def test_image_that_alone_fixes_a_parameter_is_no_gross_error() -> None:
    cage = cage_with(9, [(-40.0, 30.0), (45.0, 160.0)])
    for seed in range(30):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1,), random_exposure(rng, cage, missing=0, false_images=0, objects=0, foci_mm=random_foci(cage, rng, 30)), rng)
        result = identify(film, cage, (1,))
        assert result, f"seed {seed}: {result.runner_up}"
        assert result.dropped == (), f"seed {seed}"


@pytest.mark.parametrize(("apart_mm", "found"), [(25.0, True), (2.0, False)])
def test_control_points_must_fix_the_focus_wherever_the_others_stood(apart_mm: float, found: bool) -> None:
    cage = cage_with(9, [(-70.0, 10.0), (45.0, 160.0), (45.0, 160.0 + apart_mm)])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage, missing=0, false_images=5, noise_px=0.05, slack_mm=0.0, foci_mm=random_foci(cage, rng, 30))
        film = expose(cage, (1,), exposure, rng)
        rows = np.array([source[2:4] != ("control", 11) for source in film.source])
        seen = replace(film, images=film.images.rows(rows), source=[s for s, keep in zip(film.source, rows, strict=True) if keep])
        result = identify(seen, cage, (1,))
        assert bool(result) == found, f"seed {seed}: {result.runner_up}"
        assert seen.errors(result.assignments) == []
