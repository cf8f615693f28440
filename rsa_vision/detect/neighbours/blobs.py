"""Two balls melted into one blob: told from one ball by what that cannot explain, started from the blob's length and direction."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsa_vision.detect.balls.decide import look_clear
from rsa_vision.detect.balls.find import SURE, plausible
from rsa_vision.detect.balls.fits import BallFits
from rsa_vision.detect.balls.usual import kinds_by_size
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.places import gaps
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.models.shown import Images
from rsa_vision.detect.neighbours.groups import fit_group
from rsa_vision.types import Float

LEAST_APART = 0.7  # of the radius: nearer centres cannot be told apart with confidence, and pass for one place
LEAST_GAIN = 30.0  # twice the log-likelihood that four parameters more must gain
STRETCH = (1.0, 1.5)  # of the separation that the second moments suggest
_BLOB = (0.7, 2.2)  # radii of blobs, relative to the film's balls, that two of those may make
_DEPTH, _DEPTH_GUESSED = (0.4, 2.5), (0.4, 5.0)  # depths of the two, relative to balls of their size, or to what one ball makes of both
OF_A_BLOB = 0.8  # of the radius of a ball fitted to two
_ALIKE, _GUESSED = 0.3, 0.6  # logarithms of radii of one size, and of one of which no more is known than what two make together
CLEAR, NEARLY = 2.0 * SURE, 0.6  # significance of blobs that tell, and the part of blobs that one ball explains
_VAIN = 40  # attempts of a film that may fail
_COMPANY = 2  # balls of one size


def split_blobs(
    film: NDArray[Any],
    blobs: BallFits,
    balls: BallFits,
    optics: Optics,
    noise: NoiseModel,
    beside: Callable[[], Images],
) -> list[BallFits]:
    """Explain blobs that are no single balls by two.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    blobs : BallFits
        Single fits that were turned down.
    balls : BallFits
        Those that were not: what two balls have to be like. Where there are none, the surest blobs tell.
    optics : Optics
    noise : NoiseModel
    beside : callable
        ``beside()``: images of the known balls and tees, for the fits to subtract.

    Returns
    -------
    list of BallFits
        Pairs that explain their blob.
    """
    like = balls if len(balls.depth) else blobs.rows((blobs.significance > CLEAR) & (blobs.explained > NEARLY))
    if len(like.depth) == 0:
        return []
    usual = _usual(like)
    guessed = not len(balls.depth)
    sizes = [_Size(OF_A_BLOB * usual.radius, usual.depth)] if guessed else _sizes(like, noise)
    least_radius, most_radius, least_depth = min(s.radius for s in sizes), max(s.radius for s in sizes), min(s.depth for s in sizes)
    worth = (blobs.radius_px > _BLOB[0] * least_radius) & (blobs.radius_px < _BLOB[1] * most_radius)
    deep = np.abs(blobs.depth) > _DEPTH[0] * least_depth
    # how deep balls hardly wider than the blur are is not told, but how much they take away in all
    deep |= np.abs(blobs.depth) * blobs.radius_px**2 > min(s.depth * s.radius**2 for s in sizes)
    worth &= deep & (blobs.explained > NEARLY)
    of_length = noise.gain_of_length(float(np.hypot(optics.sigma_px, most_radius / 2)))
    out: list[BallFits] = []
    tried = 0
    for i in np.nonzero(worth)[0]:
        if tried - len(out) == _VAIN:
            break
        place = blobs.position_px[i]
        if any(np.hypot(*(pair.position_px - place).T).min() < least_radius for pair in out):
            continue
        tried += 1
        others = beside()
        whole = fit_group(film, place[None], blobs.radius_px[[i]], optics, noise, others)
        least = LEAST_GAIN * of_length / float(whole.n_core[0])
        if whole.chi2_core[0] <= least:
            continue  # even two that left nothing would not be better by enough
        axis = long_axis(film, whole, np.sign(blobs.depth[i]))
        for offsets, radius in _starts(sizes):
            starts = whole.position_px + offsets[:, None] * axis
            pair = fit_group(film, starts, radius, optics, noise, others)
            if _two(pair, whole, sizes, least, noise, guessed=guessed):
                if not any(_same(pair, known) for known in out):  # a look between two, and one at either of them
                    out.append(pair)
                break
    return _of_one_size(out) if guessed else out


def _same(pair: BallFits, other: BallFits) -> bool:
    """Say whether each of two balls lies on one of two others."""
    return bool((gaps(pair.position_px, other.position_px).min(axis=1) < LEAST_APART * pair.radius_px).all())


def _of_one_size(pairs: list[BallFits]) -> list[BallFits]:
    """Leave out pairs of another size than is usual, where pairs alone tell what that is."""
    radius = np.array([pair.radius_px for pair in pairs]).reshape(-1, 2)
    odd = np.abs(np.log(radius / np.median(radius))).max(axis=1, initial=0.0) > _ALIKE if len(pairs) else np.zeros(0, bool)
    return [pair for pair, apart in zip(pairs, odd, strict=True) if not apart]


@dataclass(frozen=True, slots=True)
class _Size:
    """What balls of one size are like on a film."""

    radius: float
    depth: float


def _usual(balls: BallFits) -> _Size:
    return _Size(float(np.median(balls.radius_px)), float(np.median(np.abs(balls.depth))))


def _sizes(balls: BallFits, noise: NoiseModel) -> list[_Size]:
    """Sizes of the film's balls, the most common first, as far as clear ones tell; of which there is but one ball may be something else."""
    clear = balls.rows(look_clear(balls, noise))
    if len(clear.depth) < _COMPANY:
        return [_usual(balls)]
    kinds = kinds_by_size(clear.radius_px, _COMPANY)
    return [_usual(clear.rows(kind)) for kind in sorted(kinds, key=len, reverse=True)]


def _starts(sizes: list[_Size]) -> Iterator[tuple[Float, Float]]:
    """Places of two balls along the axis of a blob, in its lengths, and their radii: of any two sizes, from either end."""
    for i, one in enumerate(sizes):
        for two in sizes[: i + 1]:
            for first, second in [(one, two)] if one is two else [(one, two), (two, one)]:
                share = first.depth * first.radius**2, second.depth * second.radius**2
                part = share[0] / sum(share)
                between = 0.5 / np.sqrt(part * (1 - part))  # the blob's second moments are part (1 - part) of the square of this
                for stretch in STRETCH:
                    yield stretch * between * np.array([part - 1, part]), np.array([first.radius, second.radius])


def _two(pair: BallFits, whole: BallFits, sizes: list[_Size], least: float, noise: NoiseModel, *, guessed: bool) -> bool:
    """Say whether these are two balls of the sizes of the film's, which may be no more than guessed."""
    within, (shallow, deepest) = (_GUESSED, _DEPTH_GUESSED) if guessed else (_ALIKE, _DEPTH)
    apart = float(np.hypot(*(pair.position_px[1] - pair.position_px[0])))
    radius, depth = (np.array([getattr(s, of) for s in sizes]) for of in ("radius", "depth"))
    size = np.abs(np.log(pair.radius_px[:, None] / radius))
    deep = np.abs(pair.depth)[:, None] / depth
    alike = ((size < within) & (deep > shallow) & (deep < deepest)).any(axis=1)
    one_sign = pair.depth[0] * pair.depth[1] > 0
    of_size = radius[size.argmin(axis=1)]
    held = bool((np.hypot(*(pair.position_px - whole.position_px[0]).T) < 2.5 * of_size.mean()).all())
    # the window of two is larger than that of one: compare what is left under the balls only
    better = whole.chi2_core[0] - float(pair.chi2_core.mean()) > least
    far = apart > LEAST_APART * of_size.mean()
    return bool(far and alike.all() and one_sign and held and better and plausible(pair, noise).all())


def long_axis(film: NDArray[Any], blob: BallFits, sign: float) -> Float:
    """Vector along a blob from the centre of one ball to that of the other, by the second moments of what lies over the background."""
    centre = blob.position_px[0]
    reach = int(np.ceil(2.2 * blob.radius_px[0] + 2))
    col, row = np.rint(centre).astype(np.intp)
    top, left = max(row - reach, 0), max(col - reach, 0)
    window = film[top : row + reach + 1, left : col + reach + 1].astype(np.float64)
    rows, cols = np.mgrid[0 : window.shape[0], 0 : window.shape[1]]
    dx, dy = cols + left - centre[0], rows + top - centre[1]
    over = np.maximum(sign * (window - blob.background[0]), 0.0) * (np.hypot(dx, dy) < reach)
    total = max(float(over.sum()), 1e-9)
    moments = np.array([[(over * dx * dx).sum(), (over * dx * dy).sum()], [(over * dx * dy).sum(), (over * dy * dy).sum()]]) / total
    small, large = np.linalg.eigvalsh(moments)
    direction: Float = np.linalg.eigh(moments)[1][:, 1]
    between: Float = 2.0 * np.sqrt(max(large - small, 0.04)) * direction
    return between
