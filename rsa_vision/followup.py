"""Names through the examinations of a subject: tables of each examination in, the same tables with the names that last out.

Every examination is measured alone and numbers its markers by where they lie. Here known segments are found again among them, and what
belongs to none keeps the name that it got when it was first seen. Nothing is measured again, so that it can be done anew at any time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from rsa_vision.contests import cloud_of, settle_pairs
from rsa_vision.flags import MarkerFlag, flag_names, flag_value
from rsa_vision.identify.constellation import Known, match_bodies, match_segments
from rsa_vision.identify.hidden import Sighting
from rsa_vision.identify.known_bodies import Seen, as_measured
from rsa_vision.identify.loose import loose_pairs
from rsa_vision.identify.poses import Cloud
from rsa_vision.ordering import natural_key
from rsa_vision.segments import Segment, Segments, segments_of
from rsa_vision.settings import Limits
from rsa_vision.sighted import HiddenMarker, find_sightings, hidden_of, hidden_since, image_row, missing_row, predicted_row
from rsa_vision.tables import Row, Rows, name_of, split_name
from rsa_vision.types import Float
from rsa_vision.verdict import Finding, conclude

UNRELATED: Final = 8  # markers of which not one is found again, nor nearly: another object, not one whose few markers moved
UNSURE: Final = MarkerFlag.AMBIGUOUS | MarkerFlag.LOOSE | MarkerFlag.LARGE_RESIDUAL  # places that nothing is compared with later
MOST_EARLIER: Final = 6  # examinations that one is compared with: the first, and the last ones before it


@dataclass(eq=False)
class _Exam:
    """One examination while it is being named."""

    rows: Rows
    located: list[Row]  # markers that have coordinates
    cloud: Cloud
    names: list[str] = field(default_factory=list)  # of these, empty where unknown
    flags: list[int] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    hidden: list[HiddenMarker] = field(default_factory=list)
    missing: set[str] = field(default_factory=set)  # known markers that were not found
    unsure: set[str] = field(default_factory=set)  # names that may be second ones of a marker
    turns: dict[str, Float] = field(default_factory=dict)  # rotations of known segments
    seen: dict[str, Seen] = field(default_factory=dict)  # known segments as their markers were measured
    told: str = ""  # what a reader should know of its pairs though nothing is wrong


def follow_up(exams: Sequence[Rows], segments: Segments | None, limits: Limits) -> list[Rows]:
    """Name the markers of examinations by known segments, and the others as in the earlier examinations of their subject.

    Parameters
    ----------
    exams : sequence of dict
        Rows of the tables of each examination (:func:`rsa_vision.tables.examination_rows`), those of a subject in the order of time.
    segments : mapping, optional
        As of :func:`rsa_vision.segments.read_segments`.
    limits : Limits
        ``posterior`` is used.

    Returns
    -------
    list of dict
        The same rows with other names (``number`` of object images, ``segment`` and ``marker``), flags, and with what speaks against the
        names in status, reasons and message. Examinations that failed are as they were.
    """
    subjects: dict[str, list[int]] = {}
    for index, rows in enumerate(exams):
        subjects.setdefault(rows["exams"][0]["subject"], []).append(index)
    result = list(exams)
    for subject, indices in subjects.items():
        told = [] if segments is None else segments_of(segments, subject)
        known = [segment for segment in told if not segment.problem]
        problems: list[Finding] = [("constellation-ambiguous", segment.problem) for segment in told if segment.problem]
        earlier: list[_Exam] = []
        used = 0
        for index in indices:
            if exams[index]["exams"][0]["status"] == "failed":
                continue
            bodies = [_body_of(segment, earlier) for segment in known]
            rows = settle_pairs(exams[index], bodies, limits) if bodies else exams[index]
            exam = _open(rows)
            exam.findings += problems
            if known:
                exam.told = _settled(exams[index], rows)
                _name_by_segments(exam, earlier, known, bodies, limits)
            elif segments is not None and not problems:
                exam.findings.append(("marker-mismatch", f"segments.csv knows no segment of subject {subject}"))
            used = _name_by_earlier(exam, earlier, used, limits)
            earlier.append(exam)
            result[index] = _renamed(exam)
    return result


def _open(rows: Rows) -> _Exam:
    found = [row for row in rows["markers"] if not flag_value(row["flags"] or "") & MarkerFlag.MISSING]
    rows = {**rows, "markers": found}
    located = [row for row in found if row["x_mm"] is not None]
    return _Exam(rows, located, cloud_of(located), [""] * len(located), [0] * len(located))


def _settled(before: Rows, after: Rows) -> str:
    doubts = "pair-ambiguous" in before["exams"][0]["reasons"].split(";")
    if not doubts or "pair-ambiguous" in after["exams"][0]["reasons"].split(";"):
        return ""
    return "the known segments decide the doubtful pairs"


def _body_of(segment: Segment, earlier: Sequence[_Exam]) -> Cloud:
    """Return a segment as `segments.csv` tells it, and if it does so with errors as it was measured since, which tells smaller motions."""
    body = Cloud.independent(segment.position_mm, segment.sd_mm)
    if segment.sd_mm is None:
        return body
    return as_measured(body, [other.seen[segment.name] for other in earlier if segment.name in other.seen])


def _name_by_segments(exam: _Exam, earlier: Sequence[_Exam], segments: Sequence[Segment], bodies: Sequence[Cloud], limits: Limits) -> None:
    turns = {name: turn for other in earlier for name, turn in other.turns.items()}  # the last ones
    before = [turns.get(segment.name) for segment in segments]
    matched = match_segments(bodies, exam.cloud, limits.posterior, before)
    if any(turn is None for turn in before):
        before = [_beside(k, matched) if turn is None else turn for k, turn in enumerate(before)]
        matched = match_segments(bodies, exam.cloud, limits.posterior, before)
    matched, sightings = _with_single_images(exam, bodies, matched, before, limits)
    for segment, body, known, sighting in zip(segments, bodies, matched, sightings, strict=True):
        for i, a in (*known.pairs, *known.loose, *sighting.pairs):
            exam.names[a] = f"{segment.name}/{segment.markers[i]}"
        for _, a in known.loose:
            exam.flags[a] |= MarkerFlag.LOOSE
        if (placement := known.placement or sighting.placement) is not None:
            exam.turns[segment.name] = placement.rotation
        if known.placement is not None:
            sure = [(i, a) for i, a in known.pairs if (i, a) not in known.loose and not flag_value(exam.located[a]["flags"] or "") & UNSURE]
            exam.seen[segment.name] = Seen(known.placement, tuple(sure), exam.cloud)
        if known.placement is None and sighting.placement is not None:
            known = replace(known, doubtful=())  # single rays decided
        for _, a in known.doubtful:
            exam.flags[a] |= MarkerFlag.AMBIGUOUS
        seen = {i for i, _ in (*known.pairs, *known.doubtful, *known.loose, *sighting.pairs, *sighting.sights)}
        lost = tuple(i for i in range(len(segment.markers)) if i not in seen)
        exam.missing |= {f"{segment.name}/{segment.markers[i]}" for i in (*lost, *(i for i, _ in known.doubtful))}
        exam.findings += _segment_findings(segment, replace(known, lost=lost), sighting, limits)
        if sighting.placement is not None:
            exam.hidden += hidden_of([f"{segment.name}/{marker}" for marker in segment.markers], body, sighting)
    if "pair-ambiguous" in exam.rows["exams"][0]["reasons"].split(";"):
        doubted = [a for a, row in enumerate(exam.located) if flag_value(row["flags"] or "") & MarkerFlag.AMBIGUOUS]
        agreed = [exam.names[a] for a in doubted if exam.names[a] and not exam.flags[a]]
        if agreed:
            exam.findings.append(("pair-ambiguous", f"the doubtful pairs of {', '.join(agreed)} agree with the constellation"))
    extra = [name_of(row) for row, name in zip(exam.located, exam.names, strict=True) if not name]
    if extra:
        exam.findings.append(("marker-mismatch", f"{len(extra)} markers belong to no known segment"))


def _with_single_images(
    exam: _Exam, bodies: Sequence[Cloud], matched: list[Known], before: Sequence[Float | None], limits: Limits
) -> tuple[list[Known], list[Sighting]]:
    """Look at single images, and again at the segments still in doubt among the points that are left when these have decided others."""
    while True:
        sightings = find_sightings(exam.rows, exam.cloud, bodies, matched, limits)
        both = list(zip(matched, sightings, strict=True))
        doubted = [k for k, (known, sighting) in enumerate(both) if known.placement is None and sighting.placement is None]
        if not doubted or len(doubted) == sum(known.placement is None for known in matched):
            return matched, sightings  # nothing is in doubt, or single images decided nothing
        taken = {a for known, sighting in both for _, a in (*known.pairs, *known.loose, *sighting.pairs)}
        left = np.array([a for a in range(len(exam.cloud)) if a not in taken], dtype=np.int64)
        again = match_segments([bodies[k] for k in doubted], exam.cloud.rows(left), limits.posterior, [before[k] for k in doubted])
        found = {k: known.among(left) for k, known in zip(doubted, again, strict=True)}
        matched = [found.get(k, known) for k, known in enumerate(matched)]
        if all(known.placement is None for known in found.values()):
            return matched, sightings


def _segment_findings(segment: Segment, known: Known, sighting: Sighting, limits: Limits) -> list[Finding]:
    def told(markers: Iterable[int]) -> str:
        return ", ".join(segment.markers[i] for i in markers)

    findings: list[Finding] = []
    if known.doubtful:
        doubt = f"segment {segment.name}: the names of {told(i for i, _ in known.doubtful)} have a posterior below {limits.posterior:g}"
        findings.append(("constellation-ambiguous", doubt))
    if known.loose:
        findings.append(("marker-loose", f"segment {segment.name}: {told(i for i, _ in known.loose)} not where the others say"))
    if sighting.sights:
        seen = told(sorted({i for i, _ in sighting.sights}))
        findings.append(("marker-one-view", f"segment {segment.name}: {seen} seen from one focus only, predicted by the others"))
    elif not sighting.decisive:
        findings.append(("constellation-ambiguous", f"segment {segment.name}: single images fit its missing markers in more than one way"))
    if known.placement is None and sighting.placement is None and not known.doubtful:
        findings.append(("marker-mismatch", f"segment {segment.name} was not found among the markers"))
    elif known.lost:
        findings.append(("marker-mismatch", f"segment {segment.name}: {told(known.lost)} not found"))
    return findings


def _beside(index: int, matched: Sequence[Known]) -> Float | None:
    """Return the rotation of the largest other segment: those of one patient may be given as they are to each other."""
    others = [known for k, known in enumerate(matched) if k != index and known.placement is not None]
    largest = max(others, key=lambda known: len(known.pairs), default=None)
    return None if largest is None or largest.placement is None else largest.placement.rotation


def _name_by_earlier(exam: _Exam, earlier: Sequence[_Exam], used: int, limits: Limits) -> int:
    """Give markers without a name that of an earlier examination, or the next free number; return the last number used."""
    left = [a for a, name in enumerate(exam.names) if not name]
    points = exam.cloud.rows(np.array(left, dtype=np.int64))
    given: dict[int, set[str]] = {}
    doubtful = np.zeros(len(left), bool)
    for other in (*earlier[:1], *earlier[:0:-1][: MOST_EARLIER - 1]):
        if len(given) == len(left):
            break
        before = [i for i, name in enumerate(other.names) if not split_name(name)[0]]
        old = other.cloud.rows(np.array(before, dtype=np.int64))
        bodies, doubts = match_bodies(old, points, limits.posterior)
        doubtful |= doubts
        for i, a in (pair for body in bodies for pair in body):
            given.setdefault(a, set()).add(other.names[before[i]])
        for _, a in loose_pairs(bodies, old, points, limits.posterior):
            exam.flags[left[a]] |= MarkerFlag.LOOSE
    once = [name for names in given.values() for name in names]
    agreed = {a: next(iter(names)) for a, names in given.items() if len(names) == 1 and once.count(next(iter(names))) == 1}
    for a, name in agreed.items():
        exam.names[left[a]] = name
    new = [a for a in range(len(left)) if a not in agreed]
    for a in new:
        used += 1
        exam.names[left[a]] = f"P{used:02d}"
    unrelated = bool(earlier) and not agreed and not doubtful.any() and len(new) >= UNRELATED
    if exam.missing or unrelated:  # they may be those of known segments, or of nobody that was seen before
        exam.unsure |= {exam.names[left[a]] for a in new}
    if unrelated:
        told = f"none of its {len(new)} markers is among those of earlier examinations: of another subject, or another object?"
        exam.findings.append(("marker-mismatch", told))
    elif earlier:
        known = {name for other in earlier for name in other.names if not split_name(name)[0]}
        second = {name for other in earlier for name in other.unsure}
        absent, doubted = known - set(exam.names) - second, second & set(exam.names)
        exam.missing |= absent
        if absent and doubted:
            may_be = " may be ".join(", ".join(sorted(names, key=natural_key)) for names in (doubted, absent))
            exam.findings.append(("constellation-ambiguous", f"{may_be}, as in an earlier examination that this one agrees with"))
        exam.findings += _earlier_findings(exam, [left[a] for a in new], [left[a] for a in new if doubtful[a]], known)
        _name_hidden(exam, earlier[0], limits)
    return used


def _name_hidden(exam: _Exam, first: _Exam, limits: Limits) -> None:
    """Name single images that show markers of the first examination."""
    free = [i for i, name in enumerate(first.names) if not split_name(name)[0]]
    names = [first.names[i] for i in free]
    found = tuple((names.index(name), a) for a, name in enumerate(exam.names) if name in names)
    before = first.cloud.rows(np.array(free, dtype=np.int64))
    used = {index for one in exam.hidden for index in one.images}
    hidden = hidden_since(exam.rows, before, names, exam.cloud, tuple(sorted(found)), exam.missing, limits)
    hidden = [one for one in hidden if not used & set(one.images)]
    exam.hidden += hidden
    exam.missing -= {one.name for one in hidden}
    if hidden:
        told = ", ".join(one.name for one in hidden)
        exam.findings.append(("marker-one-view", f"{told} seen from one focus only, predicted by the first examination"))


def _earlier_findings(exam: _Exam, new: Sequence[int], doubtful: Sequence[int], known: set[str]) -> list[Finding]:
    missing = sorted(known - set(exam.names))
    told = ", ".join(exam.names[a] for a in new)
    loose = [exam.names[a] for a, flags in enumerate(exam.flags) if flags & MarkerFlag.LOOSE and not split_name(exam.names[a])[0]]
    findings: list[Finding] = []
    if loose:
        findings.append(("marker-loose", f"{', '.join(loose)} not where the others of the same rigid group say"))
    if new and missing:
        exam.unsure |= {exam.names[a] for a in new}
        for a in doubtful:
            exam.flags[a] |= MarkerFlag.AMBIGUOUS
        why = f"{told} may be {', '.join(missing)} of earlier examinations: too few markers keep their distances to tell"
        findings.append(("constellation-ambiguous", why))
    elif new:
        findings.append(("marker-mismatch", f"{told} were not seen in earlier examinations"))
    return findings


def _renamed(exam: _Exam) -> Rows:
    """Return the rows with the names that were found; markers without coordinates keep theirs unless it is given away."""
    names = {name_of(row): name for row, name in zip(exam.located, exam.names, strict=True)}
    taken = set(exam.names)
    for row in exam.rows["markers"]:
        if row["x_mm"] is None:
            names[name_of(row)] = _free(name_of(row), taken)
            taken.add(names[name_of(row)])
    flags = dict(zip(map(name_of, exam.located), exam.flags, strict=True))
    markers = []
    for row in exam.rows["markers"]:
        segment, marker = split_name(names[name_of(row)])
        markers.append({**row, "segment": segment, "marker": marker, "flags": _with_flags(row, flags.get(name_of(row), 0))})
    images = [
        {**row, "number": names.get(row["number"], row["number"]), "flags": _with_flags(row, flags.get(row["number"], 0))}
        if row["role"] == "object"
        else row
        for row in exam.rows["images"]
    ]
    about = exam.rows["exams"][0]
    with_plane = any(row["role"] == "fiducial" for row in images)
    for hidden in exam.hidden:
        markers.append(predicted_row(about, hidden))
        for index, (focus, ray) in hidden.images.items():
            images[index] = image_row(images[index], hidden, focus, ray, with_plane=with_plane)
    given = {row["number"] for row in images}
    markers = [row for row in markers if row["x_mm"] is not None or name_of(row) in given or not images]
    markers += [missing_row(about, name) for name in sorted(exam.missing, key=natural_key)]
    row = judged(exam.rows["exams"][0], exam.findings)
    row["message"] = " | ".join(filter(None, [row["message"], exam.told]))
    return {**exam.rows, "exams": [row], "images": images, "markers": markers}


def _free(name: str, taken: set[str]) -> str:
    number = 0
    free = name
    while free in taken:
        number += 1
        free = f"{name}-{number}"
    return free


def _with_flags(row: Mapping[str, str], flags: int) -> str:
    return flag_names(flag_value(row["flags"] or "") | flags)


def judged(row: Row, findings: Sequence[Finding]) -> Row:
    """Return a row of ``exams.csv`` with findings added."""
    verdict = conclude([*((code, row["message"]) for code in filter(None, row["reasons"].split(";"))), *findings])
    messages = [*filter(None, [row["message"]]), *(message for _, message in findings if message not in (row["message"] or ""))]
    return {**row, "status": verdict.status, "reasons": ";".join(verdict.reasons), "message": " | ".join(dict.fromkeys(messages))}
