"""The pages hold every error, reason, flag and column that the program knows, with the right codes, and no other."""

from __future__ import annotations

import inspect
import re
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from rsa_vision import errors, readings, verdict
from rsa_vision.cage_drawing import draw_cage
from rsa_vision.cages import Cage, Mark, Plane, builtin_cages, load_cage, symmetries
from rsa_vision.flags import REASONS, MarkerFlag, flag_names
from rsa_vision.geometry.covariance import SIGNIFICANCE
from rsa_vision.identify import clutter, film_model
from rsa_vision.settings import Limits, Study
from rsa_vision.tables import DETECTIONS, SCHEMAS
from rsa_vision.verdict import FAILURES

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PROSE = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md"), *(ROOT / "examples").glob("*.*")])


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def section(name: str, heading: str) -> str:
    """Return the text under a heading, up to the next one of its level."""
    text = page(name)
    start = text.index(f"\n## {heading}\n") + 1
    end = text.find("\n## ", start)
    return text[start:] if end < 0 else text[start:end]


def rows(text: str) -> list[list[str]]:
    """Return the cells of the tables in a text, without their heads."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.replace(r"\|", "/").strip("|").split("|")] for line in lines]
    heads = {index - 1 for index, row in enumerate(cells) if set(row[0]) <= set("-:")}
    return [row for index, row in enumerate(cells) if index not in heads and index - 1 not in heads]


def codes(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_every_error_with_its_code_and_exit_code() -> None:
    known = {
        name: (kind.code, str(kind.exit_code))
        for name, kind in inspect.getmembers(errors, inspect.isclass)
        if issubclass(kind, errors.RsaError)
    }
    listed = {codes(row[0])[0]: (codes(row[1])[0], row[2]) for row in rows(section("errors.md", "Errors"))}
    assert listed == known
    assert all(row[3] and row[4] for row in rows(section("errors.md", "Errors")))


def test_every_reason_with_its_status() -> None:
    listed = {codes(row[0])[0]: row[1] for row in rows(section("errors.md", "Reasons"))}
    assert listed == {code: "failed" if code in FAILURES else "review" for code in REASONS}
    assert all(row[2] and row[3] for row in rows(section("errors.md", "Reasons")))


def test_every_flag_with_its_name() -> None:
    listed = {codes(row[0])[0]: codes(row[1])[0] for row in rows(section("errors.md", "Flags"))}
    assert listed == {flag_names(flag): flag.name for flag in MarkerFlag if flag}


@pytest.mark.parametrize("table", SCHEMAS)
def test_every_column_of_the_tables(table: str) -> None:
    listed = [name for row in rows(section("files.md", f"{table}.csv")) for name in codes(row[0])]
    assert sorted(listed) == sorted(SCHEMAS[table])


def test_every_column_of_detect() -> None:
    first = section("files.md", "The table of detect").split(", with the", 1)[0]
    assert codes(first) == list(DETECTIONS)


def test_every_setting() -> None:
    text = page("quickstart.md")
    for name in (*Study.model_fields, *Limits.model_fields):
        assert re.search(rf"^{name} =|`{name}`|\[{name}\]", text, re.MULTILINE), name
    for name, field in Limits.model_fields.items():
        if given := re.search(rf"^{name} = (\S+)", text, re.MULTILINE):
            assert float(given[1]) == field.default, name


def test_numbers_of_the_method_are_those_of_the_code() -> None:
    text = page("method.md")
    known = {name: value for module in (verdict, readings, film_model, clutter) for name, value in vars(module).items() if name.isupper()}
    stated = re.findall(r"`([A-Z_]+)` = ([\d.]+)", text)
    stated += [(codes(row[0])[0], row[1]) for row in rows(section("method.md", "Names of the cage's marks"))]
    assert len(stated) >= 10
    assert {name: float(value) for name, value in stated} == {name: known[name] for name, _ in stated}
    text, limits = " ".join(text.split()), Limits()
    assert f"{limits.fiducial_um:g} µm in the plane, {limits.line_mm:g} mm between line and focus" in text
    assert f"with a probability below {SIGNIFICANCE}" in text


def toml_blocks(text: str) -> list[dict[str, Any]]:
    return [tomllib.loads(block) for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)]


def test_the_study_file_of_the_page_is_valid() -> None:
    (whole,) = toml_blocks(section("quickstart.md", "study.toml"))
    assert Study.model_validate(whole).limits == Limits()
    for name in ("quickstart.md", "calibrated_cameras.md"):
        for block in toml_blocks(page(name)):
            Study.model_validate(block)


def test_the_cage_file_of_the_page_has_valid_parts() -> None:
    (example,) = toml_blocks(section("cages.md", "Cage files"))
    assert set(example) <= set(Cage.model_fields)
    for kind, name in ((Plane, "plane"), (Mark, "mark")):
        for part in example[name]:
            kind.model_validate(part)


@pytest.mark.parametrize("name", ["method.md", "architecture.md"])
def test_modules_that_are_named_exist(name: str) -> None:
    named = re.findall(r"`([\w/]+\.py)`", page(name))
    known = {path.relative_to(ROOT / "rsa_vision").as_posix() for path in (ROOT / "rsa_vision").rglob("*.py")}
    assert named
    assert [item for item in named if not any(f"/{path}".endswith(f"/{item}") for path in known)] == []


def test_the_picture_of_the_layers_is_the_contract() -> None:
    contract = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"][0]["layers"]
    lines = [line[:50] for line in section("architecture.md", "Layers").splitlines()]  # what stands to the right explains
    at = [
        [min(i for i, line in enumerate(lines) if re.search(rf"^ .*\b{name}\b", line)) for name in layer]
        for layer in map(modules, contract)
    ]
    assert all(max(upper) < min(lower) for upper, lower in pairwise(at))


def modules(layer: str) -> list[str]:
    """Return the modules of a layer that have a name in the picture; parts of a noun (`cage_checks`) go with it."""
    names = re.findall(r"rsa_vision\.(\w+)", layer)
    return [name for name in names if not any(name.startswith(f"{other.removesuffix('s')}_") for other in names)]


@pytest.mark.parametrize("name", builtin_cages())
def test_cage_drawings_and_ambiguities(name: str) -> None:
    cage = load_cage(name)
    drawing = DOCS / "images" / f"cage-{name}.svg"
    assert drawing.read_text(encoding="utf-8") == draw_cage(cage), f"draw it again: rsa-vision cage show {name} -o {drawing}"
    listed = [row[1] for row in rows(section("cages.md", "What the marks cannot tell")) if codes(row[0]) == [name]]
    assert listed == [str(symmetry) for symmetry in symmetries(cage)]


def test_links_between_files_lead_somewhere() -> None:
    for path in PROSE:
        if path.suffix == ".md":
            for target in re.findall(r"\]\((?!https?:|#)([^)#\s]+)", path.read_text(encoding="utf-8")):
                assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_pictures_are_small() -> None:
    for picture in (DOCS / "images").iterdir():
        assert picture.stat().st_size < 300_000, picture.name


def test_no_path_of_a_machine() -> None:
    for path in [*PROSE, *(DOCS / "images").glob("*.svg")]:
        assert not re.search(r"(?<![\w.])/(tmp|work|home|root|usr)/", path.read_text(encoding="utf-8")), path.name
