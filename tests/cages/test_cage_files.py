"""Cage files of users: whatever cannot work is listed, all at once, with its path."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsa_vision.cage_checks import in_general_position
from rsa_vision.cages import load_cage
from rsa_vision.errors import CageError

HEAD = """name = "mine"
film = "shared"
material = "plexiglas"
calibrated_at_c = 20
foci = { 1 = [-200, 100, 1000], 2 = [200, 100, 1000] }
"""
PLANE = """
[[plane]]
foci = [1, 2]
origin = [0, 0, 0]
u = [1, 0, 0]
v = [0, 1, 0]
"""


def mark(number: int, role: str, xyz: list[float], more: str = 'shape = "ball"', foci: str = "[1, 2]") -> str:
    return f'\n[[mark]]\nnumber = {number}\nrole = "{role}"\nfoci = {foci}\nxyz = {xyz}\ndiameter = 0.8\n{more}\n'


SQUARE = [[0, 0, 0], [100, 0, 0], [100, 100, 0], [0, 100, 0]]
FIDUCIALS = "".join(mark(i + 1, "fiducial", p) for i, p in enumerate(SQUARE))
CONTROLS = mark(11, "control", [30, 30, 100]) + mark(12, "control", [70, 60, 100])
GOOD = HEAD + PLANE + FIDUCIALS + CONTROLS


def load(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    load_cage(path)


def complaint(tmp_path: Path, text: str) -> str:
    with pytest.raises(CageError) as caught:
        load(tmp_path, text)
    assert "mine.toml" in str(caught.value)
    return str(caught.value)


def test_good_cage(tmp_path: Path) -> None:
    load(tmp_path, GOOD)
    load(tmp_path, GOOD.replace('"plexiglas"', '"Mirror_Glass"'))
    load(tmp_path, GOOD.replace('"plexiglas"', '"carbon"\nexpansion_per_c = 1e-6'))


TEE = 'shape = "tee"\nlength = 2.0\narms = [[1, 0, 0], [-1, 0, 0], [0, 1, 0]]'
WRONG = [
    (GOOD.replace("film =", "flim ="), ["flim: Extra inputs", "film: Field required"]),
    (GOOD.replace('"shared"', '"common"'), ["film: Input should be 'shared' or 'separate'"]),
    (GOOD.replace('"plexiglas"', '"wood"'), ["material: the expansion of 'wood' is not known"]),
    (GOOD.replace("calibrated_at_c = 20", "calibrated_at_c = nan"), ["calibrated_at_c: Input should be a finite number"]),
    (GOOD.replace("[100, 0, 0]", "[inf, 0, 0]"), ["mark.1.xyz.0: Input should be a finite number"]),
    (GOOD + mark(3, "control", [10, 10, 90]), ["mark.6.number: number 3 of focus 1 is already that of mark.2", "of focus 2 is already"]),
    (GOOD.replace("[100, 0, 0]", "[100, 0, 0.5]"), ["mark.1.xyz: lies 0.500 mm off the fiducial plane of focus 1"]),
    (HEAD + PLANE + FIDUCIALS[: FIDUCIALS.rindex("[[mark]]")] + CONTROLS, ["focus 1 has 3 fiducial marks", "focus 2 has 3 fiducial marks"]),
    (GOOD.replace("[100, 100, 0]", "[50, 0, 0]"), ["focus 1 has no four fiducial marks of which no three lie on a line"]),
    (HEAD + PLANE + FIDUCIALS + mark(11, "control", [30, 30, 100]), ["focus 1 has 1 control points"]),
    (GOOD.replace("[30, 30, 100]", "[30, 30, 0]"), ["mark.4.xyz: a control point must not lie in the fiducial plane"]),
    (GOOD.replace("[30, 30, 100]", "[30, 30, 1000]"), ["mark.4.xyz: a control point must lie nearer"]),
    (GOOD.replace("u = [1, 0, 0]", "u = [1, 0.1, 0]"), ["plane.0: u and v must be unit vectors at right angles"]),
    (GOOD.replace("u = [1, 0, 0]", "u = [-1, 0, 0]"), ["plane.0: focus 1 lies behind the plane", "focus 2 lies behind the plane"]),
    (GOOD.replace("foci = [1, 2]\norigin", "foci = [1, 2, 3]\norigin"), ["plane.0.foci: focus 3 is not among [foci]"]),
    (GOOD.replace("foci = [1, 2]\norigin", "foci = [1]\norigin"), ["plane: focus 2 has no fiducial plane"]),
    (GOOD + PLANE, ["plane: focus 1 has 2 fiducial planes", "film: foci of a shared film share one plane"]),
    (GOOD + mark(13, "control", [10, 10, 90], foci="[4]"), ["mark.6.foci: focus 4 is not among [foci]"]),
    (GOOD + mark(13, "control", [10, 10, 90], TEE.replace(", [0, 1, 0]", "")), ["mark.6.arms: a tee has 3 arms, not 2"]),
    (GOOD + mark(13, "control", [10, 10, 90], 'shape = "pin"\nlength = 2'), ["mark.6.arms: a pin has 1 arms, not 0"]),
    (GOOD + mark(13, "control", [10, 10, 90], TEE.replace("[-1, 0, 0]", "[1, 0.01, 0]")), ["mark.6.arms: two arms point the same way"]),
    (GOOD + mark(13, "control", [10, 10, 90], TEE.replace("[-1, 0, 0]", "[0, 0, 0]")), ["mark.6.arms: an arm has no direction"]),
    (GOOD + mark(13, "control", [10, 10, 90], TEE.replace("length = 2.0\n", "")), ["mark.6.length: a tee needs the length"]),
    (GOOD + mark(13, "control", [10, 10, 90], 'shape = "ball"\nsd = [0.01, 0.01]'), ["mark.6.sd.2: Field required"]),
    (GOOD + mark(13, "control", [10, 10, 90], 'shape = "ball"\nsd = [0.01, 0.01, -1]'), ["mark.6.sd.2: Input should be greater than 0"]),
    (GOOD + mark(13, "control", [10, 10, 90], 'shape = "cross"'), ["mark.6.shape: Input should be 'ball', 'pin' or 'tee'"]),
    (GOOD + mark(13, "control", [30, 30, 100]), ["mark.6.xyz: lies where mark.4 lies"]),
    (GOOD.replace("diameter = 0.8", "diameter = 0", 1), ["mark.0.diameter: Input should be greater than 0"]),
]


@pytest.mark.parametrize(("text", "says"), WRONG, ids=[says[0][:50] for _, says in WRONG])
def test_wrong_cages(text: str, says: list[str], tmp_path: Path) -> None:
    message = complaint(tmp_path, text)
    for part in says:
        assert part in message


def test_all_errors_at_once(tmp_path: Path) -> None:
    """Unknown keys and wrong values do not hide what is wrong with the geometry."""
    text = GOOD.replace("film =", "colour = 1\nfilm =").replace("[100, 0, 0]", "[100, 0, 5]").replace('"plexiglas"', '"wood"')
    text += mark(11, "control", [10, 10, 90], 'shape = "ball"\nnote = "x"') + mark(14, "control", [1, 2], 'shape = "ball"')
    message = complaint(tmp_path, text)
    for part in (
        "colour: Extra",
        "material: the expansion",
        "mark.1.xyz: lies 5.000",
        "mark.6.note: Extra",
        "mark.6.number: number 11",
        "mark.7.xyz.2",
    ):
        assert part in message
    assert "fiducial marks; it needs" not in message  # the marks that can be read suffice


def test_errors_are_not_multiplied(tmp_path: Path) -> None:
    """A mark that cannot be read is not missed as well."""
    message = complaint(tmp_path, GOOD.replace("[100, 0, 0]", '["a", 0, 0]'))
    assert message.count("\n") == 1
    assert "mark.1.xyz.0" in message


@pytest.mark.parametrize("content", [b"name = ", b"\xff\xfe\x00", b""])
def test_no_toml(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    with pytest.raises(CageError, match=r"mine\.toml"):
        load_cage(path)
    with pytest.raises(CageError, match="not a readable"):
        load_cage(tmp_path)


def test_general_position() -> None:
    import numpy as np

    assert in_general_position(np.array([(0, 0), (1, 0), (2, 0), (0, 1), (1, 1)]))
    assert not in_general_position(np.array([(0, 0), (1, 0), (2, 0), (3, 0), (1, 1)]))
    assert not in_general_position(np.array([(0, 0), (1, 0), (0, 1)]))
    assert in_general_position(np.array([(0, 0), (1, 0), (0, 1), (3, 2)]))
