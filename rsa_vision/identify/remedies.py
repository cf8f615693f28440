"""What may have been told wrongly about a film on which the cage was not found: for a message, never acted on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.identify.cage import MISSING, TURN_DEG, CageIdentification, identify_cage
from rsa_vision.identify.film_model import Scene, build_scene
from rsa_vision.identify.grids import SCALE, find_grids
from rsa_vision.settings import Limits
from rsa_vision.types import Float, MarkerImages

FACTORS: Final = (0.25, 4.0)  # by which the pixel pitch may be wrong
STEP: Final = 0.9 * SCALE[1] / SCALE[0]  # a grid found at one factor need not be found at the next
SAME: Final = 0.04  # factors nearer to each other are one: the names do not mind 3 %
MOST_TRIED: Final = 4  # factors that are looked at with all marks
MOST_IMAGES: Final = 400  # of more, triples at any scale take long
ORIENTATIONS: Final = {"upright": ("mirrored", "any"), "mirrored": ("upright",), "any": ("mirrored",)}


def what_would_fit(
    images: MarkerImages,
    cage: Cage,
    foci: Sequence[int],
    *,
    pitch_mm: tuple[float, float],
    film_shape: tuple[int, int],
    orientation: str,
    foci_mm: Mapping[int, Sequence[float]],
    limits: Limits,
    others: Sequence[Cage] = (),
) -> tuple[str, ...]:
    """Say with which other orientation, focus, cage or pixel pitch the cage would be found on a film.

    Parameters
    ----------
    images, cage, foci, pitch_mm, film_shape, orientation, foci_mm, limits
        As of :func:`rsa_vision.identify.cage.identify_cage`, that did not find it.
    others : sequence of Cage
        Other cages that it may be.

    Returns
    -------
    tuple of str
        Each a setting as one would write it; empty if nothing fits. One thing is changed at a time. Whether a film may lie in several ways
        with another orientation is for the next run to say; anything else has to fit decisively.
    """
    identify = partial(identify_cage, images, film_shape=film_shape, limits=limits)
    told = partial(identify, cage, foci, pitch_mm=pitch_mm, foci_mm=foci_mm)
    found = [f'orientation = "{other}"' for other in ORIENTATIONS[orientation] if told(orientation=other)][:1]
    if len(foci) == 1:
        as_of = partial(identify, cage, pitch_mm=pitch_mm, foci_mm=foci_mm, orientation=orientation)
        found += [
            f"focus {focus} instead of {foci[0]}" for focus in sorted(cage.foci) if focus not in foci and is_decisive(as_of((focus,)))
        ]
    possible = [other for other in others if other.name != cage.name and other.film == cage.film and set(foci) <= set(other.foci)]
    found += [
        f'cage = "{other.name}"' for other in possible if is_decisive(identify(other, foci, pitch_mm=pitch_mm, orientation=orientation))
    ]
    if len(images) <= MOST_IMAGES:
        xy_mm = images.position_px @ np.diag([-pitch_mm[1] if orientation == "mirrored" else pitch_mm[1], -pitch_mm[0]])
        for factor in _factors(xy_mm, build_scene(cage, tuple(foci), {f: np.asarray(place) for f, place in foci_mm.items()}), orientation):
            scaled = (pitch_mm[0] * factor, pitch_mm[1] * factor)
            if is_decisive(told(orientation=orientation, pitch_mm=scaled)):
                found.append(f"pixel_pitch_mm = {scaled[1]:.2g} or so instead of {pitch_mm[1]:.3g}")
                break
    return tuple(found)


def is_decisive(found: CageIdentification) -> bool:
    """Tell whether the cage was found, in one way only."""
    return bool(found) and "cage-ambiguous" not in found.reasons


def _factors(xy_mm: Float, scene: Scene, orientation: str) -> list[float]:
    """Return factors of the pixel pitch at which the fiducial grid of a focus is found, those with most marks first."""
    mine = (scene.focus == 0) & scene.fiducial
    fiducials = scene.xyz_mm[mine, :2]
    usual = np.mean(SCALE)  # of film to plane
    tried = np.geomspace(*FACTORS, int(np.log(FACTORS[1] / FACTORS[0]) / np.log(STEP)) + 2)
    ranked: list[tuple[int, float]] = []
    for factor in tried.tolist():
        grids = find_grids(factor * xy_mm, fiducials, turn_deg=TURN_DEG[orientation], foci=1, largest_shift_mm=0.0, missing=MISSING)
        ranked += [(-count, factor * float(usual / np.sqrt(abs(np.linalg.det(A))))) for A, _, count in grids]
    distinct: list[float] = []
    for _, factor in sorted(ranked):
        if abs(np.log(factor)) > SAME and all(abs(np.log(factor / other)) > SAME for other in distinct):
            distinct.append(factor)
    return distinct[:MOST_TRIED]
