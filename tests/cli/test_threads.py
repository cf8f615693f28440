"""Small products on many threads take three times the work: the command line gives linear algebra one, unless told otherwise."""

import os
import subprocess
import sys

import pytest

from rsa_vision.threads import THREAD_VARIABLES, one_thread_unless_told

# what main() does first must come before the library is loaded, which reads the variables once
MAIN = """
import os, sys
from rsa_vision import cli
early = "numpy" not in sys.modules
cli.run_app = lambda _: print(early, *(os.environ.get(name) for name in {names!r})) or 0
cli.main()
"""


@pytest.mark.parametrize(("given", "expected"), [({}, "True 1 1"), ({"OMP_NUM_THREADS": "3"}, "True 3 None")])
def test_commands_run_with_one_thread_unless_told(given: dict[str, str], expected: str) -> None:
    kept = {name: value for name, value in os.environ.items() if name not in THREAD_VARIABLES}
    code = MAIN.format(names=("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"))
    told = subprocess.run([sys.executable, "-c", code], env=kept | given, check=True, capture_output=True, text=True).stdout
    assert told.strip() == expected


def test_who_asks_for_threads_gets_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREAD_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4")
    one_thread_unless_told()
    assert [os.environ.get(name) for name in THREAD_VARIABLES] == [None, "4", None, None, None]
