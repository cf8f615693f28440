"""Small products on many threads cost more than they spare: films are measured with one."""

import pytest
import threadpoolctl

from rsa_vision.threads import in_one_thread


def _threads() -> list[int]:
    return [library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]


@in_one_thread
def _threads_meanwhile(*, fails: bool = False) -> list[int]:
    if fails:
        raise RuntimeError
    return _threads()


def test_linear_algebra_has_one_thread_meanwhile_and_as_many_as_before_afterwards() -> None:
    assert set(_threads_meanwhile()) == {1}  # the first call loads the libraries
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = _threads()
        assert set(_threads_meanwhile()) == {1}
        with pytest.raises(RuntimeError):
            _threads_meanwhile(fails=True)
        assert _threads() == before
