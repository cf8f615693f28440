"""Balls in film that is nearly black: the light around them changes, the values do not, and yet it pulls at their centres."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.detect import detect_markers
from rsa_vision.detect.film.noise import NoiseModel
from rsa_vision.detect.film.shoulder import Curve, curve_of, rounding, shown, told_by
from rsa_vision.detect.film.tiles import QUANTISATION
from rsa_vision.types import Float

from .films import film_of_balls, grid_of_balls, stored

SIDE = 940
BLACK, BASE, STEEP = 233.0, 15.0, 2.2  # ends and gradient of the film's curve


def _density(exposure: Float) -> Float:
    power = exposure**STEEP
    return np.asarray(BASE + (BLACK - BASE) * power / (1 + power))


@pytest.mark.parametrize("least", [1.5, 3.0])
def test_light_that_changes_in_black_film_is_part_of_stated_errors(least: float) -> None:
    rng = np.random.default_rng(41)
    truth, radius = grid_of_balls(rng, 10, 90.0, (3.6, 4.0))
    opacity = 1 - film_of_balls((SIDE, SIDE), truth, radius, background=1.0, depth=0.97, sigma_px=1.0)
    light = least * np.exp(1.2 + 1.2 * np.sin(2 * np.pi * np.arange(SIDE) / 400.0))
    exposure = light * (1 - opacity) * (1 + 0.004 * rng.standard_normal((SIDE, SIDE)))
    film = stored(_density(exposure), bits=8)
    found = detect_markers(film, bits=8).images
    gap = np.hypot(*(truth[:, None] - found.position_px[None]).transpose(2, 0, 1))
    sure = (gap.min(axis=1) < 1.0) & (found.flags[gap.argmin(axis=1)] == 0)
    assert np.count_nonzero(sure) > 70
    index = gap.argmin(axis=1)[sure]
    error = found.position_px[index] - truth[sure]
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2[index], error[:, :, None])[:, :, 0]) / 2
    print(f"least {least}: {len(error)} balls, RMS {np.sqrt((error**2).mean()):.4f} px, error / sd {np.sqrt(chi2.mean()):.2f}")
    assert np.sqrt(np.median(chi2)) < 1.5
    assert np.sqrt(chi2.max()) < 5


def test_noise_of_the_scanner_does_not_belie_the_curve_of_its_film() -> None:
    """It is the same on black film as under balls; that balls look the smaller the blacker it is beside them tells of the curve."""
    rng = np.random.default_rng(43)
    truth, radius = grid_of_balls(rng, 10, 90.0, (4.2, 4.6))
    opacity = 1 - film_of_balls((SIDE, SIDE), truth, radius, background=1.0, depth=0.97, sigma_px=1.0)
    light = 2.0 * np.exp(0.8 + 0.9 * np.sin(2 * np.pi * np.arange(SIDE) / 400.0))
    film = stored(16 * (_density(light * (1 - opacity)) + 2.0 * rng.standard_normal((SIDE, SIDE))), bits=12)
    found = detect_markers(film, bits=12).images
    gap = np.hypot(*(truth[:, None] - found.position_px[None]).transpose(2, 0, 1))
    index = gap.argmin(axis=1)[gap.min(axis=1) < 1.0]
    error = found.position_px[index] - truth[gap.min(axis=1) < 1.0]
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariance_px2[index], error[:, :, None])[:, :, 0]) / 2
    print(
        f"{len(error)} balls, RMS {np.sqrt((error**2).mean()):.4f} px, error / sd {np.sqrt(chi2.mean()):.2f}, {np.sqrt(2 * chi2.max()):.1f}"
    )
    assert len(error) > 95
    assert np.sqrt(np.median(chi2)) < 1.2
    assert np.sqrt(2 * chi2.max()) < 4.5


@pytest.mark.parametrize("depth", [-150.0, 150.0])
def test_sizes_tell_of_a_curve_only_where_they_go_with_its_end(depth: float) -> None:
    rng, curve = np.random.default_rng(3), Curve(BASE, BLACK, 0.0)
    light = rng.uniform(-1, 4, 40)
    background = curve.value(light if depth < 0 else -light)
    sizes = np.where(rng.random(40) < 0.5, 4.6, 5.2)  # of two kinds
    assert not told_by(background, np.full(40, depth), sizes, curve).told
    assert told_by(background, np.full(40, depth), sizes * np.exp(-0.07 * np.maximum(light, 0.0)), curve).told
    assert not told_by(background, np.full(40, -depth), sizes * np.exp(-0.07 * np.maximum(light, 0.0)), curve).told


def _noise(level: list[float], variance: list[float]) -> NoiseModel:
    return NoiseModel(np.array(level), np.array(variance), np.ones((1, 1)), -np.inf, np.inf)


def test_a_curve_shows_as_much_more_as_it_is_steeper() -> None:
    curve = Curve(BASE, BLACK, 0.0)
    level = np.linspace(BASE, BLACK, 40)
    noise = _noise(level.tolist(), (1.5 * QUANTISATION + (1e-3 * (level - BASE) * (BLACK - level)) ** 2).tolist())
    light = np.log(np.array([[4.0, 5.0]]))
    beside, changed = _density(np.exp(light))[0]
    under, under_changed = _density(np.exp(light - np.log(4.0)))[0]
    more = shown(np.array([[under]]), np.array([beside]), np.array([[changed - beside]]), curve, noise)
    assert more[0, 0] == pytest.approx((under_changed - under) - (changed - beside), rel=0.1)  # the end is half a value off


@pytest.mark.parametrize("cols", [28, 40, 70])
def test_a_narrow_film_shows_no_shading(cols: int) -> None:
    truth = np.array([[cols / 2, row] for row in (40.0, 100.0, 160.0)])
    film = film_of_balls((200, cols), truth, np.full(3, 4.0), depth=0.5, noise_sd=300.0, rng=np.random.default_rng(43))
    assert len(detect_markers(stored(film), bits=16).images) == 3
    assert curve_of(stored(film)).shading < 0.05


def test_films_with_more_noise_where_there_is_more_light_hide_nothing() -> None:
    noise = _noise([0.0, 60000.0], [QUANTISATION, 40000.0])  # quanta on a linear film
    change = np.linspace(-500.0, 500.0, 9)[None]
    assert (shown(np.full((1, 9), 20000.0), np.array([59000.0]), change, Curve(0.0, 60000.0, 0.0), noise) == 0).all()


def test_noise_takes_the_bias_from_rounding() -> None:
    rng = np.random.default_rng(42)
    true = np.linspace(100.0, 101.0, 41)
    for sd in (0.0, 0.2, 0.4):
        means = np.rint(true + sd * rng.standard_normal((20000, 41))).mean(axis=0)
        variance = _noise([0.0, 200.0], [QUANTISATION + sd**2] * 2)
        assert np.sqrt(np.square(means - true).mean()) == pytest.approx(rounding(np.array([100.0]), variance)[0], abs=0.07)
