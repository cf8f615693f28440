"""Where a film lies in the laboratory and how its scan is turned: laboratory -> film -> pixels, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.types import Bool, Float

DEFAULT_GAP_MM = 10.0  # film behind the fiducial plane where the cage does not say
MARGIN_MM = 12.0  # film beyond the outermost cage mark


@dataclass(frozen=True, slots=True)
class Pose:
    """How a film lay on the scanner.

    Attributes
    ----------
    rotation_deg : float
        Counter-clockwise turn of the picture as displayed.
    shift_mm : tuple of two floats
        To the right and down.
    anisotropy : float
        Relative excess of the true column scale over the one the file states.
    shear : float
        Columns moved to the right per column down.
    mirrored : bool
        Seen from behind.
    """

    rotation_deg: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    anisotropy: float = 0.0
    shear: float = 0.0
    mirrored: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class FilmPlane:
    """A film: a rectangle in the laboratory and the pixels that its scan makes of it.

    Attributes
    ----------
    foci : tuple of int
        Whose exposures it gets.
    origin_mm : ndarray of shape (3,)
        Middle of the film.
    axes : ndarray of shape (3, 3)
        Rows: the plane's u, v, and the normal towards the foci.
    pixel_from_film : ndarray of shape (2, 3)
        (col, row) from (u, v, 1), mm from the middle.
    shape : tuple of two ints
        (rows, cols).
    pitch_mm : tuple of two floats
        (row, col) as the file states.
    """

    foci: tuple[int, ...]
    origin_mm: Float
    axes: Float
    pixel_from_film: Float
    shape: tuple[int, int]
    pitch_mm: tuple[float, float]

    def project(self, focus_mm: Float, points_mm: Float) -> Float:
        """Return where the rays from a focus through points, shape (..., 3), meet the film: (col, row), shape (..., 2)."""
        direction = np.asarray(points_mm, float) - focus_mm
        height = (focus_mm - self.origin_mm) @ self.axes[2]
        hit = focus_mm + direction * (-height / (direction @ self.axes[2]))[..., None]
        uv = (hit - self.origin_mm) @ self.axes[:2].T
        return np.asarray(uv @ self.pixel_from_film[:, :2].T + self.pixel_from_film[:, 2])

    def lab_from_pixel(self, position_px: Float) -> Float:
        """Return the points of the laboratory, shape (..., 3), under pixels (col, row), shape (..., 2)."""
        film_from_pixel = np.linalg.inv(self.pixel_from_film[:, :2])
        uv = (np.asarray(position_px, float) - self.pixel_from_film[:, 2]) @ film_from_pixel.T
        return np.asarray(self.origin_mm + uv @ self.axes[:2])

    def holds(self, position_px: Float, border_px: float = 0.0) -> Bool:
        """Return which positions, shape (..., 2), lie on the film at least ``border_px`` from its edge."""
        col, row = np.moveaxis(np.asarray(position_px), -1, 0)
        rows, cols = self.shape
        low = border_px - 0.5
        return np.asarray((col >= low) & (row >= low) & (col <= cols - 1 - low) & (row <= rows - 1 - low))


def place_film(
    cage: Cage,
    foci_mm: dict[int, Float],
    foci: tuple[int, ...],
    *,
    pitch_mm: tuple[float, float] = (0.1, 0.1),
    pose: Pose | None = None,
    size_mm: tuple[float, float] | None = None,
) -> FilmPlane:
    """Lay a film under the fiducial plane of its foci.

    Parameters
    ----------
    cage : Cage
    foci_mm : dict
        The true foci, by number.
    foci : tuple of int
        Foci that expose this film; they share one fiducial plane.
    pitch_mm : tuple of two floats
        (row, col).
    pose : Pose, optional
    size_mm : tuple of two floats, optional
        Along u and v, centred on the fiducial marks; default: what the marks of these foci need, and a margin.

    Returns
    -------
    FilmPlane
        Its pixels cover the turned film.
    """
    pose = pose or Pose()
    plane = cage.plane_of(foci[0])
    basis = np.array([plane.u, plane.v], float)
    normal = np.cross(basis[0], basis[1])
    to_focus = foci_mm[foci[0]] - np.array(plane.origin)
    normal *= np.sign(normal @ to_focus)
    axes = np.vstack([basis, normal])
    gap = DEFAULT_GAP_MM if plane.film_gap_mm is None else plane.film_gap_mm
    under = np.array(plane.origin) - gap * normal

    images = []
    for focus in foci:
        marks = np.array([mark.xyz for mark in cage.mark if focus in mark.foci], float)
        direction = marks - foci_mm[focus]
        distance = ((under - foci_mm[focus]) @ normal) / (direction @ normal)
        images.append((foci_mm[focus] + direction * distance[:, None] - under) @ basis.T)
    low, high = np.vstack(images).min(0) - MARGIN_MM, np.vstack(images).max(0) + MARGIN_MM
    if size_mm is not None:
        fiducials = [mark.xyz for mark in cage.mark if mark.role == "fiducial" and set(foci) & set(mark.foci)]
        middle = (np.array(fiducials, float) - under) @ basis.T
        centre = (middle.min(0) + middle.max(0)) / 2
        low, high = centre - np.array(size_mm) / 2, centre + np.array(size_mm) / 2
    centre, size = (low + high) / 2, high - low

    turn = math.radians(pose.rotation_deg)
    rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])  # counter-clockwise with rows downwards
    upright = np.diag([-1.0 if pose.mirrored else 1.0, -1.0])  # u goes with +col, v with -row
    stretch = np.array([[1.0 + pose.anisotropy, pose.shear], [0.0, 1.0]])
    linear = np.diag([1 / pitch_mm[1], 1 / pitch_mm[0]]) @ stretch @ rotation @ upright
    cols, rows = (math.ceil(extent) for extent in np.abs(linear) @ size)
    shift = np.array([pose.shift_mm[0] / pitch_mm[1], pose.shift_mm[1] / pitch_mm[0]])
    offset = np.array([(cols - 1) / 2, (rows - 1) / 2]) + shift
    return FilmPlane(foci, under + centre @ basis, axes, np.column_stack([linear, offset]), (rows, cols), pitch_mm)
