"""What fits leave under balls, against what there is at free places: the noise under marks, which no tile of a film tells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import height_of, over_clutter
from rsa_vision.detect.balls.find import COARSE_SIGMA_PX, SURE, fit_at, guessed_optics
from rsa_vision.detect.balls.fits import BallFits, ball_image, derivatives, half_size, mirrored
from rsa_vision.detect.balls.surroundings import Places, free_places
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.patches import cut
from rsa_vision.detect.film.whitening import whiten
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.types import Bool, Float

_FITTED = 4  # parameters that ``uneven`` counts off
_AT_RIM = 0.7  # the rim, which tells the centre, lies at half the depth; the mean of all that is under a ball at seven tenths
_OUTLIER = 3.0  # times the median
LEAST = 8  # marks, and places, that tell something
_LEAST_PIXELS, BESIDE_NEEDLES = 40.0, 300.0  # under balls; where there are pins or tees, of which some may be parts
_NOTHING = 0.01  # places leave less only where there is no noise
_MOST = 0.4, 2.5  # what they may tell
_WHOLE, _INSIDE = 0.95, 0.8  # of the pixels under a ball, and of its window
_ASKED, _PLACES = 24, 100  # sure candidates; free places of one size, which tell more
_QUARTILE = 0.25  # that tells: what is no ball leaves more
_MORE = 0.3  # part by which the variance under them is more, that is worth it
_BY_CHANCE = 4.5  # two standard deviations of that, of one pixel: of odd parts, and neighbours share theirs
_DOUBLINGS = np.linspace(0.0, 5.0, 21)  # of the variance: hardly anything comes through the middle of a ball where nothing is scattered
_NEAREST = 0.9  # quantile of the backgrounds towards marks, beyond which odd ones may be
_FARTHEST, _FAR = 0.75, 0.5  # quantile of how far marks reach beyond the curve, and part of it from which they tell how it goes on


def noise_at_marks(film: NDArray[Any], seeds: BallFits, noise: NoiseModel, least_pixels: float = _LEAST_PIXELS) -> NoiseModel:
    """Return the noise with its curve carried on to the values under marks, as the film's sure candidates tell it.

    Where a film records the logarithm of the exposure, or anything as steep, the fewer quanta under marks make more noise than there is at
    any background. It is told by the odd part of second differences: a wrong blur leaves nothing odd, bone hardly any differences, and
    neither does what a fit takes up. The lower quartile of candidates and of free places are compared, since what is no ball leaves more.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    seeds : BallFits
        First looks of one polarity.
    noise : NoiseModel
    least_pixels : float
        Under sure candidates, from which they tell.

    Returns
    -------
    NoiseModel
        The same where too few tell, and where there is no more noise; without values beyond a gap, as shutters have.
    """
    if noise.is_lossy:  # free places are quieter than anything around marks
        return noise
    clear = over_clutter(seeds) > SURE * np.sqrt(noise.gain(np.hypot(COARSE_SIGMA_PX, 0.5 * seeds.radius_px)))
    sure = seeds.rows(clear & (seeds.valid_fraction > _WHOLE) & (seeds.window_fraction > _INSIDE))
    if _pixels(sure) < least_pixels:
        return noise
    guess = guessed_optics(float(np.median(sure.radius_px)))
    sign, height = float(np.sign(sure.depth[0])), height_of(sure, guess.sigma_px)
    known, farthest, tell = beyond_curve(noise, sign, sure.background, height)
    sure = sure.rows(tell)
    sure = sure.rows(np.argsort(-sure.significance)[:_ASKED])
    told = _told_by(film, sure, seeds, guess, known, farthest) if _pixels(sure) >= least_pixels else known
    return told.and_beyond(farthest, sign, noise)


def _told_by(film: NDArray[Any], sure: BallFits, seeds: BallFits, guess: Optics, noise: NoiseModel, farthest: float) -> NoiseModel:
    """Carry the noise on to the farthest value, as these candidates tell it; the places of all are not free."""
    places = free_places(film, sure, seeds.position_px, seeds.radius_px + guess.sigma_px, guess, noise)
    reach_px = float(np.median(sure.radius_px)) + guess.sigma_px
    some = [t.values[:: 1 + len(t.values) // _PLACES] for t in places]
    beside = np.concatenate([_ripple(values, noise.variance_at(values.mean(axis=1))[:, None], None, reach_px) for values in some])
    if len(beside) < LEAST:
        return noise
    fits = fit_at(film, sure.position_px, sure.radius_px, guess, noise, quick=True)
    half = half_size(float(fits.radius_px.max()), guess.sigma_px)
    patches = cut(film, fits.position_px, half, noise)
    rows, cols = np.mgrid[0 : patches.size, 0 : patches.size].reshape(2, 1, -1)
    local = fits.position_px - patches.corner_px
    image = fits.depth[:, None] * ball_image(cols - local[:, :1], rows - local[:, 1:], fits.radius_px, guess)
    left, model = patches.values.reshape(image.shape) - image, fits.background[:, None] + image

    def under(trial: NoiseModel) -> float:
        return float(np.quantile(_ripple(left, trial.variance_at(model), local, fits.radius_px + guess.sigma_px), _QUARTILE))

    usual = float(np.quantile(beside, _QUARTILE))
    if not worth_it(under(noise), usual, _pixels(fits)):
        return noise
    return carried_to(noise, farthest, under, usual)


def beyond_curve(noise: NoiseModel, sign: float, background: Float, height: Float) -> tuple[NoiseModel, float, Bool]:
    """Tell how far marks reach beyond the values for which the noise is known.

    Parameters
    ----------
    noise : NoiseModel
    sign : float
        Of their depths.
    background, height : ndarray of shape (n,)
        Of the marks.

    Returns
    -------
    noise : NoiseModel
        Without values beyond a gap, as shutters have.
    farthest : float
        Film value that most marks do not exceed.
    tell : ndarray of bool, shape (n,)
        Which marks reach so far that they tell how the noise goes on; none where most do not reach beyond it.
    """
    noise = noise.before_gap(sign * float(np.quantile(sign * background, _NEAREST)), sign, float(np.quantile(height, _FARTHEST)))
    end = float(noise.level[-1 if sign > 0 else 0])
    reach = sign * (background - end) + height
    farthest = float(np.quantile(reach, _FARTHEST))
    return noise, end + sign * farthest, np.asarray((reach > _FAR * farthest) & (farthest > 0))


def worth_it(under: float, usual: float, pixels: float) -> bool:
    """Say whether what is left of so many pixels under marks is more than the usual, than chance makes it, and worth a curve."""
    return bool(under > (1 + max(_MORE, _BY_CHANCE / np.sqrt(pixels))) * usual)


def carried_to(noise: NoiseModel, value: float, under: Callable[[NoiseModel], float], usual: float) -> NoiseModel:
    """Return the noise with its curve carried on to a value such that what is left under marks is the usual.

    Parameters
    ----------
    noise : NoiseModel
    value : float
        Beyond its curve.
    under : callable
        What is left under marks in units of the variance, given the noise.
    usual : float
        The same where there are no marks.

    Returns
    -------
    NoiseModel
    """
    left = [-under(noise.carried_on(value, 2.0**d)) for d in _DOUBLINGS]
    return noise.carried_on(value, 2.0 ** float(np.interp(-usual, left, _DOUBLINGS)))


def _pixels(fits: BallFits) -> float:
    return float(np.pi * np.square(fits.radius_px).sum())


def _ripple(windows: NDArray[Any], variance: Float, centre: Float | None, reach_px: Float | float) -> Float:
    """Mean square of the odd part of second differences around centres (of the windows, if not given) in units of the variance, (n,)."""
    n, side = len(windows), round(np.sqrt(windows.shape[1]))
    centre = np.full((n, 2), side // 2) if centre is None else centre
    square = windows.reshape(n, side, side).astype(np.float64)
    bent = np.zeros(square.shape)
    bent[:, 1:-1, 1:-1] = 4 * square[:, 1:-1, 1:-1]
    for near in (np.s_[:, :-2, 1:-1], np.s_[:, 2:, 1:-1], np.s_[:, 1:-1, :-2], np.s_[:, 1:-1, 2:]):
        bent[:, 1:-1, 1:-1] -= square[near]
    bent_rows = bent.reshape(windows.shape) / np.sqrt(variance)
    odd = bent_rows - np.take_along_axis(bent_rows, mirrored(centre, side), 1)
    rows, cols = np.mgrid[0:side, 0:side].reshape(2, 1, -1)
    core = np.hypot(cols - centre[:, :1], rows - centre[:, 1:]) < np.broadcast_to(reach_px, n)[:, None]
    return np.asarray((core * odd**2).sum(axis=1) / core.sum(axis=1))


def noise_under(uneven: Float, radius_px: Float, quiet: float, places: list[Places], optics: Optics, noise: NoiseModel) -> float:
    """Return the variance at the rims of a film's balls in units of that beside them, from what all of them leave together.

    The values under marks occur nowhere else on a film, so that no tile tells their noise: quanta are fewer there, the slope of the film
    curve is another, and bone goes on. Of the residuals only the odd part counts, which the model's own errors do not have.

    Parameters
    ----------
    uneven, radius_px : ndarray of shape (n,)
        ``chi2_uneven`` and radii of clear balls.
    quiet : float
        ``chi2_ring`` of clear balls is less; so has it to be on places they are compared with.
    places : list of Places
    optics : Optics
    noise : NoiseModel

    Returns
    -------
    float
        One where too few tell.
    """
    if len(uneven) < LEAST:
        return 1.0
    usual_half = half_size(float(np.median(radius_px)), optics.sigma_px)
    near = [these for these in places if abs(these.half - usual_half) <= 1 and len(these.values)]  # a crowded film has none
    left = [_uneven(these, float(np.median(radius_px)), quiet, optics, noise) for these in near]
    beside = np.concatenate([np.zeros(0), *left])
    if len(beside) < LEAST:
        return 1.0
    usual = max(usual_square(beside), 1.0 if noise.is_lossy else 0.0)  # places where there was nothing have lost nothing
    return at_rims(usual_square(uneven) / usual) if usual > _NOTHING else 1.0


def at_rims(under: float) -> float:
    """Return the variance at the rims of marks, given that under them, in units of that beside them."""
    return float(np.clip(under**_AT_RIM, *_MOST))


def usual_square(squares: Float) -> float:
    """Return the mean of those that are not far beyond the median."""
    return float(squares[squares <= _OUTLIER * np.median(squares)].mean())


def _uneven(places: Places, radius_px: float, quiet: float, optics: Optics, noise: NoiseModel) -> Float:
    """Mean squares of the odd part of what the fit of a ball leaves of quiet places, under where the ball would be."""
    half = places.half
    basis = np.linalg.qr(derivatives(np.array([radius_px]), half, optics)[0].T)[0]
    level = places.values.mean(axis=1, keepdims=True)
    values = (places.values - level) / np.sqrt(noise.variance_at(level))
    rest = values - (values @ basis) @ basis.T
    white = whiten(rest.reshape(-1, 2 * half + 1, 2 * half + 1), noise).reshape(rest.shape)
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    core = np.hypot(cols, rows) < radius_px + optics.sigma_px
    under, ring = (_odd(left, where) for left, where in ((white, core), (rest, ~core)))
    return np.asarray(under[ring < quiet])


def _odd(left: Float, where: Bool) -> Float:
    square = 0.5 * np.square(left - left[:, ::-1])  # windows are symmetric
    return np.asarray(square[:, where].sum(axis=1) / max(np.count_nonzero(where) - _FITTED, 1))
