"""Which marker image is which mark of the cage, for every focus of a film: hypothesis and test on geometry.

Grids of fiducial marks (:mod:`grids`) and places of the foci (:mod:`focus_search`) make hypotheses about a film; each is fitted and weighed
as a whole (:mod:`naming`). The best one is an answer only if it beats every different one, and clutter, at the posterior asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rsa_vision.cages import Cage
from rsa_vision.flags import MarkerFlag
from rsa_vision.identify.appearance import FilmImages, film_images, on_bodies
from rsa_vision.identify.checks import are_different, far_penalty, impossible_stretch, what_contradicts, what_is_missing
from rsa_vision.identify.doubts import doubtful_marks, drop_gross_errors, without
from rsa_vision.identify.film_model import FILM, Scene, build_scene, plane_from_film, project
from rsa_vision.identify.hypotheses import find_hypotheses, largest_overlap, moved_by_a_mark
from rsa_vision.identify.naming import Naming, melted_images, name_marks
from rsa_vision.settings import Limits
from rsa_vision.types import Bool, Float, Int, MarkerImages

TURN_DEG: Final = {"upright": 46.0, "mirrored": 46.0, "any": 180.0}  # largest angle between film and plane
COMPLETE: Final = 0.85  # of the marks named, or more where a row is long: no grid moved by a row or column could do that
MISSING: Final = 1 / 3  # of the marks of a focus may have no image
MISREAD: Final = 0.45  # or none of the mark's shape
SAME_MM: Final = 1.5  # hypotheses that show every mark as near as this come to the same naming
HALF: Final = 0.6  # of the marks of the best naming: each is worth several units of log evidence, fewer can be no rival
ONTO_ITSELF: Final = 4  # rotations that may turn a grid onto itself
CLOSE: Final = 80.0  # of the best in log evidence: gross errors of others could not make them win
LEAST_IMAGES: Final = 6  # four fiducial marks and two control points
LOG_FALSE: Final = 16.0  # evidence against clutter that is demanded: one false cage in 1e7 films
LOG_MISLED: Final = 7.0  # evidence by which another orientation or focus than told must be better to say so


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
    told = _Reading(tuple(foci), orientation == "mirrored", TURN_DEG[orientation])
    film = _Film(images, cage, pitch_mm, film_shape, {f: np.asarray(place, float) for f, place in {**cage.foci, **(foci_mm or {})}.items()})
    shapes = {m.shape for m in cage.mark if set(m.foci) & set(foci)}
    shaped = np.isin(images.shape, [*shapes, ""])
    result = _read(film, told, np.flatnonzero(shaped), shapes != {"ball"}, limits)
    return _doubt_what_was_told(film, told, result, limits) if result else result


@dataclass(frozen=True, slots=True)
class _Reading:
    """What is taken for granted about a film."""

    foci: tuple[int, ...]
    mirrored: bool
    turn_deg: float

    def __str__(self) -> str:
        focus = f"the film of focus {self.foci[0]}" if len(self.foci) == 1 else "the film"
        return f"{focus}{', seen from behind' if self.mirrored else ''}{', turned' if self.turn_deg > 90 else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class _Film:
    """The images of a film and all that is known of it."""

    images: MarkerImages
    cage: Cage
    pitch_mm: tuple[float, float]
    shape: tuple[int, int]
    foci_mm: Mapping[int, Float]

    @property
    def area_mm2(self) -> float:
        return self.shape[0] * self.shape[1] * self.pitch_mm[0] * self.pitch_mm[1]

    def log_room(self, reading: _Reading) -> float:
        return float(np.log(self.area_mm2 * 2 * np.deg2rad(reading.turn_deg)))

    def mm_from_px(self, reading: _Reading) -> Float:
        """Film frame (x right, y up as seen from the focus, mm) from (col, row)."""
        return np.diag([-self.pitch_mm[1] if reading.mirrored else self.pitch_mm[1], -self.pitch_mm[0]])

    def usable(self) -> Int:
        return np.flatnonzero(np.isfinite(self.images.position_px).all(axis=1))

    def seen(self, reading: _Reading) -> FilmImages:
        """Return the usable images in the film frame."""
        images, to_mm = self.images.rows(self.usable()), self.mm_from_px(reading)
        scale = float(self.pitch_mm[1])
        covariance = to_mm @ images.covariance_px2 @ to_mm
        covariance[~np.isfinite(covariance).all(axis=(1, 2))] = (0.2 * scale) ** 2 * np.eye(2)
        covariance += (0.002 * scale) ** 2 * np.eye(2)  # a covariance of zero would outweigh all else
        angle = np.deg2rad(images.angle_deg)
        angle = np.arctan2(np.sin(angle), (-1 if reading.mirrored else 1) * np.cos(angle))
        poor: Bool = (images.flags & MarkerFlag.POOR_FIT) != 0
        return film_images(images.position_px @ to_mm, covariance, images.shape, angle, images.radius_px * scale, poor, self.area_mm2)


def _read(film: _Film, reading: _Reading, likely: Int, misread: bool, limits: Limits) -> CageIdentification:
    """Identify the cage as told. Grids and foci are sought among the likely images; if much is missing then, among all.

    ``misread``: arms may be hidden, and a mark taken for another shape. More of the likely images may then be missing, and what is found
    among them may be less than what all would show.
    """
    scene = build_scene(film.cage, reading.foci, film.foci_mm)
    seen, log_room, usable = film.seen(reading), film.log_room(reading), film.usable()
    answer = _Answer(film.cage, film.images, usable, scene, film.mm_from_px(reading))
    namings: list[Naming] = []
    result = answer.failed("too few images")
    enough_for_all = max(COMPLETE, largest_overlap(scene))
    for among, missing in ((np.isin(usable, likely), MISREAD if misread else MISSING), (np.ones(len(usable), bool), MISSING)):
        if among.sum() < LEAST_IMAGES:
            continue
        _weigh(namings, scene, seen, log_room, find_hypotheses(scene, seen.xy_mm[among], reading.turn_deg, missing, limits))
        complete, moved_from = _names_more_than(enough_for_all, namings, scene), None
        while namings and not complete and moved_from is not (best := max(namings, key=lambda n: n.log_evidence)):
            # once more from where it settled: what drew a focus aside at first, and kept its marks from their images, may do so no longer
            again = name_marks(scene, best.fit.parameters, seen, log_room)
            if again and again.log_evidence > best.log_evidence:
                namings.append(again)
                best = again
            _weigh(namings, scene, seen, log_room, moved_by_a_mark(scene, best.fit.parameters, limits))
            moved_from = best  # what is better than that may look like itself, moved, as well
        enough = _names_more_than(HALF, namings, scene)
        if enough or not misread or among.all():
            result = _decide(answer, scene, namings, seen, limits, log_room)
        sure = enough and result and "cage-ambiguous" not in result.reasons  # what the other images hide of it was weighed, too
        if complete or sure or (result and not misread) or among.all():
            break
    return result


def _names_more_than(part: float, namings: list[Naming], scene: Scene) -> bool:
    """Say whether any of these names more than a part of the marks."""
    return any((naming.image[scene.own] >= 0).mean() > part for naming in namings)


def _weigh(namings: list[Naming], scene: Scene, seen: FilmImages, log_room: float, starts: list[Float]) -> None:
    """Name the marks for every hypothesis that is not one of the namings already, nor explains far less than they do."""
    for start in starts:
        least = int(HALF * max(((naming.image[scene.own] >= 0).sum() for naming in namings), default=0))
        places = project(scene, start)
        if not any(np.abs(places - project(scene, naming.fit.parameters)).max() < SAME_MM for naming in namings):
            naming = name_marks(scene, start, seen, log_room, least=least)
            if naming and not any(np.array_equal(naming.image, other.image) for other in namings):
                namings.append(naming)


def _doubt_what_was_told(film: _Film, told: _Reading, result: CageIdentification, limits: Limits) -> CageIdentification:
    """Ask whether the marks of other planes tell of another orientation or focus than the user: a cage's own marks may be symmetric."""
    if len(told.foci) > 1 or not result.foreign.size or all(set(told.foci) <= set(m.foci) for m in film.cage.mark):
        return result
    named = np.isin(film.usable(), [*result.assignments[told.foci[0]].values()])
    for other in _other_readings(film.cage, told):
        scene, seen, log_room = build_scene(film.cage, other.foci, film.foci_mm), film.seen(other), film.log_room(other)
        for start in find_hypotheses(scene, seen.xy_mm[named], other.turn_deg, MISSING, limits)[:ONTO_ITSELF]:
            naming = name_marks(scene, start, seen, log_room, least=int(HALF * named.sum()))
            if naming and naming.log_evidence - far_penalty(scene, naming, limits) > result.log_evidence + LOG_MISLED:
                reasons = tuple(dict.fromkeys(("cage-ambiguous", *result.reasons)))
                return replace(result, posterior=0.0, reasons=reasons, runner_up=f"the cage's other marks tell that this is {other}")
    return result


def _other_readings(cage: Cage, told: _Reading) -> Iterator[_Reading]:
    for focus in sorted(cage.foci):
        for mirrored in (told.mirrored, not told.mirrored):
            reading = _Reading((focus,), mirrored, 180.0)
            if reading != told:
                yield reading


def _decide(answer: _Answer, scene: Scene, namings: list[Naming], film: FilmImages, limits: Limits, log_room: float) -> CageIdentification:
    if not namings:
        return answer.failed("no grid of its fiducial marks with control points: other cage, orientation or pixel pitch, or marks covered")
    possible = [n for n in namings if not impossible_stretch(n)]
    if not possible:
        return answer.failed(impossible_stretch(namings[0]))
    top = max(n.log_evidence for n in possible)
    possible = [n for n in possible if n.log_evidence > top - CLOSE]
    # gross errors are left out before hypotheses are compared: a single wrong image must not decide
    limit_mm = limits.fiducial_um / 1000
    cleaned = [drop_gross_errors(scene, n, film, limit_mm, log_room) for n in possible]
    scored = sorted(((n.log_evidence - far_penalty(scene, n, limits), n) for n in cleaned), key=lambda item: -item[0])
    score, best = scored[0]
    rivals = [(s, n) for s, n in scored[1:] if are_different(scene, best, n)]
    log_odds = float(np.log(limits.posterior / (1 - limits.posterior)))
    melted = melted_images(scene, best, film)
    in_one = tuple((int(row), int(best.image[row])) for row in best.rows if best.image[row] in melted)
    if len(melted):
        again = name_marks(scene, best.fit.parameters, film, log_room, banned=melted)
        if again is None:
            return answer.failed("the images of both foci melt into one another")
        best = drop_gross_errors(scene, replace(again, dropped=in_one), film, limit_mm, log_room)
    doubtful, decisive = doubtful_marks(scene, best, film, log_odds)
    if doubtful:
        dropped = (*best.dropped, *((row, int(best.image[row])) for row in doubtful))
        smaller = without(scene, best, film, doubtful, log_room)
        if smaller is None:
            return answer.failed("too few marks without doubt")
        best = drop_gross_errors(scene, replace(smaller, dropped=dropped), film, limit_mm, log_room)
        decisive = doubtful_marks(scene, best, film, log_odds)[1]
    missing = what_is_missing(scene, best, [row for row, _ in in_one])
    if missing:
        return answer.failed(missing)
    against = what_contradicts(scene, best, film)
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
        return CageIdentification({}, nothing, nothing.copy(), 0.0, ("cage-not-found",), why, {}, {}, (), -np.inf)

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
        foreign, explained = np.zeros(len(self.images), bool), np.zeros(len(self.images), bool)
        for row in naming.rows:
            image = int(self.usable[naming.image[row]])
            explained[image] = True
            if scene.own[row]:
                focus, key = self._key(int(row))
                assignments[focus][key] = image
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
