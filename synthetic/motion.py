"""Motion of the object from one examination to the next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsa_vision.types import Float
from synthetic.film import FilmPlane
from synthetic.scene import ObjectMarker, Scene, clearance_mm

POSES = 20  # of the object that are tried for an examination


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rigid motion: turn by ``rotation_deg`` about body-fixed x, y, z in this order through ``about_mm``, then shift."""

    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def matrix(self) -> Float:
        """Return the rotation matrix, shape (3, 3)."""
        product = np.eye(3)
        for axis, degrees in enumerate(self.rotation_deg):
            c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            turn = np.eye(3)
            i, j = (axis + 1) % 3, (axis + 2) % 3
            turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
            product = product @ turn
        return product


def share_out(markers: Sequence[ObjectMarker], segments: Mapping[str, int]) -> tuple[ObjectMarker, ...]:
    """Name markers after segments, from low to high y as bones lie along a limb.

    Parameters
    ----------
    markers : sequence of ObjectMarker
    segments : mapping of str to int
        How many each segment gets; together all of them.

    Returns
    -------
    tuple of ObjectMarker
        Numbered from 1 within each segment.
    """
    along = sorted(markers, key=lambda marker: float(marker.position_mm[1]))
    names = [(segment, str(i + 1)) for segment, count in segments.items() for i in range(count)]
    pairs = zip(names, along, strict=True)
    return tuple(replace(marker, segment=segment, marker=number) for (segment, number), marker in pairs)


def next_pose(
    last: Scene, films: Mapping[int, FilmPlane], motion: Motion, segment: str, about_mm: Float, rng: np.random.Generator
) -> tuple[ObjectMarker, ...]:
    """Return the markers of the next examination: of several poses of the object, the one in which its images are clearest.

    Parameters
    ----------
    last : Scene
    films : mapping of int to FilmPlane
        As of :func:`synthetic.scene.clearance_mm`.
    motion : Motion
        Of one segment relative to the others.
    segment : str
    about_mm : ndarray of shape (3,)
        Centre of all rotations.
    rng : numpy Generator

    Returns
    -------
    tuple of ObjectMarker
    """
    turn, shift = motion.matrix(), np.array(motion.translation_mm)
    ahead = [marker.moved(turn, shift, about_mm) if marker.segment == segment else marker for marker in last.markers]
    best: tuple[float, tuple[ObjectMarker, ...]] = (-math.inf, ())
    for _ in range(POSES):
        whole = Motion(*(tuple(rng.normal(0, 2.0, 3).tolist()) for _ in range(2)))
        matrix, move = whole.matrix(), np.array(whole.translation_mm)
        markers = tuple(marker.moved(matrix, move, about_mm) for marker in ahead)
        clear = float(clearance_mm(replace(last, markers=markers), films).min(initial=math.inf))
        if clear > best[0]:
            best = clear, markers
    return best[1]
