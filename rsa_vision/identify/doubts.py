"""Doubts about single marks of a naming: images that all others contradict, and images that another one could replace."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import fdtri

from rsa_vision.identify.appearance import FilmImages, appearance
from rsa_vision.identify.film_model import Scene
from rsa_vision.identify.naming import SLACK_MM, Naming, evidence, fit_rows, gains, residual_slack
from rsa_vision.types import Float

OUTLIER: Final = 1e-5  # probability of a true mark image being called a gross error
OUTLIER_UNLIKE: Final = 1e-2  # of an image that does not have the shape of its mark, and so may be something else


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
    try:
        fitted = fit_rows(scene, naming.fit.parameters, left, image, images, naming.slack_mm)
        slack = residual_slack(fitted, images.covariance_mm2[image[left]], naming.slack_mm)
        fitted = fit_rows(scene, fitted.parameters, left, image, images, slack)
    except np.linalg.LinAlgError:
        return None
    looks = appearance(scene, fitted.parameters, images)
    return evidence(scene, replace(naming, image=image, fit=fitted, slack_mm=slack), images, looks, log_room)


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
