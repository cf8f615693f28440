"""The last decision: which fits are marks. By significance against noise and clutter, and by likeness to the sure ones of the film."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls.find import CHANCE, DOUBTFUL, EXPLAINED, MISFIT, QUIET, SURE, misfit, plausible
from rsa_vision.detect.balls.fits import RADIUS_PX, BallFits
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.models.needles import NeedleFit
from rsa_vision.types import Bool, Float

ALONE = 10.0  # the same for marks of which there are not enough to tell what they are like
_AMONG_MOTTLE = 20.0  # and those on films of which the other polarity shows nearly as much
CLOSE = 0.96  # part of the variance that the model explains of a ball that may stand as a pattern for others
FAINT = 0.1  # marks of one film are at least so high against the typical one, whatever lies over them
_LOST = 0.75  # of that, below which a first fit is too low for a mark
_LOW = 0.25  # quantile of the film's needles that are compared
UNEXCUSED = 0.5  # those below that have to fit closely
EDGE = 16.0  # more variance than this around a ball, in units of the noise, is an edge beside it; edges do not look like balls
SPOT_PX = 0.85  # spread of an image below which it is a faulty pixel or dust on the scanner, not a blurred ball
_LEAST_ROUND_PX = 1.0  # radius from which four pixels are seen of, or more: one pixel has any form
LEAST_KNOWN = 3  # balls that tell what one of them is like on this film
_COMPANY = 6  # sure ones of one size that stand for each other where none is clear enough for a pattern
# as many of one size and height that noise alone would not make, so many times those nearly as significant: of mottle there are the more,
# the less significant
_MANY, _OF_BELOW, _NEARLY = 8, 3.0, 0.85
_LIKE = 1.25  # images whose spreads are within this factor are of one size
_SMALLER, _LARGER = 0.7, 1.45  # range of sizes around those of the sure ones: marks of one film are of few sizes
_OF_CLEAR = 1.25  # ratio to the radius of any clear ball, where that is asked for
_FAR = 1.5  # beyond that range, and twice the misfit that a ball may leave: no better fit comes back from there


def over_clutter(fits: BallFits) -> Float:
    """Return the significance of each ball over noise and the structure around it, shape (n,)."""
    out: Float = fits.significance / np.sqrt(np.clip(fits.chi2_ring, 1.0, EDGE))
    return out


def look_clear(fits: BallFits, noise: NoiseModel) -> Bool:
    """Say which first fits show what balls of the film are like; hardly anything but balls is among them."""
    return _rather_on_film((over_clutter(fits) > SURE) & (misfit(fits, noise) < MISFIT) & (fits.explained > CLOSE), fits)


def like_clear(fits: BallFits, known: BallFits, limit: float, noise: NoiseModel) -> Bool:
    """Say which are of the size of a clear ball among those known, sure, and described well: for places where much else may pass for one.

    Parameters
    ----------
    fits, known : BallFits
    limit : float
        Significance that noise alone would exceed too often.
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    clear = known.radius_px[look_clear(known, noise)]
    size = np.abs(np.log(fits.radius_px[:, None] / clear)).min(axis=1, initial=np.inf) < np.log(_OF_CLEAR)
    close = plausible(fits, noise) & (misfit(fits, noise) < DOUBTFUL * MISFIT)
    return np.asarray(size & close & (over_clutter(fits) > max(SURE, limit)))


def hopeless(fits: BallFits, sigma_px: float, noise: NoiseModel) -> Bool:
    """Say which first fits are not worth better ones: far fainter than the film's sure balls, or fainter, unlike balls and of other sizes.

    Parameters
    ----------
    fits : BallFits
        With the blur of the film.
    sigma_px : float
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
        None where too few balls are sure.
    """
    pattern = look_clear(fits, noise)
    radii = _sizes(fits, pattern, sigma_px)
    if len(radii) < LEAST_KNOWN:
        return np.zeros(len(pattern), bool)
    height = height_of(fits, sigma_px)
    faint = (height < UNEXCUSED * np.median(height[pattern])) & (fits.explained < EXPLAINED)
    unlike = ~_near_in_size(fits, radii) | (misfit(fits, noise) > 2 * MISFIT)
    over_noise = height / np.sqrt(noise.variance_at(fits.background))
    lost = np.logical_and(*(h < _LOST * FAINT * np.median(h[pattern]) for h in (height, over_noise)))
    return np.asarray((faint & unlike) | lost)


def of_size(fits: BallFits, sigma_px: float, noise: NoiseModel) -> Bool:
    """Say which fits are clear, or of a size from which a better one may come to that of clear ones; as for :func:`hopeless`."""
    pattern = look_clear(fits, noise)
    radii = _sizes(fits, pattern, sigma_px)
    return np.asarray(pattern | _near_in_size(fits, radii)) if len(radii) >= LEAST_KNOWN else np.ones(len(pattern), bool)


def _near_in_size(fits: BallFits, radii: Float) -> Bool:
    high = min(_FAR * _LARGER * float(radii.max()), RADIUS_PX[1])
    return np.asarray((fits.radius_px >= _SMALLER / _FAR * radii.min()) & (fits.radius_px < high))


def are_balls(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel, *, mottled: bool = False, plain: bool = False) -> Bool:
    """Say which balls are marks.

    Parameters
    ----------
    fits : BallFits
        That look like balls.
    limit : float
        Significance that noise alone would exceed too often.
    sigma_px : float
        Blur of the film.
    noise : NoiseModel
    mottled : bool
        The other polarity looks much the same: that there are many of one size says nothing.
    plain : bool
        All but what may be balls is noise: no more is asked of many of one size than what that would not make.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    strength, height = over_clutter(fits), height_of(fits, sigma_px)
    seen = noise.rises_above(height, fits.background)
    sure, close = _are_sure(fits, limit, sigma_px, noise) & seen, misfit(fits, noise) < MISFIT
    pattern, radii = _pattern(fits, sure & close, sigma_px)
    if len(radii) < LEAST_KNOWN:
        # noise hides what marks are like here: those without company have to be clearer, and among structure noise is no excuse
        whole = sure & (misfit(fits, noise, CHANCE) < MISFIT)  # mottle and the crossings of ribs and vessels leave more than noise
        spread = _spread(fits, sigma_px)
        known = whole & (_of_like_spread(spread, whole) >= _COMPANY) & (not mottled)
        fair = whole & (close | ((fits.chi2_ring < QUIET) & (not mottled))) & ~_soft_shadows(fits.radius_px, height, known)
        alone = fair & (strength > (_AMONG_MOTTLE if mottled else ALONE))
        among = fair & (_of_like_spread(spread, alone) >= LEAST_KNOWN) & (not mottled)
        if plain:
            known |= above_noise(fits, limit, sigma_px, noise) & seen
        return np.asarray(known | alone | among | (_like_these(known, fits, height) & (strength > max(0.5 * SURE, limit)) & seen))
    typical = float(np.median(height[pattern]))
    # of fainter things on a film of clear marks noise is no excuse for what the model leaves
    least = np.where(close, FAINT, UNEXCUSED)
    # where few quanta come through a linear film shows small depths, and little noise: either may be compared
    over_noise = height / np.sqrt(noise.variance_at(fits.background))
    high_enough = (height > least * typical) | (over_noise > least * np.median(over_noise[pattern]))
    # and at the ends of a film curve all is low: there it is those on about the same background that tell
    told = pattern | (sure & close & (fits.explained > CLOSE) & high_enough)
    high_enough |= height > UNEXCUSED * _near_in_background(height, fits.background, told)
    sure &= high_enough
    low, high = _SMALLER * float(radii.min()), _LARGER * float(radii.max())
    alike = (pattern | ((fits.radius_px > low) & (fits.radius_px < min(high, RADIUS_PX[1])))) & high_enough
    if not mottled:  # smaller ones may be too faint for a pattern; where all around is noise, several of one size are marks as well
        quiet = sure & (misfit(fits, noise, CHANCE) < MISFIT) & (fits.chi2_ring < QUIET) & (strength > ALONE)
        alike |= quiet & (fits.radius_px < high) & (_of_like_spread(_spread(fits, sigma_px), quiet) >= LEAST_KNOWN)
    return np.asarray((fits.significance > limit) & seen & alike & (sure | (strength > 0.5 * SURE)))


def above_noise(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel) -> Bool:
    """Say which are of many of one size and height that noise would not make; as for :func:`are_balls`.

    Where neighbours share noise, or marks are small, none stands out far. But of noise, or mottle, there is the more the less significant.
    """
    height = height_of(fits, sigma_px)
    even = (fits.chi2_ring < QUIET) & (misfit(fits, noise, CHANCE) < MISFIT) & (fits.radius_px < RADIUS_PX[1])
    above = even & (fits.significance > limit)
    below = even & ~above & (fits.significance > _NEARLY * limit)
    if np.count_nonzero(above) < _MANY:
        return np.zeros(len(even), bool)
    spread, typical = _spread(fits, sigma_px), float(np.median(height[above]))
    like = above & (height > UNEXCUSED * typical) & (height < typical / UNEXCUSED)
    among = _of_like_spread(spread, like)
    return np.asarray(like & (among >= _MANY) & (among > _OF_BELOW * _of_like_spread(spread, below)))


def _near_in_background(height: Float, background: Float, known: Bool) -> Float:
    """Median height of the few known ones next to each in background, shape (n,)."""
    away = np.abs(background[:, None] - background[known])
    nearest = np.argsort(away, axis=1, kind="stable")[:, :LEAST_KNOWN]
    return np.asarray(np.median(height[known][nearest], axis=1))


def show_what_marks_are_like(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel) -> bool:
    """Say whether some balls are so clear that they tell what others of the film are like; as for :func:`are_balls`."""
    clear = _are_sure(fits, limit, sigma_px, noise) & (misfit(fits, noise) < MISFIT)
    return len(_pattern(fits, clear, sigma_px)[1]) >= LEAST_KNOWN


def _are_sure(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel) -> Bool:
    spread = _spread(fits, sigma_px)
    spot = spread < SPOT_PX
    # faulty pixels and dust are of any form: what sharpened films show of small balls is round, each like the next
    ball = spot & look_clear(fits, noise) & (misfit(fits, noise) < DOUBTFUL * MISFIT) & (fits.radius_px > _LEAST_ROUND_PX)
    spot &= ~(ball & (_of_like_spread(spread, ball) >= _COMPANY))
    # what would be larger still than the fit may go is no ball of that size
    return np.asarray((over_clutter(fits) > max(SURE, limit)) & ~spot & (fits.radius_px < RADIUS_PX[1]))


def _pattern(fits: BallFits, clear: Bool, sigma_px: float) -> tuple[Bool, Float]:
    """Say which stand as a pattern for others, and of which radii."""
    pattern = _rather_on_film(_not_faint(clear & (fits.explained > CLOSE), height_of(fits, sigma_px), fits), fits)
    return pattern, _sizes(fits, pattern, sigma_px)


def _rather_on_film(pattern: Bool, fits: BallFits) -> Bool:
    """Leave out those in saturated film, where enough others tell: their depths are no more than the fits make of their middles."""
    seen = pattern & (fits.hidden == 0)
    return seen if np.count_nonzero(seen) >= LEAST_KNOWN else pattern


def faint_beside(fits: BallFits, needles: list[NeedleFit], sigma_px: float, noise: NoiseModel) -> Bool:
    """Say which balls are far fainter than the film's pins and tees, whose metal they share: mottle, on films of hardly any noise.

    Parameters
    ----------
    fits : BallFits
    needles : list of NeedleFit
    sigma_px : float
        Blur of the film.
    noise : NoiseModel

    Returns
    -------
    ndarray of bool, shape (n,)
        In film values and against the noise; none where too few needles tell.
    """
    if len(needles) < LEAST_KNOWN:
        return np.zeros(len(fits.depth), bool)
    height, background = np.abs([[f.height, f.background] for f in needles]).T
    mine, noises = height_of(fits, sigma_px), [np.sqrt(noise.variance_at(at)) for at in (fits.background, background)]
    low = mine < FAINT * np.quantile(height, _LOW)
    return np.asarray(low & (mine / noises[0] < FAINT * np.quantile(height / noises[1], _LOW)))


def _like_these(known: Bool, fits: BallFits, height: Float) -> Bool:
    """Say what is no smaller, larger or much fainter than these."""
    if not known.any():
        return known
    low, high = fits.radius_px[known].min(), fits.radius_px[known].max()
    return np.asarray((fits.radius_px >= low) & (fits.radius_px <= high) & (height > UNEXCUSED * np.median(height[known])))


def _soft_shadows(radius_px: Float, height: Float, known: Bool) -> Bool:
    """Say what is larger than all known balls and fainter: a larger ball takes away more."""
    if not known.any():
        return np.zeros(len(known), bool)
    return np.asarray((radius_px > _LARGER * radius_px[known].max()) & (height < UNEXCUSED * np.median(height[known])))


def _not_faint(pattern: Bool, height: Float, fits: BallFits) -> Bool:
    """Take from patterns what is faint: a crowd of that, as edges make it on a film without noise, does not say what is usual.

    Nor does a letter or two on a bright rim, as several balls that lap: there marks behind a limb are faint as well.
    """
    ranked = np.sort(height[pattern])
    total = np.cumsum(ranked)
    usual = ranked[np.searchsorted(total, 0.5 * total[-1])] if len(ranked) else 0.0
    high = np.asarray(pattern & (height > FAINT * usual))
    rest = pattern & ~high
    few = not _are_at(fits.rows(high), LEAST_KNOWN) and _are_at(fits.rows(rest), _COMPANY)
    return _not_faint(rest, height, fits) if few else high


def _are_at(fits: BallFits, count: int) -> bool:
    """Say whether balls are at so many places or more; those that lap are at one."""
    places = np.zeros((0, 3))
    for at, radius in zip(fits.position_px, fits.radius_px, strict=True):
        if len(places) == count:
            break
        if not (np.hypot(*(places[:, :2] - at).T) < places[:, 2] + radius).any():
            places = np.append(places, [[*at, radius]], axis=0)
    return len(places) >= count


def _spread(fits: BallFits, sigma_px: float) -> Float:
    return np.asarray(np.hypot(sigma_px, 0.5 * fits.radius_px))


def _sizes(fits: BallFits, pattern: Bool, sigma_px: float) -> Float:
    """Radii of those that may stand as a pattern; a size of which there is but one stands for itself only."""
    company = _of_like_spread(_spread(fits, sigma_px), pattern) > 1
    return np.asarray(fits.radius_px[pattern & company])


def _of_like_spread(spread: Float, among: Bool) -> Float:
    """Count those of a choice whose images are of one size with each, shape (n,)."""
    return np.asarray((np.abs(np.log(spread[:, None] / spread[among])) < np.log(_LIKE)).sum(axis=1))


def height_of(fits: BallFits, sigma_px: float) -> Float:
    """Return the heights of the blurred images, roughly, shape (n,)."""
    return np.asarray(np.abs(fits.depth) * -np.expm1(-0.5 * (fits.radius_px / sigma_px) ** 2))
