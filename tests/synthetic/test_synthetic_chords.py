"""Chords in closed form against counting along the ray."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from synthetic.chords import chord_ball, chord_ellipsoid, chord_pin

STEPS = 200_001
SPAN_MM = 12.0
TOLERANCE_MM = 3 * SPAN_MM / STEPS  # two ends, each within a step of the numerical sum, and rounding

coordinate = st.floats(-1.5, 1.5)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
direction = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


def along(middle, way):
    """Points of a line within SPAN_MM / 2 of ``middle``, shape (3, STEPS), and their distance from each other."""
    unit = way / np.linalg.norm(way)
    s = np.linspace(-SPAN_MM / 2, SPAN_MM / 2, STEPS)
    return middle[:, None] + s * unit[:, None], s[1] - s[0]


@settings(max_examples=60, deadline=None)
@given(point, direction, st.floats(0.2, 2.0))
def test_ball(middle, way, radius):
    points, step = along(middle, way)
    counted = step * np.count_nonzero((points**2).sum(0) <= radius**2)
    chord = chord_ball(middle - 1000 * way, way, np.zeros(3), radius)
    assert chord == pytest.approx(counted, abs=TOLERANCE_MM + 1e-6 / max(float(chord), 1e-3))  # a grazing ray's ends are soft


@settings(max_examples=60, deadline=None)
@given(point, direction, direction, st.floats(0.3, 3.0), st.floats(0.1, 0.6), st.sampled_from([None, 0.0, 0.5]))
def test_pin(middle, way, axis, length, radius, taper_part):
    axis = axis / np.linalg.norm(axis)
    taper = None if taper_part is None else taper_part * length
    tip = np.array([0.1, -0.2, 0.3])
    points, step = along(middle, way)
    height = axis @ (points - tip[:, None])
    across = np.linalg.norm(points - tip[:, None] - axis[:, None] * height, axis=0)
    in_an_end = np.ptp(height) < 1e-6 and min(abs(height[0]), abs(height[0] - length)) < 1e-6  # neither inside nor outside
    assume(not in_an_end)
    full = length if taper is None else taper
    width = radius * np.minimum(height / full, 1) if full else radius
    counted = step * np.count_nonzero((height >= 0) & (height <= length) & (across <= width))
    chord = chord_pin(middle - 500 * way, way, tip, axis, length, radius, taper)
    assert chord == pytest.approx(counted, abs=TOLERANCE_MM + 1e-6 / max(counted, 1e-3))


@settings(max_examples=40, deadline=None)
@given(point, direction, st.tuples(*[st.floats(0.3, 2.5)] * 3).map(np.array), st.floats(0, 3))
def test_ellipsoid(middle, way, semi_axes, turn):
    c, s = np.cos(turn), np.sin(turn)
    unit_from_lab = np.diag(1 / semi_axes) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    centre = np.array([0.2, 0.1, -0.3])
    points, step = along(middle, way)
    counted = step * np.count_nonzero(((unit_from_lab @ (points - centre[:, None])) ** 2).sum(0) <= 1)
    chord, depth = chord_ellipsoid(middle - 300 * way, way, centre, unit_from_lab)
    assert chord == pytest.approx(counted, abs=TOLERANCE_MM + 1e-6 / max(counted, 1e-3))
    assert (chord == 0) == (depth == 0)


def test_pin_along_its_axis_and_beside_it():
    axis, origin = np.array([0.0, 0.0, 1.0]), np.array([[0.0, 0.2, 0.6], [0.0, 0.0, 0.0], [-50.0, -50.0, -50.0]])
    ray = np.broadcast_to(axis[:, None], (3, 3))
    assert chord_pin(origin, ray, np.zeros(3), axis, 2.0, 0.5, 0.0) == pytest.approx([2, 2, 0])
    assert chord_pin(origin, ray, np.zeros(3), axis, 2.0, 0.5) == pytest.approx([2, 2 - 0.8, 0])  # 0.2 from the axis: a cone from z = 0.8


def test_chords_do_not_depend_on_where_the_ray_starts_nor_on_the_length_of_its_direction():
    rng = np.random.default_rng(5)
    axis = np.array([0.6, 0.0, 0.8])
    near, way = 1.3 * axis[:, None] + rng.normal(0, 0.1, (3, 100)), rng.normal(0, 1, (3, 100))
    first = chord_pin(near, way, np.zeros(3), axis, 2.0, 0.25)
    second = chord_pin(near - 1000 * way, 7 * way, np.zeros(3), axis, 2.0, 0.25)
    assert np.count_nonzero(first) > 10
    assert second == pytest.approx(first, abs=1e-6)
