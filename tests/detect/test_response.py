"""Films of transmitted light, from density with toe and shoulder: measured in log odds, in which balls look like balls."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import _detect, detect_markers
from rsa_vision.detect.balls.find import significance_limit
from rsa_vision.detect.film.noise import NoiseModel, estimate_noise
from rsa_vision.detect.marks.response import in_film_values, log_odds
from rsa_vision.flags import MarkerFlag
from rsa_vision.threads import in_one_thread
from rsa_vision.types import Float, MarkerImages

from .films import film_of_balls, grid_of_balls, stored

SIDE, SIGMA_PX, RADIUS_PX = 760, 1.2, 4.0
BITS, QUANTA = 12, 3000.0
RANGE, STEEPNESS = 3.0, 1.45  # of density; of its curve against the logarithm of the exposure
SPEEDS = (0.12, 0.35, 2.0)  # exposure of the curve's middle: balls against black film, against dark film, against grey film
BETTER = {0.12: 1.5, 0.35: 1.5, 2.0: 0.95}  # times the errors of measurements of the light itself, whose noise is told value by value
LARGEST_PX = 0.03  # root mean square of the distances
Z_BAND, Z_MAX = (0.5, 1.2), 4.5


def lit(speed: float, rng: np.random.Generator, quanta: float = QUANTA) -> tuple[Float, Float]:
    """Return a film of transmitted light, in parts of full scale, exposed three times as long at one side, and the truth."""
    truth, radius = grid_of_balls(rng, 7, 98.0, (RADIUS_PX, RADIUS_PX))
    exposure = film_of_balls((SIDE, SIDE), truth, radius, background=1.0, depth=0.92, sigma_px=SIGMA_PX) * np.linspace(1.0, 1 / 3, SIDE)
    exposure = exposure + np.sqrt(exposure / quanta) * rng.standard_normal(exposure.shape)
    return 10 ** -(RANGE / (1 + (speed / np.maximum(exposure, 1e-3)) ** STEEPNESS)), truth


def errors(images: MarkerImages, truth: Float) -> tuple[Float, Float]:
    """Return the distance of each image from its ball, and in units of what is stated."""
    gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
    assert len(images) == len(truth)
    assert gap.min(axis=1).max() < 2.0
    error = images.position_px[gap.argmin(axis=1)] - truth
    square = np.einsum("ni,ni->n", error, np.linalg.solve(images.covariance_px2[gap.argmin(axis=1)], error[:, :, None])[:, :, 0])
    return gap.min(axis=1), np.sqrt(square)


@pytest.mark.parametrize(("speed", "bits"), [*zip(SPEEDS, (12, 16, 12), strict=True)])
def test_balls_on_films_of_light_are_where_they_are_said_to_be(speed: float, bits: int) -> None:
    away, ratio, away_in_light = [], [], []
    for seed in (1, 2):
        light, truth = lit(speed, np.random.default_rng(seed))
        film = stored((2**bits - 1) * light, bits)
        error, its_ratio = errors(detect_markers(film, bits=bits).images, truth)
        away, ratio = [*away, *error], [*ratio, *its_ratio]
        [(_, bright)] = _detect(film, bits, estimate_noise(film, bits), significance_limit(film.size, 0.1), only=1)
        away_in_light += errors(bright.images, truth)[0].tolist()
    assert np.sqrt(np.mean(np.square(away_in_light)) / np.mean(np.square(away))) > BETTER[speed]
    assert np.sqrt(np.mean(np.square(away))) < LARGEST_PX
    assert Z_BAND[0] < np.sqrt(np.mean(np.square(ratio)) / 2) < Z_BAND[1]
    assert max(ratio) < Z_MAX


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_where_black_film_hides_rims_and_noise_balls_are_flagged(bits: int) -> None:
    """Of few values: what seems free of noise outside of a rim is none, and weighed it decided where the ball is."""
    light, truth = lit(0.12, np.random.default_rng(1), quanta=300.0)
    scale = 2 ** (bits - 8)
    images = detect_markers(stored(scale * (10 + 240 * light), bits), bits=bits).images
    gap = np.hypot(*(truth[:, None] - images.position_px[None]).transpose(2, 0, 1))
    seen = gap.min(axis=1) < 2.0
    assert np.count_nonzero(seen) == len(images) > 0.8 * len(truth)
    _, ratio = errors(images, truth[seen])
    flat = images.flags & MarkerFlag.SATURATED > 0
    assert np.mean(flat) > 0.8 if bits < 16 else not flat.any()
    assert ratio.max() < 4.0
    assert np.sqrt(np.mean(np.square(ratio)) / 2) < Z_BAND[1]


def test_values_of_light_are_given_back() -> None:
    noise = NoiseModel(np.array([0.0, 4095.0]), np.ones(2), np.eye(1), -np.inf, np.inf)
    values = np.arange(4096, dtype=np.uint16)[None]
    odds, _ = log_odds(values, 12, noise)
    assert (odds.min(), odds.max()) == (0, 65535)
    assert (np.diff(odds[0].astype(int)) > 0).all()
    background, top = odds[0, 100] / 65535, odds[0, 3000] / 65535
    images = MarkerImages(
        np.zeros((1, 2)), np.eye(2)[None], np.array(["ball"]), *np.ones((2, 1)), np.array([top - background]), np.array([background]),
        np.ones(1), np.zeros(1, np.int64),
    )  # fmt: skip
    back = in_film_values(images, 12)
    np.testing.assert_allclose(back.background * 4095, 100, atol=0.02)
    np.testing.assert_allclose((back.background + back.contrast) * 4095, 3000, atol=0.5)


def test_noise_of_log_odds_is_that_of_the_film() -> None:
    rng = np.random.default_rng(3)
    for level in (60.0, 600.0, 3800.0):
        film = stored(level + 12.0 * rng.standard_normal((400, 400)), 12)
        noise = NoiseModel(np.array([0.0, level, 4095.0]), np.array([144.0, 144.0, 144.0]), np.eye(1), -np.inf, np.inf)
        odds, its_noise = log_odds(film, 12, noise)
        assert odds.std() / np.sqrt(its_noise.variance_at(np.median(odds))) == pytest.approx(1.0, abs=0.05)


def test_films_of_other_scales_stay_as_they_are() -> None:
    rng = np.random.default_rng(4)
    truth, radius = grid_of_balls(rng, 7, 98.0, (RADIUS_PX, RADIUS_PX))
    exposure = film_of_balls((SIDE, SIDE), truth, radius, background=0.8, depth=0.7, sigma_px=SIGMA_PX, gradient=(-0.5, 0.0))
    film = stored(60000 * (1 - exposure) + 400 * rng.standard_normal(exposure.shape))
    images = detect_markers(film, bits=16).images
    # sums in several threads differ in their last digits, and fits go on with these
    [(_, bright)] = in_one_thread(_detect)(film, 16, estimate_noise(film, 16), significance_limit(film.size, 0.1), only=1)
    assert len(images) == len(truth)
    np.testing.assert_array_equal(images.position_px, bright.images.position_px)
