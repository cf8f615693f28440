from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.errors import GeometryError
from rsa_vision.geometry.covariance import pooled_factor, residual_ratio
from rsa_vision.geometry.gross_errors import drop_gross_errors


def mean_fit(values: np.ndarray):
    def fit(index: np.ndarray) -> tuple[float, np.ndarray]:
        mean = float(values[index].mean())
        return mean, np.abs(values[index] - mean)

    return fit


def test_nothing_is_dropped_within_the_limit() -> None:
    mean, kept = drop_gross_errors(6, mean_fit(np.arange(6.0)), 3.0)
    assert mean == 2.5
    assert kept.tolist() == [0, 1, 2, 3, 4, 5]


def test_the_mark_is_dropped_whose_omission_fits_best() -> None:
    _, kept = drop_gross_errors(7, mean_fit(np.array([0, 0.1, 50, 0, -0.1, 20, 0])), 1.0)
    assert kept.tolist() == [0, 1, 3, 4, 6]


def test_it_stops_at_four() -> None:
    _, kept = drop_gross_errors(6, mean_fit(np.array([0.0, 100, 200, 300, 400, 500])), 1.0)
    assert len(kept) == 4


def test_a_fit_that_fails_counts_as_gross() -> None:
    values = np.array([0, 0.1, 0, -0.1, 0, 9])

    def fit(index: np.ndarray) -> tuple[float, np.ndarray]:
        if 5 in index:
            raise GeometryError("number 5 is impossible")
        return mean_fit(values)(index)

    assert drop_gross_errors(6, fit, 1.0)[1].tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(GeometryError, match="number 5"):
        drop_gross_errors(6, lambda index: fit(np.append(index, 5)), 1.0)


def test_equally_exact_omissions_drop_the_largest_error() -> None:
    def fit(index: np.ndarray) -> tuple[int, np.ndarray]:
        errors = np.array([1.0, 2, 9, 3, 1])[index]
        return 0, errors if len(index) == 5 else np.full(4, 1e-14) * (1 + index)

    assert drop_gross_errors(5, fit, 1.0)[1].tolist() == [0, 1, 3, 4]


def test_birge_factor_is_one_by_chance_and_true_otherwise() -> None:
    rng = np.random.default_rng(11)
    root = rng.normal(size=(20, 20))
    covariance = root @ root.T
    draws = root @ rng.normal(size=(20, 2000))
    false = np.mean([pooled_factor([residual_ratio(draw, covariance)]) > 1 for draw in draws.T])
    assert 0.002 < false < 0.03  # SIGNIFICANCE is 0.01
    found = [pooled_factor([residual_ratio(3 * draw, covariance)]) for draw in draws.T]
    assert 2.7 < np.sqrt(np.mean(np.square(found))) < 3.1
    assert pooled_factor([residual_ratio(np.ones(4), np.zeros((4, 4)))]) == 1
