"""Settings of a study: one frozen model with units in the names, which refuses unknown keys and defines every default once."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsa_vision.errors import SettingsError

Response = Literal["auto", "density", "transmission", "linear", "log"]
Orientation = Literal["upright", "any", "mirrored"]
FilmMode = Literal["shared", "separate"]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]  # strict: true is no number, nor is "0.1"
ROOM_C: Final = 50.0  # warmest of a room: 74 (Fahrenheit) would scale a cage by 0.4 %, and nothing would show it
RoomC = Annotated[float, Field(ge=0, le=ROOM_C, strict=True)]
Vector = tuple[Finite, Finite, Finite]
ORTHONORMAL: Final = 1e-3  # how well the axes of an anatomical frame must be at right angles


class Frozen(BaseModel):
    """Base of all settings: frozen, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Limits(Frozen):
    """Limits of verdicts and gross-error rules, with the defaults of the guideline and of Selvik."""

    fiducial_um: Annotated[float, Field(gt=0)] = 250.0  # Selvik 1989, ch. 2, step 1
    line_mm: Annotated[float, Field(gt=0)] = 2.0  # Selvik 1989, ch. 2, step 2 (8 x 250 um)
    focus_mm: Annotated[float, Field(gt=0)] = 150.0  # how far a focus may be from nominal
    crossing_sigma: Annotated[float, Field(gt=0)] = 5.0  # crossing line error in units of its own sigma
    calibration_px: Annotated[float, Field(ge=0)] = (
        0.5  # pairing tolerates this error of calibrated cameras; published ones reach 0.2 to 0.3
    )
    parallax_um: Annotated[float, Field(gt=0)] = 100.0  # mean y-parallax that shows film bending (Selvik 1989, table 5)
    posterior: Annotated[float, Field(gt=0.5, lt=1)] = 0.999  # an identity below it is ambiguous
    e_rb_mm: Annotated[float, Field(gt=0)] = 0.35  # ISO 16087
    condition_number: Annotated[float, Field(gt=0)] = 120.0  # guideline
    stable_mm: Annotated[float, Field(gt=0)] = 0.35  # markers whose distances change more are not of one rigid body
    continuous_mm: Annotated[float, Field(gt=0)] = 0.2  # MTPM a year after the first: continuous migration (Ryd 1995)
    false_detections_per_film: Annotated[float, Field(gt=0)] = 0.1  # expected false marker images on a film


class Axes(Frozen):
    """An anatomical frame through markers, each ``segment/marker``: y points from the first to the second, x as nearly as it can."""

    x: tuple[str, str]
    y: tuple[str, str]


class Motion(Frozen):
    """Settings of the motion analysis.

    ``rotation`` has the anatomical axes (x medial, y proximal, z anterior of a right limb) as rows, in the frame of the cage.
    """

    reference: str | None = None
    side: Literal["left", "right"] = "right"
    rotation: tuple[Vector, Vector, Vector] | None = None
    axes: Axes | None = None

    @model_validator(mode="after")
    def _one_proper_frame(self) -> Self:
        if self.rotation and self.axes:
            raise ValueError("rotation and axes exclude each other: the anatomical frame has one definition")
        if self.rotation:
            x, y, z = self.rotation
            # written with a few figures; what is left of the error is removed where the rotation is used
            products = [sum(p * q for p, q in zip(a, b, strict=True)) for a, b in ((x, x), (y, y), (z, z), (x, y), (y, z), (z, x))]
            right = (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
            orthonormal = all(abs(value - wanted) < ORTHONORMAL for value, wanted in zip(products, (1, 1, 1, 0, 0, 0), strict=True))
            if not orthonormal or sum(p * q for p, q in zip(right, z, strict=True)) < 0:
                raise ValueError("rotation must have three right-handed axes of length 1, each at right angles to the others, as rows")
        return self


class Study(Frozen):
    """The content of ``study.toml`` (docs/quickstart.md)."""

    cage: str | None = None
    film: FilmMode | None = None
    response: Response = "auto"
    pixel_pitch_mm: Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)] | None = None
    orientation: Orientation = "upright"
    temperature_c: RoomC | None = None
    file_pattern: str | None = None
    foci: dict[int, Vector] = {}
    calibration: dict[int, Path] = {}
    motion: Motion = Motion()
    limits: Limits = Limits()
    report: dict[str, str] = {}

    @model_validator(mode="after")
    def _one_frame(self) -> Self:
        if self.calibration and self.cage:
            raise ValueError("cage and calibration exclude each other: rays come from a cage or from calibrated cameras")
        return self


def describe_validation(error: ValidationError) -> str:
    """Return every error of a pydantic validation on a line of its own, with its path.

    Parameters
    ----------
    error : pydantic.ValidationError

    Returns
    -------
    str
        Lines ``path: message``; for a key that there is not, the one that is most like it.
    """
    return "\n".join(f"  {'.'.join(map(str, item['loc'])) or '(whole file)'}: {_message(dict(item))}" for item in error.errors())


def _message(item: dict[str, Any]) -> str:
    if item["type"] != "extra_forbidden":
        return str(item["msg"])
    tables: tuple[type[BaseModel], ...] = (Study, Limits, Motion)
    like = get_close_matches(str(item["loc"][-1]), [key for table in tables for key in table.model_fields], 1)
    return f"no such setting; is {like[0]} meant?" if like else "no such setting"


def load_study(path: Path) -> Study:
    """Read a study file.

    Parameters
    ----------
    path : Path
        A TOML file as in docs/quickstart.md; paths in it are taken relative to it. ``calibration`` may stand below ``[foci]``, where TOML
        makes it a part of that table.

    Returns
    -------
    Study

    Raises
    ------
    SettingsError
        If the file cannot be read, is no TOML, or has unknown keys or wrong values (all are listed).
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"{path}: not a readable TOML file ({error})") from error
    below = raw.get("foci")
    if isinstance(below, dict) and "calibration" in below and "calibration" not in raw:
        raw["calibration"] = below.pop("calibration")
    try:
        study = Study.model_validate(raw)
    except ValidationError as error:
        raise SettingsError(f"{path}: wrong settings\n{describe_validation(error)}") from error
    calibration = {focus: (path.parent / file).resolve() for focus, file in study.calibration.items()}
    cage = study.cage
    if cage is not None and cage.endswith(".toml"):
        cage = str((path.parent / cage).resolve())
    return study.model_copy(update={"calibration": calibration, "cage": cage})
