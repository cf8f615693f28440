"""What marks can tell of a focus, by the truth alone."""

from __future__ import annotations

import numpy as np
import pytest

from rsa_vision.cages import load_cage
from synthetic.sufficient import coordinates_over, focus_sd_mm

CAGE = load_cage("1A")
EVERY = {(m.role, m.number) for m in CAGE.mark if 1 in m.foci}
FIDUCIALS, CONTROLS = ({name for name in EVERY if name[0] == role} for role in ("fiducial", "control"))


def sd(names: set[tuple[str, int]], error_mm: float = 0.01) -> float:
    return focus_sd_mm(CAGE, 1, np.array(CAGE.foci[1]), names, error_mm)


def test_whole_cage_fixes_a_focus_in_proportion_to_the_error() -> None:
    assert 0.01 < sd(EVERY) < 5
    assert sd(EVERY, 0.02) == pytest.approx(2 * sd(EVERY))


def test_every_mark_that_is_lost_costs() -> None:
    for name in EVERY:
        assert sd(EVERY - {name}) > sd(EVERY)


def test_fiducial_marks_in_line_but_for_one_fix_nothing() -> None:
    xyz = {("fiducial", m.number): m.xyz for m in CAGE.marks_of(1, "fiducial")}
    row = {name for name in FIDUCIALS if xyz[name][1] == xyz[min(FIDUCIALS)][1]}
    other = next(name for name in FIDUCIALS if name not in row)
    assert len(row) >= 3
    assert sd(row | {other} | set(list(CONTROLS)[:1])) == np.inf
    assert sd(FIDUCIALS | set(list(CONTROLS)[:1])) == np.inf
    assert sd(set()) == np.inf


def test_four_and_two_marks_on_the_film_of_one_focus_leave_nothing_to_test_their_names_by() -> None:
    assert coordinates_over(6, 1) == 0
    assert coordinates_over(7, 1) == 2
    assert coordinates_over(12, 2) == 9
