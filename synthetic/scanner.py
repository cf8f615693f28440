"""From exposure to stored grey values: quantum noise, film curve, dust and scratches, scanner noise, bits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.types import Float
from synthetic.film import FilmPlane
from synthetic.render import Exposure, Image

Response = Literal["density", "transmission", "linear", "log"]
GAUSSIAN_FROM = 200.0  # quanta from which a normal variate with the Poisson skewness stands for a Poisson one (5 times as fast)


@dataclass(frozen=True, slots=True)
class FilmCurve:
    """Optical density against log exposure, with toe and shoulder: ``base + range / (1 + (speed / exposure)^steepness)``.

    The largest slope, gamma, is ``range * steepness * ln(10) / 4``.

    Attributes
    ----------
    base, range : float
        Density of base and fog, and what exposure can add to it.
    gamma : float
        Density per decade of exposure, at the steepest place.
    middle : float
        Exposure of the steepest place, relative to nothing in the way.

    Notes
    -----
    With the default a film's background, at exposure 1, has a density of 1.3.
    """

    base: float = 0.2
    range: float = 3.0
    gamma: float = 2.5
    middle: float = 1.4

    def timed_for(self, exposure: Exposure) -> FilmCurve:
        """Return the curve of a film exposed so long that its median gets the density meant for exposure 1."""
        return replace(self, middle=self.middle * float(np.median(exposure.blurred[::8, ::8])))

    def density(self, exposure: Float | Image) -> Float:
        """Return the optical density after an exposure."""
        steepness = 4 * self.gamma / (self.range * math.log(10))
        return np.asarray(self.base + self.range / (1 + (self.middle / np.maximum(exposure, 1e-9)) ** steepness))

    def exposure(self, density: Float) -> Float:
        """Return the exposure behind an optical density."""
        steepness = 4 * self.gamma / (self.range * math.log(10))
        return np.asarray(self.middle / (self.range / (density - self.base) - 1) ** (1 / steepness))


@dataclass(frozen=True, slots=True)
class Scanner:
    """What a film scanner or a digital detector makes of a mean exposure.

    Attributes
    ----------
    response : str
        ``density``, ``transmission``, ``linear`` or ``log``.
    bits : int
        8 to 16.
    quanta : float or None
        Quanta a pixel where nothing is in the way; None: no quantum noise.
    noise : str
        ``screen``: the screen blurs the quantum noise as it blurs the picture; ``white``: it does not.
    blur_mm : float
        Standard deviation of the screen's blur.
    scanner_noise : float
        Standard deviation of the scanner's own noise, part of full scale.
    inverted : bool
        Values counted from the other end, without the file saying so.
    curve : FilmCurve
    full_density : float
        Density of the largest value (``density``).
    full_exposure : float
        Exposure of the largest value (``linear``, ``log``).
    decades : float
        Exposure range of ``log``.
    """

    response: Response = "density"
    bits: int = 16
    quanta: float | None = 4000.0
    noise: Literal["screen", "white"] = "screen"
    blur_mm: float = 0.1
    scanner_noise: float = 0.0
    inverted: bool = False
    curve: FilmCurve = FilmCurve()
    full_density: float = 3.6
    full_exposure: float = 1.25
    decades: float = 3.0

    def signal(self, exposure: Float | Image) -> Float:
        """Return the value, as a part of full scale, that stands for an exposure."""
        if self.response == "density":
            return self.curve.density(exposure) / self.full_density
        if self.response == "transmission":
            return np.asarray(10.0 ** -(self.curve.density(exposure) - self.curve.base))
        relative = np.asarray(exposure, float) / self.full_exposure
        return np.asarray(relative if self.response == "linear" else 1 + np.log10(np.maximum(relative, 10**-self.decades)) / self.decades)

    def exposure(self, signal: Float) -> Float:
        """Return the exposure behind a value, part of full scale: the inverse of :meth:`signal`."""
        if self.response == "density":
            return self.curve.exposure(signal * self.full_density)
        if self.response == "transmission":
            return self.curve.exposure(self.curve.base - np.log10(signal))
        return np.asarray(self.full_exposure * (signal if self.response == "linear" else 10 ** (self.decades * (signal - 1))))


def quantum_counts(mean: Float | Image, rng: np.random.Generator) -> Image:
    """Return Poisson variates of any mean, as float32; large ones to second order of the Cornish-Fisher expansion."""
    counts = rng.standard_normal(mean.shape, dtype=np.float32)
    counts = np.rint(mean + np.sqrt(mean) * counts + (counts * counts - 1) / 6).astype(np.float32)
    few = mean < GAUSSIAN_FROM
    counts[few] = rng.poisson(mean[few])
    return np.asarray(counts, np.float32)


def add_quantum_noise(exposure: Exposure, scanner: Scanner, film: FilmPlane, rng: np.random.Generator) -> Image:
    """Return the recorded exposure: its mean and quantum noise.

    Parameters
    ----------
    exposure : Exposure
    scanner : Scanner
    film : FilmPlane
    rng : numpy Generator

    Returns
    -------
    ndarray of float32, shape (rows, cols)
    """
    if scanner.quanta is None:
        return exposure.blurred
    quanta = np.float32(scanner.quanta)
    if scanner.noise == "white":
        return quantum_counts(exposure.blurred * quanta, rng) / quanta
    mean = exposure.incident * quanta
    sigma_px = [scanner.blur_mm * float(np.linalg.norm(film.pixel_from_film[axis, :2])) for axis in (1, 0)]
    noise = gaussian_filter(quantum_counts(mean, rng) - mean, sigma_px, mode="reflect")
    return np.maximum(exposure.blurred + noise / quanta, np.float32(0))


def digitise(
    recorded: Float | Image, scanner: Scanner, rng: np.random.Generator, blemishes: Float | Image | None = None
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the stored values.

    Parameters
    ----------
    recorded : ndarray of shape (rows, cols)
        Exposure with its noise.
    scanner : Scanner
    rng : numpy Generator
    blemishes : ndarray of shape (rows, cols), optional
        Factor on the signal, where dust (< 1) or scratches (> 1) lie on the film.

    Returns
    -------
    ndarray of uint8 (8 bits) or uint16, shape (rows, cols)
    """
    signal = scanner.signal(recorded)
    if blemishes is not None:
        signal = signal * blemishes
    if scanner.scanner_noise:
        signal = signal + scanner.scanner_noise * rng.standard_normal(signal.shape, dtype=np.float32)
    full = 2**scanner.bits - 1
    values = np.clip(np.rint(signal * full), 0, full)
    stored: NDArray[np.uint8] | NDArray[np.uint16] = (full - values if scanner.inverted else values).astype(
        np.uint8 if scanner.bits == 8 else np.uint16
    )
    return stored
