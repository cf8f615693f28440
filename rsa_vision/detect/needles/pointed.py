"""Whether fits are pointed pins: against rods, and against the same the other way round."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import MISFIT
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit, either_way, turned, unexplained
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.needles.crossing import Unseen, chi2_of, fit_crossing, left_under, window_of
from rsa_vision.detect.needles.fits import STANDS_OUT, explains, fit_needles, significant_misfit

SLIM = 4.5  # length over half the width; two balls side by side have four
EXPLAINED = 0.95  # of a pin's image; long shadows and the strokes of letters leave more
SIGNIFICANT, _CHANCE = 9.0, 2.0  # and standard deviations of what noise leaves under a pin
SURER_THAN_ROD = 12.0  # half the chi2 by which a rod must be worse
_ALONE = 5.0  # standard deviations of one pixel: lower ones, of which there are fewer, may be anything as long
_SLENDER = 8.0  # length over half the width, of pins 0.5 mm thick and 2 mm long
_RATHER_THAN_ROD, RATHER_THAN_TURNED, _ONE_WAY = 2.5, 7.0, 2.5  # the last for what has been told from a rod already
_OF_LEFT = 0.5  # of the chi2 that a fit leaves beyond noise, by which the same the other way round must be worse
_ROD = 0.02  # taper of a rod: blunt
LEAST_OF_A_KIND = 3  # clear pins from which a film is one of pins: others then need less
STANDS_OUT_ROUGHLY = 11.0  # significance from which noise may hide the form of a first look, and of one of a kind
_SAMPLE = 6
_AS_LONG = 2.0  # ratio of length to the typical one: the pins of a film are of few sizes


def is_slim(fit: NeedleFit) -> bool:
    """Say whether a fit is longer than two balls side by side."""
    return fit.shape.length_px > SLIM * fit.shape.half_width_px


def is_pin(fit: NeedleFit, noise: NoiseModel, stands_out: float = STANDS_OUT) -> bool:
    """Say whether a fit looks like a pin: little misfit that chance does not explain, slim, all of it on the film.

    ``stands_out``: significance from which noise may hide its form.
    """
    if not np.isfinite(fit.misfit) or fit.significance < SIGNIFICANT or fit.valid_fraction < 0.9:
        return False
    by_chance = _CHANCE * float(noise.scatter(np.array(fit.n_core)))
    return bool(is_slim(fit) and significant_misfit(fit, noise) < MISFIT and explains(fit, EXPLAINED, stands_out, by_chance))


def pointed(film: NDArray[Any], pins: list[NeedleFit], optics: Optics, noise: NoiseModel) -> list[NeedleFit]:
    """Keep what is no rod; where noise hides the points of some, those of their kind tell that they are pins.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    pins : list of NeedleFit
        What may be pins, best first.
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    list of NeedleFit
    """
    surer = [surer_than_rod(film, f, optics, noise) for f in pins]
    alone = [by > SURER_THAN_ROD and is_pin(f, noise) for f, by in zip(pins, surer, strict=True)]
    clear = [f for f, enough in zip(pins, alone, strict=True) if enough]
    typical = float(np.median([f.shape.length_px for f in clear[:_SAMPLE]])) if clear else np.nan
    clear = [f for f in clear if _about_as_long(f, typical)]
    if len(clear) < LEAST_OF_A_KIND:
        return [f for f in clear if shows_its_form(f, noise)]
    kept = list(clear)
    for fit, enough in zip(pins, alone, strict=True):
        if not enough:
            ways = [fit, fit_needles(film, *turned(fit), fit.shape, optics, noise)]
            best, other = sorted(ways, key=unexplained)
            rather = is_pin(best, noise, STANDS_OUT_ROUGHLY) and _about_as_long(best, typical)
            rather = rather and worse_by(film, best, other, optics, noise) > RATHER_THAN_TURNED
            kept += [best] if rather and surer_than_rod(film, best, optics, noise) > _RATHER_THAN_ROD else []
    return kept


def _about_as_long(fit: NeedleFit, typical_px: float) -> bool:
    return 1 / _AS_LONG < fit.shape.length_px / typical_px < _AS_LONG


def shows_its_form(pin: NeedleFit, noise: NoiseModel) -> bool:
    """Say whether no noise hides the form of a pin, which a shorter one has less of: without company nothing else tells what it is."""
    shorter = max(_SLENDER * pin.shape.half_width_px / pin.shape.length_px, 1.0)
    return pin.height > _ALONE * shorter * float(np.sqrt(noise.variance_at(np.array(pin.background))))


def points_one_way(
    film: NDArray[Any], fit: NeedleFit, others: Images | None, optics: Optics, noise: NoiseModel, unseen: Unseen | None = None
) -> bool:
    """Say whether the same pin the other way round leaves more than noise, and what the fit leaves itself, let it.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    fit : NeedleFit
    others : callable, optional
        Images of neighbours.
    optics : Optics
        With how depths go with the background: where that is dark either end fades out.
    noise : NoiseModel
    unseen : callable, optional
        Pixels that are left out.

    Returns
    -------
    bool
    """
    both = [fit_crossing(film, [f], optics, noise, others=others, unseen=unseen, edge=fit.edged)[0] for f in either_way(fit)]
    of_own, of_other = (f.chi2_core * fit.n_core for f in both)
    if _surely_more(of_own, of_other, fit.n_core):
        return True
    # the other may leave as little of its own image, a half of the pin: on the same pixels it leaves more
    window = window_of(film, both, optics, noise, others, unseen=unseen)
    if fit.edged:
        window = window.with_edge(both[:1], optics)
    (left, more), pixels = left_under(window, both, optics, noise)
    return _surely_more(left, more, pixels)


def _surely_more(left: float, more: float, pixels: int) -> bool:
    """Say whether of so many pixels something leaves more than what leaves less, by chance and by what that leaves beyond noise."""
    return bool(more - left > 2 * _ONE_WAY * max(left / max(pixels, 1), 1.0) + _OF_LEFT * max(left - pixels, 0.0))


def surer_than_rod(film: NDArray[Any], fit: NeedleFit, optics: Optics, noise: NoiseModel) -> float:
    """Return half the chi2 by which a rod of free length, width and direction in the pin's place is worse."""
    thinner = replace(fit.shape, taper=_ROD, half_width_px=0.7 * fit.shape.half_width_px, length_px=0.8 * fit.shape.length_px)
    back = fit.position_px + 0.2 * fit.shape.length_px * fit.way
    return worse_by(film, fit, fit_needles(film, back, fit.angles, thinner, optics, noise), optics, noise)


def worse_by(film: NDArray[Any], fit: NeedleFit, other: NeedleFit, optics: Optics, noise: NoiseModel) -> float:
    """Return half the chi2 by which another fit in the place of one is worse, on the same pixels."""
    window = window_of(film, [fit], optics, noise, None)
    of_fit, of_other = (chi2_of(window, f, optics, noise) for f in (fit, other))
    return 0.5 * (of_other - of_fit) / max(of_fit / len(window.data), 1.0)
