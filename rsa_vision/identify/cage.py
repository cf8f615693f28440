"""Which marker image is which mark of the cage, for every focus of a film: hypothesis and test on geometry.

Grids of fiducial marks (:mod:`grids`) and places of the foci (:mod:`focus_search`) make hypotheses about a film; each is fitted and weighed
as a whole (:mod:`naming`). The best one is an answer only if it beats every different one, and clutter, at the posterior asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from rsa_vision.cages import Cage
from rsa_vision.identify.film_model import FILM, GAP_MM, Scene, build_scene, plane_from_film
from rsa_vision.identify.focus_search import NEAR_MM, find_foci
from rsa_vision.identify.grids import find_grids
from rsa_vision.identify.naming import (
    FilmImages,
    Naming,
    angle_difference_deg,
    doubtful_marks,
    drop_gross_errors,
    film_images,
    name_marks,
    on_bodies,
    without,
)
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, Int, MarkerImages

TURN_DEG: Final = {"upright": 46.0, "mirrored": 46.0, "any": 180.0}  # largest angle between film and plane
LARGEST_GAP_MM: Final = 45.0
FOCUS_REACH: Final = 1.4  # foci are searched this many times further away than allowed, to say `focus-far` rather than `not found`
LOG_FAR: Final = 7.0  # a focus beyond the limit is that much less likely
LOG_FALSE: Final = 16.0  # evidence against clutter that is demanded: one false cage in 1e7 films
WEIGHED: Final = 10  # hypotheses that are fitted
FOUND: Final = 0.5  # of the fiducial marks and of the control points of a focus must be named
AGREEING: Final = 0.5  # of the named images must have the shape, and of the tees the direction, of their marks
TURNED_DEG: Final = 25.0

_Place = tuple[Float, Float, Float, Int]  # film from plane (A, b), focus, image of every mark


@dataclass(frozen=True, slots=True, eq=False)
class CageIdentification:
    """The names of the cage's marks on one film; false if the cage was not found.

    Attributes
    ----------
    assignments : mapping
        ``{focus: {(role, number): row of the marker images}}``; an image may serve two foci where both images coincide.
    explained : ndarray of bool, shape (n,)
        Images that belong to the cage in any way (named, foreign, left out, or parts of a mark's image): none of them is an object marker.
    foreign : ndarray of bool, shape (n,)
        Images of cage marks that their focus is not meant to see.
    posterior : float
        Probability of these names among all hypotheses that were weighed.
    reasons : tuple of str
        Codes of :data:`rsa_vision.flags.REASONS`.
    runner_up : str
        The best different hypothesis, in words; empty if there is none.
    focus_mm : mapping
        Estimated foci, laboratory frame.
    plane_from_film : mapping
        ``{focus: ndarray of shape (3, 3)}``: (col, row, 1) to plane coordinates (u, v, 1).
    dropped : tuple of (int, str, int, int)
        Focus, role, number and image of marks that were named at first and left out: gross errors, or another image suits as well.
    residual_mm : mapping
        ``{focus: {(role, number): distance on the film between image and model}}``.
    log_evidence : float
        Of the hypothesis against clutter.
    """

    assignments: Mapping[int, Mapping[tuple[str, int], int]]
    explained: Bool
    foreign: Bool
    posterior: float
    reasons: tuple[str, ...]
    runner_up: str
    focus_mm: Mapping[int, Float]
    plane_from_film: Mapping[int, Float]
    dropped: tuple[tuple[int, str, int, int], ...]
    residual_mm: Mapping[int, Mapping[tuple[str, int], float]]
    log_evidence: float

    def __bool__(self) -> bool:
        return "cage-not-found" not in self.reasons


def identify_cage(
    images: MarkerImages,
    cage: Cage,
    foci: Sequence[int],
    *,
    pitch_mm: tuple[float, float],
    film_shape: tuple[int, int],
    orientation: str = "upright",
    foci_mm: Mapping[int, Sequence[float]] | None = None,
    limits: Limits | None = None,
) -> CageIdentification:
    """Name the images of a cage's marks on one film.

    Parameters
    ----------
    images : MarkerImages
        All marker images of the film, unnamed; rows with coordinates that are not finite are left out.
    cage : Cage
    foci : sequence of int
        The foci that exposed this film.
    pitch_mm : tuple of two floats
        (row pitch, column pitch).
    film_shape : tuple of two ints
        (rows, cols).
    orientation : str
        ``upright`` and ``mirrored``: to within 45 deg; ``any``: any rotation of a film seen from its focus.
    foci_mm : mapping, optional
        Nominal foci in the laboratory frame; default: the cage's.
    limits : Limits, optional

    Returns
    -------
    CageIdentification
        False, with its reasons, if the cage was not found.
    """
    limits = limits or Limits()
    nominal = {f: np.asarray((foci_mm or {}).get(f, cage.foci[f]), float) for f in foci}
    scene = build_scene(cage, tuple(foci), nominal)
    usable = np.flatnonzero(np.isfinite(images.position_px).all(axis=1))
    flip = np.array([-1.0 if orientation == "mirrored" else 1.0, 1.0])
    to_film = np.diag([pitch_mm[1] * flip[0], -pitch_mm[0]])  # film mm from (col, row)
    film = _film_images(images, usable, to_film, flip[0], film_shape[0] * film_shape[1] * pitch_mm[0] * pitch_mm[1])
    turn_deg = TURN_DEG[orientation]
    log_room = float(np.log(film_shape[0] * film_shape[1] * pitch_mm[0] * pitch_mm[1]) + np.log(2 * np.deg2rad(turn_deg)))
    nothing = _Answer(cage, images, usable, scene, to_film)
    shaped = np.isin(film.shape, [*np.unique(scene.shape[scene.own]), ""])
    result = nothing.failed("too few images")
    for subset in (np.flatnonzero(shaped), np.arange(len(usable)))[: 1 if shaped.all() else 2]:
        hypotheses = _hypotheses(scene, film.xy_mm[subset], turn_deg, limits)
        namings = [n for n in (name_marks(scene, start, film, log_room) for start in hypotheses) if n is not None]
        result = _decide(nothing, scene, namings, film, limits, log_room)
        if result:
            break
    return result


def _film_images(images: MarkerImages, usable: Int, to_film: Float, flip: float, area_mm2: float) -> FilmImages:
    xy = images.position_px[usable] @ to_film
    covariance = to_film @ images.covariance_px2[usable] @ to_film
    scale = float(np.abs(to_film[0, 0]))
    sound = np.isfinite(covariance).all(axis=(1, 2))
    covariance[~sound] = (0.2 * scale) ** 2 * np.eye(2)
    covariance += (0.002 * scale) ** 2 * np.eye(2)  # a covariance of zero would outweigh all else
    angle = np.deg2rad(images.angle_deg[usable])
    angle = np.arctan2(np.sin(angle), flip * np.cos(angle))
    return film_images(xy, covariance, images.shape[usable], angle, images.radius_px[usable] * scale, area_mm2)


def _hypotheses(scene: Scene, xy_mm: Float, turn_deg: float, limits: Limits) -> list[Float]:
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
            grids[key] = find_grids(xy_mm, fiducials, turn_deg=turn_deg, foci=len(scene.foci), largest_shift_mm=shift)
        options.append(
            [
                (A, b, focus, _seen(scene.xyz_mm[mine], focus, A, b, tree))
                for A, b, _ in grids[key]
                for focus, _ in find_foci((xy_mm - b) @ np.linalg.inv(A).T, controls, scene.nominal_mm[k], reach)
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


def _decide(answer: _Answer, scene: Scene, namings: list[Naming], film: FilmImages, limits: Limits, log_room: float) -> CageIdentification:
    if not namings:
        return answer.failed("no grid of fiducial marks with control points")
    # gross errors are left out before hypotheses are compared: a single wrong image must not decide
    limit_mm = limits.fiducial_um / 1000
    cleaned = [drop_gross_errors(scene, n, film, limit_mm, log_room) for n in namings]
    scored = sorted(((n.log_evidence - _far(scene, n, limits), n) for n in cleaned), key=lambda item: -item[0])
    score, best = scored[0]
    rivals = [(s, n) for s, n in scored[1:] if _different(scene, best, n)]
    log_odds = float(np.log(limits.posterior / (1 - limits.posterior)))
    doubtful, decisive = doubtful_marks(scene, best, film, log_odds)
    dropped = list(best.dropped)
    if doubtful:
        dropped += [(row, int(best.image[row])) for row in doubtful]
        smaller = without(scene, best, film, doubtful, log_room)
        if smaller is None:
            return answer.failed("too few marks without doubt")
        best = drop_gross_errors(scene, replace(smaller, dropped=tuple(dropped)), film, limit_mm, log_room)
        decisive = doubtful_marks(scene, best, film, log_odds)[1]
    missing = _missing(scene, best)
    if missing:
        return answer.failed(missing)
    against = _against(scene, best, film)
    if against:
        return answer.failed(against)
    if score < LOG_FALSE:
        return answer.failed("images at random may show as much")
    log_wrong = np.logaddexp.reduce([s - score for s, _ in rivals] + [-decisive, -score])
    posterior = float(1 / (1 + np.exp(log_wrong)))
    reasons = []
    if posterior < limits.posterior or any(abs(s - score) < log_odds for s, _ in rivals):
        reasons.append("cage-ambiguous")
    return answer.found(best, film, posterior, reasons, limits, rivals[0] if rivals else None, score)


def _far(scene: Scene, naming: Naming, limits: Limits) -> float:
    places = naming.fit.parameters[FILM:].reshape(-1, 3)
    return LOG_FAR * float((np.linalg.norm(places - scene.nominal_mm, axis=1) > limits.focus_mm).sum())


def _different(scene: Scene, a: Naming, b: Naming) -> bool:
    """Return whether a mark has different images in two namings."""
    both = scene.own & (a.image >= 0) & (b.image >= 0)
    same = (a.image[both] == b.image[both]).sum()
    return bool(same < both.sum() or same < 0.5 * (scene.own & (b.image >= 0)).sum())


def _missing(scene: Scene, naming: Naming) -> str:
    for k, focus in enumerate(scene.foci):
        for fiducial, least, name in ((True, 4, "fiducial marks"), (False, 2, "control points")):
            wanted = scene.own & (scene.focus == k) & (scene.fiducial == fiducial)
            seen = int((naming.image[wanted] >= 0).sum())
            if seen < max(least, np.ceil(FOUND * wanted.sum())):
                return f"only {seen} of {wanted.sum()} {name} of focus {focus}"
    return ""


def _against(scene: Scene, naming: Naming, film: FilmImages) -> str:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """What every answer about a film needs."""

    cage: Cage
    images: MarkerImages
    usable: Int
    scene: Scene
    to_film: Float

    def failed(self, why: str) -> CageIdentification:
        nothing = np.zeros(len(self.images), bool)
        return CageIdentification({}, nothing, nothing.copy(), 0.0, ("cage-not-found",), why, {}, {}, (), {}, -np.inf)

    def found(
        self,
        naming: Naming,
        film: FilmImages,
        posterior: float,
        reasons: list[str],
        limits: Limits,
        rival: tuple[float, Naming] | None,
        score: float,
    ) -> CageIdentification:
        scene = self.scene
        assignments: dict[int, dict[tuple[str, int], int]] = {focus: {} for focus in scene.foci}
        residuals: dict[int, dict[tuple[str, int], float]] = {focus: {} for focus in scene.foci}
        foreign, explained = np.zeros(len(self.images), bool), np.zeros(len(self.images), bool)
        for row, residual in zip(naming.rows, naming.fit.residual_mm, strict=True):
            image = int(self.usable[naming.image[row]])
            explained[image] = True
            if scene.own[row]:
                focus, key = self._key(int(row))
                assignments[focus][key] = image
                residuals[focus][key] = float(np.hypot(*residual))
            else:
                foreign[image] = True
        for focus in scene.foci:
            foreign[list(assignments[focus].values())] = False
        dropped = tuple((*self._flat(row), int(self.usable[image])) for row, image in naming.dropped if scene.own[row])
        explained[self.usable[_parts(scene, naming, film)]] = True
        explained[[image for *_, image in dropped]] = True
        places = naming.fit.parameters[FILM:].reshape(-1, 3)
        if (np.linalg.norm(places - scene.nominal_mm, axis=1) > limits.focus_mm).any():
            reasons = [*reasons, "focus-far"]
        for fiducial, least, code in ((True, 4, "few-fiducials"), (False, 2, "few-controls")):
            counts = [
                int((naming.image[scene.own & (scene.focus == k) & (scene.fiducial == fiducial)] >= 0).sum())
                for k in range(len(scene.foci))
            ]
            if min(counts) <= least:
                reasons = [*reasons, code]
        px = np.eye(3)
        px[:2, :2] = self.to_film
        planes = {focus: plane_from_film(scene, naming.fit.parameters, k) @ px for k, focus in enumerate(scene.foci)}
        return CageIdentification(
            assignments,
            explained,
            foreign,
            posterior,
            tuple(reasons),
            self._describe(naming, rival, score),
            {focus: scene.lab_mm(places[k]) for k, focus in enumerate(scene.foci)},
            {f: H / H[2, 2] for f, H in planes.items()},
            dropped,
            residuals,
            score,
        )

    def _key(self, row: int) -> tuple[int, tuple[str, int]]:
        mark = self.cage.mark[self.scene.mark[row]]
        return self.scene.foci[self.scene.focus[row]], (mark.role, mark.number)

    def _flat(self, row: int) -> tuple[int, str, int]:
        focus, (role, number) = self._key(row)
        return focus, role, number

    def _describe(self, best: Naming, rival: tuple[float, Naming] | None, score: float) -> str:
        if rival is None:
            return ""
        both = self.scene.own & (best.image >= 0) & (rival[1].image >= 0)
        other = np.flatnonzero(both & (best.image != rival[1].image))
        A = rival[1].fit.parameters[:4]
        angle = np.rad2deg(np.arctan2(A[2] - A[1], A[0] + A[3]))
        names = ", ".join("focus {} {} {}".format(*self._flat(int(row))) for row in other[:3])
        more = f" and {len(other) - 3} more" if len(other) > 3 else ""
        return f"film turned by {angle:.0f} deg, other images for {names}{more}; log odds {score - rival[0]:.1f}"


def _parts(scene: Scene, naming: Naming, film: FilmImages) -> Int:
    """Return images that are no markers of their own: on the pins of a mark, or a second answer to one mark."""
    parameters = naming.fit.parameters
    left = np.setdiff1d(np.arange(len(film.xy_mm)), naming.image)
    rows = np.flatnonzero(scene.own | (naming.image >= 0))
    parts: Int = left[on_bodies(scene, parameters, film, rows)[:, left].any(axis=0)]
    return parts
