"""Exposure of a film: attenuation along the rays from every point of the focal spot, integrated over the pixels' areas.

Small solids (markers, screws, wires, letters) are ray-traced on a fine grid in tiles where their shadows fall; the smooth background
(tissue, distance, scatter) is computed on a coarse grid and interpolated.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from rsa_vision.types import Float, Int
from synthetic.chords import chord_ball, chord_ellipsoid, chord_pin
from synthetic.film import FilmPlane
from synthetic.scene import Ball, Scene, Solid

Image = NDArray[np.float32]

TILE_PX = 32
SPOT_POINTS = 5  # along each side of the focal spot
PIECE_MM = 3.0  # long pins are cut for their bounding boxes
LARGE_MM = 1.0  # radius from which the points of the focal spot alone sample a solid finely enough: it is no marker
COARSE_MM = 0.8  # grid of the background


@dataclass(frozen=True, slots=True)
class Beam:
    """The X-rays.

    Attributes
    ----------
    focal_mm : float
        Side of the square focal spot, which lies parallel to the film.
    double_peaked : bool
        Two ridges along v instead of a uniform square.
    scatter : float
        Part of the exposure without an object in its shadow that is scattered radiation.
    scatter_mm : float
        Standard deviation of the scatter's spread.
    falloff : bool
        Exposure falls with the cube of distance (inverse square and oblique incidence).
    """

    focal_mm: float = 0.7
    double_peaked: bool = False
    scatter: float = 0.0
    scatter_mm: float = 20.0
    falloff: bool = True

    def spot(self) -> tuple[Float, Float]:
        """Return points of the focal spot, shape (k, 2), mm from its centroid, and their weights, which sum to 1."""
        line = (np.arange(SPOT_POINTS) + 0.5) / SPOT_POINTS - 0.5
        profile = np.array([1.0, 0.5, 0.2, 0.5, 1.0]) if self.double_peaked else np.ones(SPOT_POINTS)
        u, v = np.meshgrid(line * self.focal_mm, line * self.focal_mm, indexing="ij")
        weights = np.repeat(profile, SPOT_POINTS)
        return np.column_stack([u.ravel(), v.ravel()]), weights / weights.sum()


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """Mean exposure of a film's pixels, both of shape (rows, cols), 1 where nothing is in the way.

    Attributes
    ----------
    incident : ndarray
        On the screen: governs the quantum noise.
    blurred : ndarray
        After the screen's blur: what the film or detector records on average.
    """

    incident: Image
    blurred: Image


def expose(scene: Scene, film: FilmPlane, beam: Beam, *, blur_mm: float = 0.1, fine: int = 5) -> Exposure:
    """Expose a film by each of its foci in turn, each giving an equal part of the exposure.

    Parameters
    ----------
    scene : Scene
    film : FilmPlane
    beam : Beam
    blur_mm : float
        Standard deviation of the screen's Gaussian blur.
    fine : int
        Rays along the side of a pixel, for each point of the focal spot.

    Returns
    -------
    Exposure
    """
    incident, blurred = np.zeros(film.shape, np.float32), np.zeros(film.shape, np.float32)
    for focus in film.foci:
        clear, scattered = _background(scene, film, focus, beam)
        for total, lost in zip((incident, blurred), _shadows(scene, film, focus, beam, blur_mm, fine), strict=True):
            np.multiply(clear, np.subtract(1.0, lost, out=lost), out=lost)
            lost += scattered
            lost /= len(film.foci)
            total += lost
    return Exposure(incident, blurred)


def _background(scene: Scene, film: FilmPlane, focus: int, beam: Beam) -> tuple[Image, Image | float]:
    """Return the primary exposure without small solids, and the scattered exposure."""
    rows, cols = film.shape
    step = COARSE_MM / np.array(film.pitch_mm)
    row, col = (np.linspace(0, size - 1, max(5, math.ceil(size / by))) for size, by in zip(film.shape, step, strict=True))
    source = scene.foci_mm[focus]
    grid = np.stack(np.broadcast_arrays(col[None, :], row[:, None]), -1)
    ray = np.moveaxis(film.lab_from_pixel(grid) - source, -1, 0)
    distance = np.sqrt((ray * ray).sum(0))
    primary = (distance.min() / distance) ** 3 if beam.falloff else np.ones_like(distance)
    for body in scene.tissue:
        origin = np.broadcast_to(source[:, None, None], ray.shape)
        chord, depth = chord_ellipsoid(origin, ray, body.centre, body.unit_from_lab)
        primary = primary * np.exp(-body.attenuation * chord * depth**body.softness)
    every_row, every_col = np.arange(rows), np.arange(cols)

    def fill(coarse: Float) -> Image:
        return np.asarray(RectBivariateSpline(row, col, coarse, s=0)(every_row, every_col), np.float32)

    if beam.scatter == 0.0:
        return fill(primary), 0.0
    spread = gaussian_filter(primary, beam.scatter_mm / COARSE_MM, mode="nearest")
    return fill((1 - beam.scatter) * primary), fill(beam.scatter * spread)


def _shadows(scene: Scene, film: FilmPlane, focus: int, beam: Beam, blur_mm: float, rays: int) -> tuple[Image, Image]:
    """Return the part of the primary exposure that small solids take away: over pixels, and over blurred pixels."""
    lost_incident, lost_blurred = np.zeros(film.shape, np.float32), np.zeros(film.shape, np.float32)
    spot_uv, weights = beam.spot()
    sources = scene.foci_mm[focus] + spot_uv @ film.axes[:2]
    solids = scene.solids(focus)
    sigma_px = [blur_mm * float(np.linalg.norm(film.pixel_from_film[axis, :2])) for axis in (1, 0)]
    reach = [math.ceil(5 * sigma) for sigma in sigma_px]
    jitter = (np.arange(1, len(weights) + 1)[:, None] * (0.7548776662466927, 0.5698402909980532)) % 1.0  # another grid for every source

    for (r0, r1, c0, c1), members in _tiles(solids, film, sources, reach).items():
        fine = rays if any(solids[i].radius < LARGE_MM for i in members) else 1
        fine_row, fine_col = (_fine_grid(a, b, fine) + (jitter[:, i, None] - 0.5) / fine for i, (a, b) in enumerate(((r0, r1), (c0, c1))))
        inside = {index: (slice((a - r0) * fine, (b - r0) * fine), slice((c - c0) * fine, (d - c0) * fine))
                  for index, (a, b, c, d) in members.items()}  # fmt: skip
        lost = 1.0 - _transmission({solids[i]: part for i, part in inside.items()}, film, sources, fine_row, fine_col)
        lost *= weights[:, None, None]
        for out, sigma, halo in ((lost_incident, (0.0, 0.0), (0, 0)), (lost_blurred, sigma_px, reach)):
            from_row, from_col = (max(a - h, 0) for a, h in zip((r0, c0), halo, strict=True))
            to_row, to_col = (min(b + h, size) for b, h, size in zip((r1, c1), halo, film.shape, strict=True))
            if from_row >= to_row or from_col >= to_col:
                continue
            across = _bin(np.arange(from_row, to_row), fine_row, sigma[0], fine)
            along = _bin(np.arange(from_col, to_col), fine_col, sigma[1], fine)
            out[from_row:to_row, from_col:to_col] += (across @ lost @ along.transpose(0, 2, 1)).sum(0)
    return lost_incident, lost_blurred


def _fine_grid(first: int, stop: int, fine: int) -> Float:
    return first - 0.5 + (np.arange((stop - first) * fine) + 0.5) / fine


def _bin(pixels: Int, samples: Float, sigma: float, fine: int) -> Float:
    """Return the matrices, shape (k, pixels, samples), that blur fine samples and integrate them over pixels."""
    edges = np.append(pixels, pixels[-1] + 1) - 0.5
    beyond = samples[:, None, :] - edges[:, None]
    before = ndtr(beyond / sigma) if sigma else np.clip(0.5 + beyond * fine, 0.0, 1.0)  # a sample stands for 1 / fine of a pixel
    return np.asarray((before[:, :-1] - before[:, 1:]) / fine)


def _transmission(parts: dict[Solid, tuple[slice, slice]], film: FilmPlane, sources: Float, fine_row: Float, fine_col: Float) -> Float:
    """Return the transmission, shape (k, rows, cols), of solids for a grid of rays from each of k sources; each shades only its part."""
    corner, right, below = film.lab_from_pixel(np.array([[0, 0], [1, 0], [0, 1]]))
    by_col, by_row, start = (vector[:, None, None, None] for vector in (right - corner, below - corner, corner))
    ray = start - sources.T[:, :, None, None] + by_col * fine_col[:, None, :] + by_row * fine_row[:, :, None]
    origin = sources.T[:, :, None, None]
    depth = np.zeros(ray.shape[1:])
    for solid, (rows, cols) in parts.items():
        to = ray[:, :, rows, cols]
        if isinstance(solid, Ball):
            chord = chord_ball(origin, to, solid.centre, solid.radius)
        else:
            chord = chord_pin(origin, to, solid.tip, solid.axis, solid.length, solid.radius, solid.taper)
        depth[:, rows, cols] += solid.attenuation * chord
    return np.exp(-depth)


Box = tuple[int, int, int, int]  # row start, row stop, col start, col stop


def _tiles(solids: list[Solid], film: FilmPlane, sources: Float, reach: list[int]) -> dict[Box, dict[int, Box]]:
    """Return the boxes of pixels to ray-trace, which do not overlap, with the solids that may shade each and where in it."""
    margin = np.array(reach[::-1])  # shadows beside the film are blurred into it
    first, last = -margin, margin + film.shape[::-1]
    touched: dict[tuple[int, int], dict[int, Box]] = {}
    for index, solid in enumerate(solids):
        for low, high in _footprints(solid, film, sources):
            (c0, r0), (c1, r1) = np.maximum(low, first).tolist(), np.minimum(high, last).tolist()
            if r0 >= r1 or c0 >= c1:
                continue
            for row in range(r0 // TILE_PX, -(-r1 // TILE_PX)):
                for col in range(c0 // TILE_PX, -(-c1 // TILE_PX)):
                    part = (max(r0, row * TILE_PX), min(r1, (row + 1) * TILE_PX), max(c0, col * TILE_PX), min(c1, (col + 1) * TILE_PX))
                    own = touched.setdefault((row, col), {})
                    own[index] = _hull([part, own[index]] if index in own else [part])
    return {_hull(list(members.values())): members for members in touched.values()}


def _hull(boxes: list[Box]) -> Box:
    low, _, left, _ = (min(values) for values in zip(*boxes, strict=True))
    _, high, _, right = (max(values) for values in zip(*boxes, strict=True))
    return low, high, left, right


def _footprints(solid: Solid, film: FilmPlane, sources: Float) -> list[tuple[Int, Int]]:
    """Return boxes of pixels (low, high: col, row; high excluded) that together hold a solid's shadow."""
    if isinstance(solid, Ball):
        ends = np.array([solid.centre, solid.centre])
    else:
        pieces = max(1, math.ceil(solid.length / PIECE_MM))
        ends = solid.tip + np.linspace(0, solid.length, pieces + 1)[:, None] * solid.axis
    scale = np.abs(film.pixel_from_film[:, :2]).sum(1)
    boxes = []
    for first, last in itertools.pairwise(ends):
        points = np.array([film.project(source, np.array([first, last])) for source in sources[[0, SPOT_POINTS - 1, -SPOT_POINTS, -1]]])
        height = (sources[0] - film.origin_mm) @ film.axes[2]
        over = max((point - film.origin_mm) @ film.axes[2] for point in (first, last)) + solid.radius
        margin = 1.2 * solid.radius * height / (height - over) * scale + 1
        flat = points.reshape(-1, 2)
        boxes.append((np.floor(flat.min(0) - margin).astype(int), np.ceil(flat.max(0) + margin).astype(int) + 1))
    return boxes
