"""Where the tips of needles that are fitted together are, and how far they may be off: noise, what is common, bone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.leftover import LEAST, at_rims, usual_square
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.whitening import Filter
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.crossing import Window
from rsa_vision.detect.needles.disturbed import louder
from rsa_vision.detect.needles.equations import Equations
from rsa_vision.detect.needles.fits import excess_of, scored
from rsa_vision.detect.needles.grounds import errors_by_ground
from rsa_vision.detect.needles.states import Step
from rsa_vision.types import Float

# side of squares than which all that is slower is left out, on bone; near enough the best for arms of half widths of 2.5 to 4
_SQUARE_PX = 17
_GAIN = 0.2  # of the logarithm of the variance of tips, from which they are
_ASKED = 8  # windows that tell whether it is to be


@dataclass(frozen=True, slots=True, eq=False)
class AtRest:
    """A fit of all needles of a film that has come to rest.

    Attributes
    ----------
    windows : list of Window
    systems : list of Equations
        One a window, filtered, before the last step.
    sets : list of list of NeedleFit
        The needles of each window, after it.
    step : Step
        The last one.
    telling : list of bool
        Which windows tell what is common.
    normal, precision : ndarray of shape (c, c)
        Of the common parameters, and what of that was known before.
    optics : Optics
    through : Filter
        Of the systems.
    converged : bool
    """

    windows: list[Window]
    systems: list[Equations]
    sets: list[list[NeedleFit]]
    step: Step
    telling: list[bool]
    normal: Float
    precision: Float
    optics: Optics
    through: Filter
    converged: bool


def with_errors(film: NDArray[Any], fit: AtRest, noise: NoiseModel) -> list[NeedleFit]:
    """State the errors of the tips.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fit : AtRest
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
        The covariance of a tip holds the errors of what is common.
    """
    windows, systems, step, optics = fit.windows, fit.systems, fit.step, fit.optics
    left = np.array([e.noise_under(own, step.change) for e, own in zip(systems, step.own, strict=True)])
    left = left[np.isfinite(left)]
    # less noise under needles than beside them is that of the film; more may as well be an error of the model, which is each one's own
    under = at_rims(min(usual_square(left), 1.0)) if len(left) >= LEAST else 1.0
    by_noise = [_by_noise(window, e, fit.through) for window, e in zip(windows, systems, strict=True)]
    of_common = _common_errors(fit, by_noise, under)
    out = []
    for window, e, members, scatter in zip(windows, systems, fit.sets, by_noise, strict=True):
        out += _finished(window, e, members, under * scatter, of_common, optics, noise, fit.converged)
    tips = [scatter[: len(e.tips), : len(e.tips)] for scatter, e in zip(by_noise, systems, strict=True)]
    by_ground = errors_by_ground(film, windows, systems, tips, out, fit.through)
    over = [louder(w, e, own, step.change, optics.sigma_px) for w, e, own in zip(windows, systems, step.own, strict=True)]
    more = _more(out, np.concatenate(by_ground), tips, over, noise)
    return [replace(f, covariance_px2=f.covariance_px2 + extra) for f, extra in zip(out, more, strict=True)]


def quietest(film: NDArray[Any], windows: list[Window], systems: list[Equations], noise: NoiseModel) -> Filter:
    """Return the filter with which noise and the film beside some needles move their tips least.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    windows : list of Window
    systems : list of Equations
        One a window.
    noise : NoiseModel

    Returns
    -------
    Filter
    """
    needles = [f for e in systems for f in e.members]
    asked = slice(None, None, 1 + len(systems) // _ASKED)
    variances = {}
    for through in (Filter(noise), Filter(noise, _SQUARE_PX)):
        some = [e.filtered(w, through) for e, w in zip(systems[asked], windows[asked], strict=True)]
        scatter = [_by_noise(w, e, through)[: len(e.tips), : len(e.tips)] for e, w in zip(some, windows[asked], strict=True)]
        by_ground = np.concatenate(errors_by_ground(film, windows[asked], some, scatter, needles, through))
        variances[through] = np.concatenate([s.diagonal() for s in scatter]) + np.einsum("maa->ma", by_ground).ravel()
    plain, fine = (float(np.log(v).mean()) for v in variances.values())
    return list(variances)[fine < plain - _GAIN]


def _by_noise(window: Window, e: Equations, through: Filter) -> Float:
    """Covariance that noise which neighbouring pixels share makes of the tips, and of what the common parameters are estimated from."""
    influence = np.concatenate([e.inverse[e.tips] @ e.own, e.common - e.own_by_common.T @ e.own])
    return window.covariance(window.filtered(influence, through), through.noise)


def _common_errors(fit: AtRest, by_noise: list[Float], under: float) -> Float:
    """Covariance of the common parameters."""
    spread = fit.precision.copy()
    for e, scatter in compress(zip(fit.systems, by_noise, strict=True), fit.telling):
        rest = slice(len(e.tips), None)
        spread += (under * scatter[rest, rest] + e.own_by_common.T @ (e.prior[:, None] ** 2 * e.own_by_common)) / e.excess
    inverse = np.linalg.inv(fit.normal)
    covariance: Float = inverse @ spread @ inverse
    return covariance


def _finished(
    window: Window,
    e: Equations,
    members: list[NeedleFit],
    by_noise: Float,
    errors: Float,
    optics: Optics,
    noise: NoiseModel,
    converged: bool,
) -> list[NeedleFit]:
    by_common, tips = e.own_by_common[e.tips], slice(len(e.tips))
    covariance = by_noise[tips, tips] + by_common @ errors @ by_common.T
    of_prior = e.inverse[e.tips] * e.prior  # what is held near to the expected is not exactly there
    covariance = covariance + of_prior @ of_prior.T
    variance = float(noise.variance_at(np.array([e.shown.background]))[0])
    out = []
    for i, (fit, image) in enumerate(zip(members, e.images, strict=True)):
        at = slice(2 * i, 2 * i + 2)
        fit = replace(fit, covariance_px2=covariance[at, at], converged=converged)
        out.append(scored(fit, image, e.left, e.weight, window.surface, e.shown.background, variance, window.hidden, optics))
    return out


def _more(needles: list[NeedleFit], by_ground: Float, by_noise: list[Float], over: list[float], noise: NoiseModel) -> Float:
    """Covariances (n, 2, 2) by what else lies over needles: what the film beside them promises, or what their fits leave if that is more.

    ``by_noise``: covariances of the tips of each window; ``over``: what to multiply them by.
    """
    out = by_ground.copy()
    each = [(matrix[i : i + 2, i : i + 2], times) for matrix, times in zip(by_noise, over, strict=True) for i in range(0, len(matrix), 2)]
    for k, (own, times) in enumerate(each):
        left = max(times / excess_of(needles[k], noise) - 1.0, 0.0) * own  # by the excess the table widens all of it
        if np.trace(left) > np.trace(out[k]):
            out[k] = left
    return out
