"""What the images of a film look like against the marks of a cage: shape, direction, and what is a part of a mark only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from rsa_vision.identify.film_model import FILM, Scene, project
from rsa_vision.types import Bool, Float, Int, Str

ANGLE_SD_DEG: Final = 5.0
ANGLE_WRONG: Final = 0.1  # a hidden arm turns the tee
BODY_MM: Final = 0.15  # blur and the error of a detection that is no marker
SHAPE_RIGHT: Final = 0.85  # a mark is detected as what it is; hidden arms make a tee a pin or a ball


@dataclass(frozen=True, slots=True, eq=False)
class FilmImages:
    """Marker images in the film frame (x right, y up, mm; seen from the focus)."""

    xy_mm: Float
    covariance_mm2: Float
    shape: Str
    angle_rad: Float
    radius_mm: Float
    poor: Bool  # not described by the model of its shape
    log_density: Float  # of clutter around each, per mm2


def film_images(
    xy_mm: Float, covariance_mm2: Float, shape: Str, angle_rad: Float, radius_mm: Float, poor: Bool, area_mm2: float
) -> FilmImages:
    """Add the density of images around each: letters and screws make clusters, where a chance hit is likelier."""
    n = len(xy_mm)
    density = np.full(n, n / area_mm2)
    k = min(6, n - 1)
    if k >= 3:
        distance = np.asarray(cKDTree(xy_mm).query(xy_mm, k=k + 1)[0])[:, k]
        density = np.maximum(density, k / (np.pi * np.maximum(distance, 0.5) ** 2))
    return FilmImages(xy_mm, covariance_mm2, shape, angle_rad, radius_mm, poor, np.log(density))


def appearance(scene: Scene, parameters: Float, images: FilmImages) -> Float:
    """Log likelihood ratios of shape and direction, mark against clutter, shape (m, n)."""
    kinds = ("ball", "pin", "tee")
    count = np.array([(images.shape == kind).sum() for kind in kinds]) + 1.0
    of_clutter = count / count.sum()
    result = np.zeros((len(scene.mark), len(images.xy_mm)))
    for k, kind in enumerate(kinds):
        columns = images.shape == kind
        of_mark = np.where(scene.shape == kind, SHAPE_RIGHT, (1 - SHAPE_RIGHT) / 2)
        result[:, columns] = np.log(of_mark / of_clutter[k])[:, None]
    turned = angle_difference_deg(scene, parameters, images)
    peak = (1 - ANGLE_WRONG) * 360 / (np.sqrt(2 * np.pi) * ANGLE_SD_DEG)
    with np.errstate(invalid="ignore"):
        ratio = np.log(ANGLE_WRONG + peak * np.exp(-0.5 * (turned / ANGLE_SD_DEG) ** 2))
    result += np.where(np.isfinite(turned), ratio, 0.0)
    return result


def angle_difference_deg(scene: Scene, parameters: Float, images: FilmImages) -> Float:
    """Angle of every image against the stem that every mark would show, shape (m, n); NaN where either has none or shapes differ."""
    if not (np.isfinite(scene.stem).any() and np.isfinite(images.angle_rad).any()):
        return np.full((len(scene.mark), len(images.xy_mm)), np.nan)
    stem = np.nan_to_num(scene.stem)
    step = project(scene, parameters, xyz_mm=scene.xyz_mm + 0.5 * stem) - project(scene, parameters)
    predicted = np.where(np.hypot(*step.T) > 0.1, np.arctan2(step[:, 1], step[:, 0]), np.nan)
    row, column = np.nonzero((scene.shape[:, None] == images.shape) & np.isfinite(predicted)[:, None] & np.isfinite(images.angle_rad))
    turned = np.full((len(scene.mark), len(images.xy_mm)), np.nan)
    turned[row, column] = np.rad2deg((images.angle_rad[column] - predicted[row] + np.pi) % (2 * np.pi) - np.pi)
    return turned


def on_bodies(scene: Scene, parameters: Float, images: FilmImages, rows: Int) -> Bool:
    """Tell which images may be parts of the image of a mark rather than markers: shape (len(rows), n).

    A detector may see balls and pins on the pins of a tee. A ball clearly wider than the pins is no part of them, unless where they
    meet, or where it is a poor ball: arms of tees from two foci that cross are as wide.
    """
    place = project(scene, parameters, rows)
    focus = parameters[FILM:].reshape(-1, 3)[scene.focus[rows], 2]
    width = scene.size_mm[rows] / 2 * focus / (focus - scene.xyz_mm[rows, 2])
    offset = images.xy_mm[None] - place[:, None]
    away = np.hypot(offset[..., 0], offset[..., 1])
    with np.errstate(invalid="ignore"):
        wide = (images.shape == "ball") & (images.radius_mm > 1.35 * width[:, None]) & ~images.poor
    result = np.zeros(away.shape, bool)
    result |= away < 1.2 * width[:, None] + np.where(wide, 0.0, BODY_MM)
    for arm in range(scene.arms_mm.shape[1]):
        mine = np.isfinite(scene.arms_mm[rows, arm, 0])
        if mine.any():
            which = rows[mine]
            way = project(scene, parameters, which, xyz_mm=scene.xyz_mm[which] + scene.arms_mm[which, arm]) - place[mine]
            (x, y), (way_x, way_y) = np.moveaxis(offset[mine], -1, 0), way.T[:, :, None]
            along = np.clip((x * way_x + y * way_y) / (way_x**2 + way_y**2).clip(1e-9), 0, 1)
            rest = np.hypot(x - along * way_x, y - along * way_y)
            result[mine] |= (rest < 1.2 * width[mine][:, None] + BODY_MM) & ~wide[mine]
    return result
