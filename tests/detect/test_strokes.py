"""Strokes that point at one place: tees whose arms fade out far before the tip."""

import numpy as np
from scipy.ndimage import gaussian_filter

from rsa_vision.detect import detect_markers
from rsa_vision.detect.search.strokes import where_three_meet
from synthetic.chords import chord_pin

SIDE, PITCH_MM, MU_PER_MM, FINE = 500, 0.0625, 8.0, 4


def test_three_strokes_in_the_shape_of_a_t_meet_and_others_do_not() -> None:
    turn = 0.4
    middle = np.array([200.0, 150.0])
    arms = []
    for angle in (turn, turn + np.pi / 2, turn - np.pi / 2):
        way = np.array([np.cos(angle), -np.sin(angle)])
        arms.append([*(middle + 25 * way), angle, 15.0, 5.0, 2.5])
    table, none = np.array(arms), np.zeros((0, 5))
    (found,) = where_three_meet(table, none)
    np.testing.assert_allclose(found[:2], middle, atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * found[2]), np.exp(1j * turn), atol=1e-6)
    assert found[4] == 2.5
    bright = table * [1, 1, 1, 1, 1, -1]
    assert where_three_meet(bright, none)[0, 4] == -2.5
    assert len(where_three_meet(table, found[None])) == 0  # known
    assert len(where_three_meet(table[1:], none)) == 0  # two
    turned = table + np.array([0, 0, np.pi, 0, 0, 0]) * np.array([[0], [0], [1]])  # one arm the other way round
    assert len(where_three_meet(turned, none)) == 0
    mixed = np.vstack([bright[:1], table[1:]])  # of two polarities
    assert len(where_three_meet(mixed, none)) == 0


def test_large_tees_in_correlated_noise_are_found_as_such() -> None:
    rng = np.random.default_rng(4)
    clear = np.ones((SIDE, SIDE))
    tips = np.array([[110.0, 120.0], [370.0, 130.0], [120.0, 380.0], [380.0, 370.0]]) + rng.uniform(-3, 3, (4, 2))
    half = 45
    for tip in tips:
        corner = tip.astype(int) - half
        line = (np.arange((2 * half + 1) * FINE) + 0.5) / FINE - 0.5
        x, y = np.meshgrid(line + corner[0] - tip[0], line + corner[1] - tip[1])
        origin, down = np.array([x * PITCH_MM, y * PITCH_MM, 0 * x]), np.array([0 * x, 0 * x, 0 * x + 1])
        arms = [np.array([np.cos(a), np.sin(a), 0.0]) for a in (0.03, 0.03 + np.pi / 2, 0.03 - np.pi / 2)]
        chord = np.sum([chord_pin(origin, down, np.zeros(3), arm, 2.0, 0.25, None) for arm in arms], axis=0)
        left = np.exp(-MU_PER_MM * chord).reshape(2 * half + 1, FINE, 2 * half + 1, FINE).mean((1, 3))
        clear[corner[1] : corner[1] + 2 * half + 1, corner[0] : corner[0] + 2 * half + 1] *= left
    noise = gaussian_filter(rng.normal(size=clear.shape), 1.6)
    values = 30000 * gaussian_filter(clear, 1.3) + 30000 * 0.95 / 12 * noise / noise.std()
    found = detect_markers(np.clip(np.rint(values), 0, 65535).astype(np.uint16), bits=16).images
    assert found.shape.tolist() == ["tee"] * 4
    gap = np.hypot(*(found.position_px[:, None] - tips).transpose(2, 0, 1))
    assert gap.min(axis=1).max() < 1.0
