"""The image of a needle: as exact chords make it, thick ends seen at a slant included."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

from rsa_vision.detect.models.film_curve import by_film_curve, film_curve, skewness_of_log, slope_of_film_curve
from rsa_vision.detect.models.needles import NeedleShape, arm_images, arms_by_optics
from rsa_vision.detect.models.profiles import Optics
from rsa_vision.detect.needles.fits import unfit
from rsa_vision.detect.needles.states import Sizes, of_several_lengths, of_several_sizes
from rsa_vision.types import Float
from synthetic.chords import chord_pin

HALF, FINE, SIGMA, MU, TURN = 36, 7, 1.1, 0.6, 0.4
SHAPE = NeedleShape(3.1, 24.4)


def exact(along: float, across: float, blur_px: float | tuple[float, float] = SIGMA) -> np.ndarray:
    """Blurred opacity of a cone that rays of these slopes cross, attenuation counted along the film's normal."""
    line = (np.arange((2 * HALF + 1) * FINE) + 0.5) / FINE - 0.5 - HALF
    x, y = np.meshgrid(line, line)
    axis, side = np.array([np.cos(TURN), -np.sin(TURN), 0.0]), np.array([np.sin(TURN), np.cos(TURN), 0.0])
    ray = np.array([0.0, 0.0, 1.0]) + along * axis + across * side
    chord = chord_pin(np.array([x, y, 0 * x]), ray, np.zeros(3), axis, SHAPE.length_px, SHAPE.half_width_px) / np.linalg.norm(ray)
    return gaussian_filter(-np.expm1(-MU * chord), np.multiply(blur_px, FINE)).reshape(2 * HALF + 1, FINE, 2 * HALF + 1, FINE).mean((1, 3))


def modelled(slant: float, skew: float, across: float = 0.0) -> np.ndarray:
    """Image that the tables give; a slope across widens the cone and thins it."""
    rows, cols = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    wider = np.sqrt(1 + across**2)
    shape = NeedleShape(SHAPE.half_width_px * wider, SHAPE.length_px)
    optics = Optics(np.sqrt(SIGMA**2 + 1 / 12), MU / wider)
    image = arm_images(cols.ravel(), rows.ravel(), np.array([TURN]), shape, optics, np.array([[slant], [skew]]))[0]
    return image.reshape(rows.shape)


@pytest.mark.parametrize(("along", "across"), [(0.0, 0.0), (0.3, 0.0), (0.5, 0.0), (0.25, 0.35)])
def test_tables_are_the_image_of_a_cone_at_any_slant(along: float, across: float) -> None:
    image = exact(along, across)
    skew = along * across / (1 + across**2)
    ours = min((modelled(along**2, sign * skew, across) for sign in (-1, 1)), key=lambda one: np.abs(one - image).max())
    assert np.abs(ours - image).max() < 0.045
    assert np.sqrt(((ours - image) ** 2).sum() / (image**2).sum()) < 0.025
    if along > 0.2:
        assert np.abs(modelled(0.0, 0.0, across) - image).max() > 2 * np.abs(ours - image).max()


@pytest.mark.parametrize("blur_px", [(1.1, 1.1), (1.4, 0.9), (0.9, 1.4)])
def test_tables_are_the_image_of_blur_that_differs_by_direction(blur_px: tuple[float, float]) -> None:
    image = exact(0.0, 0.0, blur_px)
    across, along = np.square(blur_px) + 1 / 12  # rows, columns
    rows, cols = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    optics = Optics(np.sqrt((along + across) / 2), MU, uneven=((along - across) / (along + across), 0.0))
    ours = arm_images(cols.ravel(), rows.ravel(), np.array([TURN]), SHAPE, optics)[0].reshape(rows.shape)
    assert np.abs(ours - image).max() < 0.03
    assert np.sqrt(((ours - image) ** 2).sum() / (image**2).sum()) < 0.02


@pytest.mark.parametrize(("half_width", "length"), [(2.36, 23.3), (2.58, 25.0), (4.55, 42.0)])  # at a grid's node, and almost at the next
@pytest.mark.parametrize("mu", [0.05, 0.5])
def test_derivatives_are_as_steep_as_the_needle_whatever_the_table(half_width: float, length: float, mu: float) -> None:
    rows, cols = np.mgrid[-2 * HALF : 2 * HALF + 1, -2 * HALF : 2 * HALF + 1].reshape(2, -1).astype(float)

    def image(x: float, y: float, wide: float, long: float, turn: float) -> Float:
        return arm_images(
            cols - x, rows - y, np.array([TURN + turn]), NeedleShape(wide, long), Optics(1.4, mu), np.zeros((2, 1)), exact=True
        )[:6, 0]

    at, step = np.array([0.3, 0.2, half_width, length, 0.0]), 0.02
    for k, slope in enumerate(image(*at)[1:]):
        high, low = (image(*(at + sign * step * (np.arange(5) == k)))[0] for sign in (1, -1))
        expected = (high - low) / (2 * step)
        assert expected @ slope / (slope @ slope) == pytest.approx(1.0, abs=0.03)


def test_derivatives_by_what_is_uneven() -> None:
    rows, cols = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].reshape(2, -1).astype(float)
    angles, step = np.array([0.3, 1.87, -1.27]), 0.3  # so far that the grid of tables does not show
    slopes = arms_by_optics(cols, rows, angles, SHAPE, Optics(SIGMA, MU))[-2:].reshape(2, -1)
    for slope, uneven in zip(slopes, ((step, 0.0), (0.0, step)), strict=True):
        high, low = (
            arm_images(cols, rows, angles, SHAPE, Optics(SIGMA, MU, uneven=(sign * uneven[0], sign * uneven[1])))[0] for sign in (1, -1)
        )
        expected = (high - low).ravel() / (2 * step)
        assert slope @ expected > 0.98 * np.linalg.norm(slope) * np.linalg.norm(expected)
        assert 0.9 < np.linalg.norm(slope) / np.linalg.norm(expected) < 1.1


@pytest.mark.parametrize("step", [pytest.param(0.1, id="uneven blur"), pytest.param(0.05, id="blur and attenuation of its own")])
def test_images_go_on_where_another_table_begins(step: float) -> None:
    rows, cols = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].reshape(2, -1).astype(float)

    def image(by: float) -> Float:
        if step == 0.1:
            optics = Optics(SIGMA, MU, uneven=(by, 0.0))
        else:
            optics = replace(unfit(np.zeros(2), np.zeros(1), SHAPE), blurrier=by, denser=-by).seen_by(Optics(SIGMA, MU))
        return arm_images(cols, rows, np.array([0.0]), SHAPE, optics)[0, 0]

    below, above, beyond = image(0.499 * step), image(0.501 * step), image(1.499 * step)
    assert np.linalg.norm(above - below) < 0.15 * np.linalg.norm(beyond - above)  # without what is in between it is as much
    assert np.abs(above - below).max() < 0.006


@pytest.mark.parametrize(
    "answer",
    [
        pytest.param(lambda light: -np.log(light), id="logarithm"),
        pytest.param(lambda light: light**-2.0, id="transmitted light"),
        pytest.param(lambda light: -1 / (1 + (0.6 / light) ** 2), id="density with toe and shoulder"),
    ],
)
@pytest.mark.parametrize("scattered", [0.5, 1.0])
def test_the_film_curve_follows_those_of_films(answer: Callable[[Float], Float], scattered: float) -> None:
    opacity = np.linspace(0.0, 0.95, 50)
    shown = answer((1 + scattered - opacity) / (1 + scattered))
    shown = (shown - shown[0]) / np.ptp(shown)

    def left(of: Float) -> Float:
        return of[0] * film_curve(opacity, (of[1], of[2])) - shown

    best = least_squares(left, [1.0, 0.0, 0.0])
    assert np.sqrt(np.mean(best.fun**2)) < 0.004
    assert abs(best.x[2]) < 0.4  # a small correction


@pytest.mark.parametrize(("late_px", "density"), [(0.29, 1.5), (0.5, 0.8), (0.5, 0.0)])
def test_what_is_blurred_after_the_film_curve(late_px: float, density: float) -> None:
    """A scanner's pixel takes the mean of the light, of which density is the logarithm; what is dark then has no say."""
    curve, early = (-0.8, -0.1), np.sqrt(0.3)
    line = (np.arange((2 * HALF + 1) * FINE) + 0.5) / FINE - 0.5 - HALF
    x, y = np.meshgrid(line, line)
    along, across = x * np.cos(TURN) - y * np.sin(TURN), x * np.sin(TURN) + y * np.cos(TURN)
    width = SHAPE.half_width_px * np.clip(along / SHAPE.length_px, 0, 1) * (along < SHAPE.length_px)
    opacity = -np.expm1(-2 * MU * np.sqrt(np.maximum(width**2 - across**2, 0)))
    logged = np.log(10) * density
    shown = film_curve(gaussian_filter(opacity, early * FINE), curve)
    light = gaussian_filter(np.exp(logged * shown) if density else shown, late_px * FINE)
    image = (np.log(light) / logged if density else light)[FINE // 2 :: FINE, FINE // 2 :: FINE]
    variance = early**2 + late_px**2
    rows, cols = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)

    def missed(late: float, logged: float) -> float:
        optics = Optics(float(np.sqrt(variance)), MU, curve=curve, late=late, logged=logged)
        ours = arm_images(cols.ravel(), rows.ravel(), np.array([TURN]), SHAPE, optics)[0].reshape(rows.shape)
        return float(np.sqrt(((ours - image) ** 2).sum() / (image**2).sum()))

    right = missed(late_px**2 / variance, logged)
    assert right < 0.02
    assert missed(0.0, 0.0) > 1.5 * right


@pytest.mark.parametrize("left", [0.3, 0.05, 0.003])
def test_logarithms_of_light_are_followed_whatever_is_left(left: float) -> None:
    """A polynomial for the skewness left 0.4 % of the depth at 2 % of light, and tips 2 % of their length off."""
    opacity = np.linspace(0.0, 1.0, 50)
    bend = 0.5 * np.log(left)
    expected = np.log(1 - (1 - left) * opacity) / np.log(left)
    assert np.allclose(film_curve(opacity, (bend, skewness_of_log(bend))), expected, atol=1e-12)


@pytest.mark.parametrize("curve", [(-1.7, 0.3), (-0.8, -0.2), (0.6, 0.3), (0.0, 0.1), (-0.03, 0.1), (-2.5, 1.0)])
def test_slopes_of_the_film_curve(curve: tuple[float, float]) -> None:
    opacity, step = np.linspace(0.01, 0.99, 50), 1e-6
    high, low = (film_curve(opacity + sign * step, curve) for sign in (1, -1))
    assert np.allclose(slope_of_film_curve(opacity, curve), (high - low) / (2 * step), atol=1e-7)
    for k, slope in enumerate(by_film_curve(opacity, curve)):
        high, low = (film_curve(opacity, tuple(np.array(curve) + sign * step * np.eye(2)[k])) for sign in (1, -1))
        assert np.allclose(slope, (high - low) / (2 * step), atol=1e-6)


def test_derivatives_of_the_film_curve() -> None:
    opacity, step = np.linspace(0.0, 1.0, 21), 1e-5
    slopes = by_film_curve(opacity, (-0.8, 0.2))
    for slope, by in zip(slopes, (np.array([step, 0]), np.array([0, step])), strict=True):
        high, low = (film_curve(opacity, tuple(np.array([-0.8, 0.2]) + sign * by)) for sign in (1, -1))
        np.testing.assert_allclose(slope, (high - low) / (2 * step), atol=1e-8)


@pytest.mark.parametrize(("odd", "several"), [(0, False), (1, False), (2, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_one_needle_of_an_odd_size_does_not_make_several_sizes(odd: int, several: bool, axis: int) -> None:
    spread = np.full((40, 2), 0.02)
    spread[:odd, axis] = np.inf  # outliers
    sizes = Sizes(np.zeros(2), [spread[:13], spread[13:]])
    assert of_several_sizes(sizes) == several
    assert of_several_lengths(sizes) == (several and axis == 1)
