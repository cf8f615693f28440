"""Balls: found, none invented, and as exact as stated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rsa_vision.detect
from rsa_vision.detect import Detection, detect_markers
from rsa_vision.detect.film.noise import estimate_noise
from rsa_vision.detect.marks.polarity import Seen, polarities
from rsa_vision.flags import MarkerFlag

from .films import ATTENUATION, film_of_balls, grid_of_balls, stored

BAND = (0.85, 1.15)  # observed / stated error; 200 coordinates determine it to 5 %
BACKGROUND, DEPTH = 30000.0, 0.5


def nearest(truth: NDArray[np.float64], found: Detection) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Index of the nearest found marker image, and its distance in pixels, for every true one."""
    gap = np.hypot(*(truth[:, None] - found.images.position_px[None]).transpose(2, 0, 1))
    return gap.argmin(1), gap.min(1)


@pytest.mark.parametrize(("cnr", "noise_blur_px"), [(50, 0.0), (20, 0.0), (10, 0.0), (20, 1.2), (10, 1.2)])
def test_every_ball_is_found_and_its_stated_error_is_true(cnr: float, noise_blur_px: float) -> None:
    rng = np.random.default_rng(int(cnr))
    # one ball in 128 pixels: still seven times as dense as the marks of a cage, but with film in between to take the noise from
    truth, radius = grid_of_balls(rng, 10, 128.0, (2.5, 7.0))
    film = film_of_balls(
        (1320, 1320),
        truth,
        radius,
        background=BACKGROUND,
        depth=DEPTH,
        noise_sd=DEPTH * BACKGROUND / cnr,
        noise_blur_px=noise_blur_px,
        rng=rng,
    )
    found = detect_markers(stored(film), bits=16)
    index, gap = nearest(truth, found)
    assert found.dark_markers
    assert (gap < 1.0).all(), "a ball was missed"
    assert len(found.images) == len(truth), "a ball was invented"
    error = found.images.position_px[index] - truth
    sd = np.sqrt(np.einsum("nii->ni", found.images.covariance_px2[index]))
    ratio = float(np.sqrt(((error / sd) ** 2).mean()))
    print(f"CNR {cnr}, noise blur {noise_blur_px}: RMS {np.sqrt((error**2).mean()):.4f} px, error / sd {ratio:.2f}")
    assert BAND[0] < ratio < BAND[1]


@pytest.mark.parametrize("power", [-1.0, 1.0])  # of the exposure: variance on a film of its logarithm, and on a linear one
@pytest.mark.parametrize("noise_blur_px", [0.0, 0.8])
def test_noise_under_balls_is_not_that_beside_them(power: float, noise_blur_px: float) -> None:
    rng = np.random.default_rng(4)
    truth, radius = grid_of_balls(rng, 10, 90.0, (4.0, 5.0))
    clear = film_of_balls((940, 940), truth, radius, background=BACKGROUND, depth=0.6, sigma_px=1.2)
    noise = film_of_balls((940, 940), truth[:0], radius[:0], background=0.0, noise_sd=900.0, noise_blur_px=noise_blur_px, rng=rng)
    found = detect_markers(stored(clear + noise * (clear / BACKGROUND) ** (power / 2)), bits=16).images
    index, gap = nearest(truth, Detection(found, True, None, None))  # type: ignore[arg-type]  # of the detection only the images count
    assert (gap < 1.0).all()
    error = found.position_px[index] - truth
    ratio = float(np.sqrt((error**2 / np.einsum("nii->ni", found.covariance_px2[index])).mean()))
    print(f"variance with power {power} of the exposure, noise blur {noise_blur_px}: error / sd {ratio:.2f}")
    assert BAND[0] < ratio < BAND[1]


@pytest.mark.parametrize("grain_px", [3.0, 8.0])
def test_structure_of_the_background_counts(grain_px: float) -> None:
    rng = np.random.default_rng(6)
    truth, radius = grid_of_balls(rng, 10, 90.0, (4.0, 5.0))
    clear = film_of_balls((940, 940), truth, radius, background=BACKGROUND, depth=0.4, sigma_px=1.2, noise_sd=300.0, rng=rng)
    none = truth[:0], radius[:0]
    bone = film_of_balls((940, 940), *none, background=0.0, noise_sd=900.0 * grain_px / 8, noise_blur_px=grain_px, rng=rng)
    bone *= np.linspace(0.2, 2.0, 940)  # more of it on one side
    found = detect_markers(stored(clear + bone), bits=16).images
    index, gap = nearest(truth, Detection(found, True, None, None))  # type: ignore[arg-type]  # of the detection only the images count
    assert (gap < 1.0).all()
    error = found.position_px[index] - truth
    square = error**2 / np.einsum("nii->ni", found.covariance_px2[index])
    rough = truth[:, 0] > 470
    print(f"grain of {grain_px} px: error / sd {[round(float(np.sqrt(square[side].mean())), 2) for side in (rough, ~rough)]}")
    # drawn towards what is usual on the film, statements are cautious where it is quiet; nowhere may they be bold
    assert 0.7 < np.sqrt(square.mean()) < BAND[1]
    assert np.sqrt(square[rough].mean()) < 1.25


@pytest.mark.parametrize(("cnr", "part"), [(50, 0.04), (20, 0.05), (10, 0.06), (5, 0.12)])
@pytest.mark.parametrize("sigma_px", [0.8, 1.4])
def test_blur_and_attenuation_are_those_of_the_film(cnr: float, part: float, sigma_px: float) -> None:
    rng = np.random.default_rng(int(cnr))
    truth, radius = grid_of_balls(rng, 6, 64.0, (2.5, 6.0))
    blobs = rng.uniform(420, 620, (12, 2)), rng.uniform(2.0, 9.0, 12)  # what lies there is no ball of the film's blur
    balls = film_of_balls((640, 640), truth, radius, depth=DEPTH, sigma_px=sigma_px, noise_sd=DEPTH * BACKGROUND / cnr, rng=rng)
    soft = film_of_balls((640, 640), *blobs, depth=0.3 * DEPTH, sigma_px=3.5)
    optics = detect_markers(stored(balls + soft - BACKGROUND), bits=16).optics
    of_pixels = np.hypot(sigma_px, np.sqrt(1 / 12))  # the pixel's own square blurs too
    print(f"CNR {cnr}: blur {optics.sigma_px / of_pixels:.3f} of the true one, attenuation {optics.mu_px / ATTENUATION:.2f}")
    assert optics.sigma_px == pytest.approx(of_pixels, rel=part)
    assert optics.mu_px == pytest.approx(ATTENUATION, rel=0.5)


@pytest.mark.parametrize("bits", [8, 16])
def test_polarity_does_not_matter(bits: int) -> None:
    rng = np.random.default_rng(5)
    full = 2**bits - 1
    truth, radius = grid_of_balls(rng, 4, 64.0, (3.0, 6.0))
    film = film_of_balls((290, 290), truth, radius, background=0.7 * full, depth=0.4, noise_sd=0.01 * full, rng=rng)
    dark = detect_markers(stored(film, bits), bits=bits)
    bright = detect_markers(stored(full - film, bits), bits=bits)
    assert dark.dark_markers
    assert not bright.dark_markers
    assert len(dark.images) == len(bright.images) == 16
    _, gap = nearest(dark.images.position_px, bright)
    assert gap.max() < 0.1  # rounding goes the other way


def test_the_other_polarity_is_looked_at_where_the_likelier_one_has_no_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    """First looks took what surrounds balls on a sharpened film for more than the balls, and nothing was found."""
    rng = np.random.default_rng(8)
    film = stored(
        film_of_balls((400, 400), np.array([[101.3, 120.4], [290.2, 110.7], [200.4, 300.1]]), np.full(3, 5.0), noise_sd=400, rng=rng)
    )

    def misled(*args: Any) -> list[Seen]:
        balls, others = polarities(*args)
        return [replace(others, rival=True, weight=balls.weight), replace(balls, rival=False, weight=others.weight)]

    monkeypatch.setattr(rsa_vision.detect, "polarities", misled)
    found = detect_markers(film, bits=16)
    assert len(found.images) == 3
    assert found.dark_markers


@pytest.mark.parametrize("distance", [2.6, 1.6, 1.0, 0.75, 0.5])
def test_neighbours_are_resolved_or_flagged(distance: float) -> None:
    """A pair at a distance in diameters, among others that tell the size: right within its statement, or flagged."""
    rng = np.random.default_rng(9)
    truth, _ = grid_of_balls(rng, 5, 70.0, (4.0, 4.0))
    angle = rng.uniform(0, 2 * np.pi, 8)
    beside = truth[:8] + 8.0 * distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    every = np.concatenate([truth, beside])
    film = film_of_balls((390, 390), every, np.full(len(every), 4.0), background=BACKGROUND, depth=0.35, noise_sd=300.0, rng=rng)
    found = detect_markers(stored(film), bits=16)
    images = found.images
    trusted = images.rows((images.flags & (MarkerFlag.OVERLAP | MarkerFlag.POOR_FIT)) == 0)
    gap = np.hypot(*(trusted.position_px[:, None] - every[None]).transpose(2, 0, 1))
    error = trusted.position_px - every[gap.argmin(1)]
    sd = np.sqrt(np.einsum("nii->ni", trusted.covariance_px2))
    assert (np.abs(error) / sd).max() < 5.0, "confident and wrong"
    _, miss = nearest(every, found)
    print(f"{distance} diameters: {np.count_nonzero(miss[:8] < 1) + np.count_nonzero(miss[25:] < 1)} of 16 in pairs found")
    if distance >= 1.0:
        assert (miss < 1.0).all()


def test_saturated_cores_are_masked_and_flagged() -> None:
    rng = np.random.default_rng(2)
    truth, radius = grid_of_balls(rng, 5, 64.0, (5.0, 6.0))
    film = film_of_balls((350, 350), truth, radius, background=180.0, depth=1.2, noise_sd=2.0, rng=rng)
    found = detect_markers(stored(film, 8), bits=8)
    index, gap = nearest(truth, found)
    assert (gap < 0.5).all()
    assert (found.images.flags[index] & MarkerFlag.SATURATED).all()


@pytest.mark.parametrize("radius_px", [2.5, 4.0, 8.0])
def test_balls_over_the_edge_of_the_film_are_found_flagged_and_no_worse_than_stated(radius_px: float) -> None:
    """The filter's answer to a ball cut off there is highest on the border itself: with that left out, small ones were lost."""
    rng = np.random.default_rng(3)
    side = round(70 * radius_px)
    inner, _ = grid_of_balls(rng, 4, 12 * radius_px, (1.0, 1.0))
    depth = np.tile(np.repeat([0.3, 0.6, 0.9], 2), 4) * radius_px - 0.5
    along = np.repeat(np.linspace(0.1, 0.9, 12), 2) * side + rng.uniform(-0.5, 0.5, 24)
    edge = np.where(np.arange(24)[:, None] % 2 == 0, np.stack([depth, along], axis=1), np.stack([along, side - 1 - depth], axis=1))
    every = np.concatenate([inner + 8 * radius_px, edge])
    film = film_of_balls(
        (side, side),
        every,
        np.full(len(every), radius_px),
        background=BACKGROUND,
        depth=DEPTH,
        noise_sd=750.0,
        rng=rng,
        sigma_px=0.35 * radius_px,
    )
    found = detect_markers(stored(film), bits=16)
    assert len(found.images) == len(every)
    index, gap = nearest(edge, found)
    assert gap.max() < 0.3 * radius_px
    assert (found.images.flags[index] & MarkerFlag.EDGE).all()
    assert not (found.images.flags[index] & MarkerFlag.OVERLAP).any()  # nothing is beyond the border
    error, covariance = found.images.position_px[index] - edge, found.images.covariance_px2[index]
    ratio = np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error).mean() / 2)
    print(f"radius {radius_px}: error / sd {ratio:.2f}")
    assert 0.6 < ratio < 1.3  # 48 coordinates


def test_a_ball_on_a_film_too_small_for_surroundings_is_measured() -> None:
    rng = np.random.default_rng(8)
    truth = np.array([[25.3, 24.8]])
    film = film_of_balls((50, 50), truth, np.array([3.5]), background=BACKGROUND, depth=DEPTH, noise_sd=300.0, rng=rng)
    _, gap = nearest(truth, detect_markers(stored(film), bits=16))
    assert (gap < 0.5).all()


@pytest.mark.parametrize("bright", [False, True])
def test_balls_beside_the_margin_of_a_scan_are_found(bright: bool) -> None:
    """A slant border one or two radii away, beyond which the scan is white (black where marks are bright): its edge hid all of them."""
    rng = np.random.default_rng(3)
    rows = np.arange(25.0, 380.0, 30.0)
    border = 40 + 0.05 * np.arange(400.0)
    beside = np.stack([border[rows.astype(int)] + rng.uniform(4.0, 8.0, len(rows)), rows], axis=1)
    truth = np.vstack([beside, np.argwhere(np.ones((5, 5))) * 55.0 + [130.0, 70.0]])
    film = stored(film_of_balls((400, 400), truth, np.full(len(truth), 4.0), depth=0.12, noise_sd=0.12 * BACKGROUND / 20, rng=rng))
    film[np.arange(400)[None, :] < border[:, None]] = 65535
    film = 65535 - film if bright else film
    found = detect_markers(film, bits=16)
    index, gap = nearest(truth, found)
    print(f"{np.count_nonzero(gap > 1)} of {len(truth)} lost")
    assert np.count_nonzero(gap > 1) <= 1
    assert len(found.images) <= len(truth)
    clear = gap <= 1
    error = (found.images.position_px[index] - truth)[clear]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.images.covariance_px2[index][clear]), error)
    assert chi2.max() < 19.3


def test_noise_between_crowded_balls() -> None:
    """No tile of 32 pixels has room between them: noise was taken for a hundred times what it is, and one in twenty was lost."""
    rng = np.random.default_rng(1)
    truth, radius = grid_of_balls(rng, 14, 20.0, (4.0, 4.0))
    film = film_of_balls((310, 310), truth, radius, background=20000.0, depth=0.9, sigma_px=1.1, noise_sd=400.0, rng=rng)
    noise = estimate_noise(stored(film), 16)
    assert 0.7 < noise.variance_at(np.array(20000.0)) / 400.0**2 < 1.5
    found = detect_markers(stored(film), bits=16)
    index, _ = nearest(truth, found)
    assert len(found.images) == len(truth)
    assert len(set(index.tolist())) == len(truth)
    error = found.images.position_px[index] - truth
    ratio = np.sqrt(np.mean(error**2 / np.einsum("nii->ni", found.images.covariance_px2[index])))
    print(f"RMS {np.sqrt(np.mean(error**2)):.4f} px, error / sd {ratio:.2f}")
    assert 0.8 < ratio < 1.25
