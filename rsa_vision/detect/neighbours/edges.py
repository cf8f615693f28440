"""Balls on and beside the edges of bones and implants, fitted with the edge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import hopeless, of_size
from rsa_vision.detect.balls.find import plausible
from rsa_vision.detect.balls.fits import RADIUS_PX, BallFits, join
from rsa_vision.detect.balls.focal_spot import Spot
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.beside import MOST_IN_GROUP, all_but, groups_of
from rsa_vision.detect.neighbours.groups import edge_gain, fit_group
from rsa_vision.types import Bool

NEAR_EDGES = 2.5  # times the misfit that balls may leave: what an edge beside them adds to it
OF_SHIFT = 0.25  # of the square of what two models of an edge differ by: added to the stated variance
EDGE_GAIN = 40.0  # twice the log-likelihood that an edge of a dozen parameters must gain
_FORESEEN = 0.75  # part of it that a score test must promise for the fits to be made
_BLURRIER = (-0.25, 0.15, 0.3, 0.5)  # logarithms of a ball's own blur over the film's that are tried: a penumbra is no edge
_EXPLAINED = 0.1  # of what the film's blur leaves of a ball, that its own may leave
_CLEAR = 50.0  # significance of balls of which blur is seen so well
_MORE_GAIN = 9.0  # the same of what balls take away of it, and of its bend: each makes what else is fitted less sure


def balls_beside_edges(
    film: NDArray[Any],
    fits: BallFits,
    optics: Optics,
    noise: NoiseModel,
    needles: Images | None,
    spot: Spot | None = None,
    *,
    wanted: Callable[[BallFits], Bool] | None = None,
) -> tuple[BallFits, Bool]:
    """Fit again, with an edge in the background, the balls that lie on or beside one (the likelihood tells); say which they are.

    An edge that a quadratic surface cannot follow pulls the centre. What the edge model moves it by says how much is at stake: a quarter of
    its square is added to the stated variance, since edges have other profiles than the model's.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fits : BallFits
        Of a film's balls; what is of no size that those have is dropped.
    optics : Optics
    noise : NoiseModel
    needles : callable, optional
        Images to be taken away first.
    spot : Spot, optional
        That draws the balls, if it is no Gaussian.
    wanted : callable, optional
        Says what is asked for of those that are fitted with an edge: whether others lie at one is not told.

    Returns
    -------
    fits : BallFits
    edged : ndarray of bool, shape (n,)
        Fitted with an edge.
    """
    fits = fits.rows(of_size(fits, optics.sigma_px, noise))
    parts, edged_too = [fits.rows(slice(0))], []
    worth = ~hopeless(fits, optics.sigma_px, noise)
    for g in groups_of(fits, optics):
        index = np.array(g)
        edged_too.append(np.zeros(len(g), bool))
        beside = all_but(fits, index, optics, needles)
        plain = fits.rows(index)
        # a size at the limit is not fitted: nothing that comes to rest there is a ball. Saturated film shows no edges
        at_limit, burnt = (plain.radius_px >= RADIUS_PX[1]).any(), (plain.hidden != 0).all()
        if len(g) > MOST_IN_GROUP or not worth[index].any() or at_limit or burnt:
            parts.append(plain)
            continue
        foreseen = edge_gain(film, plain, optics, noise, beside, spot) / noise.correlation.sum()
        if foreseen < _FORESEEN * EDGE_GAIN:
            parts.append(plain)
            continue
        fitted = partial(fit_group, film, plain.position_px, plain.radius_px, optics, noise, beside, spot=spot)
        straight = fitted(edge=True)
        models = [(0.0 if straight.converged.all() else -np.inf, straight)]
        for taken, bent in ((True, False), (False, True), (True, True)):
            if taken and bent and len(models) > 1 and max(models, key=lambda model: model[0]) is models[0]:
                break  # what neither gains alone both do not
            other = fitted(edge=True, taken=taken, bent=bent)
            if other.converged.all():
                models.append((_gain(other, straight, noise) - _MORE_GAIN * (taken + bent), other))
        best, edged = max(models, key=lambda model: model[0])
        lost = plausible(plain, noise) & ~plausible(edged, noise)
        if not edged.converged.all() or lost.any() or (wanted and not wanted(edged).any()):
            parts.append(plain)
            continue
        flat = fitted()
        if len(g) == 1 and plain.significance[0] > _CLEAR and _gain(edged, flat, noise) >= EDGE_GAIN:
            blurred = (fitted(blurrier=b) for b in _BLURRIER)
            # what film curves leave, no blur takes away
            told = [b for b in blurred if b.converged.all() and b.chi2_core[0] < _EXPLAINED * flat.chi2_core[0]]
            flat = max([flat, *told], key=lambda one: float(one.log_likelihood[0]))
        if _gain(edged, flat, noise) < EDGE_GAIN:
            parts.append(plain)
            continue
        covariance = edged.covariance.copy()
        for rival in [plain, *(model for worth_it, model in models if worth_it > best - _MORE_GAIN)]:
            shift = edged.position_px - rival.position_px
            covariance[:, :2, :2] += OF_SHIFT * shift[:, :, None] * shift[:, None, :]
        parts.append(replace(edged, covariance=covariance))
        edged_too[-1][:] = True
    return join(parts), np.concatenate([np.zeros(0, bool), *edged_too])


def _gain(fits: BallFits, simpler: BallFits, noise: NoiseModel) -> float:
    """Return twice the log-likelihood that one model of a group gains over another."""
    return float(2 * (fits.log_likelihood[0] - simpler.log_likelihood[0]) / noise.correlation.sum())
