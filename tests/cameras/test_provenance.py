"""Hashes and versions for ``run.json``."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

from rsa_vision.provenance import environment, file_sha256


def test_hash_of_a_file_longer_than_a_piece(tmp_path: Path) -> None:
    data = bytes(range(256)) * 10000
    (tmp_path / "film").write_bytes(data)
    assert file_sha256(tmp_path / "film") == hashlib.sha256(data).hexdigest()


def test_environment_is_json_and_tells_versions() -> None:
    import numpy

    told = json.loads(json.dumps(environment()))
    assert told["packages"]["numpy"] == numpy.__version__
    assert told["python"] == ".".join(map(str, sys.version_info[:3]))
    assert told["host"]
