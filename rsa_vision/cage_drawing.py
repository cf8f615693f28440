"""The drawing of a cage: what its films show, and the set-up seen along the cage."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np

from rsa_vision.cage_symmetry import symmetries
from rsa_vision.types import Float

if TYPE_CHECKING:
    from rsa_vision.cages import Cage, Mark, Plane

PANEL_PX: Final = (520.0, 560.0)  # width, height
SPACE_PX: Final = 24.0
HEAD_PX: Final = 84.0
LINE_PX: Final = 20.0
INNER_PX: Final = (70.0, 66.0)  # kept free beside and above the drawing of a panel, for labels
LABEL_PX: Final = 130.0  # width of the label of a focus
FOOT_PX: Final = 64.0  # for axes and scale
COLOURS: Final = ("#1f5fa8", "#c2541b", "#2e7d4f", "#7b3f98")  # of the foci
INK, PALE, FRAME, GROUND = "#1c2430", "#5d6875", "#d3dae1", "#f8fafb"
FONT: Final = "font-family=\"'DejaVu Sans', Verdana, Helvetica, sans-serif\""


@dataclass(frozen=True, slots=True)
class _View:
    """A panel of the page with its scale: two coordinates in mm, the first to the right, the second up."""

    left: float
    top: float
    centre: tuple[float, float]
    scale: float  # px per mm

    @classmethod
    def around(cls, left: float, top: float, points: Float) -> _View:
        low, high = points.min(axis=0), points.max(axis=0)
        free = np.array(PANEL_PX) - (2 * INNER_PX[0], INNER_PX[1] + FOOT_PX + 20)
        x, y = (low + high) / 2
        return cls(left, top, (float(x), float(y)), float(np.min(free / np.maximum(high - low, 1.0))))

    def at(self, point: Float) -> tuple[float, float]:
        middle = np.array([self.left + PANEL_PX[0] / 2, self.top + (PANEL_PX[1] + INNER_PX[1] - FOOT_PX) / 2])
        x, y = middle + self.scale * (np.asarray(point) - self.centre) * (1, -1)
        return float(x), float(y)


def draw_cage(cage: Cage) -> str:
    """Return a drawing of a cage.

    Parameters
    ----------
    cage : Cage

    Returns
    -------
    str
        A self-contained SVG: for every plane the film as seen from its foci, with all marks and their numbers, control points where
        the nominal foci project them; the set-up seen along v of the first plane; what the marks cannot tell of the film's orientation.
    """
    colour = {focus: COLOURS[index % len(COLOURS)] for index, focus in enumerate(sorted(cage.foci))}
    lefts = [SPACE_PX + index * (PANEL_PX[0] + SPACE_PX) for index in range(len(cage.plane) + 1)]
    parts = [part for left, plane in zip(lefts, cage.plane, strict=False) for part in _film_panel(cage, plane, left, colour)]
    parts += _side_panel(cage, lefts[-1], colour)
    notes = [f"Not told by the marks: {symmetry}." for symmetry in symmetries(cage)] or [
        "The marks tell how a film lay, mirrored or turned."
    ]
    foot = HEAD_PX + PANEL_PX[1] + LINE_PX
    parts += _legend(foot + 8, colour, lefts[0])
    parts += [_text(lefts[0], foot + 14 + LINE_PX * (index + 1), note, 13, PALE) for index, note in enumerate(notes)]
    width = lefts[-1] + PANEL_PX[0] + SPACE_PX
    height = foot + LINE_PX * (len(notes) + 2)
    shapes = ", ".join(sorted({f"{mark.shape}s, {mark.diameter:g} mm thick" for mark in cage.mark}))
    films = "shared film" if cage.film == "shared" else "separate films"
    subtitle = f"{films} · {cage.material}, calibrated at {cage.calibrated_at_c:g} °C · {shapes}"
    head = [_text(lefts[0], 38, f"Cage {cage.name}", 24, INK, bold=True), _text(lefts[0], 62, subtitle, 14, PALE)]
    open_tag = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" viewBox="0 0 {width:.0f} {height:.0f}" {FONT}>'
    )
    return "\n".join([open_tag, f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>', *head, *parts, "</svg>", ""])


def _film_panel(cage: Cage, plane: Plane, left: float, colour: dict[int, str]) -> list[str]:
    """Draw a fiducial plane as its foci see it: each control point on its ray's way through the plane."""
    origin, basis = plane.lab_from_plane()
    controls = [
        (focus, mark, (_through(np.array(cage.foci[focus]), np.array(mark.xyz), plane) - origin) @ basis.T)
        for focus in plane.foci
        for mark in cage.marks_of(focus, "control")
    ]
    fiducials = {mark.number: mark for focus in plane.foci for mark in cage.marks_of(focus, "fiducial")}.values()
    placed = [(np.array(mark.xyz) - origin) @ basis.T for mark in fiducials]
    view = _View.around(left, HEAD_PX, np.array([*placed, *(place for _, _, place in controls)]))
    seen_from = " and ".join(f"focus {focus}" for focus in plane.foci)
    parts = _frame(view, f"Fiducial plane seen from {seen_from}")
    shared = len(plane.foci) > 1
    for focus, mark, place in controls:
        side = -1 if shared and focus == min(plane.foci) else 1
        parts += _mark(view, mark, place, basis, colour[focus], (8 * side, 17 if shared else 4))
    for mark, place in zip(fiducials, placed, strict=True):
        parts += _mark(view, mark, place, basis, INK, (3, -14) if shared else (-9, 4))
    return parts + _axes(view, plane.u, plane.v) + _scale_bar(view)


def _side_panel(cage: Cage, left: float, colour: dict[int, str]) -> list[str]:
    """Draw foci, rays, control points and planes, projected along v of the first plane."""
    first = cage.plane[0]
    origin, _ = first.lab_from_plane()
    across = np.array([first.u, first.normal()])

    def flat(points: Float) -> Float:
        result: Float = (np.asarray(points) - origin) @ across.T
        return result

    view = _View.around(left, HEAD_PX, flat(np.array([*cage.foci.values(), *(mark.xyz for mark in cage.mark)])))
    parts = _frame(view, f"Set-up seen along {_axis_name(first.v)}, nominal foci")
    for focus, position in cage.foci.items():
        plane = cage.plane_of(focus)
        marks = np.array([mark.xyz for mark in cage.marks_of(focus, "fiducial")])
        ends = {
            tuple(np.round(flat(_through(np.array(position), np.array(mark.xyz), plane)), 3)) for mark in cage.marks_of(focus, "control")
        }
        parts += [_line(view.at(flat(np.array(position))), view.at(np.array(end)), colour[focus], 0.9, 0.55) for end in sorted(ends)]
        along = (marks - marks[0]) @ np.array(plane.u)
        parts.append(_line(view.at(flat(marks[np.argmin(along)])), view.at(flat(marks[np.argmax(along)])), INK, 2.2))
    for place, tint in {tuple(np.round(flat(np.array(m.xyz)), 3)): _tint(m, colour) for m in cage.mark}.items():
        x, y = view.at(np.array(place))
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.8" fill="{tint}"/>')
    for focus, position in cage.foci.items():
        x, y = view.at(flat(np.array(position)))
        parts.append(f'<rect x="{x - 4:.1f}" y="{y - 4:.1f}" width="8" height="8" fill="{colour[focus]}"/>')
        where = ", ".join(f"{value:g}" for value in position)
        on_left = x < view.left + PANEL_PX[0] / 2
        outwards = min(x - view.left, view.left + PANEL_PX[0] - x) > LABEL_PX
        anchor, step = ("end", -9) if on_left == outwards else ("start", 9)
        base = y + 6 if outwards else y - 10  # inwards the rays run
        parts.append(_text(x + step, base - 15, f"Focus {focus}", 13, colour[focus], bold=True, anchor=anchor))
        parts.append(_text(x + step, base, f"({where})", 12, colour[focus], anchor=anchor))
    return parts + _axes(view, first.u, tuple(first.normal())) + _scale_bar(view)


def _through(focus: Float, point: Float, plane: Plane) -> Float:
    """Return where the ray from a focus through a point meets a plane."""
    origin, _ = plane.lab_from_plane()
    normal = plane.normal()
    step = point - focus
    met: Float = focus + step * float((origin - focus) @ normal) / float(step @ normal)
    return met


def _tint(mark: Mark, colour: dict[int, str]) -> str:
    return INK if mark.role == "fiducial" or len(mark.foci) > 1 else colour[mark.foci[0]]


def _mark(view: _View, mark: Mark, place: Float, basis: Float, colour: str, offset: tuple[float, float]) -> list[str]:
    """Draw a mark as a symbol of constant size: a ball as a disc (a control point as a ring), pins as wedges from their tips."""
    x, y = view.at(place)
    anchor = "start" if offset[0] > 0 else "end"
    label = _text(x + offset[0], y + offset[1], str(mark.number), 11, colour, anchor=anchor)
    if mark.shape == "ball":
        drawn = f'r="2.8" fill="{colour}"' if mark.role == "fiducial" else f'r="5" fill="none" stroke="{colour}" stroke-width="1.6"'
        return [f'<circle cx="{x:.1f}" cy="{y:.1f}" {drawn}/>', label]
    wedges = []
    for arm in np.array(mark.arms) @ basis.T:
        along = np.array([arm[0], -arm[1]]) / max(float(np.linalg.norm(arm)), 1e-9)
        thick = 2.0 * np.array([-along[1], along[0]])
        corners = [(x, y), *((x + 10 * along[0] + s * thick[0], y + 10 * along[1] + s * thick[1]) for s in (1, -1))]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
        wedges.append(f'<polygon points="{points}" fill="{colour}" stroke="{colour}" stroke-width="0.8" stroke-linejoin="round"/>')
    return [*wedges, label]


def _legend(y: float, colour: dict[int, str], left: float) -> list[str]:
    entries = [("fiducial marks", INK), *((f"control points as seen from focus {focus}", tint) for focus, tint in colour.items())]
    parts, x = [], left
    for text, tint in entries:
        parts += [f'<rect x="{x:.1f}" y="{y - 9:.1f}" width="10" height="10" rx="2" fill="{tint}"/>', _text(x + 16, y, text, 13, INK)]
        x += 46 + 7.6 * len(text)
    return parts


def _frame(view: _View, title: str) -> list[str]:
    width, height = PANEL_PX
    box = f'<rect x="{view.left}" y="{view.top}" width="{width}" height="{height}" rx="8" fill="{GROUND}" stroke="{FRAME}"/>'
    return [box, _text(view.left + 18, view.top + 28, title, 14, INK, bold=True)]


def _axis_name(vector: Iterable[float]) -> str:
    values = np.array(tuple(vector))
    largest = int(np.argmax(np.abs(values)))
    sign = "−" if values[largest] < 0 else ""
    return sign + "xyz"[largest] if abs(values[largest]) > 0.999 else f"({', '.join(f'{v:.2f}' for v in values)})"


def _axes(view: _View, right: Iterable[float], up: Iterable[float]) -> list[str]:
    x, y = view.left + 22, view.top + PANEL_PX[1] - 20
    heads = [f"{x + 34},{y} {x + 27},{y - 3.5} {x + 27},{y + 3.5}", f"{x},{y - 34} {x - 3.5},{y - 27} {x + 3.5},{y - 27}"]
    parts = [_line((x, y), (x + 28, y), PALE, 1.4), _line((x, y), (x, y - 28), PALE, 1.4)]
    parts += [f'<polygon points="{points}" fill="{PALE}"/>' for points in heads]
    return [*parts, _text(x + 39, y + 4, _axis_name(right), 13, PALE), _text(x - 4, y - 39, _axis_name(up), 13, PALE)]


def _scale_bar(view: _View) -> list[str]:
    lengths = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000])
    length = int(lengths[np.argmin(np.abs(lengths * view.scale - 110))])
    right, y = view.left + PANEL_PX[0] - 24, view.top + PANEL_PX[1] - 20
    left = right - length * view.scale
    parts = [
        _line((left, y), (right, y), INK, 2.0),
        _line((left, y - 4), (left, y + 4), INK, 1.4),
        _line((right, y - 4), (right, y + 4), INK, 1.4),
    ]
    return [*parts, _text((left + right) / 2, y - 8, f"{length} mm", 12, INK, anchor="middle")]


def _line(start: tuple[float, float], end: tuple[float, float], colour: str, width: float, opacity: float = 1.0) -> str:
    ends = f'x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width}" stroke-opacity="{opacity}"/>'


def _text(x: float, y: float, text: str, size: float, colour: str, *, bold: bool = False, anchor: str = "start") -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{colour}" text-anchor="{anchor}"{weight}>{escape(text)}</text>'
