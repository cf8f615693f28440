"""Markers near one epipolar plane, from the images of films to the tables: doubtful without segments, decided with them, never wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsa_vision.cages import load_cage
from rsa_vision.examination import name_and_reconstruct
from rsa_vision.followup import follow_up
from rsa_vision.readings import FilmReading
from rsa_vision.segments import Segment
from rsa_vision.settings import Limits, Study
from rsa_vision.tables import examination_rows
from rsa_vision.types import Float
from synthetic.point_films import Objects, expose, random_exposure
from tests.identify.bodies import random_body

SEEDS = (117, 173, 196, 198, 205)  # doubtful pairs; of the last three the likelier ones are wrong
SIGMAS = 5.0


def examination(seed: int) -> tuple[Any, list[Segment], dict[str, Float]]:
    """Return the tables of an examination with cage 1A, its two segments, and where their markers truly are."""
    rng = np.random.default_rng(seed)
    cage = load_cage("1A")
    marks = np.array([mark.xyz for mark in cage.mark])
    foci = np.array([cage.foci[1], cage.foci[2]])
    segments, true = [], {}
    for k in range(2):
        body = random_body(rng, int(rng.integers(5, 8)), 12.0)
        middle = (marks.min(axis=0) + marks.max(axis=0)) / 2 + [0, 45 * (k - 0.5), -20]
        at = Rotation.random(random_state=rng).apply(body) + middle + rng.normal(0, 5, 3)
        for _ in range(int(rng.integers(1, 3))):  # into the plane through another one and the foci
            i, j = rng.choice(len(at), 2, replace=False)
            normal = np.cross(foci[0] - at[i], foci[1] - at[i])
            normal /= np.linalg.norm(normal)
            at[j] -= normal * ((at[j] - at[i]) @ normal) + normal * rng.normal(0, 0.01)
        known = (at - at.mean(axis=0)) @ Rotation.random(random_state=rng).as_matrix().T
        segments.append(Segment(f"s{k}", tuple(map(str, range(len(at)))), known))
        true |= {f"s{k}/{i}": place for i, place in enumerate(at + rng.normal(0, 0.03, at.shape))}
    places = np.array(list(true.values()))
    n = len(places)
    objects = Objects(places, np.full(n, 0.4), np.full(n, 0.3), np.zeros(n))
    exposure = random_exposure(rng, cage, pitch_mm=0.1, false_images=0, missing=0, slack_mm=0.0, mirrored=False)
    film = expose(cage, (1, 2), exposure, rng, objects)
    reading = FilmReading(Path("S_1.tif"), None, film.shape, (0.1, 0.1), "auto", film.images)
    return examination_rows("S", "1", [], name_and_reconstruct([reading], Study(), cage), 0.0), segments, true


def pairs_of(rows: Any) -> set[frozenset[int]]:
    named = [(index, row["number"]) for index, row in enumerate(rows["images"]) if row["role"] == "object"]
    return {frozenset(index for index, name in named if name == one) for _, one in named}


@pytest.mark.parametrize("seed", SEEDS)
def test_segments_decide_doubtful_pairs_rightly(seed: int) -> None:
    rows, segments, true = examination(seed)
    assert rows["exams"][0]["reasons"] == "pair-ambiguous"
    (named,) = follow_up([rows], {"S": segments}, Limits())
    assert (named["exams"][0]["status"], named["exams"][0]["reasons"]) == ("ok", "")
    assert "segments decide the doubtful pairs" in named["exams"][0]["message"]
    for row in named["markers"]:
        assert "ambiguous" not in row["flags"]
        place, sd = (np.array([row[f"{part}{axis}_mm"] for axis in "xyz"]) for part in ("", "sd_"))
        assert (np.abs(place - true[f"{row['segment']}/{row['marker']}"]) < SIGMAS * sd).all()
    assert {f"{row['segment']}/{row['marker']}" for row in named["markers"]} == set(true)
    assert (pairs_of(named) == pairs_of(rows)) == (seed < 196)
    objects = [row for row in named["images"] if row["role"] == "object"]
    assert all(row["used"] and row["x_mm"] is not None and row["residual_um"] is not None and row["focus"] in (1, 2) for row in objects)


def test_segments_that_do_not_fit_decide_nothing() -> None:
    rng = np.random.default_rng(1)
    for seed in SEEDS:
        rows, segments, _ = examination(seed)
        others = [Segment(one.name, one.markers, random_body(rng, len(one.markers), 12.0)) for one in segments]
        (named,) = follow_up([rows], {"S": others}, Limits())
        assert "pair-ambiguous" in named["exams"][0]["reasons"]
        assert pairs_of(named) == pairs_of(rows)
