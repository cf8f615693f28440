"""Threads of the linear algebra: its products are small here, and threads that wait for each other cost twice the work and some time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import TYPE_CHECKING, Final, ParamSpec, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

THREAD_VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
Given = ParamSpec("Given")
Result = TypeVar("Result")


def in_one_thread(work: Callable[Given, Result]) -> Callable[Given, Result]:
    """Let linear algebra have one thread while this function runs; afterwards it has as many as before."""

    @wraps(work)
    def limited(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        with _libraries().limit(limits=1, user_api="blas"):
            return work(*args, **kwargs)

    return limited


@cache
def _libraries() -> ThreadpoolController:
    """To look for those that are loaded takes milliseconds, to limit them microseconds."""
    import cv2  # noqa: F401  # each brings its own
    import scipy.linalg  # noqa: F401  # as above
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let processes that are started meanwhile begin with one thread: the variables are read when the library is loaded."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
