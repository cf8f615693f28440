"""Hypotheses about a film: every way to place its fiducial grids and foci that explains many images."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from rsa_vision.identify.film_model import FILM, GAP_MM, TILT_SD, Scene
from rsa_vision.identify.focus_search import NEAR_MM, find_foci
from rsa_vision.identify.grids import NEAR_MM as GRID_NEAR_MM
from rsa_vision.identify.grids import find_grids
from rsa_vision.settings import Limits
from rsa_vision.types import Float, Int

LARGEST_GAP_MM: Final = 45.0
FOCUS_REACH: Final = 1.4  # foci are searched this many times further away than allowed, to say `focus-far` rather than `not found`
WEIGHED: Final = 10  # hypotheses that are fitted
COVERED: Final = 0.4  # of the control points of a focus may have no image: a third hidden, and one behind a screw or a letter
TILTED: Final = 2.0  # standard deviations of the tilt that are allowed for
OVERLAP: Final = 0.5  # of the marks must lie on others after a move that could be mistaken

_Place = tuple[Float, Float, Float, Int]  # film from plane (A, b), focus, image of every mark


def find_hypotheses(scene: Scene, xy_mm: Float, turn_deg: float, missing: float, limits: Limits) -> list[Float]:
    """Return parameters of the film model to start from, the most promising first."""
    reach = FOCUS_REACH * limits.focus_mm
    base = max((float(np.hypot(*(a - b)[:2])) for a in scene.nominal_mm for b in scene.nominal_mm), default=0.0)
    shift = LARGEST_GAP_MM * (base + 2 * limits.focus_mm) / (float(scene.nominal_mm[:, 2].min()) - limits.focus_mm)
    options: list[list[_Place]] = []
    grids: dict[bytes, list[tuple[Float, Float, int]]] = {}
    tree = cKDTree(xy_mm)
    for k in range(len(scene.foci)):
        mine = scene.focus == k
        fiducials = scene.xyz_mm[mine & scene.fiducial, :2]
        controls = scene.xyz_mm[mine & scene.own & ~scene.fiducial]
        key = fiducials.tobytes()
        if key not in grids:
            # a film that is tilted shows a grid as a keystone, which no affine map follows; a map through three marks doubles it for others
            half = np.ptp(fiducials, axis=0) / 2
            keystone = 2 * TILTED * TILT_SD * half[0] * half[1] / scene.nominal_mm[k, 2]
            count = len(scene.foci)
            every = [
                grid
                for near in sorted({GRID_NEAR_MM, max(GRID_NEAR_MM, float(keystone))})
                for grid in find_grids(
                    xy_mm, fiducials, turn_deg=turn_deg, foci=count, largest_shift_mm=shift, missing=missing, near_mm=near
                )
            ]
            # many are found twice, and looking for foci takes longest
            grids[key] = list({(A.tobytes(), b.tobytes()): (A, b, count) for A, b, count in reversed(every)}.values())[::-1]
        options.append(
            [
                (A, b, focus, _seen(scene.xyz_mm[mine], focus, A, b, tree))
                for A, b, _ in grids[key]
                for focus, _ in find_foci((xy_mm - b) @ np.linalg.inv(A).T, controls, scene.nominal_mm[k], reach, max(missing, COVERED))
            ]
        )
    # an image that two foci claim counts once: otherwise the marks of one focus would do for both
    choices = np.array(list(product(*(range(len(o)) for o in options))), dtype=int).reshape(-1, len(options))
    if not len(choices):
        return []
    union = np.zeros((len(choices), tree.n + 1), bool)
    for k, some in enumerate(options):
        explained = np.zeros((len(some), tree.n + 1), bool)
        for row, place in zip(explained, some, strict=True):
            row[place[3]] = True
        union |= explained[choices[:, k]]
    found: dict[bytes, Float] = {}
    for index in np.argsort(-union[:, :-1].sum(axis=1), kind="stable"):
        places = [options[k][choice] for k, choice in enumerate(choices[index])]
        names = np.concatenate([place[3] for place in places]).tobytes()
        if names not in found and (start := _start(scene, places)) is not None:
            found[names] = start
            if len(found) >= WEIGHED:
                break
    return list(found.values())


def _seen(xyz_mm: Float, focus: Float, A: Float, b: Float, tree: cKDTree) -> Int:
    """Return the image at the place where a focus would show each mark; one more than the last for none."""
    place = xyz_mm[:, :2] + (xyz_mm[:, :2] - focus[:2]) * (xyz_mm[:, 2] / (focus[2] - xyz_mm[:, 2]))[:, None]
    return np.asarray(tree.query(place @ A.T + b, distance_upper_bound=NEAR_MM)[1], dtype=np.int64)


def _start(scene: Scene, choice: Sequence[_Place]) -> Float | None:
    """Join a grid and a focus for every focus to one set of parameters; None if one film behind the plane cannot show them together."""
    A = np.mean([a for a, *_ in choice], axis=0)
    middle = [a @ scene.origin_mm + b for a, b, *_ in choice]
    foci = np.array([focus for _, _, focus, _ in choice])
    gap = GAP_MM
    if len(choice) > 1:
        if max(np.abs(a - A).max() for a, *_ in choice) > 0.02:
            return None
        # grids are shifted against each other by -gap times the difference of the foci over their heights
        towards = (foci[:, :2] - scene.origin_mm) / foci[:, 2:]
        towards = towards - towards.mean(axis=0)
        order = (foci[:, :2] - foci[:, :2].mean(axis=0)) * (scene.nominal_mm[:, :2] - scene.nominal_mm[:, :2].mean(axis=0))
        if order.sum() <= 0:
            return None  # the names of the foci are exchanged
        shifts = (np.array(middle) - np.mean(middle, axis=0)) @ np.linalg.inv(A).T
        gap = -float((shifts * towards).sum() / (towards**2).sum())
        if not -1.0 < gap < LARGEST_GAP_MM or np.abs(shifts + gap * towards).max() > 1.0:
            return None
    away = (scene.origin_mm - foci[:, :2]) * (gap / foci[:, 2:])
    stretch = 1 + gap / foci[:, 2].mean()
    b = np.mean([m - A @ a / stretch for m, a in zip(middle, away, strict=True)], axis=0)
    return np.concatenate([(A / stretch).ravel(), b, [gap, 0, 0], foci.ravel()])


def moved_by_a_mark(scene: Scene, parameters: Float, limits: Limits) -> list[Float]:
    """Return the hypotheses that take the grids of marks for the same grids moved by a row or column.

    A cage with rows and columns hidden looks like itself, moved, with others hidden: what is found must be weighed against that. Where
    fiducial marks move by m and control points of the height z by n, every line through an image and its control point still passes
    through one point: a focus of the height h moves by m + (n - m) h / z. If the pitches of both grids are nearly alike, that is not far.
    """
    found = []
    reach = FOCUS_REACH * limits.focus_mm
    foci = parameters[FILM:].reshape(-1, 3)
    for move in [np.zeros(3), *_moves(scene.xyz_mm[scene.fiducial & (scene.focus == 0)])]:
        places: list[list[Float]] = []
        for k, focus in enumerate(foci):
            controls = scene.xyz_mm[scene.own & ~scene.fiducial & (scene.focus == k)]
            options = [focus + move + (other - move) * focus[2] / controls[:, 2].mean() for other in _moves(controls)]
            options += [focus + move]
            places.append([place for place in options if np.linalg.norm(place - scene.nominal_mm[k]) < reach])
        for choice in product(*places):
            start = parameters.copy()
            start[4:6] -= parameters[:4].reshape(2, 2) @ move[:2]
            start[FILM:] = np.concatenate(choice)
            found.append(start)
    return found


def largest_overlap(scene: Scene) -> float:
    """Return the largest part of a film's marks that a grid moved by a row or column could name, all marks being there."""
    named = 0.0
    for k in range(len(scene.foci)):
        for fiducial in (True, False):
            marks = scene.xyz_mm[scene.own & (scene.fiducial == fiducial) & (scene.focus == k)]
            named += len(marks) * max((_landed(marks, move) for move in _moves(marks)), default=OVERLAP)
    return named / int(scene.own.sum())


def _moves(marks: Float) -> list[Float]:
    """Return the shifts, level with the plane, that put more than half of the marks onto others."""
    moves = (marks[None] - marks[:, None]).reshape(-1, 3)
    moves = np.unique(np.round(moves[(np.abs(moves[:, :2]).max(axis=1) > 1) & (np.abs(moves[:, 2]) < 1)], 3), axis=0)
    return [np.array([move[0], move[1], 0.0]) for move in moves if _landed(marks, move) > OVERLAP]


def _landed(marks: Float, move: Float) -> float:
    """Return the part of the marks that a shift puts onto others."""
    return float((np.linalg.norm(marks[:, None] + move - marks[None], axis=2).min(axis=1) < 2.0).mean())
