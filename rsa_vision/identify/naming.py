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
from scipy.spatial import cKDTree
from scipy.special import fdtri

from rsa_vision.identify.film_model import FILM, Fit, Scene, fit, project
from rsa_vision.types import Bool, Float, Int, Str

SEEN: Final = 0.9  # probability that a mark has an image
SEEN_FOREIGN: Final = 0.25  # of a mark that is not meant for the focus: cones and masks hide many
SLACK_MM: Final = (0.004, 0.08)  # of film, scanner and cage, each coordinate; Selvik's films showed 0.015..0.045
USUAL_SLACK_MM: Final = 0.02  # weighs like USUAL_COUNT coordinates
USUAL_COUNT: Final = 6
STAGES_MM: Final = (0.6, 0.15)  # slack while the model settles
LEAST_GAP_MM: Final = -1.0  # the film lies behind the plane: exchanged foci would need it before
GATE: Final = 16.0  # squared distance in sigma
OUTLIER: Final = 1e-5  # probability of a true mark image being called a gross error
OUTLIER_UNLIKE: Final = 1e-2  # of an image that does not have the shape of its mark, and so may be something else
ANGLE_SD_DEG: Final = 5.0
ANGLE_WRONG: Final = 0.1  # a hidden arm turns the tee
BODY_MM: Final = 0.15  # blur and the error of a detection that is no marker
SHAPE_RIGHT: Final = 0.85  # a mark is detected as what it is; hidden arms make a tee a pin or a ball


@dataclass(frozen=True, slots=True, eq=False)
class FilmImages:
    """Marker images in the film frame (x right, y up, mm; seen from the focus)."""

    xy_mm: Float
    covariance_mm2: Float
    shape: Str
    angle_rad: Float
    radius_mm: Float
    log_density: Float  # of clutter around each, per mm2


def film_images(xy_mm: Float, covariance_mm2: Float, shape: Str, angle_rad: Float, radius_mm: Float, area_mm2: float) -> FilmImages:
    """Add the density of images around each: letters and screws make clusters, where a chance hit is likelier."""
    n = len(xy_mm)
    density = np.full(n, n / area_mm2)
    k = min(6, n - 1)
    if k >= 3:
        distance = np.asarray(cKDTree(xy_mm).query(xy_mm, k=k + 1)[0])[:, k]
        density = np.maximum(density, k / (np.pi * np.maximum(distance, 0.5) ** 2))
    return FilmImages(xy_mm, covariance_mm2, shape, angle_rad, radius_mm, np.log(density))


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


def appearance(scene: Scene, parameters: Float, images: FilmImages) -> Float:
    """Log likelihood ratios of shape and direction, mark against clutter, shape (m, n)."""
    kinds = ("ball", "pin", "tee")
    count = np.array([(images.shape == kind).sum() for kind in kinds]) + 1.0
    of_clutter = count / count.sum()
    result = np.zeros((len(scene.mark), len(images.xy_mm)))
    for k, kind in enumerate(kinds):
        columns = images.shape == kind
        of_mark = np.where(scene.shape == kind, SHAPE_RIGHT, (1 - SHAPE_RIGHT) / 2)
        result[:, columns] = np.log(of_mark / of_clutter[k])[:, None]
    turned = angle_difference_deg(scene, parameters, images)
    peak = (1 - ANGLE_WRONG) * 360 / (np.sqrt(2 * np.pi) * ANGLE_SD_DEG)
    with np.errstate(invalid="ignore"):
        ratio = np.log(ANGLE_WRONG + peak * np.exp(-0.5 * (turned / ANGLE_SD_DEG) ** 2))
    result += np.where(np.isfinite(turned), ratio, 0.0)
    return result


def angle_difference_deg(scene: Scene, parameters: Float, images: FilmImages) -> Float:
    """Angle of every image against the stem that every mark would show, shape (m, n); NaN where either has none or shapes differ."""
    stem = np.nan_to_num(scene.stem)
    step = project(scene, parameters, xyz_mm=scene.xyz_mm + 0.5 * stem) - project(scene, parameters)
    predicted = np.where(np.hypot(*step.T) > 0.1, np.arctan2(step[:, 1], step[:, 0]), np.nan)
    turned = (images.angle_rad[None] - predicted[:, None] + np.pi) % (2 * np.pi) - np.pi
    return np.where(scene.shape[:, None] == images.shape[None], np.rad2deg(turned), np.nan)


def gains(scene: Scene, parameters: Float, images: FilmImages, looks: Float, slack_mm: float) -> Float:
    """Gain in log likelihood by naming each image as each mark, shape (m, n); -inf outside the gate."""
    offset = images.xy_mm[None] - project(scene, parameters)[:, None]
    result = np.full(offset.shape[:2], -np.inf)
    row, column = np.nonzero((offset**2).sum(-1) < (4 * slack_mm + 1.0) ** 2)
    covariance = images.covariance_mm2[column] + slack_mm**2 * np.eye(2)
    r = offset[row, column]
    squared = np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r)
    odds = np.where(scene.own, np.log(SEEN / (1 - SEEN)), np.log(SEEN_FOREIGN / (1 - SEEN_FOREIGN)))
    gain = odds[row] - images.log_density[column] + looks[row, column] - 0.5 * squared
    gain -= np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(covariance)[1]
    inside = squared < GATE
    result[row[inside], column[inside]] = gain[inside]
    return result


def on_bodies(scene: Scene, parameters: Float, images: FilmImages, rows: Int) -> Bool:
    """Tell which images may be parts of the image of a mark rather than markers: shape (len(rows), n).

    A detector may see balls and pins on the pins of a tee. A ball clearly wider than the pins is no part of them, unless where they meet.
    """
    place = project(scene, parameters, rows)
    focus = parameters[FILM:].reshape(-1, 3)[scene.focus[rows], 2]
    width = scene.size_mm[rows] / 2 * focus / (focus - scene.xyz_mm[rows, 2])
    offset = images.xy_mm[None] - place[:, None]
    away = np.hypot(offset[..., 0], offset[..., 1])
    with np.errstate(invalid="ignore"):
        wide = (images.shape == "ball") & (images.radius_mm > 1.35 * width[:, None])
    result: Bool = np.array(away < 1.2 * width[:, None] + BODY_MM, dtype=bool)
    for arm in range(scene.arms_mm.shape[1]):
        mine = np.isfinite(scene.arms_mm[rows, arm, 0])
        if mine.any():
            which = rows[mine]
            way = project(scene, parameters, which, xyz_mm=scene.xyz_mm[which] + scene.arms_mm[which, arm]) - place[mine]
            along = np.clip((offset[mine] * way[:, None]).sum(-1) / (way**2).sum(-1).clip(1e-9)[:, None], 0, 1)
            rest = offset[mine] - along[..., None] * way[:, None]
            result[mine] |= (np.hypot(rest[..., 0], rest[..., 1]) < 1.2 * width[mine][:, None] + BODY_MM) & ~wide[mine]
    return result


def _no_parts(scene: Scene, parameters: Float, images: FilmImages, gain: Float, image: Int) -> Float:
    """Forbid to name images of another shape than the mark's that lie on the body of a named mark."""
    rows = np.flatnonzero(image >= 0)
    rows = rows[np.isfinite(scene.arms_mm[rows, 0, 0])]
    if not len(rows):
        return gain
    body = on_bodies(scene, parameters, images, rows)
    body[np.arange(len(rows)), image[rows]] = False
    part = body.any(axis=0)
    return np.where(part[None] & (scene.shape[:, None] != images.shape[None]), -np.inf, gain)


def _assign(gain: Float) -> Int:
    """Return the image of every row with the largest total gain, each image once; -1 for none."""
    image = np.full(len(gain), -1)
    columns = np.flatnonzero((gain > 0).any(axis=0))
    if len(columns):
        row, column = linear_sum_assignment(np.maximum(gain[:, columns], 0), maximize=True)
        good = gain[row, columns[column]] > 0
        image[row[good]] = columns[column[good]]
    return image


def _share(scene: Scene, parameters: Float, images: FilmImages, gain: Float, image: Int) -> Int:
    """Let marks whose images coincide share one, and take away an image that may be two melted into one."""
    place = project(scene, parameters)
    image = image.copy()
    taken = image.copy()
    for row in np.flatnonzero(scene.own & (image < 0)):
        focus = parameters[FILM + 3 * scene.focus[row] + 2]
        width = 1.1 * scene.size_mm[row] * focus / (focus - scene.xyz_mm[row, 2])
        apart = np.hypot(*(place - place[row]).T)
        for other in np.flatnonzero((apart < width) & (taken >= 0)):
            d = taken[other]
            noise = np.sqrt(np.trace(images.covariance_mm2[d]) / 2)
            if apart[other] < 0.5 * noise + 0.005 and gain[row, d] > 0:
                image[row] = d
            elif scene.shape[row] == scene.shape[other]:
                image[other] = -1
    return image


def name_marks(scene: Scene, start: Float, images: FilmImages, log_room: float) -> Naming | None:
    """Name the images under one hypothesis.

    Parameters
    ----------
    scene : Scene
    start : ndarray of shape (p,)
        Parameters of the film model.
    images : FilmImages
    log_room : float
        Logarithm of the area and the range of rotations (mm2 rad) in which the film may lie.

    Returns
    -------
    Naming or None
        None where fewer than six marks have images, or the fit fails.
    """
    parameters = start
    image = np.full(len(scene.mark), -1)
    slack = STAGES_MM[0]
    fitted: Fit | None = None
    looks = appearance(scene, start, images)
    for stage in (*STAGES_MM, None, None):
        slack = stage if stage is not None else slack
        gain = gains(scene, parameters, images, looks, slack)
        named = _assign(gain)
        if stage is None:
            gain = _no_parts(scene, parameters, images, gain, named)
            named = _share(scene, parameters, images, gain, _assign(gain))
        if (named[scene.own] >= 0).sum() < 6:
            return None
        settled = stage is None and fitted is not None and np.array_equal(named, image)
        image = named
        rows = np.flatnonzero(image >= 0)
        try:
            fitted = _fit(scene, parameters, rows, image, images, slack)
            if stage != STAGES_MM[0]:
                slack = _slack(fitted, images.covariance_mm2[image[rows]], slack)
        except np.linalg.LinAlgError:
            return None
        parameters = fitted.parameters
        if settled:
            break
    if parameters[6] < LEAST_GAP_MM:
        return None
    looks = appearance(scene, parameters, images)
    return _evidence(scene, Naming(image, fitted, slack, 0.0), images, looks, log_room) if fitted is not None else None


def _fit(scene: Scene, start: Float, rows: Int, image: Int, images: FilmImages, slack_mm: float) -> Fit:
    chosen = image[rows]
    return fit(scene, start, rows, images.xy_mm[chosen], images.covariance_mm2[chosen] + slack_mm**2 * np.eye(2))


def _slack(fitted: Fit, covariance: Float, used_mm: float) -> float:
    """Estimate what the residuals show beyond the images' own covariance, with a prior."""
    total = covariance + used_mm**2 * np.eye(2)
    explained = np.einsum("nip,pq,njq->nij", fitted.jacobian, fitted.covariance, fitted.jacobian)
    free = 2 * len(covariance) - np.trace(explained @ np.linalg.inv(total), axis1=1, axis2=2).sum()
    excess = (fitted.residual_mm**2).sum() - free * np.trace(covariance, axis1=1, axis2=2).mean() / 2
    squared = (max(float(excess), 0.0) + USUAL_COUNT * USUAL_SLACK_MM**2) / (max(float(free), 0.0) + USUAL_COUNT)
    return float(np.clip(np.sqrt(squared), *SLACK_MM))


def _evidence(scene: Scene, naming: Naming, images: FilmImages, looks: Float, log_room: float) -> Naming:
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


def deviations(naming: Naming, images: FilmImages) -> tuple[Float, Float]:
    """How far every named image lies from where all the others predict it.

    Returns
    -------
    squared : ndarray of shape (n,)
        In units of its covariance, (observed - predicted without it); chi-squared with two degrees of freedom.
    predicted_covariance : ndarray of shape (n, 2, 2)
        Of the prediction without it.
    """
    rows = naming.rows
    covariance = images.covariance_mm2[naming.image[rows]] + naming.slack_mm**2 * np.eye(2)
    explained = np.einsum("nip,pq,njq->nij", naming.fit.jacobian, naming.fit.covariance, naming.fit.jacobian)
    rest = covariance - explained
    value, vector = np.linalg.eigh(rest)
    least = 1e-4 * np.trace(covariance, axis1=1, axis2=2)[:, None]  # an image that alone fixes a parameter is not predicted by the others
    rest = vector @ (np.maximum(value, least)[..., None] * vector.swapaxes(1, 2))
    inverse = np.linalg.inv(rest)
    r = naming.fit.residual_mm
    squared = np.einsum("ni,nij,nj->n", r, inverse, r)
    return squared, covariance @ inverse @ covariance - covariance


def drop_gross_errors(scene: Scene, naming: Naming, images: FilmImages, limit_mm: float, log_room: float) -> Naming:
    """Leave out, worst first, every image that the others contradict: by an F test, or by more than the limit."""
    dropped = list(naming.dropped)
    while (naming.image[scene.own] >= 0).sum() > 6:
        squared, _ = deviations(naming, images)
        rows = naming.rows
        covariance = np.trace(images.covariance_mm2[naming.image[rows]], axis1=1, axis2=2).mean()
        smallest = (covariance + 2 * SLACK_MM[0] ** 2) / (covariance + 2 * naming.slack_mm**2)
        others = ((squared.sum() - squared) / (len(rows) - 1) / 2).clip(min(smallest, 1.0))  # variance without the image in question
        freedom = max(2 * len(rows) - len(naming.fit.parameters) - 2, 3)
        alike = scene.shape[rows] == images.shape[naming.image[rows]]
        excess = squared / others / (2 * fdtri(2, freedom, 1 - np.where(alike, OUTLIER, OUTLIER_UNLIKE)))
        worst = int(np.argmax(excess))
        if excess[worst] < 1:
            radial = np.hypot(*naming.fit.residual_mm.T)
            worst = int(np.argmax(radial))
            if radial[worst] < limit_mm:
                break
        row = int(rows[worst])
        dropped.append((row, int(naming.image[row])))
        smaller = without(scene, naming, images, [row], log_room)
        if smaller is None:
            break
        naming = replace(smaller, dropped=tuple(dropped))
    return naming


def without(scene: Scene, naming: Naming, images: FilmImages, rows: list[int], log_room: float) -> Naming | None:
    """Return the naming without some rows, fitted again; None if that cannot be."""
    image = naming.image.copy()
    image[rows] = -1
    left = np.flatnonzero(image >= 0)
    slack = naming.slack_mm
    try:
        for _ in range(2):
            fitted = _fit(scene, naming.fit.parameters, left, image, images, slack)
            slack = _slack(fitted, images.covariance_mm2[image[left]], slack)
    except np.linalg.LinAlgError:
        return None
    looks = appearance(scene, fitted.parameters, images)
    return _evidence(scene, replace(naming, image=image, fit=fitted, slack_mm=slack), images, looks, log_room)


def doubtful_marks(scene: Scene, naming: Naming, images: FilmImages, log_odds: float) -> tuple[list[int], float]:
    """Find marks that another image would suit nearly as well.

    Parameters
    ----------
    scene, naming, images
    log_odds : float
        Of the chosen image against all others together, that is demanded.

    Returns
    -------
    rows : list of int
    log_odds : float
        The smallest that was met.
    """
    rows = naming.rows
    squared, spread = deviations(naming, images)
    looks = appearance(scene, naming.fit.parameters, images)
    gain = gains(scene, naming.fit.parameters, images, looks, naming.slack_mm)
    owner = np.full(len(images.xy_mm), -1)
    owner[naming.image[rows]] = rows
    doubtful: list[int] = []
    least = np.inf
    for k in np.flatnonzero(scene.own[rows]):
        row, chosen = int(rows[k]), int(naming.image[rows[k]])
        own = images.covariance_mm2[chosen] + naming.slack_mm**2 * np.eye(2)
        predicted = images.xy_mm[chosen] - (own + spread[k]) @ np.linalg.inv(own) @ naming.fit.residual_mm[k]
        reach = 6 * np.sqrt(np.trace(own + spread[k])) + 1e-3
        near = np.flatnonzero(np.hypot(*(images.xy_mm - predicted).T) < reach)
        near = near[near != chosen]
        if not len(near):
            continue
        covariance = images.covariance_mm2[near] + naming.slack_mm**2 * np.eye(2) + spread[k]
        r = images.xy_mm[near] - predicted
        alternative = -0.5 * np.einsum("ni,nij,nj->n", r, np.linalg.inv(covariance), r) - 0.5 * np.linalg.slogdet(covariance)[1]
        alternative += looks[row, near] - images.log_density[near]
        current = -0.5 * squared[k] - 0.5 * np.linalg.slogdet(own + spread[k])[1] + looks[row, chosen] - images.log_density[chosen]
        for i, d in enumerate(near):  # the mark that has it now would lose it, or take mine
            if owner[d] >= 0:
                alternative[i] += max(gain[owner[d], chosen], 0.0) - max(gain[owner[d], d], 0.0)
        odds = float(current - np.logaddexp.reduce(alternative))
        least = min(least, odds)
        if odds < log_odds:
            doubtful.append(row)
    return doubtful, float(least)
