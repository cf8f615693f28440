"""What the films of an examination leave open: rays of images without a partner, and pairs that their rays alone cannot decide.

Both go into the record of the examination, where knowledge of the segments may settle them (:mod:`rsa_vision.followup`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.flags import MarkerFlag, flag_value
from rsa_vision.geometry.camera import Pinhole, camera_rays
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.pairs import Pairing
from rsa_vision.readings import OBJECT_SHAPES, joined_rays
from rsa_vision.types import Float, ImagePoints, Int, Reconstruction
from rsa_vision.xray import rays_of

Row = dict[str, Any]
COLUMNS: Final = ("image", "focus", "origin_mm", "through_mm", "covariance_mm2")  # the last: 21 elements of the upper triangle
UPPER: Final = np.triu_indices(6)
RaysOf = Callable[[int, Float, Float, Int], RayBundle]
"""Rays of a focus from positions and covariances of images in pixels, and what to call them."""


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """What is left open.

    Attributes
    ----------
    rays : RayBundle
        ``image`` counts the points of the examination. An image of a shared film has a ray of each focus that it may belong to.
    contested : tuple of tuple of int
        Groups of rays, one of each focus at most, of which some are markers: as :attr:`rsa_vision.identify.pairs.Pairing.contested`.
    log_odds : ndarray of shape (c,)
        Of such a group, against its images being unrelated.
    """

    rays: RayBundle
    contested: tuple[tuple[int, ...], ...]
    log_odds: Float

    @classmethod
    def none(cls) -> Sightlines:
        """Return those of an examination that leaves nothing open."""
        return cls(no_rays(), (), np.zeros(0))

    def rows(self) -> dict[str, list[Row]]:
        """Return this as plain rows: the tables ``rays`` and ``contested`` of a record, which are in no CSV file."""
        columns = (self.rays.image, self.rays.focus, self.rays.origin_mm, self.rays.through_mm, self.rays.covariance_mm2[:, *UPPER])
        rays = [dict(zip(COLUMNS, ray, strict=True)) for ray in zip(*(values.tolist() for values in columns), strict=True)]
        groups = zip(self.contested, self.log_odds.tolist(), strict=True)
        return {"rays": rays, "contested": [{"rays": list(group), "log_odds": odds} for group, odds in groups]}

    @classmethod
    def read(cls, rows: Mapping[str, Sequence[Row]]) -> Sightlines:
        """Return what the tables of an examination say, the inverse of :meth:`rows`; nothing where they do not say."""
        rays, contested = rows.get("rays", []), rows.get("contested", [])
        n = len(rays)
        image, focus, origin, through, upper = ([ray[name] for ray in rays] for name in COLUMNS)
        covariance = np.zeros((n, 6, 6))
        covariance[:, *UPPER] = np.array(upper, np.float64).reshape(n, -1) if n else 0.0
        covariance[:, *UPPER[::-1]] = covariance[:, *UPPER]
        start, through_mm = (np.array(place, np.float64).reshape(n, 3) for place in (origin, through))
        bundle = RayBundle(np.array(image, np.int64), np.array(focus, np.int64), start, through_mm, covariance, np.zeros((n, 6, 0)))
        return cls(bundle, tuple(tuple(one["rays"]) for one in contested), np.array([one["log_odds"] for one in contested], np.float64))


def no_rays() -> RayBundle:
    """Return a bundle without rays."""
    none = np.zeros(0, np.int64)
    return RayBundle(none, none, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 6, 6)), np.zeros((0, 6, 0)))


def by_cage(reconstruction: Reconstruction, cage: Cage) -> RaysOf:
    """Return how rays come from images by the foci that were found."""
    solution = {focus.focus: focus for focus in reconstruction.foci}
    return lambda focus, px, covariance, image: rays_of(px, covariance, solution[focus], cage, image)


def by_cameras(reconstruction: Reconstruction, cameras: Mapping[int, Pinhole]) -> RaysOf:
    """Return how rays come from images of calibrated cameras, with the error of the calibration that the crossings show."""
    error_px = reconstruction.calibration_px
    return lambda focus, px, covariance, image: camera_rays(cameras[focus], focus, px, covariance, image, calibration_px=error_px)


def left_open(points: ImagePoints, rows: Int, bundle: RayBundle, pairing: Pairing, rays_of: RaysOf) -> Sightlines:
    """Return what a pairing leaves open.

    Parameters
    ----------
    points : ImagePoints
        Of the examination.
    rows : ndarray of int, shape (n,)
        Of each point in the table that ``bundle.image`` counts.
    bundle : RayBundle
        All rays that were paired, foci in rising order.
    pairing : Pairing
    rays_of : callable

    Returns
    -------
    Sightlines
    """
    contested = sorted({ray for group in pairing.contested for ray in group})
    wanted = np.union1d(np.flatnonzero(np.isin(bundle.image, pairing.unmatched)), np.array(contested, np.int64))
    point_of = {int(row): point for point, row in enumerate(rows)}
    image = np.array([point_of[int(row)] for row in bundle.image[wanted]], np.int64)
    rays = _rays(points, bundle.focus[wanted], image, rays_of)
    place = {int(ray): k for k, ray in enumerate(wanted)}
    return Sightlines(rays, tuple(tuple(place[ray] for ray in group) for group in pairing.contested), pairing.contested_log_odds)


def single_images(reconstruction: Reconstruction, rays_of: RaysOf) -> Sightlines:
    """Return the rays of points that nothing explains, and of markers that are named at one focus only."""
    points = reconstruction.points
    once = reconstruction.markers.name[reconstruction.markers.n_views == 1]
    alone = (points.role == "object") & np.isin(points.number, once)
    free = alone | ((points.role == "unassigned") & np.isin(points.shape, OBJECT_SHAPES))
    pairs = [(focus.focus, row) for focus in reconstruction.foci for row in np.flatnonzero(free & np.isin(points.focus, (0, focus.focus)))]
    focus, image = np.array(pairs, np.int64).reshape(-1, 2).T
    return replace(Sightlines.none(), rays=_rays(points, focus, image, rays_of))


def _rays(points: ImagePoints, focus: Int, image: Int, rays_of: RaysOf) -> RayBundle:
    parts = [no_rays()]
    for one in np.unique(focus):
        mine = image[focus == one]
        rays = rays_of(int(one), points.position_px[mine], points.covariance_px2[mine], mine)
        effect = rays.cage_effect_mm  # what the rays have in common by the cage counts with each: records hold no more than that
        parts.append(replace(rays, covariance_mm2=rays.covariance_mm2 + effect @ effect.swapaxes(1, 2), cage_effect_mm=effect[:, :, :0]))
    return joined_rays(parts)


def is_free(image: Row) -> bool:
    """Tell whether an image may be of a marker that no other image shows: of nothing, or a marker's that one focus alone shows."""
    flags = flag_value(image["flags"] or "")
    if image["role"] == "object":
        return bool(flags & MarkerFlag.ONE_VIEW)
    return bool(image["role"] == "unassigned" and image["shape"] in OBJECT_SHAPES and not flags & MarkerFlag.FOREIGN_MARK)
