"""Files in OUT: written whole or not at all, and the records that let a stopped run go on.

OUT/exams/KEY.json is the record of one finished examination (rows of all tables, what it was made from); KEY_1.jpg, ... its films,
small.
The tables are put together from the records.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import polars as pl

from rsa_vision.errors import UsageError
from rsa_vision.tables import SCHEMAS, Rows, frame

RETRIED: Final = frozenset({"internal", "timeout"})
"""Reasons that tell nothing about the films: such an examination counts as not finished."""


def write_atomic(path: Path, content: bytes, option: str = "-o") -> None:
    """Write a file under a temporary name and move it into place: a kill leaves the old or the new one, whole.

    Parameters
    ----------
    path : Path
        A link is followed: what it points to is replaced.
    content : bytes
    option : str
        The option that names the file, for the message.

    Raises
    ------
    UsageError
        If it cannot be written, or is there and no regular file.
    """
    temporary = _temporary(path, option)
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(os.path.realpath(path))
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(f"{path}: cannot be written ({error.strerror}); make room or choose another place with {option}") from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_target(path: Path, option: str = "-o") -> None:
    """Raise what :func:`write_atomic` would, but for want of room: to be asked before the work is done that it is to write."""
    _temporary(path, option).unlink()


def _temporary(path: Path, option: str) -> Path:
    """Return a new file beside the one to be written."""
    target = Path(os.path.realpath(path))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            kind = target.stat().st_mode
            if stat.S_ISDIR(kind):
                raise UsageError(f"{path}: is a folder; name a file in it")
            if not stat.S_ISREG(kind):
                raise UsageError(f"{path}: is no regular file; choose another place with {option}")
        handle, temporary = tempfile.mkstemp(prefix=".", suffix=".part", dir=target.parent)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}); choose another place with {option}") from error
    os.close(handle)
    return Path(temporary)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def to_csv(table: pl.DataFrame) -> bytes:
    """Return a table as UTF-8 CSV with one header row; floats keep all their digits, empty is "not determined"."""
    return table.write_csv().encode()


def write_tables(out: Path, rows: Iterable[Rows]) -> dict[str, pl.DataFrame]:
    """Put the rows of many examinations together and write every table as CSV and Parquet.

    Parameters
    ----------
    out : Path
    rows : iterable of dict
        As of :func:`rsa_vision.tables.examination_rows`, in the order wanted.

    Returns
    -------
    dict of str to polars.DataFrame
    """
    every = list(rows)
    tables = {name: frame((row for exam in every for row in exam[name]), schema) for name, schema in SCHEMAS.items()}
    for name, table in tables.items():
        write_atomic(out / f"{name}.csv", to_csv(table))
        write_atomic(out / "results.parquet" / f"{name}.parquet", parquet_bytes(table))
    return tables


def read_tables(out: Path) -> dict[str, pl.DataFrame]:
    """Read the tables of a finished run.

    Raises
    ------
    UsageError
        If the folder holds no results.
    """
    try:
        return {name: pl.read_csv(out / f"{name}.csv", schema=dict(schema)) for name, schema in SCHEMAS.items()}
    except (OSError, pl.exceptions.PolarsError) as error:
        raise UsageError(f"{out}: no results of measure or reconstruct in it ({error})") from error


def write_run(out: Path, run: Mapping[str, Any]) -> None:
    """Write ``run.json``."""
    write_atomic(out / "run.json", (json.dumps(run, indent=2, default=str) + "\n").encode())


def read_run(out: Path) -> dict[str, Any]:
    """Read ``run.json``, empty if there is none that can be read."""
    return _read_json(out / "run.json") or {}


def record_path(out: Path, subject: str, exam: str) -> Path:
    """Return where the record of an examination lies; names that are no safe file names get a hash."""
    name = f"{subject}_{exam}"
    if not re.fullmatch(r"[\w.+-]{1,100}", name, re.ASCII) or subject.count("_") or name.startswith("."):
        digest = hashlib.sha256(f"{subject}\0{exam}".encode()).hexdigest()[:8]
        name = re.sub(r"[^\w.+-]+", "-", name, flags=re.ASCII)[:80].lstrip(".") + "-" + digest
    return out / "exams" / f"{name}.json"


def fingerprint(content: Mapping[str, Any]) -> str:
    """Return the hash of everything an examination's result depends on."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def write_record(path: Path, record: Mapping[str, Any], pictures: Iterable[bytes] = ()) -> None:
    """Write the record of an examination after the pictures it names: with the record, the examination is finished.

    Parameters
    ----------
    path : Path
        As of :func:`record_path`.
    record : mapping
        At least ``fingerprint`` and ``rows``.
    pictures : iterable of bytes
        JPEG of every film.
    """
    for index, picture in enumerate(pictures):
        write_atomic(picture_path(path, index), picture)
    write_atomic(path, json.dumps(record, default=str).encode())


def picture_path(record: Path, index: int) -> Path:
    """Return where the picture of the film `index` of an examination lies."""
    return record.with_name(f"{record.stem}_{index + 1}.jpg")


def read_record(path: Path) -> dict[str, Any] | None:
    """Return a record, or None if there is none that can be read."""
    return _read_json(path)


def is_finished(record: Mapping[str, Any] | None, wanted: str) -> bool:
    """Tell whether a record holds the result for a fingerprint, so that the examination need not be measured again."""
    if not record or record.get("fingerprint") != wanted or not isinstance(record.get("rows"), dict):
        return False
    try:
        return not RETRIED & set(record["rows"]["exams"][0]["reasons"].split(";"))
    except (KeyError, IndexError, AttributeError):
        return False


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def parquet_bytes(table: pl.DataFrame) -> bytes:
    """Return a table as Parquet."""
    buffer = io.BytesIO()
    table.write_parquet(buffer)
    return buffer.getvalue()
