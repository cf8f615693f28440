"""What the marks cannot tell of a film's orientation; the drawing shows every mark and says it."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from rsa_vision.cage_drawing import draw_cage
from rsa_vision.cages import Cage, builtin_cages, load_cage, symmetries

EXPECTED = {
    "1A": {((1, 2), "mirror", 90, True)},  # the stems of the tees point to +y
    "1B": {((1, 2), "mirror", 90, True), ((1, 2), "mirror", 0, False), ((1, 2), "rotation", 180, True)},
    "1B-420": {((1, 2), "mirror", 90, True)},  # the control points are not half-way between the rows
    "2": {((1,), "mirror", 90, False), ((2,), "mirror", 90, False)},
}


def kinds(cage: Cage) -> set[tuple[tuple[int, ...], str, int, bool]]:
    return {(s.foci, s.kind, round(s.angle_deg), any(a != b for a, b in s.focus_to.items())) for s in symmetries(cage)}


@pytest.mark.parametrize("name", EXPECTED)
def test_builtin(name: str) -> None:
    assert kinds(load_cage(name)) == EXPECTED[name]


def test_numbers_and_matrix_agree() -> None:
    for name in EXPECTED:
        cage = load_cage(name)
        for symmetry in symmetries(cage):
            for (focus, number), target in symmetry.number_to.items():
                origin, basis = cage.plane_of(focus).lab_from_plane()
                before, after = (
                    (np.array(next(m.xyz for m in cage.mark if f in m.foci and m.number == n)) - origin) @ basis.T
                    for f, n in ((focus, number), (symmetry.focus_to[focus], target))
                )
                np.testing.assert_allclose(symmetry.matrix @ (*before, 1), after, atol=1e-9)


def test_arms_alone_decide() -> None:
    """Cage 1A built of balls could be turned by half a turn."""
    cage = load_cage("1A")
    balls = tuple(mark.model_copy(update={"shape": "ball", "arms": (), "length": None}) for mark in cage.mark)
    assert ((1, 2), "rotation", 180, True) in kinds(cage.model_copy(update={"mark": balls}))


def test_a_displaced_mark_decides() -> None:
    cage = load_cage("1B")
    marks = list(cage.mark)
    marks[0] = marks[0].model_copy(update={"xyz": (-97.0, 0.0, 0.0)})
    assert kinds(cage.model_copy(update={"mark": tuple(marks)})) == set()


def test_foci_decide() -> None:
    """A focus that has no counterpart breaks the symmetry, but only if it is farther off than foci may be from nominal."""
    cage = load_cage("1B")
    near = cage.model_copy(update={"foci": {1: (-330.0, 200.0, 1000.0), 2: (430.0, 200.0, 1000.0)}})
    far = cage.model_copy(update={"foci": {1: (-330.0, 200.0, 1000.0), 2: (730.0, 200.0, 1000.0)}})
    assert kinds(near) == EXPECTED["1B"]
    assert kinds(far) == {((1, 2), "mirror", 0, False)}


@pytest.mark.parametrize("name", builtin_cages())
def test_drawing(name: str) -> None:
    cage = load_cage(name)
    svg = draw_cage(cage)
    texts = [element.text or "" for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]
    for plane in cage.plane:
        labels = {str(m.number) for focus in plane.foci for m in cage.mark if focus in m.foci}
        assert labels <= set(texts)
    for focus in cage.foci:
        for mark in cage.marks_of(focus, "control"):
            assert texts.count(str(mark.number)) == sum(mark.number == m.number for f in cage.foci for m in cage.marks_of(f, "control"))
    assert sum("Not told by the marks" in text for text in texts) == len(symmetries(cage))
    assert sum(text.endswith(" mm") and text.removesuffix(" mm").isdigit() for text in texts) == len(cage.plane) + 1
    assert "href" not in svg  # nothing from elsewhere


def test_names_are_escaped() -> None:
    cage = load_cage("1A").model_copy(update={"name": "<b>&"})
    ET.fromstring(draw_cage(cage))
