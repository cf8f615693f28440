"""Flags of single rows and reason codes of whole examinations: the only vocabulary for "something is wrong here".

A flag tells about one image point or one marker, a reason about one examination. Both are written joined by ``;``.
"""

from __future__ import annotations

from enum import IntFlag
from functools import lru_cache
from typing import Final


class MarkerFlag(IntFlag):
    """What to know of one marker image or one reconstructed marker."""

    NONE = 0
    OVERLAP = 1  # fitted jointly with a neighbour that it overlaps, or as dense a thing beside it
    EDGE = 2  # its image reaches over the edge of the film
    SATURATED = 4  # saturated pixels under it were masked, or the film beside it is at the flat end of its curve
    CLIPPED = 8  # so much was masked that the coordinates lean on little
    POOR_FIT = 16  # the model does not describe the film here within its noise, or leaves the place open
    REJECTED = 32  # left out by a gross-error rule
    LARGE_RESIDUAL = 64  # residual beyond its statistics
    AMBIGUOUS = 128  # another identity explains it nearly as well
    ONE_VIEW = 256  # seen from one focus only
    PREDICTED = 512  # coordinates come from the known segment, not from rays
    NO_COVARIANCE = 1024  # the input gave no covariance
    FOREIGN_MARK = 2048  # a cage mark that this focus is not meant to see; explained, not used
    LOOSE = 4096  # not where the other markers of its rigid body say
    MISSING = 8192  # a marker that the subject has, of which nothing was found here
    UNLIKE = 16384  # of an odd size, too pale, parallel to an arm of a tee, in a hole or a row, lost in texture: of another kind, or none


def flag_names(value: int) -> str:
    """Return the names of the flags that are set, joined by ``;`` (empty for none).

    Parameters
    ----------
    value : int
        Flags, as of :class:`MarkerFlag`.

    Returns
    -------
    str
        For example ``"overlap;edge"``.
    """
    return ";".join(flag.name.lower().replace("_", "-") for flag in MarkerFlag if flag & value and flag.name)


@lru_cache(maxsize=1024)
def flag_value(names: str) -> int:
    """Return the flags with these names, the inverse of :func:`flag_names`; words that are no flags count for nothing."""
    wanted = {name.strip() for name in names.split(";")}
    return sum(int(flag) for flag in MarkerFlag if flag_names(flag) and flag_names(flag) in wanted)


REASONS: Final[dict[str, str]] = {
    "film-unreadable": "a film of the examination cannot be read; the message says why",
    "film-format": "a file is no single grey radiograph of 8 to 16 bits; export it again as such",
    "pitch-missing": "no plausible pixel pitch in the file; set pixel_pitch_mm in study.toml or --pixel-pitch-mm",
    "film-missing": "a focus has no film; look for a missing or misnamed file",
    "film-unexpected": "more films than foci, or a shared film beside single ones; look at the file names",
    "film-name": "the file name does not say subject and examination; rename it SUBJECT_EXAM[_fK].EXT or set file_pattern in study.toml",
    "film-duplicate": "the same film, or exposure, is given twice; look which of the examinations it belongs to",
    "no-markers": "no marker image was found on a film; look at the film, its polarity and response",
    "cage-not-found": "the marks of the cage are not on the film; is it this cage, this orientation, and a film as the detector gave it?",
    "cage-film-differs": "the film with _cage has other pixels than the film without; export both whole, at one pixel pitch",
    "cage-ambiguous": "two ways of naming the cage marks fit equally well, or a follow-up is turned; set orientation, look at the overlay",
    "film-stretched": "the film is stretched against its pixel pitch: another build of the cage, or a wrong pixel pitch",
    "calibration-invalid": "the camera calibration does not belong to these films; look at the calibration files",
    "few-fiducials": "four fiducial marks were found: no redundancy, a gross error would not show",
    "few-controls": "two control points were found: little redundancy, a gross error would not show",
    "fiducial-residual": "fiducial marks do not fit within the limit: another cage build, a bent film, or a wrong mark",
    "control-residual": "the lines through the control points miss the focus by more than the limit",
    "control-doubled": "most control points overlap other images, as those of a double focal spot do; look at the overlay",
    "focus-far": "the focus lies more than 150 mm from the nominal one; check the set-up in [foci]",
    "film-bend": "the mean y-parallax differs from zero: the film or cassette was not flat",
    "pair-ambiguous": "another pairing of the object markers explains the rays nearly as well, or by later examinations better",
    "crossing-large": "rays of a marker miss each other by more than their statistics allow",
    "marker-one-view": "markers were seen from one focus only and have no coordinates",
    "pins-unpaired": "single pins were found that are no cage marks, and none of them has a partner on the other film",
    "marker-mismatch": "the markers found are not those of segments.csv, or of the earlier examinations",
    "marker-loose": "a marker is not where the other markers of its segment say; leave it out, or look for a wrong pair",
    "constellation-ambiguous": "the markers fit segments.csv, or the earlier examinations, in more than one way or in none that is sure",
    "no-object-markers": "the cage was found but no object marker",
    "response-unsure": "the film response could not be told from the film; set response in study.toml",
    "geometry": "the points do not determine the focus or the plane",
    "internal": "an unexpected failure; please report it with run.json",
    "timeout": "the examination took longer than the time limit",
}
"""Every reason code of ``exams.csv`` and what to do about it (``docs/errors.md`` is checked against this)."""
