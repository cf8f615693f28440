"""When fits end that lead nowhere."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rsa_vision.detect.film.progress import in_vain

NOISE = 100.0
LEFT = st.lists(st.floats(0.0, 1e5), min_size=1, max_size=20)


@given(LEFT)
def test_steps_that_come_near_the_noise_are_never_in_vain(left: list[float]) -> None:
    assert not in_vain([*left, 3.9 * NOISE], NOISE)


@given(st.floats(1e3, 1e5), st.integers(1, 20))
def test_nor_are_those_that_gain(first: float, steps: int) -> None:
    assert not in_vain([first * 0.97**k for k in range(steps)], NOISE)


def test_three_that_gain_nothing_are() -> None:
    assert not in_vain([900.0, 890.0, 885.0], NOISE)
    assert in_vain([900.0, 890.0, 885.0, 884.0], NOISE)
    assert in_vain([2000.0, 900.0, 950.0, 890.0, 1200.0], NOISE)  # to and fro
    assert not in_vain([900.0, 890.0, 885.0, 700.0], NOISE)
