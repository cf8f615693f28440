"""What can be wrong with a motion: the codes in the column ``reasons`` of the tables of motion."""

from __future__ import annotations

from typing import Final

MOTION_REASONS: Final[dict[str, tuple[str, str]]] = {
    "segment-missing": ("failed", "the segment has no marker in one of the examinations"),
    "too-few-markers": ("failed", "fewer than three markers are common to both examinations; a motion needs three"),
    "markers-in-line": ("failed", "the markers lie in line within their errors: the rotation about it is not determined"),
    "mirrored": ("failed", "the markers of one examination are the mirror image of the other; look at film sides and exchanged foci"),
    "reference-unknown": ("failed", "no marker of the reference segment is known in this subject; look at the name of the segment"),
    "reference-failed": ("failed", "the motion of the reference segment is not determined; its own row says why"),
    "frame-undefined": ("failed", "markers that define the anatomical frame are missing in the first examination"),
    "exam-failed": ("failed", "one of the examinations has failed; exams.csv says why"),
    "exam-review": ("review", "one of the examinations is not ok; exams.csv says why"),
    "marker-duplicate": ("review", "a marker stands twice in an examination; it was left out, correct its name"),
    "marker-unstable": ("review", "distances between markers of the segment have changed: a loose or mistaken marker"),
    "fit-error": ("review", "the error of rigid-body fitting is above the limit"),
    "residual-large": ("review", "the markers fit far worse than their stated errors explain"),
    "condition-number": ("review", "the condition number is above the limit: the markers lie too close together, or nearly in line"),
    "reference-review": ("review", "the reference segment is to be reviewed; its own row says why"),
    "euler-singular": ("review", "the rotation about y is 90 degrees: rx and rz are not told apart; use the screw axis"),
    "exams-out-of-order": ("review", "by its name the later examination is the earlier one; look at the names"),
    "exam-order-unclear": (
        "review",
        "names of examinations do not tell their order (words, or dates with the day or month first);"
        " use yyyy-mm-dd, or names that differ in numbers alone",
    ),
    "marker-missing": ("ok", "a marker has no coordinates in one of the examinations; the others were used"),
    "marker-predicted": ("ok", "a marker was placed by the known segment, not by rays; it was left out"),
    "marker-doubtful": ("ok", "a marker is flagged loose or ambiguous: it may have moved in its bone, or be another one; it was left out"),
    "segments-together": ("ok", "lengths of several segments: what these moved against each other is in the lengths and the scale"),
    "screw-undefined": ("ok", "the rotation is zero within its error: no direction of the screw axis"),
    "sd-from-residuals": ("ok", "the input has no covariances: standard deviations come from the residuals"),
}
"""Status that each code gives, and what it means. Those that leave a motion ``ok`` are remarks."""

WORST: Final = ("ok", "review", "failed")
BIT: Final = {code: 1 << place for place, code in enumerate(MOTION_REASONS)}
FAILURE_BITS: Final = sum(BIT[code] for code, (status, _) in MOTION_REASONS.items() if status == "failed")
REVIEW_BITS: Final = sum(BIT[code] for code, (status, _) in MOTION_REASONS.items() if status == "review")


def status_of(bits: int) -> str:
    """Return the worst status that a set of codes (the sum of their ``BIT``) gives."""
    return "failed" if bits & FAILURE_BITS else "review" if bits & REVIEW_BITS else "ok"


def joined(bits: int) -> str:
    """Return a set of codes joined by ``;``, the worst first."""
    codes = [code for code, bit in BIT.items() if bits & bit]
    return ";".join(sorted(codes, key=lambda code: -WORST.index(MOTION_REASONS[code][0])))
