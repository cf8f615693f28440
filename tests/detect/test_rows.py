"""Threads of screws, which look like balls in a row, told from balls that lie near each other."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.neighbours.rows import in_bars, in_rows, like_those_in_rows
from rsa_vision.flags import MarkerFlag
from rsa_vision.types import MarkerImages

from .films import FINE, film_of_balls, grid_of_balls, stored

BACKGROUND, NOISE, SIGMA_PX = 30000.0, 500.0, 1.2
RADIUS_PX, DEPTH, SIZE = 2.6, 0.5, 400  # of balls; of films
OF_METAL = 0.02  # attenuation of a screw along a pixel of chord
BALLS = np.array([[40.2, 39.7], [150.4, 30.1], [359.6, 45.3], [39.9, 165.4], [360.1, 179.8], [40.3, 290.2], [169.7, 370.0], [345.4, 364.6]])
PITCH, CREST, DEEP, LENGTH = 12.5, 11.0, 5.6, 200.0  # of a thread, its radius there and its depth, of a screw; pixels


def rows_of(position_px: NDArray[np.float64], radius_px: float = 2.5) -> NDArray[np.bool_]:
    return in_rows(position_px, np.full(len(position_px), radius_px), np.full(len(position_px), -1000.0))


def line(steps: NDArray[np.float64], direction: float = 0.3) -> NDArray[np.float64]:
    return steps[:, None] * [np.cos(direction), np.sin(direction)] + 100.0


def screw(tip: tuple[float, float], direction: float) -> NDArray[np.float64]:
    """What is left of the light behind a shaft whose radius goes up and down between core and crest, by chords across it."""
    rows, cols = (np.mgrid[0 : SIZE * FINE, 0 : SIZE * FINE] + 0.5) / FINE - 0.5
    dx, dy = cols - tip[0], rows - tip[1]
    along, across = dx * np.cos(direction) + dy * np.sin(direction), dy * np.cos(direction) - dx * np.sin(direction)
    turn = np.where(across > 0, 0.0, 0.5)  # on the other side the crest has gone round by half a turn
    radius = CREST - 2 * DEEP * np.abs((along / PITCH + turn) % 1.0 - 0.5)
    chord = 2 * np.sqrt(np.maximum(radius**2 - across**2, 0.0)) * ((along > 0) & (along < LENGTH))
    return np.asarray(np.exp(-OF_METAL * chord))


@pytest.fixture(scope="module")
def found() -> list[MarkerImages]:
    """What is found on a film of balls and two screws, and on one of the balls alone."""
    rng = np.random.default_rng(1)
    light = film_of_balls((SIZE, SIZE), BALLS, np.full(len(BALLS), RADIUS_PX), background=1.0, depth=DEPTH, sigma_px=SIGMA_PX)
    fine = gaussian_filter(np.prod([screw((90.0, 80.0 + 70 * k), 0.12 - 0.08 * k) for k in range(0, 4, 2)], axis=0), SIGMA_PX * FINE)
    screws = fine.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))
    films = [BACKGROUND * part + NOISE * rng.standard_normal((SIZE, SIZE)) for part in (light * screws, light)]
    return [detect_markers(stored(film), bits=16).images for film in films]


def test_no_thread_of_a_screw_passes_for_a_ball(found: list[MarkerImages]) -> None:
    gap = np.hypot(*(found[0].position_px[:, None] - BALLS).transpose(2, 0, 1))
    others, doubted = gap.min(axis=1) > 2.0, found[0].flags & (MarkerFlag.UNLIKE | MarkerFlag.POOR_FIT) > 0
    assert not (others & ~doubted).any()
    assert (gap[~doubted].min(axis=0, initial=np.inf) < 0.2).all()


def test_threads_hardly_change_what_is_stated_of_balls(found: list[MarkerImages]) -> None:
    stated = []
    for images in found:
        nearest = np.hypot(*(images.position_px[:, None] - BALLS).transpose(2, 0, 1)).argmin(axis=0)
        stated.append(np.sqrt(np.trace(images.covariance_px2[nearest], axis1=1, axis2=2)))
    assert np.median(stated[0] / stated[1]) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("direction", np.linspace(0.0, np.pi, 7).tolist())
def test_five_in_equal_steps_of_less_than_three_diameters_are_a_row(direction: float) -> None:
    rng = np.random.default_rng(1)
    row = line(9.0 * np.arange(5.0), direction) + rng.normal(0.0, 0.2, (5, 2))
    apart = np.array([[20.0, 300], [300, 20]])
    assert rows_of(np.concatenate([row, apart])).tolist() == [True] * 5 + [False] * 2


def test_crests_across_a_screw_and_beyond_gaps_belong_to_its_row() -> None:
    other_side = line(9.0 * np.array([0.5, 2.5, 4.5])) + 25.0 * np.array([-np.sin(0.3), np.cos(0.3)])
    beyond = line(9.0 * np.array([6.0, 8.0]))
    assert rows_of(np.concatenate([line(9.0 * np.arange(5.0)), other_side, beyond])).all()
    between = line(np.array([15.5])) + 12.0 * np.array([-np.sin(0.3), np.cos(0.3)])
    assert not rows_of(np.concatenate([line(9.0 * np.arange(5.0)), between]))[-1]


@pytest.mark.parametrize(
    "steps",
    [
        20.0 * np.arange(5.0),  # four diameters
        9.0 * np.arange(4.0),  # a cluster of four
        np.cumsum([0.0, 9.0, 13.0, 8.0, 12.0, 7.0]),  # put one by one
    ],
)
def test_balls_in_line_are_no_row_if_far_few_or_uneven(steps: NDArray[np.float64]) -> None:
    assert not rows_of(line(steps)).any()


def test_balls_with_their_like_on_all_sides_are_no_rows() -> None:
    assert not rows_of(grid_of_balls(np.random.default_rng(1), 14, 20.0, (4.0, 4.0))[0], 4.0).any()


def test_balls_that_lap_at_random_make_hardly_a_row() -> None:
    rng = np.random.default_rng(3)
    crowds = [rng.uniform(0.0, 40.0, (12, 2)) for _ in range(200)]
    assert sum(rows_of(crowd).any() for crowd in crowds) <= 4


def test_a_ball_that_is_deeper_or_larger_is_not_of_a_row_beside_it() -> None:
    position = np.concatenate([line(9.0 * np.arange(5.0)), line(np.array([45.0]))])
    radius, depth = np.array([2.5] * 5 + [4.5]), np.array([-300.0] * 5 + [-1000.0])
    assert not in_rows(position, radius, np.full(6, -300.0))[-1]
    assert not in_rows(position, np.full(6, 2.5), depth)[-1]


def test_what_is_like_those_in_rows_near_them_and_like_no_ball_elsewhere_is_of_their_screw() -> None:
    position = np.concatenate([line(9.0 * np.arange(5.0)), line(9.0 * np.array([7.3, 13.4])), line(np.array([-300.0, -350.0]))])
    rowed, depth = np.arange(9) < 5, np.array([-300.0, -310.0, -290.0, -320.0, -280.0, -300.0, -300.0, -700.0, -720.0])
    radius, poor = np.array([2.4] * 7 + [2.8, 1.8]), np.zeros(9, bool)
    assert like_those_in_rows(position, radius, depth, rowed, poor).tolist() == [False] * 5 + [True, True, False, False]
    as_faint, as_large = np.append(depth[:8], -300.0), np.append(radius[:8], 2.4)
    assert not like_those_in_rows(position, as_large, as_faint, rowed, poor).any()  # a ball elsewhere is the same
    last = np.arange(9) == 8
    assert like_those_in_rows(position, as_large, as_faint, rowed, last)[5:7].all()  # but of what is none itself
    deeper = np.append(depth[:6], [-700.0, -700.0, -720.0])
    assert like_those_in_rows(position, radius, deeper, rowed, poor).tolist() == [False] * 5 + [True, False, False, False]
    assert not like_those_in_rows(position, radius, depth, np.zeros(9, bool), poor).any()


def test_true_balls_in_line_four_diameters_apart_keep_their_names() -> None:
    rng = np.random.default_rng(8)
    others = grid_of_balls(rng, 3, 60.0, (2.5, 2.5))[0]
    position = np.concatenate([line(20.0 * np.arange(5.0), 0.0) - [60.0, 25.0], others])
    film = film_of_balls((200, 200), position, np.full(len(position), 2.5), noise_sd=100.0, rng=rng)
    images = detect_markers(stored(film), bits=16).images
    those = np.hypot(*(images.position_px[:, None] - position[:5]).transpose(2, 0, 1)).argmin(axis=0)
    assert (images.flags[those] & MarkerFlag.UNLIKE == 0).all()


def test_three_that_lap_in_line_are_a_bar() -> None:
    """Balls that lie anywhere do not lap as evenly; two may."""
    bar, radius = np.array([[50.0, 50.0], [56.8, 50.3], [63.5, 50.2]]), np.array([4.3, 4.4, 4.5])
    bent, far = bar + np.array([[0, 0], [0, 3.0], [0, 0]]), bar * [2.0, 1.0]
    depth = np.full(3, -900.0)
    assert in_bars(bar, radius, depth).all()
    assert not in_bars(bent, radius, depth).any()
    assert not in_bars(far, radius, depth).any()
    assert not in_bars(bar[:2], radius[:2], depth[:2]).any()
    assert not in_bars(bar, radius, depth * [1.0, 2.5, 1.0]).any()  # a pin's end between two beads
    assert in_bars(np.append(bar, [[80.0, 50.0]], axis=0), np.append(radius, 4.4), np.full(4, -900.0)).tolist() == [True, True, True, False]
