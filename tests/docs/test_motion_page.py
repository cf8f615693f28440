"""The page on motion: its example gives what it says, its tables hold every column and reason."""

from __future__ import annotations

import re
from pathlib import Path

import polars as pl
import pytest

from rsa_vision import api
from rsa_vision.motion_reasons import MOTION_REASONS
from rsa_vision.motion_tables import MOTION, MOTION_SCHEMAS
from rsa_vision.settings import Study

from .test_pages import codes, page, rows, section, toml_blocks


def test_the_worked_example_gives_what_the_page_says(tmp_path: Path) -> None:
    text = section("motion.md", "A table and its motion")
    (table,) = re.findall(r"```text\n(.*?)```", text, re.DOTALL)
    (tmp_path / "markers.csv").write_text(table)
    found = api.motion(tmp_path / "markers.csv", reference="bone")
    assert f"{len(found.table)} motions: {found.count('ok')} ok, 0 review, 0 failed" in text
    row = found.table.row(by_predicate=(pl.col("segment") == "stem") & (pl.col("reference") == "bone"), named=True)
    for name, value in re.findall(r"`(\w+)` = (-?[\d.]+)", text):
        assert row[name] == pytest.approx(float(value), abs=0.0006), name
    assert row["rx_deg"] == pytest.approx(0, abs=0.0006)


def test_every_column_of_motion() -> None:
    listed = {name for row in rows(section("motion.md", "motion.csv")) for name in codes(row[0])}
    known = {name for name in MOTION if not name.startswith(("sd_", "consistent_"))}
    assert known <= listed
    assert listed - {"sd_...", "consistent_..."} <= set(MOTION)


def test_every_column_of_the_other_tables() -> None:
    listed = {codes(row[0])[0].removesuffix(".csv"): codes(row[1]) for row in rows(section("motion.md", "The other tables"))}
    assert listed | {"motion": list(MOTION)} == {name: list(schema) for name, schema in MOTION_SCHEMAS.items()}


def test_every_reason_of_motion() -> None:
    listed = {codes(row[0])[0]: (row[1], row[2]) for row in rows(section("motion.md", "Reasons"))}
    assert listed == MOTION_REASONS


def test_the_settings_of_the_page_are_valid_and_its_limits_the_defaults() -> None:
    (block,) = toml_blocks(page("motion.md"))
    study = Study.model_validate(block)
    assert study.limits == Study().limits
