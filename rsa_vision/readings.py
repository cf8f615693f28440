"""What the films of one examination show, and the names that it gets: marks of the cage, object markers, the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

import numpy as np

from rsa_vision.flags import MarkerFlag
from rsa_vision.geometry.rays import RayBundle, intersect_lines
from rsa_vision.identify.cage import CageIdentification
from rsa_vision.identify.clutter import more_than_clutter
from rsa_vision.identify.contrasts import contrasts_alike
from rsa_vision.identify.crossings import Region
from rsa_vision.identify.lone import chance_of_marker
from rsa_vision.identify.pairs import Pairing
from rsa_vision.types import Bool, Float, ImagePoints, Int, MarkerImages
from rsa_vision.verdict import Finding

MAY_BE_MARKER: Final = 0.1  # probability from which a single image is one for a person to look at
LOOKS_DOUBTFUL: Final = int(MarkerFlag.OVERLAP | MarkerFlag.EDGE | MarkerFlag.SATURATED | MarkerFlag.CLIPPED | MarkerFlag.POOR_FIT)
"""Images whose size and contrast say little of their markers."""
OBJECT_SHAPES: Final = ("ball", "pin")
_MOST_TOLD: Final = 3  # places of one film that a message lists


@dataclass(frozen=True, slots=True, eq=False)
class FilmReading:
    """What one film says, without its pixels.

    Attributes
    ----------
    path : Path
    focus : int or None
        None: it carries all foci.
    shape : tuple of two ints
        (rows, cols).
    pitch_mm : tuple of two floats, or None
        (row, column) pitch as used; None with calibrated cameras, which need none.
    response : str
        As set: `auto` leaves it to the film.
    images : MarkerImages
    """

    path: Path
    focus: int | None
    shape: tuple[int, int]
    pitch_mm: tuple[float, float] | None
    response: str
    images: MarkerImages


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Points of an examination, and the row of each in the table of all images, film after film."""

    films: tuple[FilmReading, ...]
    points: ImagePoints
    rows: Int

    @classmethod
    def of(cls, films: Sequence[FilmReading]) -> Readings:
        """Return all images of films, unassigned."""
        tables = [_unassigned(film.images, film.focus or 0, index) for index, film in enumerate(films)]
        points = _concatenated(tables or [_unassigned(MarkerImages.empty(), 0, 0)])
        return cls(tuple(films), points, np.arange(len(points)))

    @property
    def radius_px(self) -> Float:
        """Radii in the table of all images."""
        return np.concatenate([film.images.radius_px for film in self.films])

    @property
    def contrast(self) -> Float:
        """Contrasts of balls in the table of all images, as they would be on one background of each film.

        NaN for other shapes: how dense a pin is goes with how the ray meets it.
        """
        return np.concatenate([np.where(film.images.shape == "ball", _contrasts_alike(film.images), np.nan) for film in self.films])

    @property
    def source(self) -> Int:
        """Row of each point in the images of its film."""
        return np.concatenate([np.arange(len(film.images)) for film in self.films])[self.rows] if self.films else self.rows

    def with_points(self, points: ImagePoints, rows: Int) -> Readings:
        """Return other points of the same films."""
        return Readings(self.films, points, rows)


def _unassigned(images: MarkerImages, focus: int, film: int) -> ImagePoints:
    n = len(images)
    return ImagePoints(
        focus=np.full(n, focus, np.int64),
        role=np.full(n, "unassigned", "U10"),
        number=np.full(n, "", "U40"),
        shape=images.shape,
        position_px=images.position_px,
        covariance_px2=images.covariance_px2,
        flags=images.flags,
        film=np.full(n, film, np.int64),
    )


def _concatenated(tables: Sequence[ImagePoints]) -> ImagePoints:
    """Return the rows of all tables."""
    return ImagePoints(*(np.concatenate([getattr(table, item.name) for table in tables]) for item in fields(ImagePoints)))


def joined_rays(bundles: Sequence[RayBundle]) -> RayBundle:
    """Return the rays of all bundles."""
    return RayBundle(*(np.concatenate([getattr(bundle, item.name) for bundle in bundles]) for item in fields(RayBundle)))


def name_marks(table: Readings, marks: Sequence[CageIdentification], n_cage_films: int) -> tuple[Readings, Bool, Bool]:
    """Return the cage's points of all foci, which images may be object markers, and which are of marks their focus should not see."""
    first = np.searchsorted(table.points.film, np.arange(len(table.films)))
    free, foreign = table.points.film >= n_cage_films, np.zeros(len(table.points), bool)
    rows: list[int] = []
    names: list[tuple[int, str, str]] = []
    for start, found in zip(first.tolist(), marks, strict=False):
        free[start + np.flatnonzero(found.explained)] = False
        foreign[start + np.flatnonzero(found.foreign)] = True
        for focus, assigned in sorted(found.assignments.items()):
            for (role, number), image in sorted(assigned.items(), key=lambda item: (item[0][0] != "fiducial", item[0][1])):
                rows.append(start + image)
                names.append((focus, role, str(number)))
    chosen = np.array(rows, int)
    return table.with_points(_renamed(table.points.rows(chosen), names), chosen), free, foreign


def _renamed(points: ImagePoints, names: Sequence[tuple[int, str, str]]) -> ImagePoints:
    focus = np.array([name[0] for name in names], np.int64)
    role = np.array([name[1] for name in names], "U10")
    number = np.array([name[2] for name in names], "U40")
    return replace(points, focus=focus, role=role, number=number)


def candidates(table: Readings, free: Bool, focus: int) -> Int:
    """Return the rows of images that may be object markers of a focus."""
    points = table.points
    return np.flatnonzero(free & np.isin(points.shape, OBJECT_SHAPES) & np.isin(points.focus, (0, focus)))


def name_objects(named: Readings, table: Readings, bundle: RayBundle, pairing: Pairing, foreign: Bool) -> Readings:
    """Return the cage's points, then the object markers P01, P02, ... by rising y, then every other image as unassigned."""
    places = [intersect_lines(bundle.origin_mm[list(g)], bundle.direction[list(g)])[0] for g in pairing.groups]
    order = sorted(range(len(places)), key=lambda g: (places[g][1], places[g][0]))
    rows: list[int] = []
    names: list[tuple[int, str, str]] = []
    ambiguous: list[int] = []
    for count, g in enumerate(order):
        for ray in pairing.groups[g]:
            rows.append(int(bundle.image[ray]))
            names.append((int(bundle.focus[ray]), "object", f"P{count + 1:02d}"))
        if pairing.ambiguous[g]:
            ambiguous += rows[-len(pairing.groups[g]) :]
    others = np.setdiff1d(np.arange(len(table.points)), [*named.rows, *rows]).astype(int)
    points = _renamed(table.points.rows(np.array(rows, int)), names)
    flags = np.where(foreign, MarkerFlag.FOREIGN_MARK, 0)
    flags[ambiguous] |= MarkerFlag.AMBIGUOUS
    every = np.concatenate([named.rows, np.array(rows, int), others])
    joined = _concatenated([named.points, points, table.points.rows(others)])
    return named.with_points(replace(joined, flags=joined.flags | flags[every]), every)


def _contrasts_alike(images: MarkerImages) -> Float:
    clear = (images.shape == "ball") & (image_quality(images.flags) == 0)
    return contrasts_alike(images.contrast, images.background, clear)


def image_quality(flags: Int) -> Int:
    """Return how well images were fitted: 0 clear, 1 disturbed by something beside them, 2 not described by the model of its shape."""
    return np.where(flags & MarkerFlag.POOR_FIT, 2, np.where(flags & LOOKS_DOUBTFUL, 1, 0)).astype(np.int64)


def lonely_images(table: Readings, pairing: Pairing, bundle: RayBundle) -> list[Finding]:
    """Find single images that may be markers that the other focus does not show, or hidden there."""
    paired = np.zeros(len(table.points), bool)
    paired[[bundle.image[ray] for group in pairing.groups for ray in group]] = True
    with np.errstate(invalid="ignore", divide="ignore"):
        look = np.log(np.column_stack([table.radius_px, table.contrast]))
    quality = image_quality(table.points.flags)
    found: list[Finding] = []
    for number, film in enumerate(table.films):
        lonely = [np.zeros(0, np.int64)]
        for shape in OBJECT_SHAPES:
            mine = (table.points.film == number) & (table.points.shape == shape)
            here = np.concatenate([np.flatnonzero(paired & mine), pairing.unmatched[mine[pairing.unmatched]]])
            known = look[here][:, : 2 if shape == "ball" else 1]
            chance = chance_of_marker(known, table.points.position_px[here], quality[here], paired[here], film.shape)
            lonely.append(here[(chance > MAY_BE_MARKER) & ~paired[here]])
        if len(rows := np.concatenate(lonely)):
            found.append(("marker-one-view", f"{film.path.name}: {_told(table.points.position_px[rows])}"))
    return found


def pins_left(table: Readings, pairing: Pairing, bundle: RayBundle, region: Region | None) -> list[Finding]:
    """Find clear pins of films none of whose pins has a partner and that are more than clutter: nothing tells which of them are markers."""
    points = table.points
    if any(points.shape[bundle.image[group[0]]] == "pin" for group in pairing.groups):
        return []
    free = np.isin(bundle.image, pairing.unmatched)
    clear = free & (points.shape[bundle.image] == "pin") & (points.flags[bundle.image] == 0)
    left = np.unique(bundle.image[more_than_clutter(bundle, clear, free, region, pairing.slack_mm)])
    if not len(left):
        return []
    on = ", ".join(table.films[k].path.name for k in np.unique(points.film[left]))
    told = f"{len(left)} images of single pins ({on}) have no partner, and so no coordinates"
    return [("pins-unpaired", f"{told}; if they are markers, name their tips in images.csv and give it to reconstruct")]


def _told(position_px: Float) -> str:
    """Say where images lie that have no partner, of many where the first few do."""
    places = "; ".join(f"col {col:.0f}, row {row:.0f}" for col, row in position_px[:_MOST_TOLD])
    if len(position_px) == 1:
        return f"an image at {places} looks like a marker but has no partner"
    more = "; ..." if len(position_px) > _MOST_TOLD else ""
    return f"{len(position_px)} images look like markers but have no partner: {places}{more}"
