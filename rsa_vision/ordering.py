"""The order of names: numbers in them count by their value."""

from __future__ import annotations

import re
from functools import lru_cache


@lru_cache(maxsize=65536)
def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts numbers in text by their value (``9`` before ``10`` before ``10b``)."""
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in re.findall(r"\d+|\D+", text))
