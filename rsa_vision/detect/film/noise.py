"""The noise of a film, from the film: variance as a function of the value, correlation between neighbours, and what is saturated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import chdtri

from rsa_vision.detect.film.compression import noise_of_compression
from rsa_vision.detect.film.repairs import repaired_lines
from rsa_vision.detect.film.saturation import saturation
from rsa_vision.detect.film.tiles import ENOUGH_TILES, NO_NOISE, QUANTISATION, roughness, skewness, tiles_of, whole_tiles, without_surfaces
from rsa_vision.types import Bool, Float, Int

TILE = 32  # pixels; small enough that quiet anatomy is nearly a quadratic surface, large enough to hold correlated noise
STEEP, POWER = 1.25, 6.0  # variance grows at most by this from class to class, and with this power of the value
MARKS = 1.8  # times as much as that, and it is not even noise and texture
_OF_WHITE = 0.37  # roughness of white noise
_CROWDED, _ONE_SIDED = 3.0, 0.5  # roughness and skewness of a film's tiles from which marks fill them, and smaller ones are asked
_EVEN = 0.6  # roughness of the quietest of these up to which they tell
_STRUCTURE = 8.0  # times as much variance as film of its fine noise has elsewhere: tiles of such a class lie on edges
LAGS = 5  # correlation is followed to this distance in pixels
_LEVELS = 12  # value classes of the variance curve
_MORE_AT_ENDS, _APART = 4, 0.5  # classes more, of tiles that differ by so many standard deviations of the noise
_AS_FINE = 1.3  # of the roughness of the others
_ENDS = (0.01, 0.99)  # parts of those between which the curve is to be known
_MOST_MORE = 2.0  # times that it rises beyond its own end
_BEYOND = 12  # points by which it is carried on
_CALCULATED = 1e-3  # part of the values to which a film without noise is exact
_ROUNDED = 0.1  # of the variance of rounding: less is left by no noise
_ALL_BLURRED = 0.7  # part of the noise that is blurred, from which all of it is
_WHITE = 0.03  # correlation with the nearest neighbours below which noise counts as white

_GAP, _BEYOND_MARKS = 0.5, 0.6  # of the height of marks: a gap in the values of tiles, and how far away what lies behind it has to be
_LEAST_LEVELS = 4  # this side of it
_WAVES = 1.5  # times the height of those of one coefficient, that several at a place come to

_NO_LINES = np.zeros(0, np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """Noise of one film.

    Attributes
    ----------
    level, variance : ndarray of shape (k,)
        Variance of one pixel at these values, interpolated in between.
    correlation : ndarray of shape (2 LAGS + 1, 2 LAGS + 1)
        Correlation of pixels at (row, col) offsets -LAGS..LAGS; 1 in the middle.
    floor, ceiling : float
        Values at or beyond them are saturated and carry no information.
    repaired : tuple of ndarrays of int
        Columns and rows that were made up from those beside them, as of :func:`rsa_vision.detect.film.repairs.repaired_lines`.
    pattern : float
        Height, in standard deviations, of the waves that lossy compression makes out of nothing; 0 where it did not.
    """

    level: Float
    variance: Float
    correlation: Float
    floor: float
    ceiling: float
    repaired: tuple[Int, Int] = (_NO_LINES, _NO_LINES)
    pattern: float = 0.0

    def variance_at(self, values: Float) -> Float:
        """Return the variance of pixels with these expected values (same shape)."""
        return np.interp(values, self.level, self.variance)

    @property
    def is_lossy(self) -> bool:
        """Most of the noise are errors of lossy compression, around marks and edges: even film has none."""
        return self.pattern > 0

    def of_box(self, corner_px: Int) -> NoiseModel:
        """Return the noise of a part of the film that begins at this (col, row)."""
        cols, rows = (lines - first for lines, first in zip(self.repaired, corner_px, strict=True))
        return replace(self, repaired=(cols, rows))

    def rises_above(self, height: Float, background: Float) -> Bool:
        """Say which images, of heights without sign on these backgrounds (same shape), lossy compression has not made."""
        return np.asarray(height > _WAVES * self.pattern * np.sqrt(self.variance_at(background)))

    def carried_on(self, value: float, variance: float) -> NoiseModel:
        """Return the same noise with its curve carried on beyond its end to a value and the variance there, in units of that at the end.

        Evenly in the logarithm: where a film records the logarithm of the exposure, the variance by quanta is inverse to the exposure.
        """
        up = value > self.level[-1]
        level = np.linspace(self.level[-1 if up else 0], value, _BEYOND + 1)[1:]
        beyond = self.variance[-1 if up else 0] * variance ** (np.arange(1, _BEYOND + 1) / _BEYOND)
        if up:
            return replace(self, level=np.append(self.level, level), variance=np.append(self.variance, beyond))
        return replace(self, level=np.append(level[::-1], self.level), variance=np.append(beyond[::-1], self.variance))

    def before_gap(self, background: float, sign: float, height: float) -> NoiseModel:
        """Return the same noise without the values beyond a gap, where marks of this height on such a background lie in the gap.

        Shutters and margins are as dark as marks, or darker, and have a noise of their own: between them and the film nothing is known.
        """
        ahead = np.flatnonzero(sign * (self.level - background) > 0)[:: int(sign)]
        away = np.append(0.0, np.abs(self.level[ahead] - background))
        wide = np.flatnonzero((np.diff(away) > _GAP * height) & (away[1:] > _BEYOND_MARKS * height))
        if not len(wide) or len(self.level) - len(ahead) + wide[0] < _LEAST_LEVELS:
            return self
        kept = np.setdiff1d(np.arange(len(self.level)), ahead[wide[0] :])
        return replace(self, level=self.level[kept], variance=self.variance[kept])

    def and_beyond(self, value: float, sign: float, other: NoiseModel) -> NoiseModel:
        """Return the same noise, from its end to a value as it is at the end, and farther on as another model has it.

        Marks may lie there as well: what is beyond a gap may be a limb.
        """
        end = -1 if sign > 0 else 0
        value = sign * max(sign * value, sign * float(self.level[end]))
        more = sign * (other.level - value) > 0
        level = np.concatenate([self.level, [value], other.level[more]])
        level, first = np.unique(level, return_index=True)
        variance = np.concatenate([self.variance, [self.variance[end]], other.variance[more]])[first]
        return replace(self, level=level, variance=variance) if more.any() else self

    def scatter(self, pixels: Float) -> Float:
        """Return the standard deviation of the mean square of the noise in so many pixels beside each other, in units of the variance.

        The variance of a sample variance, with correlated samples (Bartlett, 1946): ``2 / n`` times the sum of the squared correlations.
        """
        out: Float = np.sqrt(2 * np.square(self.correlation).sum() / np.maximum(pixels, 1.0))
        return out

    def gain(self, spread_px: Float) -> Float:
        """Return the variance of a mean over Gaussians of these widths, in units of that of white noise."""
        return np.asarray((_blurred(spread_px) * self.correlation).sum((-2, -1)))

    def gain_of_length(self, spread_px: float) -> float:
        """Return the variance of how much longer than wide a Gaussian of this width is, in units of that in white noise.

        That shows in the second derivative of the Gaussian, whose correlation with itself is the fourth of one wider by the root of two.
        """
        lag = np.arange(-LAGS, LAGS + 1) / spread_px
        along = 1 - lag**2 + lag**4 / 12
        seen = _blurred(np.array(spread_px)) * self.correlation
        return float(max((seen @ along).sum(), (along @ seen).sum()))

    @property
    def blur_px(self) -> float:
        """Standard deviation of the Gaussian that has blurred it; zero where a part of it is white, and the rest may be structure."""
        first, second = self.correlation[LAGS, LAGS + 1 : LAGS + 3]
        if not first > second > 0:
            return 0.0
        blur = float(np.sqrt(0.75 / np.log(first / second)))
        return blur if first * np.exp(1 / (4 * blur**2)) > _ALL_BLURRED else 0.0

    def blurred_by(self, blur_px: float) -> NoiseModel:
        """Return noise of the same variance that a Gaussian of this standard deviation has blurred."""
        return replace(self, correlation=_blurred(np.array(blur_px)))

    @property
    def is_white(self) -> bool:
        """Noise of neighbouring pixels is independent."""
        return bool(np.count_nonzero(self.correlation) <= 1)

    @property
    def typical_sd(self) -> float:
        """Standard deviation of one pixel at the middle of the film's values."""
        return float(np.sqrt(np.median(self.variance)))


def estimate_noise(film: NDArray[Any], bits: int) -> NoiseModel:
    """Estimate the noise of a film from tiles spread over it.

    In every tile a quadratic surface is removed. Structure only ever adds variance, so within each class of values the quieter tiles are
    taken, and classes of which all lie on edges (of a round collimator) left out; their bias against the mean is undone with the chi-square
    quantile, for as many degrees of freedom as the correlation leaves.

    Parameters
    ----------
    film : ndarray of shape (rows, cols)
    bits : int

    Returns
    -------
    NoiseModel
    """
    floor, ceiling = saturation(film, bits)
    # a small field with shutters around has no room for large ones
    sides = [min(side, *film.shape) for side in (TILE, TILE // 2, TILE // 4)]
    tiles = np.zeros((0, TILE, TILE))
    while sides and len(tiles) < ENOUGH_TILES:
        side = sides.pop(0)
        tiles = whole_tiles(film, side, floor, ceiling)
    if not len(tiles):
        tiles = tiles_of(film, side)
    mean, rest, variance = without_surfaces(tiles)
    while sides and np.median(roughness(tiles, variance)) > _CROWDED and abs(np.median(skewness(rest))) > _ONE_SIDED:
        smaller = whole_tiles(film, sides.pop(0), floor, ceiling)
        if len(smaller) < ENOUGH_TILES:
            break
        of_smaller = without_surfaces(smaller)
        between = np.argsort(of_smaller[2])[: max(ENOUGH_TILES, len(smaller) // 8)]  # the quietest
        if np.median(roughness(smaller[between], of_smaller[2][between])) < _EVEN:
            tiles, (mean, rest, variance) = smaller, of_smaller  # between crowded marks there is no room for large ones either
            break
    dof = tiles[0].size - 6  # of the surface
    order = np.argsort(mean)
    level, curve, rough, quiet = [], [], [], []

    def add(part: Int) -> None:
        chosen = part[np.argsort(variance[part])][: max(3, len(part) // 4)]
        level.append(float(mean[chosen].mean()))
        curve.append(float(np.median(variance[chosen])))
        rough.append(float(np.median(roughness(tiles[chosen], variance[chosen]))))
        quiet.append(chosen)

    for part in np.array_split(order, max(1, min(_LEVELS, len(order) // 16))):
        add(part)
    # the quietest of the last class may be far from the end of the values, and marks lie where the film is still darker
    no_edges = roughness(tiles, variance) < _AS_FINE * float(np.median(rough))
    for sign in (-1, 1):
        for _ in range(_MORE_AT_ENDS):
            end = int(np.argmax(sign * np.array(level)))
            beyond = np.flatnonzero(no_edges & (sign * (mean - level[end]) > _APART * np.sqrt(curve[end])))
            if len(beyond) < ENOUGH_TILES:
                break
            add(beyond)
    ranked = np.argsort(level)
    # steps of one value are not how fine a film's noise is
    finest = min((r for r, v in zip(rough, curve, strict=True) if v > NO_NOISE), default=min(rough))
    ranked = ranked[np.array(rough)[ranked] < _STRUCTURE * max(finest, _OF_WHITE)]
    level_array, curve_array = np.array(level)[ranked], _smooth(np.array(level)[ranked], np.maximum(np.array(curve)[ranked], QUANTISATION))
    clean = curve_array >= np.array(curve)[ranked] * 0.999
    chosen = np.concatenate([quiet[k] for k, fine in zip(ranked, clean, strict=True) if fine])
    noisy = chosen[variance[chosen] > _ROUNDED * QUANTISATION]  # areas of one value say nothing of neighbours
    correlation, hidden = _correlation(rest[noisy], variance[noisy])
    independent = dof / max(float((correlation**2).sum()), 1.0)
    bias = chdtri(independent, 0.875) / independent / (1 + hidden)  # the median of the quietest quarter is the eighth of all
    # a film without noise is one that was calculated: no more exact than that
    least = (_CALCULATED * float(np.ptp(tiles))) ** 2 if curve_array.min() < NO_NOISE else 0.0
    if np.count_nonzero(no_edges) >= ENOUGH_TILES:
        level_array, curve_array = _to_the_ends(level_array, curve_array, np.quantile(mean[no_edges], _ENDS))
    variance = np.maximum(curve_array / bias, max(QUANTISATION, least))
    lossy, pattern = noise_of_compression(film, LAGS, floor, ceiling), 0.0
    if lossy is not None:  # where it left nothing to see there is no noise either
        more = lossy.variance > np.median(variance)  # else what is rounded has noise enough to be wrong by chance
        correlation, pattern = (lossy.correlation, lossy.pattern / np.sqrt(lossy.variance)) if more else (correlation, 0.0)
        variance = np.maximum(variance, lossy.variance)
    return NoiseModel(level_array, variance, correlation, floor, ceiling, repaired_lines(film), pattern)


def _blurred(blur_px: Float) -> Float:
    """Return the correlation of noise that Gaussians of these widths have blurred, one more table for each."""
    lag = np.arange(-LAGS, LAGS + 1)
    return np.asarray(np.exp(-(lag[:, None] ** 2 + lag**2) / (4 * np.square(blur_px)[..., None, None])))


def _lag_zero() -> Float:
    """Return the correlation of white noise."""
    at_zero = (np.arange(-LAGS, LAGS + 1) == 0).astype(np.float64)
    return np.asarray(np.outer(at_zero, at_zero))


def _smooth(level: Float, variance: Float) -> Float:
    """Take from a variance curve (levels ascending) what rises too steeply to be noise: classes full of structure."""
    out = variance.copy()
    middle = int(np.argsort(variance)[(len(variance) - 1) // 2])
    for step in (1, -1):
        for k in range(middle + step, len(out) if step > 0 else -1, step):
            ratio = (level[k] + 1) / (level[k - step] + 1) if level[k - step] > -1 else 1.0
            most = out[k - step] * STEEP * max(ratio, 1 / max(ratio, 1e-9)) ** POWER
            if out[k] > MARKS * most:
                out[k] = out[k - step]  # a class of marks: nothing is known of its noise but what is beside it
            else:
                out[k] = min(out[k], most)
    return out


def _to_the_ends(level: Float, variance: Float, ends: Float) -> tuple[Float, Float]:
    """Carry a variance curve (levels ascending) on to the values that a film reaches, as it rises over as much of itself.

    Evenly in the logarithm. Where it falls towards its end, nothing says how far.
    """
    for sign, value in zip((-1, 1), ends.tolist(), strict=True):
        last, at = (0, 0) if sign < 0 else (-1, len(level))
        away, apart = sign * (value - level[last]), np.abs(level - level[last])
        if len(level) > 1 and away > _APART * np.sqrt(variance[last]):
            base = int(np.argmin(np.where(apart >= min(away, apart.max()), apart, np.inf)))
            more = min((variance[last] / variance[base]) ** (away / apart[base]), _MOST_MORE)
            level, variance = (
                (level, variance) if more <= 1 else (np.insert(level, at, value), np.insert(variance, at, more * variance[last]))
            )
    return level, variance


def _correlation(rest: Float, variance: Float) -> tuple[Float, float]:
    side = round(np.sqrt(rest.shape[1]))
    if len(rest) == 0:
        return _lag_zero(), 0.0
    tiles = (rest / np.sqrt(np.maximum(variance, 1e-12))[:, None]).reshape(-1, side, side)
    size = 2 * side
    spectrum = np.abs(rfft2(tiles.astype(np.float32), s=(size, size))) ** 2  # as in influence_covariance
    sums = irfft2(spectrum.mean(0, dtype=np.float64), s=(size, size))
    lag = np.arange(-LAGS, LAGS + 1)
    pairs = (side - np.abs(lag))[:, None] * (side - np.abs(lag))[None, :]
    auto = sums[np.ix_(lag % size, lag % size)] / pairs
    centre = auto[LAGS, LAGS]
    auto = auto / centre if centre > 0 else _lag_zero()
    return _smooth_correlation(auto)


def _smooth_correlation(auto: Float) -> tuple[Float, float]:
    """Describe measured correlations as white noise plus noise blurred by a Gaussian (screen or detector), less a constant.

    The surface that was removed from a tile takes low frequencies with it, which lowers all correlations by about the same amount and hides
    some of the variance. The description gives both back.
    """
    lag = np.arange(-LAGS, LAGS + 1)
    square = (lag[:, None] ** 2 + lag[None, :] ** 2).astype(np.float64)
    others = square > 0
    best: tuple[float, float, float, float] = (np.inf, 0.0, 0.0, 1.0)
    for sigma in np.geomspace(0.4, 3.0, 40):
        shape = np.exp(-square[others] / (4 * sigma**2))  # autocorrelation of noise blurred by sigma
        (alpha, beta), *_ = np.linalg.lstsq(np.column_stack([shape, -np.ones_like(shape)]), auto[others], rcond=None)
        misfit = float(((auto[others] - alpha * shape + beta) ** 2).sum())
        if misfit < best[0]:
            best = (misfit, float(alpha), float(beta), float(sigma))
    _, alpha, beta, sigma = best
    beta = max(beta, 0.0)
    part = min(alpha / (1 + beta), 1.0)
    if part < _WHITE:
        return (square == 0).astype(np.float64), 0.0
    correlation = part * _blurred(np.array(sigma))
    correlation[LAGS, LAGS] = 1.0
    return correlation, beta


def influence_covariance(influence: NDArray[Any], correlation: Float) -> Float:
    """Return the covariance of linear functions of correlated noise.

    A weighted least-squares fit stays unbiased when the noise of neighbouring pixels is correlated, but its variance is no longer the
    inverse of the normal matrix; this is the "sandwich" for it.

    Parameters
    ----------
    influence : ndarray of shape (..., p, rows, cols)
        What one standard deviation of noise in each pixel does to each of ``p`` parameters; 0 outside the fit.
    correlation : ndarray of shape (2 LAGS + 1, 2 LAGS + 1)

    Returns
    -------
    ndarray of shape (..., p, p)
    """
    # by Parseval's theorem in the frequency domain, where the columns of the half spectrum but the first and the middle one stand for two
    reach = len(correlation) // 2
    size = tuple(next_fast_len(max(n, reach + 1) + reach, real=True) for n in influence.shape[-2:])
    # to six digits, in half the time of double precision
    spectrum = rfft2(influence.astype(np.float32), s=size).reshape(*influence.shape[:-2], -1)
    weighted = (spectrum * _root_of_power(correlation.tobytes(), len(correlation), size)).view(np.float32)  # real and imaginary parts
    with np.errstate(over="ignore", invalid="ignore"):  # of what a fit knows nothing at all, the variance is beyond single precision
        return np.asarray(np.matmul(weighted, weighted.swapaxes(-1, -2)), np.float64)


def power_spectrum(correlation: Float, size: tuple[int, ...]) -> Float:
    """Return the power of correlated noise of variance one at the frequencies of ``rfft2`` of so many rows and columns."""
    wrapped, side = np.zeros(size), len(correlation)
    wrapped[:side, :side] = correlation
    return np.asarray(rfft2(np.roll(wrapped, (-(side // 2), -(side // 2)), (0, 1))).real)


@lru_cache(maxsize=64)
def _root_of_power(correlation: bytes, side: int, size: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the root of the power of correlated noise at the frequencies of ``rfft2``, so that sums over half of them are whole."""
    power = np.maximum(power_spectrum(np.frombuffer(correlation).reshape(side, side), size), 0.0) / np.prod(size)
    power[:, 1 : (size[1] + 1) // 2] *= 2
    return np.sqrt(power.ravel()).astype(np.float32)
