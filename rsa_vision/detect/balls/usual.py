"""What the balls of a film have in common: their size, and how their depth goes with the background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsa_vision.detect.balls.alike import robust_sd, true_spread
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.types import Bool, Float, Int

_ANYTHING = 9.0  # spread of logarithms: no two balls need be alike
_LEAST_BALLS = 5  # whose depths tell how they go with the background
_LEAST_BENT, _NEAREST = 10, 6  # those whose depths tell it at their own background, and how many do for each
_BENT = 0.7  # of what a straight line leaves of depths, that is left by those at nearly the same background
_SLOPING = 0.5  # of how those differ, that lines through most or through all leave: balls of several kinds have depths apart, and no slope
_UNSEEN = 2.0  # times the slope that they tell: the film shows less of how the light changes beside them as well
_LEAST_VALUE = 1.0  # of a film
_OUTLIER = 3.0
_FEW = 0.25  # clear balls to one that is fitted with an edge, from which they do not tell which sizes are usual
_APART = 1.15  # ratio of radii of two kinds
_LEAST_SIZES = 3  # balls that tell which sizes there are
_COMPANY = 5  # others of its size: nothing beside a ball makes it by chance
_MAGNIFIED = 0.04  # parts by which radii of markers of one size differ that are nearer to the film or farther from it


@dataclass(frozen=True, slots=True)
class Size:
    """Radii of a film's balls.

    Attributes
    ----------
    log_radius, spread : float
        Mean and standard deviation of the logarithm of the radius in pixels.
    """

    log_radius: float
    spread: float

    @property
    def radius_px(self) -> float:
        """Usual radius."""
        return float(np.exp(self.log_radius))

    @property
    def radius_sd_px(self) -> float:
        """By how much radii differ from it."""
        return self.spread * self.radius_px


def kinds_by_size(radius_px: Float, least: int) -> list[Int]:
    """Group balls by size: where radii in a row differ by 15 % and more, smallest first.

    Parameters
    ----------
    radius_px : ndarray of shape (n,)
    least : int
        Balls of one kind. Those of which there are fewer may be something else.

    Returns
    -------
    list of ndarray of int
        Indices; all in one where no kind has so many.
    """
    order = np.argsort(radius_px)
    kinds = np.split(order, np.flatnonzero(np.diff(np.log(radius_px[order])) > np.log(_APART)) + 1)
    return [kind for kind in kinds if len(kind) >= least] or [order]


def over_kinds(radius_px: Float, known_px: Float, least: int) -> tuple[Float, Float]:
    """Return by how much balls are larger than the next smaller kind of known ones, and what radii of that kind differ by.

    Parameters
    ----------
    radius_px : ndarray of shape (n,)
    known_px : ndarray of shape (m,)
    least : int
        As of :func:`kinds_by_size`.

    Returns
    -------
    over, spread : ndarrays of shape (n,)
        Of the logarithms; minus infinity where they are smaller than all.
    """
    size, known = np.log(radius_px), np.log(known_px)
    over, spread = np.full(len(size), -np.inf), np.zeros(len(size))
    for kind in kinds_by_size(known_px, least):
        middle = float(np.median(known[kind]))
        larger = size >= middle
        over[larger] = size[larger] - middle
        spread[larger] = robust_sd(known[kind])
    return over, spread


def usual_size(clear: BallFits) -> Size:
    """Return the size of these balls, with what they truly differ by."""
    centre, spread, _ = true_spread(np.log(clear.radius_px), clear.covariance[:, 2, 2] / clear.radius_px**2)
    return Size(centre, min(spread, _ANYTHING))


def size_unlike(balls: BallFits, clear: BallFits) -> Float:
    """Return by how much the radii of balls differ from the nearest ones of clear balls, squared, beyond what errors explain; shape (n,).

    What pulls at a radius, as a corner or a second edge beside a ball does, pulls at its centre as much. Where clear balls are few, as
    those in nearly saturated film beside a limb full of structure, what most of the others are like is usual as well; and so is a size that
    several others share, as balls that a focal spot draws do. Fewer than three clear ones of about a size tell it only as closely as
    magnification lets it be known; where there is none, another beside an edge does, for no two are pulled to one size. Where film was
    sharpened, all larger balls have an edge around them.
    """
    if len(clear.depth) < _LEAST_SIZES:
        return np.zeros(len(balls.depth))

    def apart(others: BallFits, about_px: Float | float = 0.0) -> Float:
        gap = np.maximum(np.abs(balls.radius_px[:, None] - others.radius_px) - np.reshape(about_px, (-1, 1)), 0.0)
        return np.sort(np.maximum(gap**2 - balls.covariance[:, None, 2, 2] - others.covariance[:, 2, 2], 0.0), axis=1)

    kin = (np.abs(np.log(balls.radius_px[:, None] / clear.radius_px)) < np.log(_APART)).sum(axis=1)
    about_px = np.where(kin < _LEAST_SIZES, _MAGNIFIED * balls.radius_px, 0.0)
    more = apart(clear, about_px)[:, 0]
    if len(balls.depth) > 1:
        more = np.where(kin == 0, np.minimum(more, apart(balls, about_px)[:, 1]), more)
    if len(balls.depth) > _COMPANY:  # no edges pull so many by the same
        more = np.minimum(more, apart(balls)[:, _COMPANY])
    if len(clear.depth) < _FEW * len(balls.depth):
        gap = np.square(balls.radius_px - np.median(balls.radius_px))
        more = np.minimum(more, np.maximum(gap - balls.covariance[:, 2, 2], 0.0))
    return np.asarray(more)


@dataclass(frozen=True, slots=True, eq=False)
class Proportion:
    """Change of balls' depths with the background, both in film values, and its standard deviation; shape (n,)."""

    slope: Float
    sd: Float

    def rows(self, which: Int) -> Proportion:
        """Return those that ``which`` selects."""
        return Proportion(self.slope[which], self.sd[which])

    def but_of_hidden(self, hidden: Bool) -> Proportion:
        """Return the same, but not for these: slopes of a background that is not seen are none to be told, and would bend rims."""
        return Proportion(np.where(hidden, 0.0, self.slope), np.where(hidden, np.hypot(self.slope, self.sd), self.sd))


def proportion(depth: Float, background: Float, beside: Float, at: Float) -> Proportion:
    """Tell how depths go with the background: not at all on logarithmic films, like it on linear ones, near the end of a curve as it bends.

    The fits' own backgrounds have errors that are those of the depths with the other sign. Values farther off have not, and go with the
    backgrounds all the same: they are the instrument of the regression (Wright, 1928), by their ranks. The prior is centred on none and as
    wide as a linear film's. Where the depths of others at nearly the same background foretell each depth much better than a straight line
    or the usual depth does, they tell the slope there.

    Parameters
    ----------
    depth, background : ndarray of shape (m,)
        Of clear balls.
    beside : ndarray of shape (m,)
        Values of the film beside them.
    at : ndarray of shape (n,)
        Backgrounds of the balls of which it is asked.

    Returns
    -------
    Proportion
    """
    slope, sd = proportion_of_all(depth, background, beside)
    if len(depth) < _LEAST_BENT:
        return Proportion(np.full(len(at), slope), np.full(len(at), sd))
    gap = np.abs(background[:, None] - background)
    others = np.argsort(gap + np.diag(np.full(len(gap), np.inf)), axis=1)[:, :_NEAREST]
    line, (near, _, _, rest) = _lines(depth[None], background[None], background)[0], _lines(depth[others], background[others], background)
    left, by_line, at_all = (float(np.median(np.abs(depth - of))) for of in (near, line, np.median(depth)))
    differ = np.maximum(depth[others].std(axis=1, ddof=1), 1e-12)
    sloping = min(float(np.median(rest / differ)), float(np.sqrt((rest @ rest) / (differ @ differ)))) < _SLOPING
    if left > _BENT * min(by_line, at_all) or not sloping:  # a few of another kind turn a line, and none
        return Proportion(np.full(len(at), slope), np.full(len(at), sd))
    order = np.argsort(np.abs(at[:, None] - background), axis=1)
    (_, local, error, _), (_, wider, _, _) = (
        _lines(depth[order[:, :count]], background[order[:, :count]], at) for count in (_NEAREST, 2 * _NEAREST)
    )
    return Proportion(local, np.sqrt(error**2 + (0.5 * (local - wider)) ** 2 + (_UNSEEN * local) ** 2))


def _lines(depth: Float, background: Float, at: Float) -> tuple[Float, Float, Float, Float]:
    """Return what straight lines through depths (n, k) come to at backgrounds (n,), their slopes, the errors of these, and what is left."""
    off = background - background.mean(axis=1, keepdims=True)
    square = np.maximum((off**2).sum(axis=1), 1e-12)
    slope = (off * depth).sum(axis=1) / square
    off_line = depth - depth.mean(axis=1, keepdims=True) - slope[:, None] * off
    left = np.sqrt((off_line**2).sum(axis=1) / (depth.shape[1] - 2))
    return depth.mean(axis=1) + slope * (at - background.mean(axis=1)), slope, left / np.sqrt(square), left


def proportion_of_all(depth: Float, background: Float, beside: Float) -> tuple[float, float]:
    """Return the slope of a straight line through depths by background, and its error; arguments as of :func:`proportion`."""
    if len(depth) == 0:
        return 0.0, 0.0
    of_linear = abs(float(np.median(depth))) / max(abs(float(np.median(background))), _LEAST_VALUE)
    if len(depth) < _LEAST_BALLS:
        return 0.0, of_linear
    rank = np.argsort(np.argsort(beside)) - 0.5 * (len(beside) - 1)
    middle = float(np.median(depth))
    far = _OUTLIER * robust_sd(depth)
    depth = np.clip(depth, middle - far, middle + far)
    shared = float(rank @ background)
    if shared <= 0:
        return 0.0, of_linear
    slope = float(rank @ depth) / shared
    left = depth - depth.mean() - slope * (background - background.mean())
    error = float(np.sqrt(left @ left / (len(left) - 2) * (rank @ rank))) / shared
    drawn = 1 + (error / of_linear) ** 2
    return slope / drawn, error / float(np.sqrt(drawn))
