"""The names of all images under one hypothesis about a film, and the evidence for it.

The likelihood of an assignment: images of marks lie at their predicted places within their covariance and the slack of film and cage, every
other image is clutter of the density found around it, and a mark may be hidden. The evidence integrates over the model's parameters, so
that a hypothesis pays for what it had to adjust.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from rsa_vision.identify.appearance import FilmImages, appearance, on_bodies
from rsa_vision.identify.film_model import FILM, Fit, Scene, fit, project
from rsa_vision.types import Float, Int

SEEN: Final = 0.9  # probability that a mark has an image
SEEN_FOREIGN: Final = 0.25  # of a mark that is not meant for the focus: cones and masks hide many
SLACK_MM: Final = (0.004, 0.08)  # of film, scanner and cage, each coordinate; Selvik's films showed 0.015..0.045
USUAL_SLACK_MM: Final = 0.02  # weighs like USUAL_COUNT coordinates
USUAL_COUNT: Final = 6
STAGES_MM: Final = (0.6, 0.15)  # slack while the model settles
SETTLED_MM: Final = 0.02
SETTLING: Final = 8  # rounds of naming and fitting at most, until the names stay
NEAR_MM: Final = 1.0  # images further apart than this are never one
LEAST_GAP_MM: Final = -0.1  # the film lies behind the plane: with the foci exchanged it would lie before
LEAST: Final = 6  # named marks: four fiducial marks and two control points
GATE: Final = 16.0  # squared distance in sigma


@dataclass(frozen=True, slots=True, eq=False)
class Naming:
    """One hypothesis with its best assignment.

    Attributes
    ----------
    image : ndarray of int, shape (m,)
        Image of every row of the scene, -1 for none.
    fit : Fit
        Of the rows with an image, in their order.
    slack_mm : float
        With which the fit was weighed: what its covariance leaves of an image's own is exact, also of one that alone fixes a parameter.
    log_evidence : float
        Against clutter only.
    dropped : tuple of (int, int)
        Rows and images that were named at first and left out as gross errors.
    """

    image: Int
    fit: Fit
    slack_mm: float
    log_evidence: float
    dropped: tuple[tuple[int, int], ...] = ()

    @property
    def rows(self) -> Int:
        """Rows of the scene that have an image."""
        return np.flatnonzero(self.image >= 0)


def gains(scene: Scene, parameters: Float, images: FilmImages, looks: Float, slack_mm: float) -> Float:
    """Gain in log likelihood by naming each image as each mark, shape (m, n); -inf outside the gate."""
    offset = images.xy_mm[None] - project(scene, parameters)[:, None]
    result = np.full(offset.shape[:2], -np.inf)
    row, column = np.nonzero(offset[..., 0] ** 2 + offset[..., 1] ** 2 < (4 * slack_mm + 1.0) ** 2)
    covariance = images.covariance_mm2[column] + slack_mm**2 * np.eye(2)
    r = offset[row, column]
    squared = np.einsum("ni,ni->n", r, (np.linalg.inv(covariance) @ r[:, :, None])[:, :, 0])
    odds = np.where(scene.own, np.log(SEEN / (1 - SEEN)), np.log(SEEN_FOREIGN / (1 - SEEN_FOREIGN)))
    gain = odds[row] - images.log_density[column] + looks[row, column] - 0.5 * squared
    gain -= np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(covariance)[1]
    inside = squared < GATE
    result[row[inside], column[inside]] = gain[inside]
    return result


def _no_parts(scene: Scene, parameters: Float, images: FilmImages, gain: Float, image: Int) -> Float:
    """Forbid to name images of another shape than the mark's that lie on the body of a named mark."""
    rows = np.flatnonzero(image >= 0)
    rows = rows[np.isfinite(scene.arms_mm[rows, 0, 0])]
    if not len(rows):
        return gain
    body = on_bodies(scene, parameters, images, rows)
    body[np.arange(len(rows)), image[rows]] = False
    part = np.flatnonzero(body.any(axis=0))
    gain = gain.copy()
    gain[:, part] = np.where(scene.shape[:, None] != images.shape[part], -np.inf, gain[:, part])
    return gain


def _assign(gain: Float) -> Int:
    """Return the image of every row with the largest total gain, each image once; -1 for none."""
    image = np.full(len(gain), -1)
    columns = np.flatnonzero((gain > 0).any(axis=0))
    if len(columns):
        row, column = linear_sum_assignment(np.maximum(gain[:, columns], 0), maximize=True)
        good = gain[row, columns[column]] > 0
        image[row[good]] = columns[column[good]]
    return image


def _share(scene: Scene, parameters: Float, images: FilmImages, gain: Float, image: Int, slack_mm: float) -> Int:
    """Let marks whose images coincide share one."""
    place = project(scene, parameters)
    shared = image.copy()
    for row in np.flatnonzero(scene.own & (image < 0)):
        apart = np.hypot(*(place - place[row]).T)
        for other in np.flatnonzero((apart < NEAR_MM) & (image >= 0)):
            d = image[other]
            if apart[other] < _noise(images, d, slack_mm) and gain[row, d] > 0:  # off by half of it if both were there
                shared[row] = d
    return shared


def _noise(images: FilmImages, image: int, slack_mm: float) -> float:
    return float(np.sqrt(np.trace(images.covariance_mm2[image]) / 2 + slack_mm**2))


def melted_images(scene: Scene, naming: Naming, images: FilmImages) -> Int:
    """Find named images that may be two in one: another mark should show one as near as it is wide, and does not."""
    parameters = naming.fit.parameters
    place = project(scene, parameters)
    found = []
    for row in np.flatnonzero(scene.own & (naming.image < 0)):
        focus = parameters[FILM + 3 * scene.focus[row] + 2]
        width = 1.1 * scene.size_mm[row] * focus / (focus - scene.xyz_mm[row, 2])
        apart = np.hypot(*(place - place[row]).T)
        near = (apart < width) & (naming.image >= 0) & (scene.shape == scene.shape[row])
        found += [
            naming.image[other] for other in np.flatnonzero(near) if apart[other] > _noise(images, naming.image[other], naming.slack_mm)
        ]
    return np.unique(np.array(found, dtype=np.int64))


def name_marks(
    scene: Scene, start: Float, images: FilmImages, log_room: float, *, banned: Int | None = None, least: int = LEAST
) -> Naming | None:
    """Name the images under one hypothesis.

    Parameters
    ----------
    scene : Scene
    start : ndarray of shape (p,)
        Parameters of the film model.
    images : FilmImages
    log_room : float
        Logarithm of the area and the range of rotations (mm2 rad) in which the film may lie.
    banned : ndarray of int, optional
        Images that are not to be named.
    least : int
        Give up where fewer marks have images: an explanation of less is not asked for.

    Returns
    -------
    Naming or None
        None where too few marks have images, or the fit fails.
    """
    parameters = start
    image = np.full(len(scene.mark), -1)
    slack = fitted_with = STAGES_MM[0]
    fitted: Fit | None = None
    looks = appearance(scene, start, images)
    for stage in (*STAGES_MM, *[None] * SETTLING):
        slack = stage if stage is not None else slack
        gain = gains(scene, parameters, images, looks, slack)
        if banned is not None:
            gain[:, banned] = -np.inf
        named = _assign(gain)
        if stage is None:
            gain = _no_parts(scene, parameters, images, gain, named)
            named = _assign(gain)
        named = _share(scene, parameters, images, gain, named, slack)
        count = (named[scene.own] >= 0).sum()
        if count < LEAST or (count < least and stage != STAGES_MM[0]):
            return None
        settled = stage is None and fitted is not None and np.array_equal(named, image)
        image = named
        rows = np.flatnonzero(image >= 0)
        try:
            fitted, fitted_with = fit_rows(scene, parameters, rows, image, images, slack), slack
            if stage != STAGES_MM[0]:
                slack = residual_slack(fitted, images.covariance_mm2[image[rows]], slack)
        except np.linalg.LinAlgError:
            return None
        moved = np.abs(project(scene, fitted.parameters) - project(scene, parameters)).max()
        parameters = fitted.parameters
        if settled and moved < SETTLED_MM:
            break
        if stage is not None and parameters[6] < 0:
            parameters = parameters * np.where(np.arange(len(parameters)) == 6, -1.0, 1.0)
    if fitted is None or parameters[6] + 3 * np.sqrt(fitted.covariance[6, 6]) < LEAST_GAP_MM:
        return None
    looks = appearance(scene, parameters, images)
    return evidence(scene, Naming(image, fitted, fitted_with, 0.0), images, looks, log_room)


def fit_rows(scene: Scene, start: Float, rows: Int, image: Int, images: FilmImages, slack_mm: float) -> Fit:
    """Fit the film model to the images of some rows."""
    chosen = image[rows]
    return fit(scene, start, rows, images.xy_mm[chosen], images.covariance_mm2[chosen] + slack_mm**2 * np.eye(2))


def residual_slack(fitted: Fit, covariance: Float, used_mm: float) -> float:
    """Estimate what the residuals show beyond the images' own covariance, with a prior."""
    total = covariance + used_mm**2 * np.eye(2)
    explained = np.einsum("nip,pq,njq->nij", fitted.jacobian, fitted.covariance, fitted.jacobian)
    free = 2 * len(covariance) - np.trace(explained @ np.linalg.inv(total), axis1=1, axis2=2).sum()
    excess = (fitted.residual_mm**2).sum() - free * np.trace(covariance, axis1=1, axis2=2).mean() / 2
    squared = (max(float(excess), 0.0) + USUAL_COUNT * USUAL_SLACK_MM**2) / (max(float(free), 0.0) + USUAL_COUNT)
    return float(np.clip(np.sqrt(squared), *SLACK_MM))


def evidence(scene: Scene, naming: Naming, images: FilmImages, looks: Float, log_room: float) -> Naming:
    """Return the naming with its evidence against clutter only."""
    rows = naming.rows
    chosen = naming.image[rows]
    covariance = images.covariance_mm2[chosen] + naming.slack_mm**2 * np.eye(2)
    r = naming.fit.residual_mm
    squared = np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r)
    odds = np.where(scene.own[rows], np.log(SEEN / (1 - SEEN)), np.log(SEEN_FOREIGN / (1 - SEEN_FOREIGN)))
    gain = odds - images.log_density[chosen] + looks[rows, chosen] - np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(covariance)[1]
    _, first = np.unique(chosen, return_index=True)
    once = np.zeros(len(rows), bool)
    once[first] = True  # an image that two marks share was seen once
    hidden = scene.own.sum() * np.log(1 - SEEN)
    total = gain[once].sum() - 0.5 * squared.sum() + naming.fit.log_prior - log_room + hidden
    return replace(naming, log_evidence=float(total))
