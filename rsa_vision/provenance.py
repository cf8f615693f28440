"""What a run was made with: enough to make it again."""

from __future__ import annotations

import hashlib
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any, Final

DISTRIBUTION: Final = "rsa-vision"
PACKAGES: Final = (
    "imagecodecs",
    "numpy",
    "opencv-contrib-python-headless",
    "polars",
    "pydantic",
    "pydicom",
    "python-gdcm",
    "scipy",
    "tifffile",
)
CHUNK_BYTES: Final = 1 << 20


def version() -> str:
    """Return the version of rsa_vision; ``unknown`` if it runs from a folder that is not installed."""
    return _version(DISTRIBUTION) or "unknown"


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, read in pieces.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str
        Hexadecimal.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def environment() -> dict[str, Any]:
    """Return version, host, system, Python and package versions, as they stand in ``run.json``."""
    return {
        "rsa_vision": version(),
        "host": platform.node(),
        "system": platform.platform(),
        "python": sys.version.split()[0],
        "packages": {name: found for name in PACKAGES if (found := _version(name))},
    }


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
