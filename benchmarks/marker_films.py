"""Films of balls, pins and tees whose Cramér-Rao bound is known, for ``detection.py``.

The model shares nothing with the detection: chords of solids on a fine grid (closed forms of ``synthetic``), attenuation, scatter, a
Gaussian blur, the pixel's area, a film response, noise of known standard deviation, rounding. What the bound needs, the derivatives of
the expected values, are differences of rendered images.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter

from synthetic.chords import chord_pin
from synthetic.scanner import Response, Scanner

Float = NDArray[np.float64]

# samples along a pixel: of films of balls, of those of pins and tees (of fewer, ends of arms along rows of pixels are 0.01 px off), and of
# the derivatives, where nearly equal ones must be told apart
FINE, FINE_ARMS, FINER = 5, 13, 9
PRIMARY = 0.5  # of the exposure; the rest is scatter, which no marker stops: noise of CNR 5 must not reach the ends of the value range
TANTALUM_MM = 0.8  # diameter of the balls: their attenuation is 8 per mm at every pitch
PER_MM = 8.0
PIN_HALF_MM, PIN_LENGTH_MM = 0.25, 2.0  # of cage 1A
# correlated noise: blur of its screen part in pixels, and that part of its variance; the rest is white
SCREENS = {"screen": (0.8, 0.8), "fine scan": (1.2, 0.95)}
EXPOSURE = (0.6, 0.95)  # darkest and brightest background
PHASE = (0.23, -0.31)  # where in its pixel a mark lies whose bound is calculated; the bound hardly depends on it


@dataclass(frozen=True)
class Case:
    """Conditions of one film.

    Attributes
    ----------
    shape : str
        ``ball``, ``pin``, ``tee`` or ``pair`` (two balls side by side).
    radius_px : float
        Of the ball, half the width of the pin at its thick end.
    cnr : float
        Largest departure of a mark from a background of exposure 0.8, over the standard deviation of one pixel there.
    background, noise : str
        ``flat``, ``gradient``, ``bone``; ``white``, ``quantum`` (variance goes with the exposure), ``screen`` (that, and correlated),
        ``fine scan`` (as blurred as the picture: a film scanned finer than its screen resolves).
    apart : float
        Of the balls of a pair, in diameters.
    companions : bool
        Among pins, tees and pairs every fourth mark is a ball of 0.8 mm, as an examination has them.
    side_px, across : int
        Side of the film, marks along it.
    """

    shape: str = "ball"
    radius_px: float = 4.0
    cnr: float = 20.0
    background: str = "flat"
    noise: str = "white"
    response: Response = "linear"
    bits: int = 16
    apart: float = 0.0
    companions: bool = False
    side_px: tuple[int, int] = (1500, 1500)
    across: int = 7

    @property
    def per_px(self) -> float:
        """Attenuation along one pixel: the same marks at another pitch."""
        mm = TANTALUM_MM / 2 if self.shape in ("ball", "pair") else PIN_HALF_MM
        return PER_MM * mm / self.radius_px

    @property
    def length_px(self) -> float:
        """Length of a pin."""
        return self.radius_px * PIN_LENGTH_MM / PIN_HALF_MM


@dataclass(frozen=True)
class TestFilm:
    """A film and what is true of it.

    Attributes
    ----------
    case : Case
    values : ndarray of shape (rows, cols)
    position_px : ndarray of shape (n, 2)
        (col, row) of the marks that are measured.
    bound_px2 : dict of ndarrays of shape (n, 2, 2)
        Cramér-Rao bound of each, by variant.
    turn : float
        Of its pins and tees, radians.
    companions_px : ndarray of shape (m, 2)
        Balls among pins and tees.
    """

    case: Case
    values: NDArray[np.uint8] | NDArray[np.uint16]
    position_px: Float
    bound_px2: dict[str, Float]
    turn: float
    companions_px: Float

    @property
    def brighter(self) -> bool:
        """Whether marks have higher values than their surroundings."""
        return self.case.response in ("transmission",)


# parameters of a mark beside its position: (radius, ...), (turn, half width, length), for tees also the lean of the
# second and third arm and their attenuation against the first, or (dx, dy, r1, r2) of a pair about its first ball
def _chord(shape: str, x: Float, y: Float, parameters: tuple[float, ...]) -> Float:
    if shape == "ball":
        return 2 * np.sqrt(np.maximum(parameters[0] ** 2 - x**2 - y**2, 0.0))
    if shape == "pair":
        dx, dy, r1, r2 = parameters
        return _chord("ball", x, y, (r1,)) + _chord("ball", x - dx, y - dy, (r2,))
    turn, half_width, length, *more = parameters
    lean, thick = (0.0, *more[:2]), (1.0, *more[2:])
    origin = np.stack([x, y, np.zeros_like(x)])
    total = np.zeros_like(x)
    for k, angle in enumerate((0.0,) if shape == "pin" else (0.0, np.pi / 2, -np.pi / 2)):
        at = turn + angle + lean[k]
        axis = np.array([math.cos(at), -math.sin(at), 0.0])
        on = np.hypot(x - length / 2 * axis[0], y - length / 2 * axis[1]) < 0.56 * length + half_width
        total[on] += thick[k] * chord_pin(origin[:, on], np.array([0.0, 0.0, 1.0]), np.zeros(3), axis, length, half_width)
    return total


def _reach(case: Case, sigma: float) -> int:
    size = {"ball": case.radius_px, "pair": case.radius_px * (1 + 2 * case.apart)}.get(case.shape, 1.1 * case.length_px)
    return math.ceil(size + 5 * sigma + 2)


def _fine_opacity(case: Case, phase: tuple[float, float], parameters: tuple[float, ...], sigma: float, fine: int, half: int) -> Float:
    line = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    x, y = np.meshgrid(line - phase[0], line - phase[1])
    opacity = -np.expm1(-case.per_px * _chord(case.shape, x, y, parameters))
    return gaussian_filter(opacity, sigma * fine, mode="constant", truncate=5.0)


def _binned(image: Float, fine: int) -> Float:
    n = image.shape[0] // fine
    return np.asarray(image.reshape(n, fine, n, fine).mean((1, 3)))


def opacity(case: Case, phase: tuple[float, float], parameters: tuple[float, ...], sigma: float) -> Float:
    """Return the part of the primary exposure that a mark takes away, over pixels whose middle one is (0, 0)."""
    fine = FINE_ARMS if case.shape in ("pin", "tee") else FINE
    return _binned(_fine_opacity(case, phase, parameters, sigma, fine, _reach(case, sigma)), fine)


@lru_cache(maxsize=256)
def _derivatives(case: Case, parameters: tuple[float, ...], sigma: float) -> dict[str, Float]:
    """Opacity and its derivatives by position, blur and shape."""
    half = _reach(case, sigma)

    def render(parameters: tuple[float, ...], sigma: float) -> Float:
        return _fine_opacity(case, PHASE, parameters, sigma, FINER, half)

    middle = render(parameters, sigma)
    out = {"value": middle}
    out["row"], out["col"] = (-np.gradient(middle, 1 / FINER, axis=axis) for axis in (0, 1))
    out["blur"] = (render(parameters, sigma + 0.05) - render(parameters, sigma - 0.05)) / 0.1
    for k, step in enumerate(STEPS[case.shape]):
        high, low = (render(tuple(np.asarray(parameters) + s), sigma) for s in np.eye(len(parameters))[k] * [[step], [-step]])
        out[str(k)] = (high - low) / (2 * step)
    return {key: _binned(image, FINER) for key, image in out.items()}


STEPS = {"ball": (0.1,), "pair": (0.1,) * 4, "pin": (0.01, 0.1, 0.1), "tee": (0.01, 0.1, 0.1, 0.01, 0.01, 0.05, 0.05)}
# what is estimated beside position, amplitude and the background's level and slopes; the first is the one that ratios refer to
VARIANTS: dict[str, dict[str, tuple[str, ...]]] = {
    "ball": {"radius free": ("0",), "radius known": (), "radius, blur free": ("0", "blur")},
    "pair": {"radii free": ("0", "1", "2", "3"), "radii known": ("0", "1")},
    "pin": {"direction, size free": ("0", "1", "2"), "direction, size known": (), "blur free too": ("0", "1", "2", "blur")},
    "tee": {
        "direction, size free": ("0", "1", "2"),
        "direction, size known": (),
        "each arm's direction and attenuation free too": tuple("0123456"),
    },
}


def _screen_covariance(n: int, noise: str) -> Float:
    blur_px, part = SCREENS[noise]
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2)
    square = ((grid[:, None] - grid[None]) ** 2).sum(-1)
    return part * np.exp(-square / (4 * blur_px**2)) + (1 - part) * (square == 0)


def bounds(
    case: Case, parameters: tuple[float, ...], sigma: float, level: float, sd: float, signal: Callable[[Float], Float]
) -> dict[str, Float]:
    """Return the Cramér-Rao bound of a mark's position, (col, row), px^2, for every variant; of a pair: of either ball, (2, 2, 2).

    ``level`` is the exposure around it, ``sd`` that of a pixel at exposure 0.8, in parts of full scale.
    """
    d = _derivatives(case, parameters, sigma)
    half = len(d["value"]) // 2
    row, col = (np.mgrid[-half : half + 1, -half : half + 1] / half).astype(float)
    exposure = level * (1 - PRIMARY * d["value"])
    slope = (signal(exposure + 1e-4) - signal(exposure - 1e-4)) / 2e-4
    clear = 1 - PRIMARY * d["value"]
    variance = sd**2 * np.ones_like(exposure) if case.noise == "white" else (sd / SLOPES[case.response]) ** 2 * exposure / 0.8 * slope**2
    variance = variance + 1 / 12 / (2**case.bits - 1) ** 2
    out = {}
    for name, free in VARIANTS[case.shape].items():
        columns = [-PRIMARY * level * d[key] for key in ("col", "row", *free)]
        columns += [d["value"], clear, clear * col, clear * row]
        jacobian = np.stack([slope * c for c in columns]).reshape(len(columns), -1) / np.sqrt(variance).ravel()
        information = jacobian @ (_whitened(jacobian, len(d["value"]), case.noise) if case.noise in SCREENS else jacobian.T)
        scale = 1 / np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
        first = covariance[:2, :2]
        if case.shape == "pair":  # the second ball lies at the first and the difference
            both = np.array([np.pad(np.eye(2), ((0, 0), (0, len(columns) - 2))), np.eye(len(columns))[:2] + np.eye(len(columns))[2:4]])
            out[name] = both @ covariance @ both.transpose(0, 2, 1)
        else:
            out[name] = first
    return out


def _whitened(jacobian: Float, n: int, noise: str) -> Float:
    return np.asarray(cho_solve(_screen_factor(n, noise), jacobian.T))


@lru_cache(maxsize=4)
def _screen_factor(n: int, noise: str) -> tuple[Float, bool]:
    factor: tuple[Float, bool] = cho_factor(_screen_covariance(n, noise) + 1e-9 * np.eye(n * n))
    return factor


def _response_slope(response: Response) -> float:
    signal = Scanner(response=response).signal
    return float((signal(np.array([0.8001])) - signal(np.array([0.7999])))[0] / 2e-4)


SLOPES: dict[str, float] = {response: abs(_response_slope(response)) for response in ("linear", "log", "density", "transmission")}


def background(case: Case, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the exposure of a film without marks."""
    rows, cols = case.side_px
    low, high = EXPOSURE
    if case.background == "flat":
        return np.full((rows, cols), 0.8, np.float32)
    if case.background == "gradient":
        angle = rng.uniform(0, 2 * np.pi)
        ramp = np.linspace(-1, 1, cols)[None] * math.cos(angle) + np.linspace(-1, 1, rows)[:, None] * math.sin(angle)
        return np.asarray((low + high) / 2 + (high - low) / 2 * ramp / 1.42, np.float32)
    field_ = np.zeros((rows, cols), np.float32)  # bone: bones, their cortices and what is between
    for scale, sd in ((150, 0.22), (40, 0.07), (12, 0.006)):
        coarse = gaussian_filter(rng.standard_normal((4 * rows // scale + 8, 4 * cols // scale + 8)), 4 / 2.0)
        coarse = np.asarray(sd * coarse / coarse.std(), np.float32)
        field_ += cv2.resize(coarse, (cols, rows), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(0.75 * np.exp(field_), low, high), np.float32)


def make_film(case: Case, seed: int) -> TestFilm:
    """Render a film.

    The marks stand on a jittered square grid at random fractions of a pixel. Balls have 0.92, 1 or 1.08 times the nominal radius; pins and
    tees have one size and one random turn, as in a cage. The blur, of 0.8 to 1.5 px, is the film's.
    """
    rng = np.random.default_rng(seed)
    sigma = float(rng.uniform(0.8, 1.5))
    turn = float(rng.uniform(-np.pi, np.pi))
    scanner = Scanner(response=case.response, bits=case.bits)
    exposure = background(case, rng).astype(np.float64)
    rows, cols = case.side_px
    axes = [(np.arange(case.across) + 0.5) * n / case.across for n in (cols, rows)]
    spacing = min(rows, cols) / case.across
    room = max(2.0, spacing / 2 - _reach(case, 1.5) - 15)
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    grid = grid + rng.uniform(-room, room, grid.shape)
    nominal = _nominal(case, turn, 1.0)
    peak = opacity(case, (0.0, 0.0), nominal, sigma).max()
    contrast = abs(float(np.diff(scanner.signal(np.array([0.8, 0.8 * (1 - PRIMARY * peak)])))[0]))
    sd = contrast / case.cnr
    truth: list[Float] = []
    companions: list[Float] = []
    limits: dict[str, list[Float]] = {name: [] for name in VARIANTS[case.shape]}
    clear = exposure.copy()
    for k, position in enumerate(grid):
        middle = np.rint(position).astype(int)
        if case.companions and k % 4 == 3:
            ball = replace(case, shape="ball", radius_px=case.radius_px * (1 if case.shape == "pair" else TANTALUM_MM / 2 / PIN_HALF_MM))
            _shade(exposure, middle, opacity(ball, tuple(position - middle), (ball.radius_px,), sigma))
            companions.append(position)
            continue
        parameters = _nominal(case, float(rng.integers(8)) * np.pi / 4 if case.shape == "pair" else turn, (0.92, 1.0, 1.08)[k % 3])
        _shade(exposure, middle, opacity(case, tuple(position - middle), parameters, sigma))
        truth.append(position)
        if case.shape == "pair":
            truth.append(position + parameters[:2])
        level = round(float(clear[middle[1], middle[0]]), 2)
        for name, covariance in _bounds(case, parameters, sigma, level, sd).items():
            limits[name] += list(covariance) if case.shape == "pair" else [covariance]
    values = _stored(case, scanner, exposure, sd, rng)
    bound = {name: np.array(covariances) for name, covariances in limits.items()}
    return TestFilm(case, values, np.array(truth), bound, turn, np.array(companions).reshape(-1, 2))


def _shade(exposure: Float, middle: NDArray[np.intp], image: Float) -> None:
    half = len(image) // 2
    exposure[middle[1] - half : middle[1] + half + 1, middle[0] - half : middle[0] + half + 1] *= 1 - PRIMARY * image


@lru_cache(maxsize=4096)
def _bounds(case: Case, parameters: tuple[float, ...], sigma: float, level: float, sd: float) -> dict[str, Float]:
    return bounds(case, parameters, sigma, level, sd, Scanner(response=case.response).signal)


def _nominal(case: Case, turn: float, size: float) -> tuple[float, ...]:
    if case.shape == "ball":
        return (case.radius_px * size,)
    if case.shape == "pair":
        apart = 2 * case.radius_px * case.apart
        return (apart * math.cos(turn), -apart * math.sin(turn), case.radius_px, case.radius_px)
    cone = (turn, case.radius_px, case.length_px)
    return cone if case.shape == "pin" else (*cone, 0.0, 0.0, 1.0, 1.0)


def _stored(case: Case, scanner: Scanner, exposure: Float, sd: float, rng: np.random.Generator) -> NDArray[np.uint8] | NDArray[np.uint16]:
    noise = rng.standard_normal(exposure.shape, dtype=np.float32)
    if case.noise in SCREENS:
        blur_px, part = SCREENS[case.noise]
        screen = gaussian_filter(noise, blur_px, mode="wrap") * (2 * blur_px * math.sqrt(np.pi))
        noise = math.sqrt(part) * screen + math.sqrt(1 - part) * rng.standard_normal(noise.shape, dtype=np.float32)
    if case.noise == "white":
        signal = scanner.signal(exposure) + sd * noise
    else:
        signal = scanner.signal(np.maximum(exposure + sd / SLOPES[case.response] * np.sqrt(exposure / 0.8) * noise, 1e-3))
    full = 2**case.bits - 1
    return np.clip(np.rint(signal * full), 0, full).astype(np.uint8 if case.bits == 8 else np.uint16)
