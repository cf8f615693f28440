"""Naming the marks of a cage on films at the level of points: nothing wrong in silence, and most of it named."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from rsa_vision.cages import Cage, Mark, Plane, load_cage
from rsa_vision.flags import REASONS
from rsa_vision.identify.cage import CageIdentification, identify_cage
from rsa_vision.identify.film_model import build_scene
from rsa_vision.identify.hypotheses import largest_overlap
from rsa_vision.types import MarkerImages
from synthetic.point_films import FilmTruth, expose, random_exposure, random_foci, random_objects

EXAMINATIONS = int(os.environ.get("RSA_VISION_EXAMINATIONS", "24"))  # of each cage; thousands take minutes


def identify(film: FilmTruth, cage: Cage, foci: tuple[int, ...], **options: object) -> CageIdentification:
    return identify_cage(film.images, cage, foci, **{"pitch_mm": (0.1, 0.1), "film_shape": film.shape, **options})  # type: ignore[arg-type]


def films_of(cage: Cage) -> list[tuple[int, ...]]:
    return [tuple(cage.foci)] if cage.film == "shared" else [(focus,) for focus in cage.foci]


def suffices(film: FilmTruth, cage: Cage, foci: tuple[int, ...]) -> bool:
    """Return whether two thirds of the marks of every focus have an image."""
    return all(
        film.visible(f, role) >= len(cage.marks_of(f, role)) - len(cage.marks_of(f, role)) // 3
        for f in foci
        for role in ("fiducial", "control")
    )


def small_cage(controls: int) -> Cage:
    corners = [(-80.0, 0.0), (90.0, 10.0), (-60.0, 180.0), (75.0, 200.0)]
    posts = [(-40.0, 30.0), (45.0, 160.0), (50.0, 40.0), (-45.0, 150.0)][:controls]
    marks = [
        Mark(number=i + 1, role="fiducial", foci=(1,), shape="ball", xyz=(x, y, 0.0), diameter=0.8) for i, (x, y) in enumerate(corners)
    ] + [Mark(number=i + 11, role="control", foci=(1,), shape="ball", xyz=(x, y, 160.0), diameter=0.8) for i, (x, y) in enumerate(posts)]
    plane = Plane(foci=(1,), origin=(0.0, 0.0, 0.0), u=(1.0, 0.0, 0.0), v=(0.0, 1.0, 0.0))
    return Cage(
        name="small",
        film="separate",
        material="plexiglas",
        calibrated_at_c=23.5,
        foci={1: (0.0, 100.0, 1000.0)},
        plane=(plane,),
        mark=tuple(marks),
    )


@pytest.mark.parametrize("name", ["1A", "1B", "1B-420", "2"])
def test_random_examinations_have_no_silent_error(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    cage = load_cage(name)
    counts = {"films": 0, "enough marks": 0, "named": 0, "told": 0}
    seconds = []
    for seed in range(EXAMINATIONS):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage)
        for foci in films_of(cage):
            film = expose(cage, foci, exposure, rng)
            start = time.process_time()
            result = identify(film, cage, foci)
            seconds.append(time.process_time() - start)
            decisive = bool(result) and "cage-ambiguous" not in result.reasons
            counts["films"] += 1
            counts["told"] += not decisive
            if decisive:
                assert film.errors(result.assignments) == [], f"seed {seed}, film {foci}"
            if suffices(film, cage, foci):
                counts["enough marks"] += 1
                counts["named"] += decisive
    with capsys.disabled():
        print(f"\n{name}: {counts}, silent errors 0, {np.mean(seconds):.3f} s a film (largest {max(seconds):.3f})")
    assert counts["named"] >= 0.98 * counts["enough marks"]
    assert counts["enough marks"] > 0.5 * counts["films"]


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
def test_estimates_agree_with_the_truth(name: str) -> None:
    cage, rng = load_cage(name), np.random.default_rng(5)
    exposure = random_exposure(rng, cage, noise_px=0.01, slack_mm=0.0, missing=0, misread=0.0)
    for foci in films_of(cage):
        film = expose(cage, foci, exposure, rng)
        result = identify(film, cage, foci)
        assert result.reasons == ()
        assert result.posterior > 0.999
        for focus in foci:
            assert np.linalg.norm(result.focus_mm[focus] - exposure.foci_mm[focus]) < 1.0
            plane = cage.plane_of(focus)
            origin, basis = plane.lab_from_plane()
            for mark in cage.marks_of(focus, "fiducial"):
                place = result.plane_from_film[focus] @ np.append(film.place_px[focus, "fiducial", mark.number], 1)
                np.testing.assert_allclose(place[:2] / place[2], basis @ (np.array(mark.xyz) - origin), atol=0.01)


@pytest.mark.parametrize("said", ["1A", "1B", "1B-420", "2"])
@pytest.mark.parametrize("true", ["1A", "1B", "1B-420", "2", "clutter", "objects"])
def test_film_of_another_cage_or_of_none_is_never_ok(said: str, true: str) -> None:
    if said == true:
        pytest.skip("the same cage")
    named = load_cage(said)
    cage = load_cage(true) if true in ("1A", "1B", "1B-420", "2") else named
    for seed in range(max(8, EXAMINATIONS // 5)):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage, missing=int(rng.integers(0, 3)))
        foci = (1, 2) if named.film == "shared" else (1 + seed % 2,)
        if cage is named:
            film = expose(cage, foci, replace(exposure, false_images=int(rng.integers(0, 290))), rng)
            wanted = ("false",) if true == "clutter" else ("false", "object")
            images = film.images.rows(np.array([name[0] in wanted for name in film.source]))
        else:
            film = expose(cage, (1, 2) if cage.film == "shared" else (1 + seed % 2,), exposure, rng)
            images = film.images
        result = identify_cage(images, named, foci, pitch_mm=(0.1, 0.1), film_shape=film.shape)
        assert not result, f"seed {seed}"
        assert result.reasons == ("cage-not-found",)
        assert not result.explained.any()


def test_tees_are_not_found_on_a_film_of_balls() -> None:
    cage, rng = load_cage("1A"), np.random.default_rng(3)
    film = expose(cage, (1, 2), random_exposure(rng, cage, false_images=5, missing=0), rng)
    balls = replace(film.images, shape=np.full(len(film.images), "ball"), angle_deg=np.full(len(film.images), np.nan))
    result = identify_cage(balls, cage, (1, 2), pitch_mm=(0.1, 0.1), film_shape=film.shape)
    assert not result
    assert "another shape" in result.runner_up


@pytest.mark.parametrize(("name", "expected"), [("1A", True), ("1B", False)])
def test_any_orientation_is_decided_by_tees_only(name: str, expected: bool) -> None:
    cage = load_cage(name)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1, 2), random_exposure(rng, cage, turn_deg=rng.uniform(-180, 180), missing=1), rng)
        result = identify(film, cage, (1, 2), orientation="any")
        assert ("cage-ambiguous" not in result.reasons) == expected
        if expected:
            assert film.errors(result.assignments) == []


def test_upside_down_tees_are_refused() -> None:
    cage, rng = load_cage("1A"), np.random.default_rng(1)
    film = expose(cage, (1, 2), random_exposure(rng, cage, turn_deg=180.0, missing=0), rng)
    result = identify(film, cage, (1, 2))
    assert not result


@pytest.mark.parametrize("name", ["1A", "1B", "2"])
def test_mirrored_film(name: str) -> None:
    cage, rng = load_cage(name), np.random.default_rng(2)
    exposure = random_exposure(rng, cage, mirrored=True, missing=1)
    for foci in films_of(cage):
        film = expose(cage, foci, exposure, rng)
        result = identify(film, cage, foci, orientation="mirrored")
        assert result.reasons == ()
        assert film.errors(result.assignments) == []


@pytest.mark.parametrize("change", ["exchanged", "turned", "mirrored"])
def test_marks_of_the_other_plane_tell_of_a_wrong_name_or_orientation(change: str) -> None:
    cage = load_cage("2")
    for seed in range(5):
        rng = np.random.default_rng(seed)
        fixed = {"exchanged": {}, "turned": {"turn_deg": 180.0}, "mirrored": {"mirrored": True}}[change]
        film = expose(cage, (1,), random_exposure(rng, cage, missing=0, **fixed), rng)
        result = identify(film, cage, (2,) if change == "exchanged" else (1,))
        assert "cage-ambiguous" in result.reasons
        assert result.runner_up


def test_far_focus_is_said() -> None:
    cage, rng = load_cage("1A"), np.random.default_rng(4)
    film = expose(cage, (1, 2), random_exposure(rng, cage, foci_mm=random_foci(cage, rng, 190.0), missing=0), rng)
    result = identify(film, cage, (1, 2))
    assert "focus-far" in result.reasons
    assert film.errors(result.assignments) == []


@pytest.mark.parametrize("gap_mm", [0.3, 1.0, 2.0, 30.0, 40.0])
@pytest.mark.parametrize("name", ["1A", "1B"])
def test_images_of_both_foci_at_any_distance(name: str, gap_mm: float) -> None:
    cage = load_cage(name)
    named = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1, 2), random_exposure(rng, cage, gap_mm=gap_mm, missing=0, misread=0.0), rng)
        result = identify(film, cage, (1, 2))
        named += not result.reasons
        if not result.reasons:
            assert film.errors(result.assignments) == [], f"seed {seed}"
    assert named >= (3 if gap_mm >= 1 else 0)


def test_foreign_marks_and_parts_of_tees_are_explained() -> None:
    for name, kind in (("1B", "foreign"), ("2", "foreign"), ("1A", "arm")):
        cage, rng = load_cage(name), np.random.default_rng(6)
        exposure = random_exposure(rng, cage, missing=0, arms=0.3, false_images=20, misread=0.0, slack_mm=0.0, gap_mm=10.0)
        foci = films_of(cage)[0]
        film = expose(cage, foci, exposure, rng)
        result = identify(film, cage, foci)
        mine = np.array([source[0] == kind for source in film.source])
        objects = np.array([source[0] == "object" for source in film.source])
        assert mine.any()
        assert result.explained[mine].all()
        if kind == "foreign":
            assert result.foreign[mine].all()
            assert not result.foreign[~mine].any()
        assert result.explained[objects].sum() <= 1  # one may lie on a mark


def test_gross_error_is_dropped_and_reported() -> None:
    cage, rng = load_cage("1B"), np.random.default_rng(7)
    film = expose(cage, (1, 2), random_exposure(rng, cage, missing=0, false_images=0, noise_px=0.03, slack_mm=0.0, gap_mm=10.0), rng)
    row = next(i for i, source in enumerate(film.source) if source[:4] == ("mark", 1, "fiducial", 4))
    position = film.images.position_px.copy()
    position[row] += [1.2, 0.8]
    result = identify_cage(replace(film.images, position_px=position), cage, (1, 2), pitch_mm=(0.1, 0.1), film_shape=film.shape)
    assert ("fiducial", 4) not in result.assignments[1]
    assert row not in result.assignments[1].values()
    assert result.explained[row]
    alone = {s[2:4] for s in film.source if s[:2] == ("mark", 1) and len(s) == 4}  # images that melted may be left out as well
    assert set(result.assignments[1]) >= alone - {("fiducial", 4)}


@pytest.mark.parametrize("tilt", [(0.03, 0.0), (0.0, 0.03), (-0.025, 0.025)])
def test_keystone_of_a_tilted_film_is_followed_on_a_long_cage(tilt: tuple[float, float]) -> None:
    cage = load_cage("1B-420")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1, 2), random_exposure(rng, cage, tilt=tilt, gap_mm=20.0, missing=1, false_images=60), rng)
        result = identify(film, cage, (1, 2))
        assert result
        assert film.errors(result.assignments) == []


def images_at(position: np.ndarray, shape: str = "tee") -> MarkerImages:
    n = len(position)
    ones = np.ones(n)
    return MarkerImages(
        position,
        0.01 * np.tile(np.eye(2), (n, 1, 1)),
        np.full(n, shape),
        3 * ones,
        90 * ones,
        ones / 3,
        ones / 2,
        30 * ones,
        np.zeros(n, int),
    )


@pytest.mark.parametrize(
    "position",
    [
        np.zeros((0, 2)),
        np.full((1, 2), 100.0),
        np.full((60, 2), 1000.0),
        np.full((50, 2), np.nan),
        np.stack([np.linspace(0, 3000, 60), np.linspace(0, 4000, 60)], 1),
        np.stack(np.meshgrid(np.arange(12) * 250.0, np.arange(15) * 250.0), -1).reshape(-1, 2),
        np.full((30, 2), np.inf),
        np.random.default_rng(0).uniform(-1e7, 1e7, (80, 2)),
    ],
    ids=["none", "one", "identical", "nan", "line", "lattice", "infinite", "far outside"],
)
@pytest.mark.parametrize("name", ["1A", "1B", "2"])
def test_bad_input_is_an_answer_not_an_exception(name: str, position: np.ndarray) -> None:
    cage = load_cage(name)
    for shape in ("ball", "tee"):
        for foci in films_of(cage):
            result = identify_cage(images_at(position, shape), cage, foci, pitch_mm=(0.1, 0.1), film_shape=(4300, 3500))
            assert not result
            assert result.reasons == ("cage-not-found",)
            assert len(result.explained) == len(position)


def test_nan_among_good_images_and_covariances_are_borne() -> None:
    cage, rng = load_cage("1A"), np.random.default_rng(9)
    film = expose(cage, (1, 2), random_exposure(rng, cage, missing=0, false_images=30), rng)
    position, covariance = film.images.position_px.copy(), film.images.covariance_px2.copy()
    bad = [i for i, source in enumerate(film.source) if source[0] == "false"][:10]
    position[bad] = np.nan
    covariance[::7] = np.nan
    covariance[::11] = 0.0
    result = identify_cage(
        replace(film.images, position_px=position, covariance_px2=covariance), cage, (1, 2), pitch_mm=(0.1, 0.1), film_shape=film.shape
    )
    assert result
    assert not set(bad) & {i for marks in result.assignments.values() for i in marks.values()}
    assert set(result.reasons) <= set(REASONS)


def test_hidden_end_columns_with_other_foci_are_ambiguous() -> None:
    """Columns of cage 1B-420 are 50 and 45 mm apart: with an end column hidden, all names moved by one agree with foci 17 mm away."""
    cage = load_cage("1B-420")
    hidden = {1: {("fiducial", 1), ("fiducial", 6), ("control", 11), ("control", 18)}}
    hidden[2] = {("fiducial", 1), ("fiducial", 6), ("control", 14), ("control", 21)}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage, missing=0, false_images=10, turn_deg=5.0, slack_mm=0.0, foci_mm=random_foci(cage, rng, 60.0))
        film = expose(cage, (1, 2), exposure, rng)
        kept = np.array([source[0] != "mark" or source[2:4] not in hidden[source[1]] for source in film.source])
        result = identify(replace(film, images=film.images.rows(kept)), cage, (1, 2))
        assert "cage-ambiguous" in result.reasons, f"seed {seed}"
        assert result.runner_up


def test_what_a_move_by_a_mark_finds_is_moved_again() -> None:
    """Half the columns off the film, the foci 12 cm from nominal: of all first hypotheses the best is two columns from the truth."""
    cage, rng = load_cage("1B-420"), np.random.default_rng([979, 2])
    rng.random()
    objects = random_objects(cage, int(rng.integers(5, 21)), rng, hidden=float(rng.choice([0.0, 0.02, 0.1])))
    rng.random()
    foci_mm = random_exposure(rng, cage).foci_mm
    rng.random()
    rng.choice([0.0, 0.005, 0.01])
    film = expose(cage, (1, 2), random_exposure(rng, cage, foci_mm=foci_mm, pitch_mm=0.1, false_images=0, slack_mm=0.0), rng, objects)
    result = identify(film, cage, (1, 2))
    assert result
    assert film.errors(result.assignments) == []


def test_hidden_end_column_of_long_rows_is_weighed_too() -> None:
    """Of rows of eight, seven marks in eight fit all names moved by one: a film that shows so many is not complete."""
    few = small_cage(2)
    rows = [("fiducial", 25.0, 0.0, (0.0, 200.0), 1), ("control", 24.0, 150.0, (40.0, 160.0), 101)]
    marks = [
        Mark(number=first + 8 * j + i, role=role, foci=(1,), shape="ball", xyz=(step * (i - 3.5), y, z), diameter=0.8)  # type: ignore[arg-type]
        for role, step, z, ys, first in rows
        for j, y in enumerate(ys)
        for i in range(8)
    ]
    cage = few.model_copy(update={"mark": tuple(marks)})
    assert largest_overlap(build_scene(cage, (1,), {1: np.array(cage.foci[1])})) == 7 / 8
    for seed in range(3):
        rng = np.random.default_rng(seed)
        exposure = random_exposure(rng, cage, missing=0, false_images=5, turn_deg=3.0, slack_mm=0.0, foci_mm=random_foci(cage, rng, 40.0))
        film = expose(cage, (1,), exposure, rng)
        kept = np.array([source[0] != "mark" or source[3] not in {1, 9, 101, 109} for source in film.source])
        assert "cage-ambiguous" in identify(replace(film, images=film.images.rows(kept)), cage, (1,)).reasons, f"seed {seed}"


def test_three_of_eight_control_points_may_be_covered() -> None:
    cage = load_cage("1B")
    covered = {(1, 12), (1, 19), (2, 14), (2, 17), (2, 22)}
    for seed in range(3):
        rng = np.random.default_rng(seed)
        film = expose(cage, (1, 2), random_exposure(rng, cage, missing=0, false_images=10, turn_deg=2.0, noise_px=0.03), rng)
        kept = np.array([source[0] != "mark" or (source[1], source[3]) not in covered for source in film.source])
        film = replace(film, images=film.images.rows(kept), source=[s for s, keep in zip(film.source, kept, strict=True) if keep])
        result = identify(film, cage, (1, 2))
        assert result, f"seed {seed}"
        assert "cage-ambiguous" not in result.reasons
        assert film.errors(result.assignments) == []
