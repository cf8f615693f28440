"""One examination: films -> marker images -> names -> 3-D markers, with a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, TypedDict

import numpy as np

from rsa_vision.cages import Cage, builtin_cages, load_cage
from rsa_vision.cameras import Camera
from rsa_vision.detect import detect_markers
from rsa_vision.errors import CalibrationError, RsaError
from rsa_vision.geometry.camera import camera_rays
from rsa_vision.geometry.rays import RayBundle
from rsa_vision.identify.cage import CageIdentification, identify_cage
from rsa_vision.identify.crossings import Region, cage_region
from rsa_vision.identify.pairs import Pairing, pair_rays
from rsa_vision.identify.remedies import is_decisive, what_would_fit
from rsa_vision.images import require_pitch
from rsa_vision.readings import (
    FilmReading,
    Readings,
    candidates,
    image_quality,
    joined_rays,
    lonely_images,
    name_marks,
    name_objects,
    pins_left,
)
from rsa_vision.settings import Limits, Study
from rsa_vision.sightlines import Sightlines, by_cage, by_cameras, left_open, single_images
from rsa_vision.threads import in_one_thread
from rsa_vision.types import Film, Float, ImagePoints, Int, Reconstruction
from rsa_vision.verdict import STRETCH_LIMIT, Finding, Verdict, conclude, film_stretch, judge, local_scale
from rsa_vision.xray import rays_of, reconstruct, reconstruct_calibrated, solve_focus

SAME_PITCH: Final = 1e-4  # relative: what tags round differently; over a film of 4000 pixels less than half of one
TIP_ERROR: Final = 0.01
"""Part of the half width: what the fits of all points of a cage have in common where the points are no cones (rounded, or cylinders with
a short point). Root mean square over 33 films of another renderer; at the worst 3 %."""


class _Told(TypedDict):
    """What a user, or the file, tells of a film."""

    pitch_mm: tuple[float, float]
    film_shape: tuple[int, int]
    orientation: str
    foci_mm: Mapping[int, Sequence[float]]
    limits: Limits


ExposedFilm = tuple[Film, int | None]
"""A film and the focus that it belongs to, None for all foci."""


@dataclass(frozen=True, slots=True, eq=False)
class ExaminationResult:
    """One measured examination.

    Attributes
    ----------
    films : tuple of FilmReading
    points : ImagePoints
        Every image that was found; named ones once for each focus that they serve.
    source : ndarray of int, or None
        Row of each point in the table of images of its film; None where points were measured elsewhere.
    reconstruction : Reconstruction or None
        None where it failed. Its points are `points`, flags extended.
    verdict : Verdict
    sightlines : Sightlines
        What the films leave open.
    """

    films: tuple[FilmReading, ...]
    points: ImagePoints
    source: Int | None
    reconstruction: Reconstruction | None
    verdict: Verdict
    sightlines: Sightlines = field(default_factory=Sightlines.none)


@in_one_thread
def measure_examination(
    films: Sequence[ExposedFilm],
    study: Study,
    geometry: Cage | Mapping[int, Camera],
    *,
    cage_films: Sequence[ExposedFilm] = (),
) -> ExaminationResult:
    """Measure the films of one examination.

    Parameters
    ----------
    films : sequence of (Film, focus)
        One film of all foci (focus None), or one of each focus.
    study : Study
    geometry : Cage, or mapping of focus number to Camera
        A cage as calibrated (it is brought to the study's temperature here), or calibrated cameras instead.
    cage_films : sequence of (Film, focus)
        The cage exposed apart with the same foci and film position; then `films` show the object alone.

    Returns
    -------
    ExaminationResult
        Expected failures (no pitch, cage not found, too few marks) are verdicts, not exceptions.
    """
    table = Readings.of(())
    try:
        every = [*cage_films, *films]
        pitches = [require_pitch(film, study.pixel_pitch_mm) if isinstance(geometry, Cage) else None for film, _ in every]
        table = Readings.of([_read(*exposed, pitch, study) for exposed, pitch in zip(every, pitches, strict=True)])
    except RsaError as error:
        return _failed(table, [(error.code, str(error))])
    return name_and_reconstruct(table.films, study, geometry, n_cage_films=len(cage_films))


@in_one_thread
def name_and_reconstruct(
    films: Sequence[FilmReading], study: Study, geometry: Cage | Mapping[int, Camera], *, n_cage_films: int = 0
) -> ExaminationResult:
    """Measure one examination whose marker images were found already.

    Parameters
    ----------
    films : sequence of FilmReading
        Films of the cage alone first, if there are any.
    study : Study
    geometry : Cage, or mapping of focus number to Camera
    n_cage_films : int

    Returns
    -------
    ExaminationResult
        Without times; expected failures are verdicts.
    """
    table = Readings.of(films)
    if blank := [film.path.name for film in table.films if not len(film.images)]:
        return _failed(table, [("no-markers", f"{name}: no marker image was found") for name in blank])
    try:
        if isinstance(geometry, Cage):
            return _with_cage(table, n_cage_films, study, geometry)
        return _with_cameras(table, study, geometry)
    except RsaError as error:
        return _failed(table, [(error.code, str(error))])


def reconstruct_points(points: ImagePoints, study: Study, cage: Cage) -> ExaminationResult:
    """Reconstruct an examination whose image points were named elsewhere.

    Parameters
    ----------
    points : ImagePoints
    study : Study
    cage : Cage
        As calibrated.

    Returns
    -------
    ExaminationResult
        Without films.
    """
    try:
        at_exam = cage.at_temperature(study.temperature_c)
        reconstruction = reconstruct(points, at_exam, study.limits)
    except RsaError as error:
        return ExaminationResult((), points, None, None, conclude([(error.code, str(error))]))
    verdict = conclude(judge(reconstruction, _nominal(study, cage), study.limits))
    sightlines = single_images(reconstruction, by_cage(reconstruction, at_exam))
    return ExaminationResult((), reconstruction.points, None, reconstruction, verdict, sightlines=sightlines)


def _with_cage(table: Readings, n_cage_films: int, study: Study, cage: Cage) -> ExaminationResult:
    if differing := _unlike_cage_films(table.films[:n_cage_films], table.films[n_cage_films:]):
        return _failed(table, differing)
    cage = cage.at_temperature(study.temperature_c)
    marks = [_identify(film, study, cage) for film in table.films[: n_cage_films or None]]
    findings = [(code, _explain(code, m, film, study, cage)) for film, m in zip(table.films, marks, strict=False) for code in m.reasons]
    if not all(marks):
        return _failed(table, findings)
    named, free, foreign = name_marks(table, marks, n_cage_films)
    foci = sorted(set(named.points.focus.tolist()))
    fits = {focus: solve_focus(named.points.rows(named.points.focus == focus), cage, focus, study.limits).solution for focus in foci}
    findings += [finding for film, m in zip(table.films, marks, strict=False) for finding in _stretch(film, m)]
    bundles = []
    for focus in foci:
        rows = candidates(table, free, focus)
        bundles.append(rays_of(table.points.position_px[rows], table.points.covariance_px2[rows], fits[focus], cage, rows))
    bundle = joined_rays(bundles)
    centre = named.points.position_px.mean(axis=0)
    scale = {focus: local_scale(fit.plane_from_film, centre) for focus, fit in fits.items()}
    region = cage_region(cage, {focus: fit.position_mm for focus, fit in fits.items()})
    normals = np.array([cage.plane_of(int(focus)).normal() for focus in bundle.focus]).reshape(-1, 3)
    slant = np.abs(np.einsum("ij,ij->i", bundle.direction, normals))
    pairing = _pair(table, bundle, scale, study, region, slant=slant)
    complete = name_objects(named, table, bundle, pairing, foreign)
    reconstruction = reconstruct(complete.points, cage, study.limits, TIP_ERROR)
    findings += _pair_findings(pairing, study) + lonely_images(table, pairing, bundle) + pins_left(table, pairing, bundle, region)
    result = _judged(complete, reconstruction, findings + judge(reconstruction, _nominal(study, cage), study.limits))
    return replace(result, sightlines=left_open(result.points, complete.rows, bundle, pairing, by_cage(reconstruction, cage)))


def _with_cameras(table: Readings, study: Study, cameras: Mapping[int, Camera]) -> ExaminationResult:
    for film in table.films:
        if film.focus is None:
            raise CalibrationError(f"{film.path.name}: calibrated cameras need a film for each focus; name the films _f1, _f2")
        if (size := cameras[film.focus].image_size) != film.shape[::-1]:
            found = f"{film.shape[1]} x {film.shape[0]} pixels"
            raise CalibrationError(f"{film.path.name}: {found}, but camera {film.focus} was calibrated for {size[0]} x {size[1]}")
    everything = np.ones(len(table.points), bool)
    bundles, scale = [], {}
    for focus, camera in sorted(cameras.items()):
        rows = candidates(table, everything, focus)
        bundles.append(camera_rays(camera, focus, table.points.position_px[rows], table.points.covariance_px2[rows], rows))
        # the rays' second points lie as far away as the origin of the calibration
        scale[focus] = float(np.linalg.norm(camera.translation) / camera.matrix[0, 0])
    bundle = joined_rays(bundles)
    slack_mm = study.limits.calibration_px * float(np.sqrt(2) * np.mean(list(scale.values())))
    # exact calibrations pair best by their small errors; where those leave partners apart, the calibration has errors of its own
    exact, tolerant = _pair(table, bundle, scale, study, None), _pair(table, bundle, scale, study, None, slack_mm)
    pairing = exact if len(exact.groups) >= len(tolerant.groups) else tolerant
    nothing = table.with_points(table.points.rows(~everything), table.rows[:0])
    complete = name_objects(nothing, table, bundle, pairing, ~everything)
    findings = _pair_findings(pairing, study) + lonely_images(table, pairing, bundle) + pins_left(table, pairing, bundle, None)
    if not pairing.groups:
        return _failed(complete, [*findings, ("cage-not-found", "no image of one film meets one of the other: look at the calibration")])
    reconstruction = reconstruct_calibrated(complete.points, cameras, study.limits)
    result = _judged(complete, reconstruction, findings + judge(reconstruction, {}, study.limits))
    return replace(result, sightlines=left_open(result.points, complete.rows, bundle, pairing, by_cameras(reconstruction, cameras)))


def _pair(
    table: Readings,
    bundle: RayBundle,
    mm_per_px: Mapping[int, float],
    study: Study,
    region: Region | None,
    slack_mm: float | None = None,
    *,
    slant: Float | None = None,
) -> Pairing:
    scale = np.array([mm_per_px[int(focus)] for focus in bundle.focus])
    radius_mm, shape = table.radius_px[bundle.image] * scale, table.points.shape[bundle.image]
    if slant is not None:  # a ball seen at a slant is an ellipse, longer by 1 / cos: the fitted radius is the geometric mean
        radius_mm = radius_mm * np.where(shape == "ball", np.sqrt(slant), 1.0)
    # the edge of a disc tells its radius about as well as its centre, that of a pin its width as well as its place across
    variance = np.linalg.eigvalsh(table.points.covariance_px2)
    sd_px = np.sqrt(np.where(table.points.shape == "ball", variance.mean(axis=1), variance[:, 0]))
    return pair_rays(
        bundle,
        study.limits,
        region=region,
        shape=shape,
        radius_mm=radius_mm,
        contrast=table.contrast[bundle.image],
        quality=image_quality(table.points.flags[bundle.image]),
        error=(sd_px / table.radius_px)[bundle.image],
        slack_mm=slack_mm,
    )


def _pair_findings(pairing: Pairing, study: Study) -> list[Finding]:
    doubtful = f"{pairing.ambiguous.sum()} of {len(pairing.groups)} markers: the pairing has a posterior below {study.limits.posterior:g}"
    return [(code, doubtful) for code in pairing.reasons]


def _read(film: Film, focus: int | None, pitch_mm: tuple[float, float] | None, study: Study) -> FilmReading:
    rows, cols = film.values.shape
    limit = study.limits.false_detections_per_film
    found = detect_markers(film.values, bits=film.bits, response=study.response, false_detections=limit).images
    return FilmReading(film.path, focus, (rows, cols), pitch_mm, study.response, found)


def _unlike_cage_films(cage_films: Sequence[FilmReading], films: Sequence[FilmReading]) -> list[Finding]:
    """Find the films whose pixels are not those of the film of the cage: coordinates of one are then none of the other."""
    findings: list[Finding] = []
    for pair in zip(cage_films, films, strict=False):  # one for each, of the same focus
        pitches = [np.array(film.pitch_mm) for film in pair]  # a cage needs the pitch: required before
        if pair[0].shape != pair[1].shape or not np.allclose(pitches[0], pitches[1], rtol=SAME_PITCH, atol=0):
            each = zip(pair, pitches, strict=True)
            said = [f"{f.path.name} has {f.shape[1]} x {f.shape[0]} pixels of {p[1]:.5g} x {p[0]:.5g} mm" for f, p in each]
            findings.append(("cage-film-differs", ", ".join(said)))
    return findings


def _nominal(study: Study, cage: Cage) -> dict[int, tuple[float, float, float]]:
    return {**cage.foci, **{focus: place for focus, place in study.foci.items() if focus in cage.foci}}


def _identify(film: FilmReading, study: Study, cage: Cage) -> CageIdentification:
    return identify_cage(film.images, cage, _foci(film, cage), **_told(film, study, cage))


def _foci(film: FilmReading, cage: Cage) -> tuple[int, ...]:
    return tuple(sorted(cage.foci)) if film.focus is None else (film.focus,)


def _told(film: FilmReading, study: Study, cage: Cage) -> _Told:
    assert film.pitch_mm is not None  # a cage needs the pitch: required before
    return {
        "pitch_mm": film.pitch_mm,
        "film_shape": film.shape,
        "orientation": study.orientation,
        "foci_mm": _nominal(study, cage),
        "limits": study.limits,
    }


def _explain(code: str, found: CageIdentification, film: FilmReading, study: Study, cage: Cage) -> str:
    why = code.replace("-", " ")
    if code == "cage-not-found":
        why = f"the cage was not found among {len(film.images)} marker images: {found.runner_up or 'too few of its marks'}"
        others = [load_cage(name) for name in builtin_cages()]
        if fits := what_would_fit(film.images, cage, _foci(film, cage), **_told(film, study, cage), others=others):
            why += f"; it would be found with {' or with '.join(fits)}: look which is true"
    if code == "cage-ambiguous":
        why = f"posterior of the names {found.posterior:.4f}; the rival: {found.runner_up or 'images at random'}"
        if study.orientation == "any" and is_decisive(_identify(film, study.model_copy(update={"orientation": "upright"}), cage)):
            why += '; orientation = "upright" decides if the film lies so; if it was turned over by 180 deg, turn it back first'
    return f"{film.path.name}: {why}"


def _stretch(film: FilmReading, found: CageIdentification) -> list[Finding]:
    assert film.pitch_mm is not None  # as in _told
    findings: list[Finding] = []
    for focus, homography in found.plane_from_film.items():
        images = [image for (role, _), image in found.assignments[focus].items() if role == "fiducial"]
        stretch = film_stretch(homography, film.images.position_px[images].mean(axis=0), film.pitch_mm)
        if stretch > STRETCH_LIMIT:
            findings.append(("film-stretched", f"{film.path.name}, focus {focus}: {stretch:.1%} longer in one direction"))
    return findings


def _failed(readings: Readings, findings: Sequence[Finding]) -> ExaminationResult:
    return ExaminationResult(readings.films, readings.points, readings.source, None, conclude(findings))


def _judged(readings: Readings, reconstruction: Reconstruction, findings: Sequence[Finding]) -> ExaminationResult:
    return ExaminationResult(readings.films, reconstruction.points, readings.source, reconstruction, conclude(findings))
