"""Whole examinations and studies: films, names, truth."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import polars as pl

from rsa_vision.cages import Cage, load_cage
from rsa_vision.types import Float
from synthetic.anatomy import DISTRACTORS, blemishes, distractor_solids, tissue_with_bones
from synthetic.film import FilmPlane, Pose, place_film
from synthetic.motion import Motion, next_pose, share_out
from synthetic.render import Beam, expose
from synthetic.scanner import FilmCurve, Response, Scanner, add_quantum_noise, digitise
from synthetic.scene import TANTALUM_PER_MM, ObjectMarker, Scene, missing_by_focus, object_box, place_objects, shift_foci
from synthetic.truth import truth_tables
from synthetic.write import Values, write_film, write_truth

FIRST_EXAM: Final = datetime(2026, 1, 1, 9)  # local time, as names of films tell it


@dataclass(frozen=True, slots=True, eq=False)
class RenderedExamination:
    """Films of one examination and their truth.

    Attributes
    ----------
    films : dict of str to ndarray of shape (rows, cols)
        Stored values (uint8 or uint16) by file name.
    film_foci : dict of str to tuple of int
        The foci that exposed each film.
    pitch_mm : tuple of two floats
        (row, col).
    bits : int
    scene : Scene
    planes : dict of str to FilmPlane
        Where each film lay.
    images, foci, markers : polars.DataFrame
        The truth, in the columns of the CSV files of these names.
    """

    films: dict[str, Values]
    film_foci: dict[str, tuple[int, ...]]
    pitch_mm: tuple[float, float]
    bits: int
    scene: Scene
    planes: dict[str, FilmPlane]
    images: pl.DataFrame
    foci: pl.DataFrame
    markers: pl.DataFrame

    def write(self, folder: Path, *, with_pitch: bool = True) -> list[Path]:
        """Write the films (not the truth) into a folder and return their paths."""
        folder.mkdir(parents=True, exist_ok=True)
        pitch = self.pitch_mm if with_pitch else None
        for name, values in self.films.items():
            write_film(folder / name, values, bits=self.bits, pitch_mm=pitch)
        return [folder / name for name in self.films]


def render_examination(
    cage: Cage | str | Path,
    *,
    rng: np.random.Generator,
    subject: str = "S01",
    exam: str = "202601010900",
    extension: str = "tif",
    n_objects: int = 13,
    segments: Mapping[str, int] | None = None,
    object_diameter_mm: float = 0.8,
    markers: Sequence[ObjectMarker] | None = None,
    box_mm: Float | None = None,
    gap_diameters: float = 3.0,
    clear_of_marks: bool = True,
    foci_mm: Mapping[int, Float] | None = None,
    focus_shift_mm: float = 10.0,
    shared: bool | None = None,
    film_size_mm: tuple[float, float] | None = None,
    pitch_mm: float | tuple[float, float] = 0.1,
    rotation_deg: float | None = None,
    shift_mm: tuple[float, float] | None = None,
    anisotropy: float = 0.0,
    shear: float = 0.0,
    mirrored: bool = False,
    response: Response = "density",
    bits: int = 16,
    quanta: float | None = 4000.0,
    noise: Literal["screen", "white"] = "screen",
    blur_mm: float = 0.1,
    scanner_noise: float = 0.0,
    inverted: bool = False,
    focal_mm: float = 0.7,
    double_peaked: bool = False,
    scatter: float = 0.0,
    bone: bool = False,
    clutter: bool | Collection[str] = False,
    missing_marks: Mapping[int, Collection[int]] | Collection[int] = (),
    foreign_marks: bool = True,
    taper_mm: float | None = None,
    attenuation_per_mm: float = TANTALUM_PER_MM,
    fine: int = 5,
) -> RenderedExamination:
    """Render one examination.

    Parameters
    ----------
    cage : Cage, or name or path of one
    rng : numpy Generator
        Everything random comes from it: the same state gives the same films.
    subject, exam, extension : str
        Make the file names, ``SUBJECT_EXAM[_fK].EXT``.
    n_objects : int
        Balls of ``object_diameter_mm`` at random places (segment ``P``), unless ``markers`` says where they are.
    segments : mapping of str to int, optional
        Names of segments and the number of their balls, instead of ``n_objects``; the first lie lowest in y.
    markers : sequence of ObjectMarker, optional
    box_mm : ndarray of shape (2, 3), optional
        Where the object is; default :func:`synthetic.scene.object_box`.
    gap_diameters, clear_of_marks
        As of :func:`synthetic.scene.place_objects`.
    foci_mm : mapping of int to ndarray, optional
        The true foci; default: the cage's, each moved by ``focus_shift_mm`` in a random direction.
    shared : bool, optional
        All exposures on one film, or one film each; default: as the cage.
    film_size_mm : tuple of two floats, optional
        Along u and v; default: what the cage marks need.
    pitch_mm : float, or tuple (row, col)
    rotation_deg, shift_mm : optional
        Of the film on the scanner (:class:`synthetic.film.Pose`); default: random, sd 1.5 deg and 1.5 mm, another for each film.
    anisotropy, shear, mirrored
        As of :class:`synthetic.film.Pose`.
    response, bits, quanta, noise, blur_mm, scanner_noise, inverted
        As of :class:`synthetic.scanner.Scanner`. On a shared film ``quanta`` is the sum of the exposures.
    focal_mm, double_peaked, scatter
        As of :class:`synthetic.render.Beam`.
    bone : bool
        Put a limb around the object.
    clutter : bool or collection of str
        Distractors of :data:`synthetic.anatomy.DISTRACTORS`; True: all.
    missing_marks : mapping of focus to numbers, or numbers
        Cage marks that are not on the film.
    foreign_marks : bool
        Whether exposures also show the marks that their focus is not meant to see.
    taper_mm : float, optional
        Conical part of the cage's pins; default: all of it.
    attenuation_per_mm : float
        Of the markers.
    fine : int
        Rays along the side of a pixel for each of 25 points of the focal spot.

    Returns
    -------
    RenderedExamination
    """
    cage = cage if isinstance(cage, Cage) else load_cage(cage)
    pitch = (pitch_mm, pitch_mm) if isinstance(pitch_mm, int | float) else pitch_mm
    sources = {k: np.asarray(v, float) for k, v in foci_mm.items()} if foci_mm else shift_foci(cage, focus_shift_mm, rng)
    numbers = tuple(sorted(sources))
    on_one = cage.film == "shared" if shared is None else shared
    groups: dict[str, tuple[int, ...]] = {f"{subject}_{exam}_f{k}.{extension}": (k,) for k in numbers}
    if on_one:
        groups = {f"{subject}_{exam}.{extension}": numbers}
    planes: dict[str, FilmPlane] = {}
    for name, group in groups.items():
        turn = float(rng.normal(0, 1.5)) if rotation_deg is None else rotation_deg
        move = (float(rng.normal(0, 1.5)), float(rng.normal(0, 1.5))) if shift_mm is None else shift_mm
        pose = Pose(turn, move, anisotropy, shear, mirrored)
        planes[name] = place_film(cage, sources, group, pitch_mm=pitch, pose=pose, size_mm=film_size_mm)

    box = object_box(cage) if box_mm is None else np.asarray(box_mm, float)
    missing = missing_by_focus(cage, missing_marks)
    kinds = tuple(DISTRACTORS) if clutter is True else tuple(clutter or ())
    bare: dict[str, Any] = {"missing_marks": missing, "foreign_marks": foreign_marks, "taper_mm": taper_mm}
    bare |= {"attenuation_per_mm": attenuation_per_mm}
    scene = Scene(cage, sources, **bare)
    if markers is None:
        film_of = {k: planes[name] for name, group in groups.items() for k in group}
        count = sum(segments.values()) if segments else n_objects
        gaps: dict[str, Any] = {"gap_diameters": gap_diameters, "clear_of_marks": clear_of_marks, "box_mm": box}
        markers = place_objects(scene, film_of, count, rng=rng, diameter_mm=object_diameter_mm, **gaps)
        markers = share_out(markers, segments) if segments else markers
    solids = distractor_solids(kinds, planes, box, rng)
    tissue = tissue_with_bones(box, rng) if bone else ()
    scene = Scene(cage, sources, tuple(markers), solids, tissue, **bare)

    beam = Beam(focal_mm, double_peaked, scatter)
    scanner = Scanner(response, bits, quanta, noise, blur_mm, scanner_noise, inverted)
    films: dict[str, Values] = {}
    for name, film in planes.items():
        exposure = expose(scene, film, beam, blur_mm=blur_mm, fine=fine)
        scanner = replace(scanner, curve=FilmCurve().timed_for(exposure))
        films[name] = digitise(add_quantum_noise(exposure, scanner, film, rng), scanner, rng, blemishes(kinds, film.shape, rng))
    truth = truth_tables(scene, planes, subject, exam)
    return RenderedExamination(films, groups, pitch, bits, scene, planes, truth["images"], truth["foci"], truth["markers"])


def make_study(
    folder: Path,
    cage: Cage | str | Path,
    *,
    rng: np.random.Generator,
    n_exams: int = 2,
    interval_days: int = 1,
    subjects: Sequence[str] = ("S01",),
    segments: Mapping[str, int] | None = None,
    motion: Motion | None = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> list[Path]:
    """Write a folder of films with its ``study.toml``, and the truth in ``truth/``.

    From one examination to the next the whole object takes another pose of a few mm and degrees, and the last segment moves by ``motion``
    relative to the others.

    Parameters
    ----------
    folder : Path
    cage : Cage, or name or path of one
    rng : numpy Generator
    n_exams : int
        Examinations of each subject.
    interval_days : int
        From each to the next.
    subjects : sequence of str
    segments : mapping of str to int, optional
        Number of balls in each segment; default: bone 7, implant 6.
    motion : Motion, optional
        Default: a degree and half a millimetre order.
    settings : mapping, optional
        More keys for ``study.toml``.
    **options
        As of :func:`render_examination`.

    Returns
    -------
    list of Path
        The films.
    """
    loaded = cage if isinstance(cage, Cage) else load_cage(cage)
    segments = {"bone": 7, "implant": 6} if segments is None else segments
    motion = Motion((1.0, -0.6, 0.4), (0.2, 0.5, -0.3)) if motion is None else motion
    box = object_box(loaded) if options.get("box_mm") is None else np.asarray(options["box_mm"], float)
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    tables: dict[str, list[pl.DataFrame]] = {"images": [], "foci": [], "markers": [], "segments": []}
    for subject in subjects:
        for k in range(n_exams):
            exam = f"{FIRST_EXAM + timedelta(k * interval_days):%Y%m%d%H%M}"
            named: dict[str, Any] = {"rng": rng, "subject": subject, "exam": exam}
            if k == 0:
                shot = render_examination(loaded, **named, **{"segments": segments, **options})
                columns = ["subject", "segment", "marker", "x_mm", "y_mm", "z_mm"]
                tables["segments"].append(shot.markers.select(columns))
            else:
                films = {focus: film for film in shot.planes.values() for focus in film.foci}
                markers = next_pose(shot.scene, films, motion, list(segments)[-1], box.mean(0), rng)
                shot = render_examination(loaded, **named, **{**options, "markers": markers})
            paths += shot.write(folder)
            for name in ("images", "foci", "markers"):
                tables[name].append(getattr(shot, name))
    write_truth(folder / "truth", {name: pl.concat(parts) for name, parts in tables.items()})
    known = {"cage": str(cage) if not isinstance(cage, Cage) else cage.name, **(settings or {})}
    shared = options.get("shared")
    if shared is not None:
        known["film"] = "shared" if shared else "separate"
    if options.get("mirrored"):
        known["orientation"] = "mirrored"
    lines = (f"{key} = {_toml(value)}\n" for key, value in known.items())
    (folder / "study.toml").write_text("".join(lines), encoding="utf-8")
    return paths


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value).lower() if isinstance(value, bool) else repr(value)
