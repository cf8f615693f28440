"""What the looks of images say of pairs: sizes that change with contrast, light that differs between foci, errors that are bounds."""

from __future__ import annotations

import numpy as np

from rsa_vision.identify.alone import images_alone
from rsa_vision.identify.crossings import Crossings
from rsa_vision.identify.looks import Looks
from rsa_vision.identify.pair_looks import log_odds_of_looks


def odds(first: np.ndarray, second: np.ndarray, strangers: np.ndarray, error: np.ndarray | None = None) -> np.ndarray:
    """Return the log odds of the looks of pairs, all of which teach but the last."""
    pairs = len(first)
    of_ray = np.concatenate([first, second, strangers])
    n = len(of_ray)
    a, b = np.arange(pairs), pairs + np.arange(pairs)
    looks = Looks(np.arange(n), of_ray, np.zeros(n, int), a, b, np.zeros(pairs), np.zeros(pairs), np.zeros(n) if error is None else error)
    paired = (np.arange(n) < 2 * pairs).astype(float)
    probable = np.where(np.arange(pairs) < pairs - 1, 1.0, 1e-6)
    return log_odds_of_looks(looks, probable, images_alone(looks, paired), images_alone(looks.sizes, paired))


def test_sizes_are_compared_as_at_one_contrast() -> None:
    """Where the size of an image goes with its contrast, a pair off that line is told from one on it."""
    better = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        contrast = rng.normal(0, 0.5, (14, 2))
        size = -0.3 * contrast + rng.normal(0, 0.01, contrast.shape)
        strangers = rng.normal(0, 0.7, (6, 2))
        contrast[-1], on, off = [-0.4, 0.4], [0.12, -0.12], [0.0, 0.0]
        told = []
        for last in (on, off):
            size[-1] = last
            told.append(odds(np.stack([size[:, 0], contrast[:, 0]], 1), np.stack([size[:, 1], contrast[:, 1]], 1), strangers)[-1])
        better.append(told[0] - told[1])
    assert np.min(better) > 1


def test_each_image_may_have_the_light_of_its_focus() -> None:
    """Contrasts that vary independently from focus to focus are no reason to doubt a pair."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        light = rng.choice([0.0, -1.0], (14, 2)) + rng.normal(0, 0.03, (14, 2))
        light[:4] = [[0, 0], [0, -1], [-1, 0], [-1, -1]]
        size = rng.normal(0, 0.02, (14, 2))
        found = odds(np.stack([size[:, 0], light[:, 0]], 1), np.stack([size[:, 1], light[:, 1]], 1), rng.normal(0, 0.7, (6, 2)))
        assert found.min() > -1.5


def test_an_error_far_above_the_usual_is_a_bound() -> None:
    """A crossing at 0.01 mm of an error of 0.3 mm: likelier a clear pair than its error says; one at 0.3 mm: not excluded."""
    both = np.array([0.01, 0.3])
    one, none = np.zeros(2, int), np.zeros(2)
    crossings = Crossings(one, one, both, np.full(2, 0.3), none, none, none, none)
    plain, bounded = crossings.log_ratio(), crossings.log_ratio(0.01)
    assert bounded[0] > plain[0] + 1
    assert plain[1] - 2 < bounded[1] < plain[1]
    np.testing.assert_allclose(crossings.log_ratio(0.2), plain)
    wide = np.linspace(0, 60, 600_001)
    many = Crossings(*[np.zeros(len(wide), int)] * 2, wide, np.full(len(wide), 0.3), *[np.zeros(len(wide))] * 4)
    assert abs(2 * np.trapezoid(np.exp(many.log_ratio(0.01)), wide) - 1) < 1e-3  # a density of the signed distance


def test_sizes_of_faint_images_are_known_as_well_as_noise_lets_them() -> None:
    """A pair whose sizes differ by 15 % is no reason for doubt where one of them is known to 10 % only."""
    rng = np.random.default_rng(3)
    first, second = (rng.normal(0, 0.01, (14, 2)) for _ in range(2))
    second[-1] = [0.15, 0.0]
    strangers = rng.normal(0, 0.7, (6, 2))
    sharp = odds(first, second, strangers)[-1]
    noisy = odds(first, second, strangers, np.where(np.arange(34) == 27, 0.1, 0.0))[-1]
    assert noisy > sharp + 1


def test_one_image_without_a_partner_makes_no_kind() -> None:
    """Another lone image that happens to look like it makes an image hardly likelier to be alone itself."""
    pair = np.zeros((14, 2))
    of_ray = np.concatenate([pair, pair, [[0.0, -1.3], [0.0, -1.3]]])
    n = len(of_ray)
    looks = Looks(np.arange(n), of_ray, np.zeros(n, int), np.arange(14), 14 + np.arange(14), np.zeros(14), np.zeros(14), np.zeros(n))
    alone = images_alone(looks, (np.arange(n) < 28).astype(float))
    assert alone.log_density[-1] < 1.5
