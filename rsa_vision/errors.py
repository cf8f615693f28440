"""The expected failures of rsa_vision.

Every failure a user can meet derives from :class:`RsaError`, carries the reason code that stands in ``exams.csv`` and the exit code of the
command, and names the remedy in its message. ``docs/errors.md`` lists them all (a test keeps that list whole).
"""

from __future__ import annotations

from typing import ClassVar


class RsaError(Exception):
    """An expected failure.

    Parameters
    ----------
    message : str
        What is wrong with what, and the remedy.
    """

    code: ClassVar[str] = "error"
    exit_code: ClassVar[int] = 2


class UsageError(RsaError):
    """Options or arguments that cannot be used together, or an input that stops the whole run."""

    code: ClassVar[str] = "usage"


class SettingsError(RsaError):
    """A study file, segments file or option with wrong content; the message lists every error with its path."""

    code: ClassVar[str] = "settings"


class CageError(RsaError):
    """A cage that is unknown or a cage file that is not valid; the message lists every error with its path."""

    code: ClassVar[str] = "cage-invalid"


class CalibrationError(RsaError):
    """A camera calibration file that cannot be read or is not a calibration."""

    code: ClassVar[str] = "calibration-invalid"


class PointsError(RsaError):
    """A table of image coordinates or markers that lacks columns or holds impossible values."""

    code: ClassVar[str] = "points-invalid"


class FilmError(RsaError):
    """A film that cannot be used; only its examination fails."""

    code: ClassVar[str] = "film-unreadable"
    exit_code: ClassVar[int] = 1


class FilmFormatError(FilmError):
    """A file that is no single grey radiograph of 8 to 16 bits (colour, one bit, stack, NaN, absurd size)."""

    code: ClassVar[str] = "film-format"


class PitchError(FilmError):
    """The pixel pitch is missing or implausible; it is never guessed."""

    code: ClassVar[str] = "pitch-missing"


class GeometryError(RsaError):
    """Points that do not determine what is asked (too few, in line, coincident)."""

    code: ClassVar[str] = "geometry"
    exit_code: ClassVar[int] = 1
