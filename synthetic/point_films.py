"""Examinations at the level of points: the marker images of every film, made from known geometry by a projector of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from rsa_vision.cages import Cage, Mark
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import Bool, Float, MarkerImages

Rng = np.random.Generator
Source = tuple[Any, ...]
"""(kind, focus, role, number) of an image; the sources of images that melted into it follow."""

NEVER: Final = 1e9
LIKELY_SIGMA: Final = 6.0
WIDER: Final = 1.15  # images of control points are wider than those of fiducial marks, by their height: discs that touch may be one


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """Object balls: places, shape (n, 3), and radii, shape (n,), mm; contrasts; foci that do not see them, shape (n,), 0 for none."""

    xyz_mm: Float
    radius_mm: Float
    contrast: Float
    hidden: Float


@dataclass(frozen=True, slots=True)
class Exposure:
    """What varies from film to film."""

    pitch_mm: float = 0.1
    size_mm: tuple[float, float] = (350.0, 430.0)  # width, height
    turn_deg: float = 0.0
    mirrored: bool = False
    gap_mm: float = 10.0
    tilt: tuple[float, float] = (0.0, 0.0)  # rad
    anisotropy: float = 0.0
    shear: float = 0.0
    scale: float = 1.0  # true pitch / stated pitch
    noise_px: float = 0.03
    slack_mm: float = 0.0
    false_images: int = 0
    clustered: float = 0.0  # part of the false images that stand in lines and heaps
    clutter_shapes: tuple[float, float, float] = (0.4, 0.4, 0.2)  # ball, pin, tee
    missing: int = 0  # fiducial marks and control points of each focus, a third of either at most
    misread: float = 0.0  # tees seen as pins or balls
    arms: float = 0.0  # chance of a spurious detection on a tee's arm
    objects: int = 13
    foci_mm: Mapping[int, Float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class FilmTruth:
    """The marker images of one film and what they are images of."""

    images: MarkerImages
    shape: tuple[int, int]
    source: list[Source]
    place_px: Mapping[Source, Float]  # true place of every mark and object, by (focus, role, number)
    slack_px: float

    def lies_at(self, row: int, name: Source) -> bool:
        """Return whether an image lies where a mark or object is, within six sigma."""
        place = self.place_px.get(name, np.full(2, np.nan))
        sigma = np.hypot(np.sqrt(np.trace(self.images.covariance_px2[row]) / 2), self.slack_px)
        return bool(np.hypot(*(self.images.position_px[row] - place)) < LIKELY_SIGMA * sigma)

    def shows(self, row: int, name: Source) -> bool:
        """Return whether an image is that of a mark or object, alone or melted with others."""
        first, *others = self.source[row][:4], *self.source[row][4:]
        return any(tuple(one[1:4]) == name for one in (first, *others))

    def errors(self, assignments: Mapping[int, Mapping[tuple[str, int], int]]) -> list[Source]:
        """Return the marks whose image does not lie where the mark is."""
        return [
            (focus, role, number, self.source[i])
            for focus, marks in assignments.items()
            for (role, number), i in marks.items()
            if not self.lies_at(i, (focus, role, number))
        ]

    def visible(self, focus: int, role: str) -> int:
        """Return how many marks of a focus have an image."""
        names = {tuple(one[1:4]) for source in self.source for one in (source[:4], *source[4:]) if one[0] == "mark"}
        return sum(name[:2] == (focus, role) for name in names)

    def alone(self, focus: int) -> set[tuple[str, int]]:
        """Return role and number of the marks of a focus that have an image of their own.

        Not melted with another, nor so near to where a mark without an image should show one that nobody could tell.
        """
        shown = {tuple(one[1:4]) for source in self.source for one in (source[:4], *source[4:])}
        unseen = np.array([place for name, place in self.place_px.items() if name not in shown and name[1] != "object"]).reshape(-1, 2)
        single = [i for i, source in enumerate(self.source) if len(source) == 4 and source[:2] == ("mark", focus)]
        width = WIDER * 2 * self.images.radius_px
        near = {i for i in single if (np.hypot(*(unseen - self.place_px[self.source[i][1:4]]).T) < width[i]).any()}
        return {self.source[i][2:4] for i in single if i not in near}

    def in_line(self, cage: Cage, focus: int) -> bool:
        """Return whether the fiducial marks that a focus shows are nearly on a line: three times nearer to it than those of the cage."""
        shown = {one[3] for source in self.source for one in (source[:4], *source[4:]) if one[:3] == ("mark", focus, "fiducial")}
        marks = np.array([m.xyz for m in cage.marks_of(focus, "fiducial")])
        seen = np.array([m.xyz for m in cage.marks_of(focus, "fiducial") if m.number in shown])
        return len(seen) < 3 or bool(_breadth(seen) < _breadth(marks) / 3)


def _breadth(points: Float) -> float:
    """Root mean square distance of points from their best line."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points)))


def random_foci(cage: Cage, rng: Rng, away_mm: float) -> dict[int, Float]:
    """Return the cage's foci, each moved by a distance in any direction."""
    steps = {focus: rng.normal(size=3) for focus in cage.foci}
    return {focus: np.array(place) + steps[focus] / np.linalg.norm(steps[focus]) * away_mm for focus, place in cage.foci.items()}


def random_objects(cage: Cage, count: int, rng: Rng, *, hidden: float = 0.0) -> Objects:
    """Return balls of one or two sizes in two to four bones within the cage.

    Parameters
    ----------
    cage : Cage
    count : int
    rng : numpy.random.Generator
    hidden : float
        Chance of a ball to be seen by one focus only.

    Returns
    -------
    Objects
    """
    marks = np.array([m.xyz for m in cage.mark])
    low, high = marks.min(axis=0), marks.max(axis=0)
    bones = low + (0.25 + 0.5 * rng.random((int(rng.integers(2, 5)), 3))) * (high - low)
    xyz = np.array([bones[i % len(bones)] + rng.normal(0, 15, 3) for i in range(count)]).reshape(-1, 3)
    xyz = np.clip(xyz, low + 0.1 * (high - low), high - 0.1 * (high - low))
    for _ in range(100):  # no two balls in one place
        apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1) + NEVER * np.eye(count)
        close = np.flatnonzero(apart.min(axis=1, initial=NEVER) < 3)
        xyz[close] += rng.normal(0, 3, (len(close), 3))
    radius = rng.choice(rng.choice([0.25, 0.4, 0.5], 2), count)
    foci = np.array(sorted(cage.foci))
    return Objects(xyz, radius, 0.6 * radius, np.where(rng.random(count) < hidden, rng.choice(foci, count), 0))


def object_points(cage: Cage, count: int, rng: Rng) -> Objects:
    """Return equal balls anywhere within the cage."""
    marks = np.array([m.xyz for m in cage.mark])
    low, high = marks.min(axis=0), marks.max(axis=0)
    xyz = low + (0.15 + 0.7 * rng.random((count, 3))) * (high - low)
    return Objects(xyz, np.full(count, 0.4), np.full(count, 0.3), np.zeros(count))


class _Table:
    """Images of a film while it is made."""

    def __init__(self) -> None:
        self.px: list[Float] = []
        self.shape: list[str] = []
        self.angle: list[float] = []
        self.radius: list[float] = []
        self.contrast: list[float] = []
        self.source: list[Source] = []

    def add(self, px: Float, shape: str, angle: float, radius: float, contrast: float, source: Source) -> None:
        for column, value in zip(
            (self.px, self.shape, self.angle, self.radius, self.contrast, self.source),
            (px, shape, angle, radius, contrast, source),
            strict=True,
        ):
            column.append(value)  # type: ignore[attr-defined]  # lists of several types


def expose(cage: Cage, foci: tuple[int, ...], e: Exposure, rng: Rng, objects: Objects | None = None) -> FilmTruth:
    """Make the marker images of one film that the given foci share.

    Parameters
    ----------
    cage : Cage
    foci : tuple of int
    e : Exposure
    rng : numpy.random.Generator
    objects : Objects, optional
        Default: ``e.objects`` balls anywhere in the cage.

    Returns
    -------
    FilmTruth
    """
    balls = object_points(cage, e.objects, rng) if objects is None else objects
    plane = cage.plane_of(foci[0])
    origin, u, v = np.array(plane.origin, float), np.array(plane.u, float), np.array(plane.v, float)
    normal = np.cross(u, v)
    middle = np.mean([m.xyz for m in cage.mark if m.role == "fiducial" and foci[0] in m.foci], axis=0)
    steep = 0.5 * e.gap_mm / 250  # a film lies behind its plane everywhere
    film_normal = normal - np.clip(e.tilt[0], -steep, steep) * u - np.clip(e.tilt[1], -steep, steep) * v
    film_origin = middle - e.gap_mm * normal
    cols, rows = round(e.size_mm[0] / e.pitch_mm), round(e.size_mm[1] / e.pitch_mm)
    if abs(e.turn_deg) > 30:
        cols = rows = max(cols, rows)
    turn = np.deg2rad(e.turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    px_per_mm = np.array([[1 + e.anisotropy, e.shear], [0, 1]]) @ rotation / (e.pitch_mm * e.scale)
    flip = np.array([-1.0 if e.mirrored else 1.0, -1.0])

    def to_px(point: Float, focus: Float) -> Float:
        way = point - focus
        q = focus + way * ((film_origin - focus) @ film_normal) / (way @ film_normal) - film_origin
        at: Float = np.array([cols / 2, rows / 2]) + px_per_mm @ np.array([q @ u, q @ v]) * flip
        return at

    table = _Table()
    places: dict[Source, Float] = {}
    for focus in foci:
        f = np.asarray(e.foci_mm.get(focus, np.array(cage.foci[focus], float)))
        own = [m for m in cage.mark if focus in m.foci]
        hidden: set[tuple[str, int]] = set()
        for role, least in (("fiducial", 4), ("control", 2)):
            names = [m.number for m in own if m.role == role]
            lost = min(e.missing, len(names) // 3, len(names) - least)
            hidden |= {(role, int(n)) for n in rng.choice(names, lost, replace=False)}
        for m in cage.mark:
            xyz = np.array(m.xyz, float)
            if m in own:
                places[focus, m.role, m.number] = to_px(xyz, f)
            if (xyz - origin) @ normal < -1 or (xyz - f) @ normal > -50 or (m in own and (m.role, m.number) in hidden):
                continue
            _add_mark(table, m, ("mark" if m in own else "foreign", focus, m.role, m.number), lambda p, f=f: to_px(p, f), e, rng)
        for n, xyz in enumerate(balls.xyz_mm):
            places[focus, "object", n] = to_px(xyz, f)
            if balls.hidden[n] != focus:
                grown = ((film_origin - f) @ normal) / ((xyz - f) @ normal) / e.pitch_mm
                table.add(
                    places[focus, "object", n],
                    "ball",
                    np.nan,
                    balls.radius_mm[n] * grown,
                    balls.contrast[n],
                    ("object", focus, "object", n),
                )
    for at in _clutter(e, (cols, rows), rng):
        kind = str(rng.choice(["ball", "pin", "tee"], p=e.clutter_shapes))
        angle = np.nan if kind == "ball" else rng.uniform(-180, 180)
        table.add(at, kind, angle, 10 ** rng.uniform(0.3, 1), 10 ** rng.uniform(-1.3, -0.2), ("false", 0, "", 0))
    return _detected(table, (rows, cols), places, e, rng)


def _add_mark(table: _Table, m: Mark, name: Source, to_px: Any, e: Exposure, rng: Rng) -> None:
    xyz, kind, direction, half_width = np.array(m.xyz, float), str(m.shape), np.nan, m.diameter / 2 / e.pitch_mm * 1.05
    stem = next((a for a in m.arms if not any(np.allclose(a, -np.array(o)) for o in m.arms)), None)
    at = to_px(xyz)
    if stem is not None:
        way = to_px(xyz + 0.5 * np.array(stem)) - at
        direction = np.rad2deg(np.arctan2(-way[1], way[0])) + rng.normal(0, 2)
        if rng.random() < e.misread:
            kind = str(rng.choice(["pin", "ball"]))
            direction = rng.uniform(-180, 180) if kind == "pin" else np.nan
    table.add(at, kind, direction, half_width, 0.6 * m.diameter / 2, name)
    for arm in m.arms:
        if rng.random() < e.arms:
            spot = to_px(xyz + rng.uniform(0.2, 1.0) * (m.length or 1) * np.array(arm))
            table.add(spot, str(rng.choice(["pin", "ball"])), rng.uniform(-180, 180), half_width, 0.2, ("arm", *name[1:]))


def _clutter(e: Exposure, size: tuple[int, int], rng: Rng) -> list[Float]:
    """Places of false images: scattered, and in lines (edges, letters, wires) and heaps (screws)."""
    found: list[Float] = []
    while len(found) < e.false_images:
        if rng.random() < e.clustered:
            count = int(rng.integers(5, 15))
            start, way = rng.uniform([0, 0], size), rng.normal(size=2)
            if rng.random() < 0.5:
                steps = np.cumsum(rng.uniform(15, 60, count))
                found += list(start + steps[:, None] * way / np.hypot(*way) + rng.normal(0, 1, (count, 2)))
            else:
                found += list(start + rng.normal(0, rng.uniform(20, 100), (count, 2)))
        else:
            found.append(rng.uniform([0, 0], size))
    return found[: e.false_images]


def _detected(table: _Table, shape: tuple[int, int], places: Mapping[Source, Float], e: Exposure, rng: Rng) -> FilmTruth:
    """Let images melt that lie too close, and add the errors of detection."""
    position = np.array(table.px, float).reshape(-1, 2)
    n, named = len(position), list(table.source)
    kind, radius = np.array(table.shape, "U4"), np.array(table.radius, float)
    sd = e.noise_px * rng.uniform(0.7, 1.5, n)
    flags = np.zeros(n, np.int64)
    keep: Bool = np.array(((position > -20) & (position < np.array(shape[::-1]) + 20)).all(axis=1))
    for i in range(n):
        if not keep[i]:
            continue
        apart = np.hypot(*(position[:i] - position[i]).T)
        for j in np.flatnonzero(keep[:i] & (kind[:i] == kind[i]) & (apart < 2 * np.minimum(radius[:i], radius[i]))):
            if apart[j] < 0.7 * min(radius[i], radius[j]):
                keep[i], position[j], sd[j] = False, (position[i] + position[j]) / 2, max(sd[j], apart[j] / 4)
                named[j] = (*named[j], named[i])
                break
            sd[[i, int(j)]] *= 2
            flags[[i, int(j)]] = int(MarkerFlag.OVERLAP)
    noise = rng.normal(size=(2, n, 2))
    position = position + noise[0] * sd[:, None] + noise[1] * e.slack_mm / e.pitch_mm
    contrast = np.array(table.contrast, float) * np.exp(rng.normal(0, 0.03, n))
    radius = radius * np.exp(rng.normal(0, sd / radius))
    covariance = (sd**2)[:, None, None] * np.eye(2)
    unknown = np.full(n, np.nan)
    images = MarkerImages(position, covariance, kind, radius, np.array(table.angle, float), contrast, unknown, 100 * contrast, flags)
    order = rng.permutation(np.flatnonzero(keep))
    return FilmTruth(images.rows(order), shape, [named[i] for i in order], places, e.slack_mm / e.pitch_mm)


def random_exposure(rng: Rng, cage: Cage, **fixed: Any) -> Exposure:
    """Draw all that varies within the limits that must be borne; what is fixed is as given."""
    drawn = Exposure(
        size_mm=film_size_mm(cage),
        turn_deg=rng.uniform(-20, 20) if rng.random() < 0.7 else rng.uniform(-45, 45),
        gap_mm=rng.uniform(4, 25),
        tilt=(rng.normal(0, 0.01), rng.normal(0, 0.01)),
        anisotropy=rng.uniform(-0.015, 0.015),
        shear=rng.uniform(-0.01, 0.01),
        scale=rng.uniform(0.98, 1.02),
        noise_px=10 ** rng.uniform(-1.7, -1),
        slack_mm=float(rng.choice([0.0, 0.01, 0.03])),
        false_images=int(rng.integers(0, 151)),
        clustered=float(rng.choice([0.0, 0.05, 0.2])),
        missing=int(rng.integers(0, 4)),
        misread=rng.uniform(0, 0.15),
        arms=float(rng.choice([0.0, 0.1])),
        foci_mm=random_foci(cage, rng, rng.uniform(0, 150)),
    )
    return replace(drawn, **fixed)


def film_size_mm(cage: Cage) -> tuple[float, float]:
    """Return a film that holds the images of all marks."""
    if cage.name in ("1A", "2"):
        return 350.0, 430.0
    widths = []
    for focus, place in cage.foci.items():
        plane = cage.plane_of(focus)
        axes = np.array([plane.u, plane.v, np.cross(plane.u, plane.v)])
        f = axes @ (np.array(place) - plane.origin)
        marks = np.array([axes @ (np.array(m.xyz) - plane.origin) for m in cage.mark if focus in m.foci])
        on_plane = marks[:, :2] + (marks[:, :2] - f[:2]) * (marks[:, 2:] / (f[2] - marks[:, 2:]))
        middle = marks[[m.role == "fiducial" for m in cage.mark if focus in m.foci], :2].mean(axis=0)
        widths.append(2 * np.abs(on_plane - middle).max(axis=0) + 100)
    width, height = np.max(widths, axis=0)
    return float(width), float(height)
