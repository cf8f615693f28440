"""The image of a needle: as exact chords make it, thick ends seen at a slant included."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rsa_vision.detect.needle_images import NeedleShape, arm_images
from rsa_vision.detect.profiles import Optics
from synthetic.chords import chord_pin

HALF, FINE, SIGMA, MU, TURN = 36, 7, 1.1, 0.6, 0.4
SHAPE = NeedleShape(3.1, 24.4)


def exact(along: float, across: float) -> np.ndarray:
    """Blurred opacity of a cone that rays of these slopes cross, attenuation counted along the film's normal."""
    line = (np.arange((2 * HALF + 1) * FINE) + 0.5) / FINE - 0.5 - HALF
    x, y = np.meshgrid(line, line)
    axis, side = np.array([np.cos(TURN), -np.sin(TURN), 0.0]), np.array([np.sin(TURN), np.cos(TURN), 0.0])
    ray = np.array([0.0, 0.0, 1.0]) + along * axis + across * side
    chord = chord_pin(np.array([x, y, 0 * x]), ray, np.zeros(3), axis, SHAPE.length_px, SHAPE.half_width_px) / np.linalg.norm(ray)
    return gaussian_filter(-np.expm1(-MU * chord), SIGMA * FINE).reshape(2 * HALF + 1, FINE, 2 * HALF + 1, FINE).mean((1, 3))


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
