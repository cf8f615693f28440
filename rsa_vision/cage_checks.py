"""What makes a cage unable to work, found on the values of its file; see :class:`rsa_vision.cages.Cage`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from rsa_vision.types import Float

if TYPE_CHECKING:
    from rsa_vision.cages import Mark, Plane

Issue = tuple[str, str]
"""(path in the file, message)"""

EXPANSION_PER_C: Final[Mapping[str, float]] = {"plexiglas": 75e-6, "mirror glass": 8e-6, "quartz glass": 3.2e-6}  # Selvik 1989, ch. 3
PLANE_TOLERANCE_MM: Final = 0.01  # seen at 45 deg, a mark this far off its plane is displaced by as much: the size of one image error
CONTROL_HEIGHT_MM: Final = 1.0  # a lower control point says nothing about the focus
COINCIDENT_MM: Final = 0.1  # two marks this near are one mark entered twice
UNIT_TOLERANCE: Final = 1e-6  # of u and v: 0.4 um on 400 mm
LINE_TOLERANCE: Final = 1e-3  # deviation from a straight line, relative to the extent of the marks
ARMS: Final[Mapping[str, int]] = {"ball": 0, "pin": 1, "tee": 3}
MIN_FIDUCIALS: Final = 4
MIN_CONTROLS: Final = 2


def material_name(name: str) -> str:
    """Return the name of a material as in :data:`EXPANSION_PER_C`, whatever its case and separators."""
    return name.strip().lower().replace("_", " ").replace("-", " ")


def material_issues(material: str, expansion_given: bool) -> list[Issue]:
    """Return what is wrong with the material: its expansion must be known one way or the other."""
    if expansion_given or material_name(material) in EXPANSION_PER_C:
        return []
    known = ", ".join(EXPANSION_PER_C)
    return [("material", f"the expansion of {material!r} is not known (known: {known}); give it as expansion_per_c, 1/degC")]


def geometry_issues(
    film: str,
    foci: Mapping[int, tuple[float, float, float]],
    planes: Mapping[int, Plane],
    marks: Mapping[int, Mark],
    *,
    unread_planes: int = 0,
    unread_marks: int = 0,
) -> list[Issue]:
    """Return everything that keeps a cage from working.

    Parameters
    ----------
    film : str
        ``shared`` or ``separate``.
    foci : mapping
        Nominal foci, mm.
    planes, marks : mapping
        By their index in the file.
    unread_planes, unread_marks : int
        How many there are beside these that could not be read: what they might mend is not reported.

    Returns
    -------
    list of (path, message)
    """
    issues = [issue for index, plane in planes.items() for issue in _plane_issues(f"plane.{index}", plane, foci)]
    issues += [issue for index, mark in marks.items() for issue in _mark_issues(f"mark.{index}", mark, foci)]
    plane_of = {focus: plane for plane in planes.values() for focus in plane.foci}
    count = Counter(focus for plane in planes.values() for focus in plane.foci)
    for focus in foci:
        if count[focus] > 1:
            issues.append(("plane", f"focus {focus} has {count[focus]} fiducial planes; it needs one"))
        elif count[focus] == 0 and not unread_planes:
            issues.append(("plane", f"focus {focus} has no fiducial plane"))
    if film == "shared" and len(planes) > 1:
        issues.append(("film", 'foci of a shared film share one plane; give one [[plane]], or film = "separate"'))
    issues += _duplicate_issues(marks)
    for focus, plane in plane_of.items():
        if focus in foci and _orthonormal(plane):
            issues += _focus_issues(focus, np.array(foci[focus]), plane, marks, unread_marks)
    return issues


def _orthonormal(plane: Plane) -> bool:
    _, basis = plane.lab_from_plane()
    return bool(np.allclose(basis @ basis.T, np.eye(2), atol=UNIT_TOLERANCE))


def _plane_issues(path: str, plane: Plane, foci: Mapping[int, tuple[float, float, float]]) -> list[Issue]:
    issues = [(f"{path}.foci", f"focus {focus} is not among [foci]") for focus in plane.foci if focus not in foci]
    if not _orthonormal(plane):
        return [*issues, (path, "u and v must be unit vectors at right angles")]
    origin, _ = plane.lab_from_plane()
    behind = [focus for focus in plane.foci if focus in foci and float((np.array(foci[focus]) - origin) @ plane.normal()) <= 0]
    return issues + [
        (path, f"focus {focus} lies behind the plane; u x v must point towards it (exchange or negate u and v)") for focus in behind
    ]


def _mark_issues(path: str, mark: Mark, foci: Mapping[int, tuple[float, float, float]]) -> list[Issue]:
    issues = [(f"{path}.foci", f"focus {focus} is not among [foci]") for focus in mark.foci if focus not in foci]
    if len(set(mark.foci)) < len(mark.foci):
        issues.append((f"{path}.foci", "a focus is named twice"))
    if len(mark.arms) != ARMS[mark.shape]:
        issues.append((f"{path}.arms", f"a {mark.shape} has {ARMS[mark.shape]} arms, not {len(mark.arms)}"))
    if mark.shape == "ball" and mark.length is not None:
        issues.append((f"{path}.length", "a ball has no length"))
    if mark.shape != "ball" and mark.length is None:
        issues.append((f"{path}.length", f"a {mark.shape} needs the length of its pins, mm"))
    arms = np.array(mark.arms).reshape(-1, 3)
    norms = np.linalg.norm(arms, axis=1)
    if np.any(norms < UNIT_TOLERANCE):
        issues.append((f"{path}.arms", "an arm has no direction"))
    elif any(float(a @ b) > np.cos(np.deg2rad(10)) for a, b in combinations(arms / norms[:, None], 2)):
        issues.append((f"{path}.arms", "two arms point the same way"))
    return issues


def _duplicate_issues(marks: Mapping[int, Mark]) -> list[Issue]:
    issues: list[Issue] = []
    first: dict[tuple[int, int], int] = {}
    for index, mark in marks.items():
        for focus in dict.fromkeys(mark.foci):
            earlier = first.setdefault((focus, mark.number), index)
            if earlier != index:
                issues.append((f"mark.{index}.number", f"number {mark.number} of focus {focus} is already that of mark.{earlier}"))
    for (i, a), (j, b) in combinations(marks.items(), 2):
        if set(a.foci) & set(b.foci) and np.linalg.norm(np.subtract(a.xyz, b.xyz)) < COINCIDENT_MM:
            issues.append((f"mark.{j}.xyz", f"lies where mark.{i} lies"))
    return issues


def _focus_issues(focus: int, position: Float, plane: Plane, marks: Mapping[int, Mark], unread: int) -> list[Issue]:
    issues: list[Issue] = []
    origin, basis = plane.lab_from_plane()
    normal = plane.normal()
    height_of_focus = float((position - origin) @ normal)
    own = {index: mark for index, mark in marks.items() if focus in mark.foci}
    for index, mark in own.items():
        height = float((np.array(mark.xyz) - origin) @ normal)
        if mark.role == "fiducial" and abs(height) > PLANE_TOLERANCE_MM:
            issues.append((f"mark.{index}.xyz", f"lies {height:.3f} mm off the fiducial plane of focus {focus}"))
        elif mark.role == "control" and abs(height) < CONTROL_HEIGHT_MM:
            issues.append((f"mark.{index}.xyz", f"a control point must not lie in the fiducial plane of focus {focus}"))
        elif mark.role == "control" and height >= height_of_focus > 0:
            issues.append((f"mark.{index}.xyz", f"a control point must lie nearer to the plane than focus {focus}"))
    fiducials = np.array([mark.xyz for mark in own.values() if mark.role == "fiducial"]).reshape(-1, 3)
    n_controls = sum(mark.role == "control" for mark in own.values())
    if len(fiducials) + unread < MIN_FIDUCIALS:
        issues.append(("mark", f"focus {focus} has {len(fiducials)} fiducial marks; it needs at least {MIN_FIDUCIALS}, no three on a line"))
    elif not unread and not in_general_position((fiducials - origin) @ basis.T):
        issues.append(("mark", f"focus {focus} has no four fiducial marks of which no three lie on a line"))
    if n_controls + unread < MIN_CONTROLS:
        issues.append(("mark", f"focus {focus} has {n_controls} control points; it needs at least {MIN_CONTROLS}"))
    return issues


def in_general_position(points: Float) -> bool:
    """Tell whether four of the points have no three on a line.

    Parameters
    ----------
    points : ndarray of shape (n, 2)

    Returns
    -------
    bool
        False exactly if all points but at most one lie on a line (then any four have three on it; otherwise two points on the fullest line
        and two off it can be chosen).
    """
    if len(points) < MIN_FIDUCIALS:
        return False
    tolerance = LINE_TOLERANCE * float(np.max(np.ptp(points, axis=0)))
    for i, j in combinations(range(len(points)), 2):
        along = points[j] - points[i]
        offset = points - points[i]
        off_line = np.abs(offset[:, 0] * along[1] - offset[:, 1] * along[0]) > tolerance * np.hypot(*along)
        if np.count_nonzero(off_line) <= 1:
            return False
    return True
