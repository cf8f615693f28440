"""What the marks of a cage cannot tell about the orientation of a film."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from rsa_vision.types import Float

if TYPE_CHECKING:
    from rsa_vision.cages import Cage, Mark, Plane

POSITION_TOLERANCE_MM: Final = 1.0  # marks that agree within a few gross-error limits (0.25 mm) cannot be trusted to tell
ARM_TOLERANCE_DEG: Final = 10.0  # perspective and a turned pin move arms by about this much
FOCUS_TOLERANCE_MM: Final = 300.0  # the true focus and its image may each be 150 mm from nominal


@dataclass(frozen=True, slots=True, eq=False)
class Symmetry:
    """A motion of a fiducial plane onto itself that maps the marks and the foci onto marks and foci.

    Films that differ by it look alike: without knowing how the film lay, the names of the marks are ambiguous.

    Attributes
    ----------
    foci : tuple of int
        The foci of the plane, all on the film.
    kind : str
        ``rotation`` or ``mirror``.
    angle_deg : float
        Of the rotation, or of the direction of the mirror's axis; from u towards v.
    matrix : ndarray of shape (2, 3)
        Plane coordinates after from before: ``matrix @ (u, v, 1)``.
    focus_to : mapping
        The focus that takes the place of each; on a shared film they may change places.
    number_to : mapping
        ``{(focus, number): number}``: the mark that takes the place of each, of focus ``focus_to[focus]``.
    """

    foci: tuple[int, ...]
    kind: Literal["rotation", "mirror"]
    angle_deg: float
    matrix: Float
    focus_to: Mapping[int, int]
    number_to: Mapping[tuple[int, int], int]

    def __str__(self) -> str:
        films = "the film" if len(self.foci) > 1 else f"the film of focus {self.foci[0]}"
        swap = ", foci exchanged" if any(a != b for a, b in self.focus_to.items()) else ""
        if self.kind == "rotation":
            return f'{films} turned by {self.angle_deg:.0f} deg{swap}: told by orientation = "upright" only'
        return f"{films} seen from behind, mirrored about a line at {self.angle_deg:.0f} deg to u{swap}: told by orientation only"


def symmetries(cage: Cage) -> tuple[Symmetry, ...]:
    """Return the in-plane symmetries of a cage: what an unknown orientation of the film leaves ambiguous.

    Parameters
    ----------
    cage : Cage

    Returns
    -------
    tuple of Symmetry
        For every plane the rotations and mirrors, without the identity, that map fiducial marks onto fiducial marks and control points onto
        control points of the same height, shape and arms, of the same focus or, on a shared film, of another one, and foci to within
        :data:`FOCUS_TOLERANCE_MM` of foci. Empty: the marks decide.
    """
    return tuple(symmetry for plane in cage.plane for symmetry in _of_plane(cage, plane))


def turns(cage: Cage) -> tuple[Float, ...]:
    """Return the rotations of everything that films of a cage show if all foci's were turned, and that its marks cannot tell.

    Parameters
    ----------
    cage : Cage

    Returns
    -------
    tuple of ndarray of shape (3, 3)
        In the laboratory frame. Empty where single films can be turned only: then rays miss each other.
    """
    whole = [symmetry for symmetry in symmetries(cage) if symmetry.kind == "rotation" and set(symmetry.foci) == set(cage.foci)]
    return tuple(_in_space(symmetry.matrix[:, :2], cage.plane_of(symmetry.foci[0])) for symmetry in whole)


def _in_space(linear: Float, plane: Plane) -> Float:
    u, v = plane.lab_from_plane()[1]
    normal = plane.normal()
    turned = np.column_stack([u, v]) @ linear @ np.stack([u, v])
    rotation: Float = turned + np.outer(normal, normal)
    return rotation


def _of_plane(cage: Cage, plane: Plane) -> list[Symmetry]:
    origin, basis = plane.lab_from_plane()
    frame = np.vstack([basis, plane.normal()])
    groups = [plane.foci] if cage.film == "shared" else [(focus,) for focus in plane.foci]
    found: list[Symmetry] = []
    for foci in groups:
        marks = {f: (*cage.marks_of(f, "fiducial"), *cage.marks_of(f, "control")) for f in foci}
        placed = {f: (np.array([m.xyz for m in marks[f]]) - origin) @ frame.T for f in foci}
        positions = {f: (np.array(cage.foci[f]) - origin) @ frame.T for f in foci}
        fiducials = np.vstack([(np.array([m.xyz for m in cage.marks_of(f, "fiducial")]) - origin) @ frame.T for f in foci])
        for linear in _candidates(fiducials[:, :2]):
            motion = np.eye(4)
            motion[:2, :2] = linear
            centre = _centre(fiducials[:, :2])
            motion[:2, 3] = centre - linear @ centre
            for targets in permutations(foci):
                focus_to = dict(zip(foci, targets, strict=True))
                shift = max(float(np.linalg.norm(_moved(motion, positions[f][None])[0] - positions[t])) for f, t in focus_to.items())
                if shift > FOCUS_TOLERANCE_MM:
                    continue
                numbers = _number_map(motion, frame, focus_to, marks, placed)
                if numbers is not None:
                    kind: Literal["rotation", "mirror"] = "rotation" if np.linalg.det(linear) > 0 else "mirror"
                    angle = float(np.rad2deg(np.arctan2(linear[1, 0], linear[0, 0])))
                    angle = angle % 360 if kind == "rotation" else (angle / 2) % 180
                    found.append(Symmetry(foci, kind, angle, motion[:2, [0, 1, 3]], focus_to, numbers))
    return found


def _centre(points: Float) -> Float:
    centre: Float = np.unique(np.round(points, 6), axis=0).mean(axis=0)  # a mark that several foci see counts once
    return centre


def _candidates(points: Float) -> list[Float]:
    """Return the rotations and reflections, shape (2, 2), that may map the points onto themselves about their centre (no identity)."""
    offsets = points - _centre(points)
    radii = np.hypot(*offsets.T)
    reference = offsets[np.argmax(radii)]
    angle = np.arctan2(reference[1], reference[0])
    found: list[Float] = []
    for target in offsets[np.abs(radii - radii.max()) < POSITION_TOLERANCE_MM]:
        goal = np.arctan2(target[1], target[0])
        for sign, turn in ((1, goal - angle), (-1, goal + angle)):
            cos, sin = np.cos(turn), np.sin(turn)
            linear = np.array([[cos, -sign * sin], [sin, sign * cos]])
            if not any(np.allclose(linear, other, atol=0.01) for other in [np.eye(2), *found]):
                found.append(linear)
    return found


def _moved(motion: Float, points: Float) -> Float:
    moved: Float = points @ motion[:3, :3].T + motion[:3, 3]
    return moved


def _number_map(
    motion: Float,
    frame: Float,
    focus_to: Mapping[int, int],
    marks: Mapping[int, tuple[Mark, ...]],
    placed: Mapping[int, Float],
) -> dict[tuple[int, int], int] | None:
    """Return which mark takes the place of which, or None where one finds no equal."""
    numbers: dict[tuple[int, int], int] = {}
    for focus, target in focus_to.items():
        if len(marks[focus]) != len(marks[target]):
            return None
        for mark, place in zip(marks[focus], _moved(motion, placed[focus]), strict=True):
            distance = np.linalg.norm(placed[target] - place, axis=1)
            nearest = int(np.argmin(distance))
            other = marks[target][nearest]
            alike = other.role == mark.role and other.shape == mark.shape and _same_arms(motion, frame, mark, other)
            if distance[nearest] > POSITION_TOLERANCE_MM or not alike:
                return None
            numbers[focus, mark.number] = other.number
    return numbers


def _same_arms(motion: Float, frame: Float, mark: Mark, other: Mark) -> bool:
    if not mark.arms:
        return True
    arms, others = (np.array(m.arms) / np.linalg.norm(m.arms, axis=1)[:, None] @ frame.T for m in (mark, other))
    cosines = (arms @ motion[:3, :3].T) @ others.T
    return bool(np.all(cosines.max(axis=1) > np.cos(np.deg2rad(ARM_TOLERANCE_DEG))))
