"""Pairs of images that later examinations contradict: where one marker is hidden on one film and another on the other, two pass for one.

The two images that are left may meet as well as those of a marker. No examination shows that alone, but a later one that shows both markers
and not the one that seemed to be there does.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from rsa_vision.contests import CODE, cloud_of
from rsa_vision.flags import MarkerFlag, flag_names, flag_value
from rsa_vision.followup import judged
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.geometry.rigid import LEAST_POINTS
from rsa_vision.identify.constellation import LOOSE_SIGMA
from rsa_vision.identify.groups import rigid_groups
from rsa_vision.identify.hidden import hidden_markers
from rsa_vision.identify.poses import Cloud, Pairs, place, volume_mm3
from rsa_vision.ordering import natural_key
from rsa_vision.settings import Limits
from rsa_vision.tables import AXES, Row, Rows, name_of


def with_wrong_pairs_reviewed(exams: Sequence[Rows], limits: Limits) -> list[Rows]:
    """Have those examinations reviewed whose markers are, by later ones of their subject, pairs of images of other markers.

    Parameters
    ----------
    exams : sequence of dict
        Rows of the tables of each examination, markers named, those of a subject in the order of time.
    limits : Limits
        ``posterior`` is used.

    Returns
    -------
    list of dict
        With the reason ``pair-ambiguous``, and the flag ``ambiguous`` of the marker and its images, where no later examination shows a
        marker and each of its rays is that of another one, which this examination does not show: where the markers about it put it.
    """
    result: list[Rows] = []
    for index, rows in enumerate(exams):
        subject = rows["exams"][0]["subject"]
        later = [_located(other) for other in exams[index + 1 :] if other["exams"][0]["subject"] == subject]
        wrong = _wrong_pairs(rows, later, limits)
        result.append(_reviewed(rows, wrong) if wrong else rows)
    return result


def _located(rows: Rows) -> dict[str, Row]:
    return {name_of(row): row for row in rows["markers"] if row["x_mm"] is not None}


def _wrong_pairs(rows: Rows, later: Sequence[Mapping[str, Row]], limits: Limits) -> dict[str, list[str]]:
    """Return the markers that are wrong pairs, and those whose images they are."""
    here = _located(rows)
    suspects = here.keys() - {name for there in later for name in there} if later else set()
    rays = _rays(rows, [here[name] for name in sorted(suspects)])
    seen: list[set[str]] = [set() for _ in range(len(rays))]
    for there in later if len(rays) else ():
        for name, ray in _seen_as(here, there, rays, limits):
            seen[ray].add(name)
    wrong: dict[str, list[str]] = {}
    for suspect in sorted(suspects, key=natural_key):
        mine = [seen[r] for r, image in enumerate(rays.image.tolist()) if rows["images"][image]["number"] == suspect]
        # what is on several of its rays lies where they meet: the marker itself under a second name
        others = [names - {name for other in mine if other is not names for name in other} for names in mine]
        if len(mine) > 1 and all(others):
            wrong[suspect] = sorted({name for names in others for name in names}, key=natural_key)
    return wrong


def _rays(rows: Rows, markers: Sequence[Row]) -> RayBundle:
    """Return the rays of markers, from the foci through their places: images have no rays of their own in the tables."""
    cloud, row_of = cloud_of(markers), {name_of(marker): k for k, marker in enumerate(markers)}
    origin = {focus["focus"]: [focus[axis] for axis in AXES] for focus in rows["foci"]}
    image = [i for i, row in enumerate(rows["images"]) if row["role"] == "object" and row["number"] in row_of and row["focus"] in origin]
    of, focus = [row_of[rows["images"][i]["number"]] for i in image], [rows["images"][i]["focus"] for i in image]
    covariance = np.zeros((len(image), 6, 6))
    covariance[:, :3, :3] = cloud.covariance_mm2[of]
    origins = np.array([origin[one] for one in focus], np.float64).reshape(-1, 3)
    numbers = np.array(image, np.int64), np.array(focus, np.int64)
    return RayBundle(*numbers, origins, cloud.position_mm[of], covariance, np.zeros((len(image), 6, 0)))


def _seen_as(here: Mapping[str, Row], there: Mapping[str, Row], rays: RayBundle, limits: Limits) -> Iterator[tuple[str, int]]:
    """Yield markers of a later examination that this one does not show, and the rays that are theirs by a pose of those about them."""
    both, new = sorted(here.keys() & there.keys()), sorted(there.keys() - here.keys())
    if len(both) < LEAST_POINTS or not new:
        return
    points, body = cloud_of([here[name] for name in both]), cloud_of([there[name] for name in (*both, *new)])
    volume = volume_mm3(body)
    groups = [group.members for group in rigid_groups([points, body.rows(np.arange(len(both)))])]
    for i, name in enumerate(new, len(both)):
        for pairs in _about(body, i, groups):
            placement = place(body, points, pairs)
            if placement is not None and (placement.sigmas < LOOSE_SIGMA).all():
                sights = hidden_markers(body, points, pairs, placement, rays, {i}, volume, limits.posterior).sights
                yield from ((name, ray) for _, ray in sights)


def _about(body: Cloud, marker: int, groups: Iterable[Sequence[int]]) -> Iterator[Pairs]:
    """Yield the nearest three markers of each group, the nearest four, and so on to all: bones that hardly moved are one group, nearly."""
    away = np.linalg.norm(body.position_mm - body.position_mm[marker], axis=1).tolist()
    for members in groups:
        nearest = sorted(members, key=away.__getitem__)
        for count in range(LEAST_POINTS, len(members) + 1):
            yield tuple((k, k) for k in sorted(nearest[:count]))


def _reviewed(rows: Rows, wrong: Mapping[str, Sequence[str]]) -> Rows:
    findings = [(CODE, f"the images of {pair} are, by later examinations, of {' and '.join(others)}") for pair, others in wrong.items()]
    markers = [_doubted(row) if name_of(row) in wrong else row for row in rows["markers"]]
    images = [_doubted(row) if row["role"] == "object" and row["number"] in wrong else row for row in rows["images"]]
    return {**rows, "exams": [judged(rows["exams"][0], findings)], "images": images, "markers": markers}


def _doubted(row: Row) -> Row:
    return {**row, "flags": flag_names(flag_value(row["flags"] or "") | MarkerFlag.AMBIGUOUS)}
