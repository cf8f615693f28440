"""Markers of known segments that single images show: tables and what was found among points in, rows of hidden markers out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rsa_vision.flags import MarkerFlag, flag_names, flag_value
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.constellation import LOOSE_SIGMA, Known
from rsa_vision.identify.hidden import Sighting, find_with_rays, hidden_markers
from rsa_vision.identify.poses import TOLERANCE_MM, Cloud, Pairs, place, volume_mm3
from rsa_vision.settings import Limits
from rsa_vision.sightlines import Sightlines, is_free
from rsa_vision.tables import AXES, SCHEMAS, Row, Rows, split_name
from rsa_vision.types import Float

LEAST_RIGID: Final = 4  # markers that tell that nothing moved: three fit too easily
PRESENT: Final = 0.98  # probability that a segment is on films that show another segment of its subject


@dataclass(frozen=True, eq=False)
class HiddenMarker:
    """A marker without rays of its own from two foci: its place by its segment, and its images with their focus and ray."""

    name: str
    place_mm: Float
    covariance_mm2: Float
    images: Mapping[int, tuple[int, RayBundle]]
    flags: int


def find_sightings(rows: Rows, cloud: Cloud, bodies: Sequence[Cloud], matched: Sequence[Known], limits: Limits) -> list[Sighting]:
    """Look for the markers that are missing among single images; what two segments claim goes to neither.

    Parameters
    ----------
    rows : dict
        Tables of the examination.
    cloud : Cloud
        Its points.
    bodies : sequence of Cloud
        The known segments.
    matched : sequence of Known
        What became of them among the points.
    limits : Limits
        ``posterior`` is used.

    Returns
    -------
    list of Sighting
        One of each segment.
    """
    rays = _free_rays(rows)
    nothing = Sighting((), (), None, decisive=True)
    if not len(rays):
        return [nothing] * len(bodies)
    volume = max(volume_mm3(cloud) for cloud in (cloud, *bodies))
    lost = [index for index, known in enumerate(matched) if known.placement is None]
    doubtful = {a for index in lost for _, a in matched[index].doubtful}
    taken = {a for known in matched for _, a in (*known.pairs, *known.loose, *known.doubtful)} - doubtful
    mine = np.array([a for a in range(len(cloud)) if a not in taken], dtype=np.int64)
    present = PRESENT if len(lost) < len(matched) else 0.5
    some = [bodies[index] for index in lost]
    by_rays = find_with_rays(some, cloud.rows(mine), rays, volume, limits.posterior, around_mm=cloud.position_mm, present=present)
    competing = dict(zip(lost, by_rays, strict=True))
    found = []
    for index, (body, known) in enumerate(zip(bodies, matched, strict=True)):
        if known.placement is not None:
            seen = known.pairs if not known.loose else tuple(pair for pair in known.pairs if pair not in known.loose)
            missing = set(known.lost)
            sighting = hidden_markers(body, cloud, seen, known.placement, rays, missing, volume, limits.posterior)
        else:
            sighting = competing[index]
            sighting = replace(sighting, pairs=tuple((i, int(mine[a])) for i, a in sighting.pairs))
            if not (sighting.sights if sighting.decisive else not known.doubtful):
                sighting = nothing  # points tell nothing here that they did not tell by themselves, and their doubt says it all
        found.append(sighting if sighting.decisive else replace(nothing, decisive=False))
    claims = [claim for one in found for claim in {("image", rays.image[r]) for _, r in one.sights} | {("point", a) for _, a in one.pairs}]
    return [
        replace(nothing, decisive=False)
        if any(
            claims.count(claim) > 1 for claim in [*(("image", rays.image[r]) for _, r in one.sights), *(("point", a) for _, a in one.pairs)]
        )
        else replace(one, sights=tuple((i, int(r)) for i, r in one.sights), rays=rays)
        for one in found
    ]


def _free_rays(rows: Rows) -> RayBundle:
    """Return the rays of images that show no marker so far."""
    rays = Sightlines.read(rows).rays
    free = np.array([is_free(rows["images"][i]) for i in rays.image.tolist()], bool)
    return rays.rows(free)


def hidden_of(names: Sequence[str], body: Cloud, sighting: Sighting) -> list[HiddenMarker]:
    """Return the markers of a body that single images show, where its pose puts them."""
    if sighting.placement is None or sighting.rays is None:
        return []
    markers = sorted({i for i, _ in sighting.sights})
    some = body.rows(np.array(markers, np.int64))
    place_mm, by_pose = sighting.placement.predict(some.position_mm)
    own = sighting.placement.rotation @ some.covariance_mm2 @ sighting.placement.rotation.T
    result = []
    for k, i in enumerate(markers):
        views = [r for marker, r in sighting.sights if marker == i]
        images = {int(sighting.rays.image[r]): (int(sighting.rays.focus[r]), sighting.rays.rows(np.array([r]))) for r in views}
        flags = int(MarkerFlag.PREDICTED | (MarkerFlag.ONE_VIEW if len(views) == 1 else 0))
        covariance = by_pose[k] + own[k] + TOLERANCE_MM**2 * np.eye(3)
        result.append(HiddenMarker(names[i], place_mm[k], covariance, images, flags))
    return result


def hidden_since(
    rows: Rows, before: Cloud, names: Sequence[str], cloud: Cloud, found: Pairs, missing: Collection[str], limits: Limits
) -> list[HiddenMarker]:
    """Return markers of an earlier examination that single images show, where nothing has moved against anything since.

    Parameters
    ----------
    rows : dict
        Tables of the examination.
    before : Cloud
        Markers of the earlier one.
    names : sequence of str
        Of these.
    cloud : Cloud
        Points of the examination.
    found : tuple of (earlier marker, point)
        Markers found again.
    missing : collection of str
        Names of those that were not.
    limits : Limits
        ``posterior`` is used.

    Returns
    -------
    list of HiddenMarker
        None if the markers found are no one rigid body: then nothing tells to which part of them a missing one belongs.
    """
    lost = {i for i, name in enumerate(names) if name in missing}
    rays = _free_rays(rows)
    placement = place(before, cloud, found) if len(found) >= LEAST_RIGID else None
    if placement is None or (placement.sigmas > LOOSE_SIGMA).any() or not lost or not len(rays):
        return []
    sighting = hidden_markers(before, cloud, found, placement, rays, lost, max(volume_mm3(before), volume_mm3(cloud)), limits.posterior)
    return hidden_of(names, before, replace(sighting, rays=rays)) if sighting.decisive else []


def predicted_row(exam: Row, hidden: HiddenMarker) -> Row:
    """Return a hidden marker's row of ``markers.csv``."""
    segment, marker = split_name(hidden.name)
    row: Row = dict.fromkeys(SCHEMAS["markers"]) | {"subject": exam["subject"], "exam": exam["exam"], "segment": segment, "marker": marker}
    cov = hidden.covariance_mm2
    row |= dict(zip(AXES, hidden.place_mm.tolist(), strict=True))
    row |= dict(zip((f"sd_{axis}" for axis in AXES), np.sqrt(np.diagonal(cov)).tolist(), strict=True))
    row |= {"cov_xy_mm2": float(cov[0, 1]), "cov_xz_mm2": float(cov[0, 2]), "cov_yz_mm2": float(cov[1, 2])}
    return row | {"n_views": len(hidden.images), "flags": flag_names(hidden.flags)}


def image_row(row: Row, hidden: HiddenMarker, focus: int, ray: RayBundle, *, with_plane: bool) -> Row:
    """Return the row of an image of it; `with_plane`: rays go through the fiducial plane, where images have coordinates."""
    through = ray.through_mm[0]
    away = float(np.linalg.norm(np.cross(hidden.place_mm - through, ray.direction[0])))
    named = {"focus": focus, "role": "object", "number": hidden.name, "residual_um": 1000 * away, "used": True}
    flags = flag_names(flag_value(row["flags"] or "") | (MarkerFlag.ONE_VIEW & hidden.flags))
    return {**row, **named, **(dict(zip(AXES, through.tolist(), strict=True)) if with_plane else {}), "flags": flags}


def missing_row(exam: Row, name: str) -> Row:
    """Return the row of ``markers.csv`` of a known marker that was not found: without coordinates."""
    segment, marker = split_name(name)
    head = {"subject": exam["subject"], "exam": exam["exam"], "segment": segment, "marker": marker}
    return dict.fromkeys(SCHEMAS["markers"]) | head | {"n_views": 0, "flags": flag_names(MarkerFlag.MISSING)}
