"""The pixel pitch: taken from the file if it is plausible, else asked for; never guessed."""

from __future__ import annotations

import math
from typing import Final

from rsa_vision.errors import PitchError
from rsa_vision.types import Film

MIN_PITCH_MM: Final = 0.01  # 2540 dpi
MAX_PITCH_MM: Final = 0.5  # 51 dpi
MAX_ANISOTROPY: Final = 0.05  # row and column pitch of a scanner differ by less
SCREEN_DPI: Final = (72.0, 96.0)  # what programs write that know no resolution
SCREEN_TOLERANCE: Final = 5e-4  # they are stored as whole pixels per metre or inch
MM_PER_INCH: Final = 25.4

Pitch = tuple[float, float]
"""(row, column) pitch, mm"""


def judge_pitch(row_mm: float, col_mm: float, source: str, *, default_suspected: bool = False) -> tuple[Pitch | None, str]:
    """Return a pitch if a film can have it, and where it comes from or why it is not believed.

    Parameters
    ----------
    row_mm, col_mm : float
        What the file claims, mm.
    source : str
        Name of the tag.
    default_suspected : bool
        Whether 72 and 96 dpi are taken for a program's default (raster formats) and not believed.

    Returns
    -------
    pitch : tuple of two floats, or None
    source : str
    """
    claim = f"{source} ({row_mm:.6g} x {col_mm:.6g} mm)"
    if not (math.isfinite(row_mm) and math.isfinite(col_mm) and row_mm > 0 and col_mm > 0):
        return None, f"{claim}: no length"
    if min(row_mm, col_mm) < MIN_PITCH_MM or max(row_mm, col_mm) > MAX_PITCH_MM:
        return None, f"{claim}: implausible for a film, outside {MIN_PITCH_MM} to {MAX_PITCH_MM} mm"
    if abs(row_mm - col_mm) > MAX_ANISOTROPY * max(row_mm, col_mm):
        return None, f"{claim}: implausible, rows and columns differ by more than {MAX_ANISOTROPY:.0%}"
    if default_suspected and any(abs(MM_PER_INCH / row_mm / dpi - 1) < SCREEN_TOLERANCE for dpi in SCREEN_DPI):
        return None, f"{claim}: {MM_PER_INCH / row_mm:.0f} dpi is what programs write that do not know"
    return (row_mm, col_mm), source


def require_pitch(film: Film, override_mm: float | None = None) -> Pitch:
    """Return the pixel pitch to use.

    Parameters
    ----------
    film : Film
    override_mm : float, optional
        ``pixel_pitch_mm`` of the study; it wins over the file.

    Returns
    -------
    tuple of two floats
        (row, column) pitch, mm.

    Raises
    ------
    PitchError
        If the file gives no plausible pitch and there is no override, or the override itself is implausible.
    """
    if override_mm is not None:
        if not MIN_PITCH_MM <= override_mm <= MAX_PITCH_MM:
            raise PitchError(
                f"pixel_pitch_mm = {override_mm:g} is implausible for a film ({MIN_PITCH_MM} to {MAX_PITCH_MM} mm); correct it"
            )
        return override_mm, override_mm
    if film.pitch_mm is None:
        remedy = "set pixel_pitch_mm in study.toml, or --pixel-pitch-mm"
        raise PitchError(f"{film.path}: the file tells no plausible pixel pitch ({film.pitch_source}); {remedy}")
    return film.pitch_mm
