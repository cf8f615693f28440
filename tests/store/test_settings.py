"""What a study file may say."""

from pathlib import Path

import pytest

from rsa_vision.errors import SettingsError
from rsa_vision.settings import load_study


def study(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_bytes(text.encode())
    return path


WRONG = """
temperature_c = 74
temperature_c = 296.5
temperature_c = true
pixel_pitch_mm = inf
pixel_pitch_mm = "0.1"
pixel_pitch_mm = true
foci.1 = ["0", 100, 1000]
foci.1 = [0, nan, 1000]
colour = 1
limits.colour = 1
"""


@pytest.mark.parametrize("line", WRONG.split("\n")[1:-1])
def test_values_that_would_be_believed_and_are_wrong_are_refused_with_their_key(tmp_path: Path, line: str) -> None:
    with pytest.raises(SettingsError, match=line.split(" ")[0].replace(".", r"\.")):
        load_study(study(tmp_path, line + "\n"))


def test_calibration_may_stand_below_the_table_of_the_foci(tmp_path: Path) -> None:
    found = load_study(study(tmp_path, '[foci]\n1 = [0, 100, 1000]\ncalibration = { 1 = "a.txt", 2 = "b.txt" }\n'))
    assert found.calibration == {1: tmp_path / "a.txt", 2: tmp_path / "b.txt"}
    assert set(found.foci) == {1}


def test_a_byte_order_mark_is_no_part_of_the_settings(tmp_path: Path) -> None:
    assert load_study(study(tmp_path, "\ufefftemperature_c = 20\n")).temperature_c == 20
