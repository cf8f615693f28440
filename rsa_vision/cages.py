"""Cages: the content of cage files, and the built-in ones.

A cage file is TOML as in docs/cages.md; lengths are mm in the laboratory frame of docs/conventions.md. The built-in cages are
such files too.
"""

from __future__ import annotations

import hashlib
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator

from rsa_vision.cage_checks import EXPANSION_PER_C, Issue, geometry_issues, material_issues, material_name
from rsa_vision.cage_symmetry import Symmetry, symmetries
from rsa_vision.errors import CageError
from rsa_vision.settings import FilmMode, Finite, Frozen, Vector
from rsa_vision.types import Float

__all__ = ["Cage", "Mark", "Plane", "Role", "Shape", "Symmetry", "builtin_cages", "load_cage", "symmetries"]

Role = Literal["fiducial", "control"]
Shape = Literal["ball", "pin", "tee"]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Number = Annotated[int, Field(ge=1)]
Foci = dict[Number, Vector]


class Plane(Frozen):
    """A fiducial plane: ``origin + a * u + b * v``; ``u x v`` points towards its foci.

    ``film_gap_mm`` is the distance of the film behind it, ``film_size_mm`` the size of the film along u and v, where known.
    """

    foci: Annotated[tuple[Number, ...], Field(min_length=1)]
    origin: Vector
    u: Vector
    v: Vector
    film_gap_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    film_size_mm: tuple[Positive, Positive] | None = None

    def lab_from_plane(self) -> tuple[Float, Float]:
        """Return the origin, shape (3,), mm, and the unit vectors u and v, shape (2, 3), in the laboratory frame."""
        return np.array(self.origin), np.array([self.u, self.v])

    def normal(self) -> Float:
        """Return the unit normal, shape (3,), that points towards the foci."""
        return np.cross(self.u, self.v)


class Mark(Frozen):
    """A fiducial mark or control point, and the foci that see it.

    ``diameter`` and ``length`` (of each pin) are mm; ``arms`` point from the tip, or from where the tips meet, to the thick ends; ``sd``
    are the standard deviations of ``xyz`` from calibration, mm.
    """

    number: Number
    role: Role
    foci: Annotated[tuple[Number, ...], Field(min_length=1)]
    shape: Shape
    xyz: Vector
    diameter: Positive
    length: Positive | None = None
    arms: tuple[Vector, ...] = ()
    sd: tuple[Positive, Positive, Positive] | None = None


class Cage(Frozen):
    """A calibration cage.

    Raises
    ------
    pydantic.ValidationError
        On construction, if it cannot work; :func:`load_cage` makes a :class:`CageError` of it that lists all errors.
    """

    name: Annotated[str, Field(min_length=1)]
    film: FilmMode
    material: str
    calibrated_at_c: Finite
    expansion_per_c: Annotated[float, Field(ge=0, lt=1e-3)] | None = None
    foci: Annotated[Foci, Field(min_length=1)]
    plane: Annotated[tuple[Plane, ...], Field(min_length=1)]
    mark: tuple[Mark, ...]

    @model_validator(mode="after")
    def _works(self) -> Self:
        issues = material_issues(self.material, self.expansion_per_c is not None)
        issues += geometry_issues(self.film, self.foci, dict(enumerate(self.plane)), dict(enumerate(self.mark)))
        if issues:
            raise ValueError("\n" + _lines(issues))
        return self

    def plane_of(self, focus: int) -> Plane:
        """Return the fiducial plane of a focus; :class:`CageError` if the cage has no such focus."""
        for plane in self.plane:
            if focus in plane.foci:
                return plane
        raise CageError(f"cage {self.name} has no focus {focus}; it has {', '.join(map(str, sorted(self.foci)))}")

    def marks_of(self, focus: int, role: Role) -> tuple[Mark, ...]:
        """Return the marks of one role that a focus sees, by rising number."""
        return tuple(sorted((m for m in self.mark if m.role == role and focus in m.foci), key=lambda m: m.number))

    def at_temperature(self, temperature_c: float | None) -> Cage:
        """Return the cage with the coordinates it has at a temperature (Selvik 1989, ch. 3).

        Parameters
        ----------
        temperature_c : float or None
            None: not known, the cage is returned as calibrated.

        Returns
        -------
        Cage
            Marks and planes scaled by ``1 + expansion * (temperature_c - calibrated_at_c)`` about the origin. The foci are no part of the
            cage and stay.
        """
        if temperature_c is None:
            return self
        expansion = EXPANSION_PER_C[material_name(self.material)] if self.expansion_per_c is None else self.expansion_per_c
        scale = 1 + expansion * (temperature_c - self.calibrated_at_c)
        planes = tuple(plane.model_copy(update={"origin": _scaled(plane.origin, scale)}) for plane in self.plane)
        marks = tuple(mark.model_copy(update={"xyz": _scaled(mark.xyz, scale)}) for mark in self.mark)
        return self.model_copy(update={"plane": planes, "mark": marks, "calibrated_at_c": float(temperature_c)})

    @property
    def sha256(self) -> str:
        """Hash of the cage's content (not of the layout of its file)."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()


def builtin_cages() -> tuple[str, ...]:
    """Return the names of the built-in cages."""
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in _folder().iterdir() if entry.name.endswith(".toml")))


def load_cage(name_or_path: str | Path) -> Cage:
    """Read a built-in cage or a cage file.

    Parameters
    ----------
    name_or_path : str or Path
        A name of :func:`builtin_cages`, or the path of a TOML file.

    Returns
    -------
    Cage

    Raises
    ------
    CageError
        If there is no such cage, the file is no TOML, or the cage cannot work: every error is listed with its path in the file.
    """
    builtin = isinstance(name_or_path, str) and name_or_path in builtin_cages()
    source: Traversable | Path = _folder() / f"{name_or_path}.toml" if builtin else Path(name_or_path)
    try:
        raw = tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        known = ", ".join(builtin_cages())
        raise CageError(f"{name_or_path}: neither a built-in cage ({known}) nor a cage file; see `rsa-vision cage list`") from error
    except (OSError, ValueError) as error:  # TOMLDecodeError, UnicodeDecodeError, a NUL in the path
        raise CageError(f"{name_or_path}: not a readable TOML file ({error})") from error
    try:
        return Cage.model_validate(raw)
    except ValidationError as error:
        raise CageError(f"{name_or_path}: not a valid cage\n{_lines(_all_issues(raw, error))}") from error


def _folder() -> Traversable:
    return resources.files("rsa_vision") / "data" / "cages"


def _scaled(vector: Vector, scale: float) -> Vector:
    x, y, z = vector
    return x * scale, y * scale, z * scale


def _lines(issues: list[Issue]) -> str:
    return "\n".join(f"  {path}: {message}" for path, message in issues)


def _all_issues(raw: dict[str, Any], error: ValidationError) -> list[Issue]:
    """Return the errors of single values, and those of the geometry of whatever can be read: one run shows all.

    pydantic alone checks a whole model only after all of its values are right.
    """
    issues = [(".".join(map(str, item["loc"])), item["msg"]) for item in error.errors() if item["loc"]]
    if isinstance(material := raw.get("material"), str):
        issues += material_issues(material, "expansion_per_c" in raw)
    try:
        foci = TypeAdapter(Foci).validate_python(raw.get("foci"))
    except ValidationError:
        return issues
    planes, unread_planes = _readable(Plane, raw.get("plane"))
    marks, unread_marks = _readable(Mark, raw.get("mark"))
    film = str(raw.get("film"))
    return issues + geometry_issues(film, foci, planes, marks, unread_planes=unread_planes, unread_marks=unread_marks)


Part = TypeVar("Part", Plane, Mark)


def _readable(model: type[Part], raw: object) -> tuple[dict[int, Part], int]:
    """Return the parts of a list that can be read (unknown keys put aside), by their index, and the number of the others."""
    parts: dict[int, Part] = {}
    items = raw if isinstance(raw, list) else []
    for index, item in enumerate(items):
        known = {key: value for key, value in item.items() if key in model.model_fields} if isinstance(item, dict) else item
        try:
            parts[index] = model.model_validate(known)
        except ValidationError:
            continue
    return parts, len(items) - len(parts)
