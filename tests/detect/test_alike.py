"""How much sizes differ beyond the errors of their measurement."""

import numpy as np
import pytest

from rsa_vision.detect.balls.alike import true_spread

TRIALS = 400


@pytest.mark.parametrize("n", [8, 20, 40])
@pytest.mark.parametrize("truth", [0.0, 0.5, 1.0, 2.0])
def test_what_is_held_near_to_the_others_has_an_honest_error(n: int, truth: float) -> None:
    rng = np.random.default_rng(n)
    square = []
    for _ in range(TRIALS):
        sd = rng.uniform(0.5, 1.5, n)
        true = 10 + truth * rng.standard_normal(n)
        measured = true + sd * rng.standard_normal(n)
        centre, spread, belongs = true_spread(measured, sd**2)
        assert belongs.mean() > 0.6
        held = np.average([measured, np.full(n, centre)], axis=0, weights=[1 / sd**2, np.full(n, spread**-2)])
        error = held - true
        square.append(np.mean(error**2 * (1 / sd**2 + 1 / spread**2)))
        # the usual size is known no better than so many allow; the fit of all estimates it, here it is what it is
    ratio = float(np.sqrt(np.mean(square)))
    print(f"{n} of spread {truth}: error / stated {ratio:.2f}")
    assert 0.5 < ratio < 1.15


def test_what_is_of_another_size_does_not_belong() -> None:
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(3.0, 0.01, 15), [2.0, 3.5]])
    centre, spread, belongs = true_spread(values, np.full(17, 0.01**2))
    assert belongs.tolist() == [True] * 15 + [False] * 2
    assert centre == pytest.approx(3.0, abs=0.01)
    assert spread < 0.015


def test_few_or_two_kinds_tell_nothing() -> None:
    assert np.isinf(true_spread(np.ones(4), np.full(4, 1e-6))[1])
    _, spread, belongs = true_spread(np.array([1.0, 1.3] * 8), np.full(16, 1e-4))
    assert belongs.all()
    assert spread > 0.14
