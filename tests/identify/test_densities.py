"""Densities and medians of many rows at once are those of each row alone, and what weighs nothing has no say."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from rsa_vision.identify.densities import log_kernels, log_student, some_of, weighted_median

RNG = np.random.default_rng(3)
SAMPLE, WEIGHT = RNG.normal(0, 1, (5, 9, 2)), RNG.random((5, 9)) * (RNG.random((5, 9)) < 0.7)
VALUE, LEAST, COUNT = RNG.normal(0, 1, (5, 2)), RNG.uniform(0.1, 0.5, (5, 2)), WEIGHT.sum(axis=1)


def test_kernels_of_rows_are_those_of_each_by_what_weighs_something() -> None:
    together = log_kernels(VALUE, SAMPLE, WEIGHT, LEAST, COUNT)
    for row, some in enumerate(WEIGHT > 0):
        sample, weight, n = SAMPLE[row, some], WEIGHT[row, some] / WEIGHT[row].sum(), COUNT[row]
        middle = weight @ sample
        width = np.hypot(LEAST[row], 0.5 * max(n, 1.0) ** (-1 / 6) * np.sqrt(weight @ (sample - middle) ** 2))
        density = weight @ (student.pdf((VALUE[row] - sample) / width, max(n, 2.0)) / width).prod(axis=1)
        np.testing.assert_allclose(together[row], np.log(density), rtol=1e-12)


def test_a_median_has_half_the_weight_on_either_side() -> None:
    together = weighted_median(SAMPLE, WEIGHT)
    for row in range(len(SAMPLE)):
        for column, median in enumerate(together[row]):
            below, above = (WEIGHT[row, side(SAMPLE[row, :, column], median)].sum() for side in (np.less, np.greater))
            assert median in SAMPLE[row, WEIGHT[row] > 0, column]
            assert max(below, above) <= WEIGHT[row].sum() / 2


def test_log_student_is_that_of_the_library() -> None:
    np.testing.assert_allclose(log_student(VALUE, 3.0), student.logpdf(VALUE, 3.0), rtol=1e-12)


def test_rows_are_split_and_none_is_lost() -> None:
    rows = np.arange(3, 50)
    parts = some_of(rows, 10_000)
    assert len(parts) > 1
    np.testing.assert_array_equal(np.concatenate(parts), rows)
    assert some_of(rows[:0], 10) == []
