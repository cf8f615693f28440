"""What stands between the foci and the film: cage marks, object markers, bone, soft tissue, and things that are no markers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rsa_vision.cages import Cage, Mark
from rsa_vision.types import Float
from synthetic.film import FilmPlane

TANTALUM_PER_MM = 8.0  # effective attenuation at 60-120 kV after filtering by the patient
STEEL_PER_MM = 1.2
TITANIUM_PER_MM = 0.25
LEAD_PER_MM = 6.0
MAGNIFICATION = 1.2  # of a ball in the middle of a cage
TRIES = 1000  # places to try for each object marker


@dataclass(frozen=True, slots=True, eq=False)
class Ball:
    """A ball; ``centre`` mm, ``attenuation`` 1/mm."""

    centre: Float
    radius: float
    attenuation: float = TANTALUM_PER_MM


@dataclass(frozen=True, slots=True, eq=False)
class Pin:
    """A cone from ``tip`` over ``taper`` mm (None: the whole length), then a cylinder; ``axis`` is a unit vector away from the tip."""

    tip: Float
    axis: Float
    length: float
    radius: float
    taper: float | None = None
    attenuation: float = TANTALUM_PER_MM


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Bone or soft tissue: ``unit_from_lab``, shape (3, 3), makes it a unit ball.

    The larger ``softness`` is, the more its density falls off towards its rim; 0 is homogeneous.
    """

    centre: Float
    unit_from_lab: Float
    attenuation: float
    softness: float = 0.5


Solid = Ball | Pin


@dataclass(frozen=True, slots=True, eq=False)
class ObjectMarker:
    """A marker of the object; ``arms`` (k, 3) and ``length_mm`` make it a pin (one arm) or a tee (three)."""

    segment: str
    marker: str
    position_mm: Float
    diameter_mm: float = 0.8
    arms: tuple[tuple[float, float, float], ...] = ()
    length_mm: float = 2.0

    @property
    def shape(self) -> Literal["ball", "pin", "tee"]:
        """The marker's shape, by its arms."""
        return "ball" if not self.arms else "pin" if len(self.arms) == 1 else "tee"

    def moved(self, rotation: Float, translation_mm: Float, about_mm: Float) -> ObjectMarker:
        """Return the marker turned by ``rotation`` (3, 3) about a point, then shifted."""
        arms = tuple((float(x), float(y), float(z)) for x, y, z in (rotation @ np.array(arm) for arm in self.arms))
        return replace(self, position_mm=rotation @ (self.position_mm - about_mm) + about_mm + translation_mm, arms=arms)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One examination as it was in the room.

    Attributes
    ----------
    cage : Cage
    foci_mm : dict of int to ndarray of shape (3,)
        The true foci: centroids of the focal spots.
    markers : tuple of ObjectMarker
    clutter : tuple of Ball and Pin
        Solids without truth: screws, wires, letters.
    tissue : tuple of Ellipsoid
    missing_marks : dict of int to frozenset of int
        Numbers of cage marks that an exposure does not show, by focus.
    foreign_marks : bool
        Whether an exposure also shows the marks that its focus is not meant to see (it does, in the room).
    taper_mm : float or None
        Conical part of the cage's pins; None: all of it.
    attenuation_per_mm : float
        Of the markers.
    """

    cage: Cage
    foci_mm: dict[int, Float]
    markers: tuple[ObjectMarker, ...] = ()
    clutter: tuple[Solid, ...] = ()
    tissue: tuple[Ellipsoid, ...] = ()
    missing_marks: Mapping[int, frozenset[int]] = field(default_factory=dict)
    foreign_marks: bool = True
    taper_mm: float | None = None
    attenuation_per_mm: float = TANTALUM_PER_MM

    def marks_shown(self, focus: int) -> tuple[Mark, ...]:
        """Return the cage marks in the way of one focus's rays."""
        missing = self.missing_marks.get(focus, frozenset())
        shown = (mark for mark in self.cage.mark if self.foreign_marks or focus in mark.foci)
        return tuple(mark for mark in shown if not (focus in mark.foci and mark.number in missing))

    def solids(self, focus: int) -> list[Solid]:
        """Return all small solids in the way of one focus's rays."""
        mu = self.attenuation_per_mm
        solids: list[Solid] = []
        for mark in self.marks_shown(focus):
            solids += shape_solids(np.array(mark.xyz, float), mark.diameter, mark.arms, mark.length or 0.0, self.taper_mm, mu)
        for marker in self.markers:
            solids += shape_solids(marker.position_mm, marker.diameter_mm, marker.arms, marker.length_mm, None, mu)
        return solids + list(self.clutter)


def shape_solids(
    position_mm: Float,
    diameter_mm: float,
    arms: Iterable[tuple[float, float, float]],
    length_mm: float,
    taper_mm: float | None = None,
    attenuation: float = TANTALUM_PER_MM,
) -> list[Solid]:
    """Return a ball, or a pin along every arm with its tip at the position."""
    axes = [np.array(arm, float) / np.linalg.norm(arm) for arm in arms]
    if not axes:
        return [Ball(position_mm, diameter_mm / 2, attenuation)]
    return [Pin(position_mm, axis, length_mm, diameter_mm / 2, taper_mm, attenuation) for axis in axes]


def shift_foci(cage: Cage, shift_mm: float, rng: np.random.Generator) -> dict[int, Float]:
    """Return the foci moved from nominal by ``shift_mm``, each in a random direction."""
    moved = {}
    for focus, nominal_mm in sorted(cage.foci.items()):
        direction = rng.standard_normal(3)
        moved[focus] = np.array(nominal_mm, float) + shift_mm * direction / np.linalg.norm(direction)
    return moved


def object_box(cage: Cage) -> Float:
    """Return the corners (low, high), shape (2, 3), mm, of a box for the object between the fiducial planes and the control points.

    It lies in the middle of the marks and takes six tenths of their extent in every direction.
    """
    marks = np.array([mark.xyz for mark in cage.mark], float)
    low, high = marks.min(0), marks.max(0)
    middle, half = (low + high) / 2, 0.3 * (high - low)
    return np.array([middle - half, middle + half])


def clearance_mm(scene: Scene, films: Mapping[int, FilmPlane], *, clear_of_marks: bool = True) -> Float:
    """Return how far the images of each marker are from all other images on their film and from its edge.

    Parameters
    ----------
    scene : Scene
    films : mapping of int to FilmPlane
        The film of each focus; foci on one film share the object.
    clear_of_marks : bool
        Whether images of cage marks count; from them their length is taken off.

    Returns
    -------
    ndarray of shape (n markers,)
        mm on the film, between centres.
    """
    points = np.array([marker.position_mm for marker in scene.markers], float).reshape(-1, 3)
    least = np.full(len(points), np.inf)
    for film in set(films.values()):
        pitch = min(film.pitch_mm)
        groups = [film.project(scene.foci_mm[focus], points) for focus in film.foci]
        images = np.concatenate(groups)
        marks = [(focus, mark) for focus in film.foci for mark in scene.marks_shown(focus)] if clear_of_marks else []
        others = [film.project(scene.foci_mm[focus], np.array(mark.xyz, float)) for focus, mark in marks]
        reach = np.array([1.2 * (mark.length or 0.0) for _, mark in marks])
        gap = np.linalg.norm(images[:, None] - images, axis=-1) * pitch
        np.fill_diagonal(gap, np.inf)
        to_marks = np.linalg.norm(images[:, None] - np.reshape(others, (-1, 2)), axis=-1) * pitch - reach
        rows, cols = film.shape
        to_edge = np.min([images[:, 0], images[:, 1], cols - 1 - images[:, 0], rows - 1 - images[:, 1]], axis=0) * pitch
        own = np.min([gap.min(1, initial=np.inf), to_marks.min(1, initial=np.inf), to_edge], axis=0)
        least = np.minimum(least, own.reshape(len(groups), -1).min(0))
    return least


def place_objects(
    scene: Scene,
    films: Mapping[int, FilmPlane],
    count: int,
    *,
    rng: np.random.Generator,
    diameter_mm: float = 0.8,
    gap_diameters: float = 3.0,
    box_mm: Float | None = None,
    clear_of_marks: bool = True,
    segment: str = "P",
) -> tuple[ObjectMarker, ...]:
    """Place balls at random where all foci see them and no image touches another.

    Parameters
    ----------
    scene : Scene
        Its marks and markers are in the way.
    films : mapping of int to FilmPlane
        As of :func:`clearance_mm`.
    count : int
    rng : numpy Generator
    diameter_mm : float
    gap_diameters : float
        Least :func:`clearance_mm`, in diameters of their images.
    box_mm : ndarray of shape (2, 3), optional
        Corners low and high; default :func:`object_box`.
    clear_of_marks : bool
    segment : str

    Returns
    -------
    tuple of ObjectMarker
        The new ones, numbered from 1.

    Raises
    ------
    ValueError
        If there is no room for so many.
    """
    low, high = object_box(scene.cage) if box_mm is None else np.asarray(box_mm, float)
    gap_mm = MAGNIFICATION * gap_diameters * diameter_mm
    placed: list[ObjectMarker] = []
    for _ in range(TRIES * count):
        if len(placed) == count:
            break
        candidate = ObjectMarker(segment, str(len(placed) + 1), rng.uniform(low, high), diameter_mm)
        trial = replace(scene, markers=(*scene.markers, *placed, candidate))
        if clearance_mm(trial, films, clear_of_marks=clear_of_marks)[-1] > gap_mm:
            placed.append(candidate)
    if len(placed) < count:
        raise ValueError(f"no room for {count} markers {gap_diameters} diameters apart: enlarge box_mm or lower gap_diameters")
    return tuple(placed)


def missing_by_focus(cage: Cage, missing: Mapping[int, Collection[int]] | Collection[int]) -> dict[int, frozenset[int]]:
    """Return the missing marks by focus; numbers alone mean all foci."""
    if isinstance(missing, Mapping):
        return {focus: frozenset(numbers) for focus, numbers in missing.items()}
    return {focus: frozenset(missing) for focus in cage.foci}
