"""How many marks a naming must show: those of a film's plane together, and those that melt into others' images as well."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsa_vision.identify.checks import what_is_missing
from rsa_vision.identify.film_model import FILM

FIDUCIALS, CONTROLS = 9, 8  # of each of two foci


def scene_and_naming(fiducials: tuple[int, int], controls: tuple[int, int]) -> tuple[Any, Any]:
    """Return a shared film of two foci with so many marks named, the first of each kind."""
    rng = np.random.default_rng(1)
    focus = np.repeat([0, 1], FIDUCIALS + CONTROLS)
    fiducial = np.tile(np.arange(FIDUCIALS + CONTROLS) < FIDUCIALS, 2)
    xyz = rng.uniform(-100, 100, (len(focus), 3))
    xyz[fiducial, 2] = 0.0
    image = np.full(len(focus), -1)
    for k in (0, 1):
        for kind, named in ((fiducial, fiducials[k]), (~fiducial, controls[k])):
            image[np.flatnonzero((focus == k) & kind)[:named]] = 0
    scene = SimpleNamespace(own=np.ones(len(focus), bool), fiducial=fiducial, focus=focus, foci=(1, 2), xyz_mm=xyz)
    return scene, SimpleNamespace(image=image, fit=SimpleNamespace(covariance=np.eye(FILM + 6)))


@pytest.mark.parametrize(
    ("fiducials", "controls", "missing"),
    [
        ((9, 9), (8, 8), ""),
        ((4, 6), (5, 5), ""),  # 10 of 18 fix the plane of the film
        ((4, 5), (5, 5), "only 9 of 18 fiducial marks"),
        ((9, 9), (4, 8), "only 4 of 8 control points of focus 1"),
        ((9, 9), (8, 1), "only 1 of 8 control points of focus 2"),
    ],
)
def test_enough_marks(fiducials: tuple[int, int], controls: tuple[int, int], missing: str) -> None:
    assert what_is_missing(*scene_and_naming(fiducials, controls), melted=()) == missing


def test_marks_in_one_image_are_there_but_not_measured() -> None:
    scene, naming = scene_and_naming((9, 9), (4, 8))
    of_first = np.flatnonzero((scene.focus == 0) & ~scene.fiducial)
    assert what_is_missing(scene, naming, melted=of_first[4:5].tolist()) == ""
    scene, naming = scene_and_naming((9, 9), (1, 8))
    assert what_is_missing(scene, naming, melted=of_first[1:].tolist()) == "only 1 of 8 control points of focus 1"


def test_fiducial_marks_in_line_fix_no_plane() -> None:
    scene, naming = scene_and_naming((9, 9), (8, 8))
    scene.xyz_mm[scene.fiducial, 1] = 0.0
    named = scene.fiducial & (scene.focus == 0)
    scene.xyz_mm[scene.fiducial & (scene.focus == 1), 1] = np.linspace(-100, 100, FIDUCIALS)
    naming.image[scene.fiducial] = np.where(named[scene.fiducial], 0, -1)
    assert "only" in what_is_missing(scene, naming, melted=())
    naming.image[scene.fiducial] = 0
    scene.xyz_mm[scene.fiducial, 1] = 0.0
    scene.xyz_mm[np.flatnonzero(scene.fiducial)[-1], 1] = 400.0
    naming.image[np.flatnonzero(scene.fiducial)[-1]] = -1
    assert what_is_missing(scene, naming, melted=()) == "the fiducial marks found lie nearly in line"
