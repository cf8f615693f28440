"""The table of a film's marker images: what is unlike the others, and how much all of it speaks for a polarity."""

from dataclasses import replace

import numpy as np

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.find import fit_at, no_fits
from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.detect.marks.table import table_of, what_is_left
from rsa_vision.detect.models.needles import NeedleShape
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.fits import unfit
from rsa_vision.flags import MarkerFlag

from .films import film_of_balls, grid_of_balls, stored
from .test_balls import BACKGROUND, DEPTH, nearest


def test_a_ball_of_a_size_of_its_own_is_flagged_and_measured_all_the_same() -> None:
    rng = np.random.default_rng(1)
    truth, radius = grid_of_balls(rng, 4, 80.0, (3.9, 4.1))
    radius[5] = 5.6
    film = film_of_balls((360, 360), truth, radius, background=BACKGROUND, depth=DEPTH, noise_sd=DEPTH * BACKGROUND / 20, rng=rng)
    found = detect_markers(stored(film), bits=16)
    index, gap = nearest(truth, found)
    assert gap.max() < 0.2
    assert np.flatnonzero(found.images.flags[index] == MarkerFlag.UNLIKE).tolist() == [5]
    assert not np.delete(found.images.flags[index], 5).any()


def test_balls_of_many_sizes_are_unlike_nothing() -> None:
    rng = np.random.default_rng(2)
    truth, radius = grid_of_balls(rng, 3, 110.0, (3.0, 9.0))
    film = film_of_balls((380, 380), truth, radius, background=BACKGROUND, depth=DEPTH, noise_sd=DEPTH * BACKGROUND / 20, rng=rng)
    found = detect_markers(stored(film), bits=16).images
    assert len(found) == len(truth)
    assert not found.flags.any()


def test_dots_are_no_more_evidence_for_balls_in_a_wide_blur_than_they_are_high() -> None:
    """Their depths can be anything: as small balls in a blur as wide as they are they would be opaque many times over."""
    rng = np.random.default_rng(3)
    truth, radius = grid_of_balls(rng, 4, 80.0, (1.3, 1.3))
    high = 6.0  # standard deviations of the noise
    film = film_of_balls((360, 360), truth, radius, background=BACKGROUND, depth=1.0, sigma_px=3.0, rng=rng) - BACKGROUND
    film *= high * 300.0 / np.ptp(film)
    values = stored(film + BACKGROUND + 300.0 * rng.standard_normal(film.shape))
    noise, optics = estimate_noise(values, 16), Optics(3.1, 0.5)
    fits = fit_at(values, truth, radius, optics, noise)
    plain = np.zeros(len(truth), bool)
    images, evidence = table_of(
        values, 16, fits, 1.0, np.ones(len(truth)), np.zeros((len(truth), 2, 2)), plain, plain, plain, [], np.zeros((0, 5)), optics, noise
    )
    assert np.median(images.snr) > 3 * high
    assert 0.5 * high * len(truth) < evidence < 2 * high * len(truth)


def test_what_all_balls_of_a_film_leave_is_no_fault_of_one() -> None:
    rng = np.random.default_rng(5)
    truth, radius = grid_of_balls(rng, 4, 80.0, (3.9, 4.1))
    noise_sd = DEPTH * BACKGROUND / 400
    film = film_of_balls((360, 360), truth, radius, background=BACKGROUND, depth=DEPTH, noise_sd=noise_sd, rng=rng)
    values = stored(film)
    noise, optics = estimate_noise(values, 16), Optics(1.1, 0.5)
    fits = fit_at(values, truth, radius, optics, noise)
    left = np.full(len(truth), 0.06)  # of the depth: of a blur that is no Gaussian, where there is hardly any noise
    left[3] = 0.13

    def with_misfit(part: np.ndarray, ring: float, shown: np.ndarray | float = 1.0) -> np.ndarray:
        chi2 = 1 + np.square(part * shown * fits.depth) / noise.variance_at(fits.background)
        balls = replace(fits, depth=shown * fits.depth, chi2_core=chi2, chi2_ring=np.full(len(part), ring))
        return what_is_left(balls, 1.0, optics.sigma_px, noise)[1]

    assert np.flatnonzero(with_misfit(left, 1.0)).tolist() == [3]
    faint = np.where(np.arange(len(truth)) < 6, 1.0, 0.02)  # most, on which noise hides what a few leave
    assert np.flatnonzero(with_misfit(left, 1.0, faint)).tolist() == [3]
    assert with_misfit(np.full(len(truth), 0.01), 20.0).sum() == 0  # 20 times so little noise is no edge
    assert with_misfit(np.full(len(truth), 0.01), 1 + (0.05 * DEPTH * BACKGROUND / noise_sd) ** 2).all()


def test_flags_of_needles_at_the_edge_and_at_the_end_of_the_range() -> None:
    """A pin that points inwards is whole; what is left out of a fit is saturated only where the film is."""
    rng = np.random.default_rng(6)
    film = np.clip(30000 + 300 * rng.standard_normal((400, 400)), 0, 65535).astype(np.uint16)
    film[195:206, 320:340] = 65535
    noise = replace(estimate_noise(film, 16), ceiling=65535.0)
    blank = unfit(np.zeros(2), np.zeros(1), NeedleShape(3.0, 30.0))
    told = {
        "depth": -1e4,
        "chi2_core": 1.0,
        "chi2_ring": 1.0,
        "n_core": 100,
        "explained": 0.99,
        "misfit": 0.01,
        "significance": 50.0,
        "height": 1e4,
    }
    fit = replace(blank, depths=np.array([-1e4]), background=3e4, covariance_px2=1e-4 * np.eye(2), **told)
    at = {(15.0, 60.0): 1.0, (380.0, 120.0): 1.0, (300.0, 200.0): 0.9, (100.0, 300.0): 0.9, (200.0, 300.0): 0.5}
    pins = [replace(fit, position_px=np.array(tip), valid_fraction=valid) for tip, valid in at.items()]
    none = np.zeros(0, bool)
    args = (1.0, np.ones(0), np.zeros((5, 2, 2)), np.zeros(5, bool), none, none, pins, np.zeros((0, 5)), Optics(1.0, 0.5), noise)
    images, _ = table_of(film, 16, no_fits(), *args)
    asked = MarkerFlag.EDGE | MarkerFlag.SATURATED | MarkerFlag.CLIPPED
    flags = [MarkerFlag(int(flags)) & asked for flags in images.flags[np.lexsort((images.position_px[:, 0], images.position_px[:, 1]))]]
    assert flags == [MarkerFlag.NONE, MarkerFlag.EDGE, MarkerFlag.SATURATED, MarkerFlag.CLIPPED, MarkerFlag.CLIPPED]
