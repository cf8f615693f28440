"""Noise, film curve and bits of the rendered films."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsa_vision.cages import load_cage
from synthetic.film import place_film
from synthetic.render import Exposure
from synthetic.scanner import GAUSSIAN_FROM, FilmCurve, Scanner, add_quantum_noise, digitise, quantum_counts

RESPONSES = ("density", "transmission", "linear", "log")
SAMPLES = 400_000
FIVE_SD = 5.0


@pytest.fixture(scope="module")
def film():
    cage = load_cage("2")
    return place_film(cage, {k: np.array(v, float) for k, v in cage.foci.items()}, (1,), size_mm=(60, 60))


@pytest.mark.parametrize("mean", [0.5, 20.0, GAUSSIAN_FROM * 0.99, GAUSSIAN_FROM * 1.01, 4000.0])
def test_counts_have_the_moments_of_poisson(mean):
    counts = quantum_counts(np.full(SAMPLES, mean, np.float32), np.random.default_rng(1)).astype(float)
    assert np.array_equal(counts, np.rint(counts))
    assert counts.mean() == pytest.approx(mean, abs=FIVE_SD * np.sqrt(mean / SAMPLES))
    sd_of_variance = mean * np.sqrt((2 + 1 / mean) / SAMPLES)
    assert counts.var() == pytest.approx(mean, abs=FIVE_SD * sd_of_variance + 0.15)  # 0.15: rounding of the normal variates
    skewness = ((counts - mean) ** 3).mean() / mean**1.5
    assert skewness == pytest.approx(1 / np.sqrt(mean), abs=FIVE_SD * np.sqrt((6 + 100 / mean) / SAMPLES))


@pytest.mark.parametrize(("noise", "variance"), [("white", 1.0), ("screen", 1 / (4 * np.pi * 1.0**2))])
def test_noise_of_the_recorded_exposure(film, noise, variance):
    """The screen of sigma 1 px keeps 1 / (4 pi sigma^2) of the white variance and correlates neighbours by exp(-1/4)."""
    level = 0.6
    flat = np.full(film.shape, level, np.float32)
    recorded = add_quantum_noise(Exposure(flat, flat), Scanner(quanta=4000.0, noise=noise), film, np.random.default_rng(2))
    inner = recorded[20:-20, 20:-20].astype(float)
    assert inner.mean() == pytest.approx(level, rel=1e-3)
    assert inner.var() == pytest.approx(level / 4000 * variance, rel=0.03)
    lag = np.mean((inner[:, 1:] - level) * (inner[:, :-1] - level)) / inner.var()
    assert lag == pytest.approx(0.0 if noise == "white" else np.exp(-0.25), abs=0.03)


def test_without_quanta_nothing_is_random(film):
    flat = np.full(film.shape, 0.5, np.float32)
    assert np.array_equal(add_quantum_noise(Exposure(flat, flat), Scanner(quanta=None), film, np.random.default_rng(0)), flat)


@pytest.mark.parametrize("response", RESPONSES)
@given(exposure=st.floats(0.02, 1.2))
def test_responses_invert(response, exposure):
    scanner = Scanner(response=response)
    assert scanner.exposure(scanner.signal(np.array(exposure))) == pytest.approx(exposure, rel=1e-9)


@pytest.mark.parametrize("response", RESPONSES)
def test_responses_are_monotonic_and_fill_the_scale(response):
    signal = Scanner(response=response).signal(np.linspace(0.01, 1.25, 500))
    rises = np.diff(signal) > 0
    assert rises.all() or not rises.any()
    assert rises.all() == (response != "transmission")  # much light on the film makes it dark
    assert 0 <= signal.min() < signal.max() <= 1


def test_film_curve_has_its_gamma_a_toe_and_a_shoulder():
    curve = FilmCurve()
    log_exposure = np.linspace(-3, 3, 6001)
    density = curve.density(10**log_exposure)
    slope = np.gradient(density, log_exposure)
    assert slope.max() == pytest.approx(curve.gamma, rel=1e-4)
    assert 10 ** log_exposure[slope.argmax()] == pytest.approx(curve.middle, rel=0.01)
    assert density[0] == pytest.approx(curve.base, abs=0.02)
    assert density[-1] == pytest.approx(curve.base + curve.range, abs=0.05)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_bits_and_polarity(bits):
    exposure = np.linspace(0, 1.3, 1000).reshape(10, 100)
    rng = np.random.default_rng(0)
    values = digitise(exposure, Scanner(response="linear", bits=bits), rng)
    assert values.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (values.min(), values.max()) == (0, 2**bits - 1)
    assert np.unique(values).size > min(2**bits, 900) * 0.9
    inverted = digitise(exposure, Scanner(response="linear", bits=bits, inverted=True), rng)
    assert np.array_equal(inverted.astype(int) + values, np.full(values.shape, 2**bits - 1))


def test_scanner_noise_has_its_standard_deviation():
    rng = np.random.default_rng(3)
    values = digitise(np.full((400, 400), 0.6), Scanner(response="linear", scanner_noise=0.01), rng)
    assert values.std() / 65535 == pytest.approx(0.01, rel=0.02)
