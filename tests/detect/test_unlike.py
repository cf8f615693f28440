"""What is paler than a film's balls wherever they lie, told from balls that are pale because of what they lie on."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.balls.unlike import like_poor_ones, of_odd_size, too_deep, too_pale
from rsa_vision.detect.models.needles import NeedleFit, NeedleShape
from rsa_vision.detect.needles.arms import badly_placed, lone_tees
from rsa_vision.detect.needles.fits import unfit
from rsa_vision.flags import MarkerFlag

from .films import film_of_balls, grid_of_balls, stored
from .test_balls import BACKGROUND, DEPTH, nearest

Response = Callable[[NDArray[np.float64]], NDArray[np.float64]]
SD = 0.02  # of depths


def linear(background: NDArray[np.float64]) -> NDArray[np.float64]:
    return background - 0.15


def arched(background: NDArray[np.float64]) -> NDArray[np.float64]:
    return background * (1.1 - background)


def level(background: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full(len(background), 0.5)


def pale(depth: NDArray[np.float64], background: NDArray[np.float64]) -> list[int]:
    return np.flatnonzero(too_pale(depth, (SD * depth) ** 2, background, np.ones(len(depth), bool))).tolist()


@pytest.mark.parametrize("gradient", [(0.0, 0.0), (0.5, 0.3)])
def test_things_of_a_balls_size_and_less_than_half_as_deep_are_flagged(gradient: tuple[float, float]) -> None:
    """Their size alone does not tell them, nor do there have to be few: a row of staples has many corners."""
    rng = np.random.default_rng(1)
    truth, _ = grid_of_balls(rng, 5, 80.0, (4.0, 4.0))
    radius = rng.uniform(3.95, 4.05, 25)
    paler = [6, 11, 12, 13, 17, 18]
    part = np.full(25, DEPTH)
    part[paler] *= 0.35
    place = 1 + truth @ np.array(gradient) / 440.0
    film = film_of_balls(
        (440, 440), truth, radius, background=BACKGROUND, depth=part * place, gradient=gradient, noise_sd=DEPTH * BACKGROUND / 30, rng=rng
    )
    found = detect_markers(stored(film), bits=16)
    index, gap = nearest(truth, found)
    assert gap.max() < 0.3
    assert np.flatnonzero(found.images.flags[index] == MarkerFlag.UNLIKE).tolist() == paler
    assert not np.delete(found.images.flags[index], paler).any()


@pytest.mark.parametrize("response", [linear, arched, level])
def test_balls_are_as_deep_as_their_background_lets_them_be(response: Response) -> None:
    """Whatever function of the background their depth is, as long as it is no hollow, on whatever part of the film most of them lie."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        background = np.concatenate([rng.uniform(0.2, 1.0, rng.integers(2, 12)), rng.normal(0.9, 0.02, rng.integers(2, 15))])
        depth = response(background) * rng.uniform(0.85, 1.0, len(background)) * (1 + SD * rng.standard_normal(len(background)))
        assert pale(depth, background) == []


@pytest.mark.parametrize("response", [linear, arched, level])
def test_what_is_a_third_as_deep_as_balls_on_darker_and_lighter_film_is_too_pale(response: Response) -> None:
    rng = np.random.default_rng(3)
    background = np.linspace(0.3, 1.0, 20)
    depth = response(background) * (1 + SD * rng.standard_normal(20))
    things = [5, 9, 10, 11, 14]
    depth[things] *= 0.33
    assert pale(depth, background) == things


def test_nothing_is_known_of_balls_on_backgrounds_of_their_own_nor_on_films_of_few() -> None:
    background = np.linspace(0.3, 1.0, 12)
    depth = np.full(12, 0.5)
    depth[[0, 11]] = 0.1
    assert pale(depth, background) == []
    few = np.array([0.5, 0.5, 0.1, 0.5, 0.5])
    assert pale(few, background[:5]) == []


def test_doubtful_depths_are_not_too_pale() -> None:
    background, depth, sd = np.linspace(0.3, 1.0, 12), np.full(12, 0.5), np.full(12, 0.01)
    depth[5], sd[5] = 0.2, 0.1
    assert not too_pale(depth, sd**2, background, np.ones(12, bool)).any()


def test_balls_that_scatter_much_make_nothing_too_pale() -> None:
    rng = np.random.default_rng(4)
    depth = 0.5 * np.exp(0.5 * rng.standard_normal(30))
    depth[15] = 0.15
    assert pale(depth, np.linspace(0.3, 1.0, 30)) == []


def test_what_is_too_pale_is_no_company_for_an_odd_size() -> None:
    """Three of one size of their own could be marks of another kind, did one of them not take away too little."""
    rng = np.random.default_rng(5)
    truth, radius = grid_of_balls(rng, 4, 80.0, (3.95, 4.05))
    radius[[5, 6, 9]] = 5.6
    for part, expected in ((1.0, []), (0.3, [5, 6, 9])):
        depth = np.full(16, DEPTH)
        depth[9] *= part
        film = film_of_balls((360, 360), truth, radius, background=BACKGROUND, depth=depth, noise_sd=DEPTH * BACKGROUND / 30, rng=rng)
        found = detect_markers(stored(film), bits=16)
        index, gap = nearest(truth, found)
        assert gap.max() < 0.3
        assert np.flatnonzero(found.images.flags[index] == MarkerFlag.UNLIKE).tolist() == expected


@pytest.mark.parametrize("response", [linear, arched, level])
def test_what_is_twice_as_deep_as_balls_on_darker_and_lighter_film_is_none_of_their_metal(response: Response) -> None:
    rng = np.random.default_rng(6)
    background = np.linspace(0.3, 0.9, 24)
    depth = response(background) * rng.uniform(0.7, 1.0, 24) * (1 + SD * rng.standard_normal(24))
    known = np.ones(24, bool)
    assert not too_deep(depth, (SD * depth) ** 2, background, known).any()
    things = [8, 9, 14]
    depth[things] = 2.2 * response(background)[things]
    assert np.flatnonzero(too_deep(depth, (SD * depth) ** 2, background, known)).tolist() == things
    assert not too_deep(depth, (0.5 * depth) ** 2, background, known).any()  # doubtful ones
    assert not too_deep(depth[:5], (SD * depth[:5]) ** 2, background[:5], known[:5]).any()  # a film of few


@pytest.mark.parametrize(("small", "flagged"), [(4, True), (5, True), (6, False), (9, False)])
def test_a_few_of_half_the_size_of_two_dozen_are_dots_and_not_beads(small: int, flagged: bool) -> None:
    """A date has two colons; a bone has half a dozen of its own beads, or the cage has larger ones."""
    rng = np.random.default_rng(7)
    size = np.append(rng.normal(6.0, 0.4, 24), rng.normal(3.0, 0.05, small))
    odd = of_odd_size(size, np.full(len(size), 0.02**2))
    assert odd[24:].all() == odd[24:].any() == flagged
    assert not of_odd_size(size[:24], np.full(24, 0.2**2)).any()
    assert not of_odd_size(np.append(np.full(24, 6.0), np.full(4, 4.5)), np.full(28, 0.02**2)).any()  # 0.8 and 0.6 mm
    # of two in one beam noise lets nothing be seen but their size: less than three standard deviations from two others, and like none
    scattered = np.array([4.3, 4.43, 4.49, 4.6, 4.78, 4.85, 4.87, 4.88, 4.96, 4.98, 5.07, 5.98])
    error = np.array([0.16, 0.17, 0.15, 0.16, 0.19, 0.23, 0.19, 0.14, 0.24, 0.17, 0.25, 0.17])
    assert np.flatnonzero(of_odd_size(scattered, error**2)).tolist() == [11]


def test_tees_among_balls_need_company() -> None:
    """Letters of lead have corners like tees; those of a set are as wide as each other and parallel."""
    arms = np.deg2rad([90.0, 180.0, 0.0])

    def tee(turn: float, half_width: float) -> NeedleFit:
        return unfit(np.zeros(2), arms + turn, NeedleShape(half_width, 20.0))

    pin = unfit(np.zeros(2), arms[:1], NeedleShape(2.5, 20.0))
    two, three = [tee(0.0, 2.5), tee(0.1, 2.4)], [tee(0.0, 2.5), tee(0.1, 2.4), tee(-0.1, 2.6)]
    assert lone_tees([*two, pin], np.ones(3, bool)).tolist() == [True, True, False]
    assert not lone_tees([*three, pin], np.ones(4, bool)).any()
    assert lone_tees([*two, tee(1.5, 2.5)], np.ones(3, bool)).all()
    assert lone_tees([*two, tee(0.0, 4.5)], np.ones(3, bool)).all()
    assert lone_tees(three, np.array([True, True, False])).tolist() == [True, True, False]
    turned = [tee(turn, 2.5) for turn in (0.0, 1.0, 2.0)]
    for explained, lone in ((0.98, True), (0.992, False)):  # more than the model explains of letters
        assert lone_tees([replace(t, explained=explained) for t in turned], np.ones(3, bool)).all() == lone
    closely = replace(turned[0], explained=0.996)
    assert lone_tees([closely, turned[1]], np.ones(2, bool)).tolist() == [False, True]
    assert lone_tees([closely], np.zeros(1, bool)).all()


def test_a_tee_whose_place_is_known_badly_though_it_stands_high_above_noise_is_none() -> None:
    covariance = np.array([0.02, 0.02, 0.3, 0.3, np.nan])[:, None, None] ** 2 * np.eye(2)
    snr = np.array([200.0, 20.0, 20.0, 200.0, 200.0])
    assert badly_placed(covariance, np.full(5, 2.0), snr).tolist() == [False, False, False, True, False]


def test_what_is_like_many_that_are_poorly_described_is_no_surer() -> None:
    size = np.array([3.2] * 9 + [2.5] * 8 + [3.25, 4.5])
    depth = np.full(len(size), -9000.0)
    poor = np.arange(len(size)) < 9
    told = like_poor_ones(size, depth, poor)
    assert np.flatnonzero(told).tolist() == [17]
    assert not like_poor_ones(size, np.where(np.arange(len(size)) == 17, -2e4, depth), poor).any()  # another depth
    assert not like_poor_ones(size, depth, poor & (np.arange(len(size)) < 5)).any()  # too few, and others of the size that are described


@pytest.mark.parametrize(("stroke_px", "half_px", "stem_px"), [(6, 14, 28), (7, 16, 30), (8, 14, 28), (8, 16, 30)])
@pytest.mark.parametrize("seed", range(2))
def test_lead_letters_whose_strokes_meet_are_no_tees(seed: int, stroke_px: int, half_px: int, stem_px: int) -> None:
    rng, fine, side = np.random.default_rng(seed), 4, 320
    light = np.zeros((side * fine, side * fine))
    for place in np.array([[60.0, 70.0], [220.0, 70.0], [60.0, 220.0], [220.0, 220.0]]) + rng.uniform(-20, 20, (4, 2)):
        col, row = (fine * place).astype(int)
        half, stroke = fine * half_px, fine * stroke_px // 2
        light[row - stroke : row + stroke, col - half : col + half] = 1.0
        light[row : row + fine * stem_px, col - stroke : col + stroke] = 1.0
    opacity = gaussian_filter(light, 0.9 * fine).reshape(side, fine, side, fine).mean((1, 3))
    film = 30000 * (1 - 0.6 * opacity) + rng.normal(0, 140, (side, side))
    assert (detect_markers(stored(film), bits=16).images.flags != 0).all()
