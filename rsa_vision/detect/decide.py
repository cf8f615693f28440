"""The last decision: which fits are marks. By significance against noise and clutter, and by likeness to the sure ones of the film."""

from __future__ import annotations

import numpy as np

from rsa_vision.detect.balls import RADIUS_PX, BallFits
from rsa_vision.detect.find import MISFIT, misfit
from rsa_vision.detect.noise import NoiseModel
from rsa_vision.types import Bool, Float

SURE = 9.0  # significance over clutter that trabeculae and soft shadows seldom reach; tantalum mostly does
CLOSE = 0.96  # part of the variance that the model explains of a ball that may stand as a pattern for others
FAINT = 0.1  # marks of one film are at least so high against the typical one, whatever lies over them
UNEXCUSED = 0.5  # those below that have to fit closely
EDGE = 16.0  # more variance than this around a ball, in units of the noise, is an edge beside it; edges do not look like balls
SPOT_PX = 0.85  # spread of an image below which it is a faulty pixel or dust on the scanner, not a blurred ball
_LEAST_PATTERNS = 3  # sure balls from which their sizes tell something of the others
_LIKE = 1.25  # images whose spreads are within this factor are of one size
_SMALLER, _LARGER = 0.7, 1.45  # range of sizes around those of the sure ones: marks of one film are of few sizes


def over_clutter(fits: BallFits) -> Float:
    """Return the significance of each ball over noise and the structure around it, shape (n,)."""
    out: Float = fits.significance / np.sqrt(np.clip(fits.chi2_ring, 1.0, EDGE))
    return out


def are_balls(fits: BallFits, limit: float, sigma_px: float, noise: NoiseModel) -> Bool:
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

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    strength = over_clutter(fits)
    spread = np.hypot(sigma_px, 0.5 * fits.radius_px)
    spot = spread < SPOT_PX
    # what would be larger still than the fit may go is no ball of that size
    sure = (strength > max(SURE, limit)) & ~spot & (fits.radius_px < RADIUS_PX[1])
    close = misfit(fits, noise) < MISFIT
    pattern = sure & close & (fits.explained > CLOSE)
    # a size of which there is but one stands for itself only
    company = (np.abs(np.log(spread[pattern, None] / spread[pattern])) < np.log(_LIKE)).sum(1) > 1
    radii = fits.radius_px[pattern][company]
    if len(radii) < _LEAST_PATTERNS:
        return np.asarray(sure)
    height = np.abs(fits.depth) * -np.expm1(-0.5 * (fits.radius_px / sigma_px) ** 2)  # of the blurred image, roughly
    typical = float(np.median(height[pattern]))
    # of fainter things on a film of clear marks noise is no excuse for what the model leaves
    high_enough = height > np.where(close, FAINT, UNEXCUSED) * typical
    sure &= high_enough
    low, high = _SMALLER * float(radii.min()), _LARGER * float(radii.max())
    alike = (pattern | ((fits.radius_px > low) & (fits.radius_px < min(high, RADIUS_PX[1])))) & high_enough
    return np.asarray((fits.significance > limit) & alike & (sure | (strength > 0.5 * SURE)))
