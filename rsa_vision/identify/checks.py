"""What a naming must show beyond being the best one: enough marks, spread, of the right look, on a film that can be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rsa_vision.identify.appearance import FilmImages, angle_difference_deg
from rsa_vision.identify.film_model import FILM, Scene
from rsa_vision.identify.naming import Naming
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float

LOG_FAR: Final = 7.0  # a focus beyond the limit is that much less likely
FOUND: Final = 0.55  # of the fiducial marks of a film and of the control points of a focus must be named: no single row of a cage of two
SPREAD: Final = 0.3  # of the breadth of the cage's own fiducial marks must be left to the named ones
FIXED_MM: Final = 10.0  # sd of a focus along any axis: a tenth of what is presumed of it, its control points fix it and not the presumption
STRETCH: Final = 0.017  # largest half anisotropy and shear of a film, 2 % each; cages 1B and 1B-420 differ by 0.025
AGREEING: Final = 0.5  # of the named images must have the shape, and of the tees the direction, of their marks
TURNED_DEG: Final = 25.0


def far_penalty(scene: Scene, naming: Naming, limits: Limits) -> float:
    """Return by how much less likely foci are that lie further from the nominal ones than the limit."""
    places = naming.fit.parameters[FILM:].reshape(-1, 3)
    return LOG_FAR * float((np.linalg.norm(places - scene.nominal_mm, axis=1) > limits.focus_mm).sum())


def are_different(scene: Scene, a: Naming, b: Naming) -> bool:
    """Return whether a mark has different images in two namings."""
    both = scene.own & (a.image >= 0) & (b.image >= 0)
    same = (a.image[both] == b.image[both]).sum()
    return bool(same < both.sum() or same < 0.5 * (scene.own & (b.image >= 0)).sum())


def what_is_missing(scene: Scene, naming: Naming, melted: Sequence[int]) -> str:
    """Return in words which marks are too few, or do not fix the plane or a focus, else nothing.

    Parameters
    ----------
    scene : Scene
    naming : Naming
    melted : sequence of int
        Marks that are there, but in one image with another: they do not count as measured.

    Returns
    -------
    str
    """
    there = naming.image >= 0
    there[list(melted)] = True
    fiducials = scene.own & scene.fiducial  # of all foci together: they lie in one plane
    if few := _too_few(naming, there, fiducials, 4, "fiducial marks"):
        return few
    if _breadth(scene.xyz_mm[fiducials & (naming.image >= 0)]) < SPREAD * _breadth(scene.xyz_mm[fiducials]):
        return "the fiducial marks found lie nearly in line"
    for k, focus in enumerate(scene.foci):
        if few := _too_few(naming, there, scene.own & (scene.focus == k) & ~scene.fiducial, 2, f"control points of focus {focus}"):
            return few
        place = slice(FILM + 3 * k, FILM + 3 * k + 3)
        if np.linalg.eigvalsh(naming.fit.covariance[place, place])[-1] > FIXED_MM**2:  # two points fix a focus unless they lie in one place
            return f"the control points found of focus {focus} lie too close together"
    return ""


def _too_few(naming: Naming, there: Bool, wanted: Bool, least: int, name: str) -> str:
    measured = int((naming.image[wanted] >= 0).sum())
    few = measured < least or there[wanted].sum() < FOUND * wanted.sum()
    return f"only {measured} of {wanted.sum()} {name}" if few else ""


def _breadth(points: Float) -> float:
    """Return the root mean square distance of points from their best line."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.linalg.norm(singular[1:]) / np.sqrt(len(points)))


def impossible_stretch(naming: Naming) -> str:
    """Return in words if the film would be stretched more than a scanner stretches it, else nothing."""
    a, b, c, d = naming.fit.parameters[:4]
    stretch = np.hypot(a - d, b + c) / np.hypot(a + d, c - b)
    if stretch > STRETCH:
        return f"the film would be stretched by {2 * stretch:.1%}: another cage, or a wrong pixel pitch in one direction"
    return ""


def what_contradicts(scene: Scene, naming: Naming, film: FilmImages) -> str:
    """Return what of the look of the images contradicts the cage; single ones may be hidden in part, most may not."""
    rows = naming.rows[scene.own[naming.rows]]
    chosen = naming.image[rows]
    known = film.shape[chosen] != ""
    right = film.shape[chosen] == scene.shape[rows]
    if known.any() and right[known].mean() < AGREEING:
        return f"{(~right[known]).sum()} of {known.sum()} images have another shape than their marks"
    turned = angle_difference_deg(scene, naming.fit.parameters, film)[rows, chosen]
    turned = turned[np.isfinite(turned)]
    if len(turned) and (np.abs(turned) < TURNED_DEG).mean() < AGREEING:
        return f"{(np.abs(turned) >= TURNED_DEG).sum()} of {len(turned)} images point in another direction than their marks"
    return ""
