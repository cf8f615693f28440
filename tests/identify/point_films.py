"""Films at the level of points, with their truth: a projector of its own, independent of rsa_vision.geometry and .identify."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.types import MarkerImages


@dataclass
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
    clutter_shapes: tuple[float, float, float] = (0.4, 0.4, 0.2)  # ball, pin, tee
    missing: int = 0  # fiducials and controls of each focus
    misread: float = 0.0  # tees seen as pins or balls
    arms: float = 0.0  # chance of a spurious detection on a tee's arm
    objects: int = 13
    foci_mm: dict[int, np.ndarray] = field(default_factory=dict)


@dataclass
class FilmTruth:
    images: MarkerImages
    shape: tuple[int, int]
    source: list[tuple]  # (kind, focus, role, number) of every image
    place_px: dict[tuple[int, str, int], np.ndarray]  # true place of every mark that the film shows
    slack_px: float

    def errors(self, assignments: object) -> list[tuple]:
        """Return the marks whose image does not lie where the mark is, within six sigma."""
        wrong = []
        for focus, marks in assignments.items():  # type: ignore[attr-defined]
            for (role, number), i in marks.items():
                place = self.place_px.get((focus, role, number), np.full(2, np.nan))
                sigma = np.hypot(np.sqrt(np.trace(self.images.covariance_px2[i]) / 2), self.slack_px)
                if not np.hypot(*(self.images.position_px[i] - place)) < 6 * sigma:
                    wrong.append((focus, role, number, self.source[i]))
        return wrong

    def visible(self, focus: int, role: str) -> int:
        """Return how many marks of a focus have an image."""
        names = {name[1:4] for name in self.source} | {other[1:4] for name in self.source for other in name[4:]}
        return sum(name[:2] == (focus, role) and name in self.place_px for name in names)


def _hit(point: np.ndarray, focus: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> np.ndarray:
    way = point - focus
    return focus + way * ((origin - focus) @ normal) / (way @ normal)


def random_foci(cage: Cage, rng: np.random.Generator, away_mm: float) -> dict[int, np.ndarray]:
    foci = {}
    for focus, place in cage.foci.items():
        step = rng.normal(size=3)
        foci[focus] = np.array(place) + step / np.linalg.norm(step) * away_mm
    return foci


def object_points(cage: Cage, foci: tuple[int, ...], count: int, rng: np.random.Generator) -> np.ndarray:
    marks = np.array([m.xyz for m in cage.mark])
    low, high = marks.min(axis=0), marks.max(axis=0)
    return low + (0.15 + 0.7 * rng.random((count, 3))) * (high - low)


def expose(cage: Cage, foci: tuple[int, ...], e: Exposure, rng: np.random.Generator, objects: np.ndarray | None = None) -> FilmTruth:
    """Make the marker images of one film that the given foci share."""
    plane = cage.plane_of(foci[0])
    origin, (u, v) = np.array(plane.origin, float), np.array([plane.u, plane.v], float)
    normal = np.cross(u, v)
    middle = np.mean([m.xyz for m in cage.mark if m.role == "fiducial" and foci[0] in m.foci], axis=0)
    steep = 0.5 * e.gap_mm / 250  # a film lies behind its plane everywhere
    film_normal = normal - np.clip(e.tilt[0], -steep, steep) * u - np.clip(e.tilt[1], -steep, steep) * v
    film_origin = middle - e.gap_mm * normal
    cols, rows = round(e.size_mm[0] / e.pitch_mm), round(e.size_mm[1] / e.pitch_mm)
    turn = np.deg2rad(e.turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    if abs(e.turn_deg) > 30:
        cols = rows = max(cols, rows)
    distort = np.array([[1 + e.anisotropy, e.shear], [0, 1]]) / (e.pitch_mm * e.scale)
    flip = np.array([-1.0 if e.mirrored else 1.0, -1.0])

    def to_px(point: np.ndarray, focus: np.ndarray) -> np.ndarray:
        q = _hit(point, focus, film_origin, film_normal) - film_origin
        xy = distort @ (rotation @ np.array([q @ u, q @ v]))
        return np.array([cols / 2, rows / 2]) + xy * flip

    px, shape, angle, radius, source, places = [], [], [], [], [], {}

    def add(point: np.ndarray, kind: str, direction: float, size: float, name: tuple) -> None:
        if -20 < point[0] < cols + 20 and -20 < point[1] < rows + 20:
            px.append(point)
            shape.append(kind)
            angle.append(direction)
            radius.append(size)
            source.append(name)

    points = object_points(cage, foci, e.objects, rng) if objects is None else objects
    for focus in foci:
        f = e.foci_mm.get(focus, np.array(cage.foci[focus], float))
        own = [m for m in cage.mark if focus in m.foci]
        hidden = set()
        for role in ("fiducial", "control"):
            candidates = [m.number for m in own if m.role == role]
            hidden |= {(role, int(n)) for n in rng.choice(candidates, min(e.missing, len(candidates)), replace=False)}
        for m in cage.mark:
            xyz = np.array(m.xyz, float)
            if m in own:
                places[focus, m.role, m.number] = to_px(xyz, f)
            if (xyz - origin) @ normal < -1 or (m in own and (m.role, m.number) in hidden):
                continue
            at = to_px(xyz, f)
            direction, kind = np.nan, m.shape
            stem = next((a for a in m.arms if not any(np.allclose(a, -np.array(o)) for o in m.arms)), None)
            if stem is not None:
                way = to_px(xyz + 0.5 * np.array(stem), f) - at
                direction = np.rad2deg(np.arctan2(-way[1], way[0])) + rng.normal(0, 2)
                if rng.random() < e.misread:
                    kind = str(rng.choice(["pin", "ball"]))
                    direction = rng.uniform(-180, 180) if kind == "pin" else np.nan
            add(at, kind, direction, m.diameter / 2 / e.pitch_mm * 1.05, ("mark" if m in own else "foreign", focus, m.role, m.number))
            for arm in m.arms:
                if rng.random() < e.arms:
                    spot = to_px(xyz + rng.uniform(0.2, 1.0) * (m.length or 1) * np.array(arm), f)
                    add(
                        spot,
                        str(rng.choice(["pin", "ball"])),
                        rng.uniform(-180, 180),
                        m.diameter / 2 / e.pitch_mm,
                        ("arm", focus, m.role, m.number),
                    )
        for n, point in enumerate(points):
            add(to_px(point, f), "ball", np.nan, 4.3, ("object", focus, "object", n))
    for _ in range(e.false_images):
        kind = str(rng.choice(["ball", "pin", "tee"], p=e.clutter_shapes))
        at = rng.uniform([0, 0], [cols, rows])
        add(at, kind, np.nan if kind == "ball" else rng.uniform(-180, 180), rng.uniform(2, 8), ("false", 0, "", 0))
    position, sd, named = np.array(px).reshape(-1, 2), e.noise_px * rng.uniform(0.7, 1.5, len(px)), list(source)
    keep = np.ones(len(px), bool)
    for i in range(len(px)):  # what lies too close is one image, what overlaps is found less well
        for j in np.flatnonzero(keep & (np.arange(len(px)) < i) & (np.array(shape) == shape[i])):
            apart, width = np.hypot(*(position[i] - position[j])), min(radius[i], radius[j])
            if apart < 0.7 * width:
                keep[i], position[j], sd[j] = False, (position[i] + position[j]) / 2, max(sd[j], apart / 4)
                named[j] = (*named[j], source[i])
                break
            if apart < 2 * width:
                sd[i], sd[j] = 2 * sd[i], 2 * sd[j]
    position = position + rng.normal(size=position.shape) * sd[:, None] + rng.normal(size=position.shape) * e.slack_mm / e.pitch_mm
    covariance = (sd**2)[:, None, None] * np.eye(2)
    filled = np.full(len(position), 0.3)
    images = MarkerImages(
        position,
        covariance,
        np.array(shape, dtype="U4"),
        np.array(radius, float),
        np.array(angle, float),
        filled,
        filled * 100,
        np.zeros(len(position), np.int64),
    )
    order = rng.permutation(np.flatnonzero(keep))
    return FilmTruth(images.rows(order), (rows, cols), [named[i] for i in order], places, e.slack_mm / e.pitch_mm)


def random_exposure(rng: np.random.Generator, cage: Cage, **fixed: object) -> Exposure:
    """Draw all that varies within the limits that must be borne."""
    tall = cage.name.startswith("1B")
    values: dict = {
        "size_mm": (450.0, 640.0) if tall else (350.0, 430.0),
        "turn_deg": rng.uniform(-20, 20) if rng.random() < 0.7 else rng.uniform(-45, 45),
        "gap_mm": rng.uniform(4, 25),
        "tilt": tuple(rng.normal(0, 0.01, 2)),
        "anisotropy": rng.uniform(-0.015, 0.015),
        "shear": rng.uniform(-0.01, 0.01),
        "scale": rng.uniform(0.98, 1.02),
        "noise_px": 10 ** rng.uniform(-1.7, -1),
        "slack_mm": rng.choice([0.0, 0.01, 0.03]),
        "false_images": int(rng.integers(0, 151)),
        "missing": int(rng.integers(0, 4)),
        "misread": rng.uniform(0, 0.15),
        "arms": rng.choice([0.0, 0.1]),
        "foci_mm": random_foci(cage, rng, rng.uniform(0, 150)),
    }
    if tall:
        values["missing"] = int(rng.integers(0, 3))  # of eight control points
    return Exposure(**{**values, **fixed})
