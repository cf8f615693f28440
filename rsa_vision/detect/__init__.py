"""Marker images of one film: tantalum balls, pointed pins and tees, without knowing the cage.

Nothing about the film is taken for granted: polarity, blur, attenuation (with it the bend of the film curve) and noise are
estimated from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.find import significance_limit
from rsa_vision.detect.balls.likeliest import with_bend
from rsa_vision.detect.film.noise import NoiseModel, estimate_noise
from rsa_vision.detect.film.wavelets import height_of_waves
from rsa_vision.detect.marks.found import marks_of
from rsa_vision.detect.marks.polarity import are_of_one_kind, first_looks, is_mottled, likelier, of_doubtful_polarity, polarities
from rsa_vision.detect.marks.response import BITS, high_balls, in_film_values, is_straighter, log_odds
from rsa_vision.detect.marks.waves import like_waves
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.first_pins import MOST_STROKES, look_for_pins
from rsa_vision.detect.search.candidates import STRENGTH, find_candidates
from rsa_vision.detect.search.strokes import at_junctions
from rsa_vision.errors import FilmFormatError
from rsa_vision.images.header import MAX_BITS, MIN_BITS
from rsa_vision.threads import in_one_thread
from rsa_vision.types import MarkerImages

__all__ = ["Detection", "detect_markers"]

_LEAST_PX = 16  # of a side; cuttings of films are welcome, but noise is told by tiles
_BEYOND = 4.0  # times what first looks show of the other polarity: marks that are found leave it no chance


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """What was found on one film, and how the film is.

    Attributes
    ----------
    images : MarkerImages
    dark_markers : bool
        Markers have lower values than their surroundings.
    optics : Optics
        Blur (with the pixel's own) and attenuation.
    noise : NoiseModel
        In the scale in which the film was measured.
    """

    images: MarkerImages
    dark_markers: bool
    optics: Optics
    noise: NoiseModel


@in_one_thread
def detect_markers(values: NDArray[Any], *, bits: int, response: str = "auto", false_detections: float = 0.1) -> Detection:
    """Find and measure all marker images of a film.

    Parameters
    ----------
    values : ndarray of shape (rows, cols)
        uint8 or uint16, of either byte order, at least 16 a side.
    bits : int
        Significant bits, 8 to 16.
    response : str
        ``auto``, ``density``, ``transmission``, ``linear`` or ``log``. The model takes the bend of the response from the film (it shows in
        the profiles as more or less attenuation), so this is a statement about the film, not a switch: nothing here depends on it.
    false_detections : float
        Expected number of marker images on a film that are noise alone.

    Returns
    -------
    Detection

    Raises
    ------
    FilmFormatError
        If the values are no film: of another type or shape, fewer, or beyond the bits.
    """
    values = _film_values(values, bits)
    limit = significance_limit(values.size, false_detections)
    noise = estimate_noise(values, bits)
    found = _detect(values, bits, noise, limit)
    if not found:
        return Detection(MarkerImages.empty(), True, Optics(1.0, 0.5), noise)
    images = [detection.images for _, detection in found]
    which, contested = likelier(images, [evidence for evidence, _ in found])
    chosen = found[which][1]
    doubted = of_doubtful_polarity(chosen.images) if contested else chosen.images
    height = height_of_waves(values, noise.floor, noise.ceiling) / (2**bits - 1)
    return replace(chosen, images=like_waves(doubted, height, chosen.optics))


def _film_values(values: NDArray[Any], bits: int) -> NDArray[Any]:
    """Return the values in the byte order of the machine, or refuse what is no film."""
    values = np.asarray(values)
    if values.ndim != 2 or min(values.shape) < _LEAST_PX:
        raise FilmFormatError(f"an array of shape {values.shape} is no film; give one of (rows, cols), at least {_LEAST_PX} a side")
    if values.dtype.kind != "u" or values.dtype.itemsize > 2:
        raise FilmFormatError(f"values of type {values.dtype} are no film; scale them to the integers of 8 to 16 bits, as uint8 or uint16")
    if not MIN_BITS <= bits <= MAX_BITS:
        raise FilmFormatError(f"{bits} bits; films have {MIN_BITS} to {MAX_BITS}")
    if int(values.max()) >= 2**bits:
        raise FilmFormatError(f"values beyond {bits} bits; give the number of bits that the film has")
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _detect(values: NDArray[Any], bits: int, noise: NoiseModel, limit: float, only: int | None = None) -> list[tuple[float, Detection]]:
    """Return what is found of either polarity worth a look, with its evidence; ``only``: of that, in no other scale of the values."""
    faint = find_candidates(values, noise)
    candidates = faint.rows(np.abs(faint.strength) > STRENGTH)
    # strokes at junctions are arms of tees, most likely: they are looked at once it is known that there are none
    strokes = candidates.strokes[:MOST_STROKES]
    arms = at_junctions(strokes, candidates.junctions)
    pins, candidates = look_for_pins(values, strokes[~arms], noise), replace(candidates, strokes=strokes[arms])
    seeds, signs = first_looks(values, candidates, pins, noise)
    found: list[tuple[float, Detection]] = []
    for seen in polarities(values, signs, seeds, pins, candidates, noise):
        if only not in (None, seen.sign):
            continue
        mottled = is_mottled(seeds, seen.sign, noise)
        # where both show nearly as much, first looks do not say which is which; nor where there may be tees, and bubbles were found
        enough = 0.0 if not seen.rival else np.inf if mottled else _BEYOND * seen.weight
        if found and found[0][0] > enough and (not seen.junctions or are_of_one_kind(found[0][1].images)):
            break
        bright = high_balls(seen.looks, seen.noise)
        if len(bright.depth) and only is None:
            other, its_noise = log_odds(values, bits, noise)
            if is_straighter(values, noise, other, its_noise, bright, seen.optics):
                straight = _detect(other, BITS, its_noise, limit, seen.sign)
                found += [(evidence, replace(each, images=in_film_values(each.images, bits))) for evidence, each in straight]
                continue
        if only is None:  # log odds are as straight as film lets them be
            seen = replace(seen, optics=with_bend(values, seen.looks, seen.optics, seen.noise))
        images, evidence = marks_of(values, bits, seen, pins, candidates, faint, limit, mottled=mottled)
        found.append((evidence, Detection(images, seen.sign < 0, seen.optics, seen.noise)))
    return found
