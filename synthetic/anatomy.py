"""Things around the markers: bone and soft tissue, and what might be taken for one (screws, wires, letters, dust ...)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping
from typing import Final, Literal

import numpy as np
from scipy.ndimage import gaussian_filter

from rsa_vision.types import Float
from synthetic.film import FilmPlane
from synthetic.render import Image
from synthetic.scene import LEAD_PER_MM, STEEL_PER_MM, TITANIUM_PER_MM, Ellipsoid, Pin, Solid

Distractor = Literal["screw", "wire", "staple", "letter", "dust", "scratch"]
DISTRACTORS: Final[tuple[Distractor, ...]] = ("screw", "wire", "staple", "letter", "dust", "scratch")
LETTERS: Final[dict[str, list[list[tuple[float, float]]]]] = {  # strokes in units of the letter's height
    "L": [[(0, 1), (0, 0), (0.6, 0)]],
    "R": [[(0, 0), (0, 1), (0.5, 1), (0.6, 0.8), (0.5, 0.55), (0, 0.5)], [(0.25, 0.5), (0.6, 0)]],
    "V": [[(0, 1), (0.3, 0), (0.6, 1)]],
    "4": [[(0.4, 0), (0.4, 1), (0, 0.35), (0.6, 0.35)]],
}


def tissue_with_bones(box_mm: Float, rng: np.random.Generator) -> tuple[Ellipsoid, ...]:
    """Return a limb: soft tissue with two hollow bones that meet near the middle of a box (2, 3)."""
    low, high = np.asarray(box_mm)
    middle, half = (low + high) / 2, (high - low) / 2
    girth = float(min(half[0], half[2]))
    bodies = [_ellipsoid(middle, (1.5 * girth, 3.0 * half[1], 1.5 * girth), rng, 2.0, 0.009, 0.5)]
    for side in (-1, 1):
        centre = middle + [0, side * 1.05 * half[1], 0] + rng.uniform(-0.1, 0.1, 3) * girth
        turn = rng.uniform(-8, 8)
        for grow, attenuation in ((1.0, 0.030), (0.75, -0.018)):  # the marrow takes away from the cortical bone around it
            axes = (0.55 * girth * grow, half[1] * (0.1 + 0.9 * grow), 0.5 * girth * grow)
            bodies.append(_ellipsoid(centre, axes, rng, turn, attenuation, 0.2, exact_turn=True))
    return tuple(bodies)


def _ellipsoid(
    centre: Float,
    semi_axes: tuple[float, float, float],
    rng: np.random.Generator,
    turn_deg: float,
    attenuation: float,
    softness: float,
    *,
    exact_turn: bool = False,
) -> Ellipsoid:
    turn = math.radians(turn_deg if exact_turn else rng.uniform(-turn_deg, turn_deg))
    rotation = np.array([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    return Ellipsoid(np.asarray(centre), np.diag(1 / np.array(semi_axes)) @ rotation, attenuation, softness)


def distractor_solids(kinds: Collection[str], films: Mapping[str, FilmPlane], box_mm: Float, rng: np.random.Generator) -> tuple[Solid, ...]:
    """Return one or a few solids of each kind: in the box (2, 3), letters on the films.

    Raises
    ------
    ValueError
        For an unknown kind.
    """
    if unknown := set(kinds) - set(DISTRACTORS):
        raise ValueError(f"unknown distractors {sorted(unknown)}; there are {', '.join(DISTRACTORS)}")
    low, high = np.asarray(box_mm)
    solids: list[Solid] = []
    for kind in sorted(kinds):
        if kind == "screw":
            for _ in range(2):
                start, axis = rng.uniform(low, high), _direction(rng)
                solids.append(Pin(start, axis, 28.0, 2.2, 4.0, TITANIUM_PER_MM))
                solids.append(Pin(start + 28 * axis, axis, 3.0, 4.0, 0.0, TITANIUM_PER_MM))
        elif kind == "wire":
            points = low + (high - low) * rng.uniform(0, 1, 3) + np.cumsum(rng.normal(0, 4, (9, 3)), 0)
            solids += stroke(points, 0.4, STEEL_PER_MM)
        elif kind == "staple":
            for _ in range(3):
                corner, along, up = rng.uniform(low, high), _direction(rng), _direction(rng)
                solids += stroke(np.array([corner, corner + 4 * up, corner + 4 * up + 6 * along, corner + 6 * along]), 0.25, STEEL_PER_MM)
        elif kind == "letter":
            for film in films.values():
                solids += _letter(film, str(rng.choice(list(LETTERS))), rng)
    return tuple(solids)


def stroke(points_mm: Float, radius_mm: float, attenuation: float) -> list[Solid]:
    """Return straight rods along a chain of points (n, 3)."""
    rods: list[Solid] = []
    for first, last in itertools.pairwise(points_mm):
        length = float(np.linalg.norm(last - first))
        rods.append(Pin(first, (last - first) / length, length, radius_mm, 0.0, attenuation))
    return rods


def _letter(film: FilmPlane, letter: str, rng: np.random.Generator) -> list[Solid]:
    rows, cols = film.shape
    corner = film.lab_from_pixel(np.array([rng.uniform(0.1, 0.85) * cols, rng.uniform(0.04, 0.07) * rows])) + 2.0 * film.axes[2]
    height = 9.0
    rods: list[Solid] = []
    for line in LETTERS[letter]:
        rods += stroke(corner + height * np.array(line) @ film.axes[:2], 0.7, LEAD_PER_MM)
    return rods


def _direction(rng: np.random.Generator) -> Float:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def blemishes(kinds: Collection[str], shape: tuple[int, int], rng: np.random.Generator) -> Float | None:
    """Return the factor on the scanned signal of dust specks and scratches, shape (rows, cols), or None if neither is wanted."""
    if not {"dust", "scratch"} & set(kinds):
        return None
    factor = np.ones(shape, np.float32)
    if "dust" in kinds:
        for _ in range(40):
            _speck(factor, rng)
    if "scratch" in kinds:
        for _ in range(5):
            length = rng.uniform(50, 400)
            turn, row, col = rng.uniform(0, math.pi), rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
            steps = np.arange(0, length, 0.5)
            rows = np.rint(row + steps * math.sin(turn) + 3 * np.sin(steps / 90)).astype(int)
            cols = np.rint(col + steps * math.cos(turn)).astype(int)
            inside = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
            factor[rows[inside], cols[inside]] = rng.uniform(0.6, 0.85)
    return np.asarray(factor)


def _speck(factor: Image, rng: np.random.Generator) -> None:
    """Draw one speck of dust into an array of the caller."""
    size = 15
    row, col = (int(rng.integers(0, extent - size)) for extent in factor.shape)
    blot = gaussian_filter(rng.standard_normal((size, size)), rng.uniform(0.8, 2.0))
    distance = np.hypot(*np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j])
    mask = (blot / blot.std() - 2.5 * distance) > 0
    factor[row : row + size, col : col + size][mask] *= rng.uniform(0.5, 1.4)
