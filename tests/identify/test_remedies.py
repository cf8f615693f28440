"""What a cage that was not found would be found with: said where it is so, and nothing where it is not."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsa_vision.cages import Cage, builtin_cages, load_cage
from rsa_vision.identify.cage import identify_cage
from rsa_vision.identify.remedies import what_would_fit
from rsa_vision.settings import Limits
from synthetic.point_films import expose, random_exposure

OTHERS = [load_cage(name) for name in builtin_cages()]


def said_of(true: Cage, told: Cage, seed: int, *, pitch_mm: float = 0.1, orientation: str = "upright", **look: Any) -> tuple[str, ...]:
    """Return what is said of a film of 0.1 mm, on which the cage told is not found."""
    rng = np.random.default_rng(seed)
    foci = tuple(sorted(true.foci)) if true.film == "shared" else (1,)
    film = expose(true, foci, random_exposure(rng, true, missing=int(rng.integers(0, 2)), **look), rng)
    as_told: dict[str, Any] = {
        "pitch_mm": (pitch_mm, pitch_mm),
        "film_shape": film.shape,
        "orientation": orientation,
        "foci_mm": told.foci,
        "limits": Limits(),
    }
    assert not identify_cage(film.images, told, foci, **as_told)
    return what_would_fit(film.images, told, foci, **as_told, others=OTHERS)


def unsymmetric() -> Cage:
    """Cage 2 with one plane, of which no mark would lie on another seen from behind."""
    cage = load_cage("2")
    mine = [mark for mark in cage.mark if 1 in mark.foci]
    slant = [mark.model_copy(update={"xyz": (mark.xyz[0], mark.xyz[1] + 0.15 * mark.xyz[0], mark.xyz[2]), "foci": (1,)}) for mark in mine]
    plane = cage.plane_of(1).model_copy(update={"foci": (1,)})
    return Cage(**{**cage.model_dump(), "name": "slant", "foci": {1: cage.foci[1]}, "plane": (plane,), "mark": tuple(slant)})


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
@pytest.mark.parametrize("pitch_mm", [0.07, 0.085, 0.143, 0.254])
def test_another_pixel_pitch_is_said_to_within_the_three_per_cent_that_names_allow(name: str, pitch_mm: float) -> None:
    for seed in (0, 2):
        (said,) = said_of(load_cage(name), load_cage(name), seed, pitch_mm=pitch_mm)
        (right,) = re.findall(r"^pixel_pitch_mm = (0\.\d+) or so instead of ", said)
        assert float(right) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(("true", "told"), [("1A", "1B"), ("1B", "1A"), ("1B", "1B-420"), ("1B-420", "1B")])
def test_another_cage_is_said(true: str, told: str) -> None:
    assert said_of(load_cage(true), load_cage(told), 1) == (f'cage = "{true}"',)


def test_a_film_seen_from_behind_or_turned_is_said() -> None:
    cage = unsymmetric()
    assert said_of(cage, cage, 1, mirrored=True) == ('orientation = "mirrored"',)
    assert said_of(cage, cage, 1, orientation="mirrored") == ('orientation = "upright"',)
    assert said_of(cage, cage, 1, turn_deg=120.0) == ('orientation = "any"',)


def test_nothing_is_said_of_a_film_without_a_cage() -> None:
    for name in builtin_cages():
        cage, rng = load_cage(name), np.random.default_rng(3)
        foci = (1, 2) if cage.film == "shared" else (1,)
        film = expose(cage, foci, replace(random_exposure(rng, cage), false_images=80), rng)
        images = film.images.rows(np.array([source[0] in ("false", "object") for source in film.source]))
        as_told = {"pitch_mm": (0.1, 0.1), "film_shape": film.shape, "orientation": "upright", "foci_mm": cage.foci, "limits": Limits()}
        assert what_would_fit(images, cage, foci, **as_told, others=OTHERS) == ()  # type: ignore[arg-type]
