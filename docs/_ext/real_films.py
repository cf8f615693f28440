"""Real films drawn with what is found on them, while the page is built: no film is copied into the project.

The directive ``real-films`` measures every film of the folder beside the project, draws what it found and, in red, what the labels name and
it did not find. Where the folder is absent the page says so, and where nobody asks for them: they take minutes, and to check the rest of
the documentation does not need them.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from docutils import nodes
from numpy.typing import NDArray
from sphinx.util.docutils import SphinxDirective

from rsa_vision.detect import detect_markers
from rsa_vision.images import read_film
from rsa_vision.overlay import overlay_png
from rsa_vision.types import Film, MarkerImages

REAL = Path(__file__).parents[3] / "shared" / "data" / "real"
NEAR_PX = 2.0
RED = (60, 60, 255)
LARGEST_PX = 1000
ABSENT = "The folder of real films (``../shared/data/real``) was not there when this page was built: nothing is drawn."
LEFT_OUT = "The real films were not asked for when this page was built: ``make docs`` draws them."


def labelled(path: Path, rows: list[dict[str, str]], view: str) -> tuple[Path, NDArray[Any]]:
    """Return a film and its labels, (col, row)."""
    return path, np.array([[float(row[f"{side}_px_{view}"]) for side in ("col", "row")] for row in rows]).reshape(-1, 2)


def films() -> Iterator[tuple[Path, NDArray[Any]]]:
    """Yield every film with its labels; films with none have none."""
    pig = list(csv.DictReader((REAL / "pig" / "labels.csv").read_text().splitlines()))
    for path in sorted((REAL / "pig").glob("*.png")):
        _, frame, view = path.stem.split("_")
        yield labelled(path, [row for row in pig if int(row["frame"]) == int(frame)], view)
    for path in sorted((REAL / "wrist").glob("*.tif")):
        _, frame, view = path.stem.split("_")
        beads = (REAL / "wrist" / f"beads_{frame}_approx.csv").read_text().splitlines()
        yield labelled(path, list(csv.DictReader(beads)), view)
    for path in sorted([*(REAL / "winston_lutz").glob("*.dcm"), *(REAL / "negatives").glob("*.dcm")]):
        yield labelled(path, [], "")


def draw(film: Film, images: MarkerImages, labels: NDArray[Any], to: Path) -> str:
    """Draw one film; return what there is to see."""
    gap = np.hypot(*(labels[:, None] - images.position_px[None]).transpose(2, 0, 1))
    missed, more = labels[gap.min(axis=1, initial=np.inf) > NEAR_PX], int((gap.min(axis=0, initial=np.inf) > NEAR_PX).sum())
    canvas = cv2.imdecode(np.frombuffer(overlay_png(film.values, images), np.uint8), cv2.IMREAD_COLOR)
    for col, row in missed:
        cv2.drawMarker(canvas, (round(col), round(row)), RED, cv2.MARKER_TILTED_CROSS, 18, 2)
    shrink = min(1.0, LARGEST_PX / max(canvas.shape))
    cv2.imwrite(str(to), cv2.resize(canvas, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA))
    if not len(labels):
        return f"{len(images)} marker images"
    found, median = len(labels) - len(missed), np.median(gap.min(axis=1, initial=np.inf))
    return f"{found} of {len(labels)} labelled beads within {NEAR_PX:g} pixels (median {median:.2f}), {more} more"


class RealFilms(SphinxDirective):
    """All films, drawn."""

    def run(self) -> list[nodes.Node]:
        """Return the pictures with their captions."""
        if not REAL.is_dir():
            return self.parse_text_to_nodes(ABSENT)
        if not self.config.draw_real_films:
            return self.parse_text_to_nodes(LEFT_OUT)
        folder = Path(self.env.app.outdir) / "_images" / "real_films"
        folder.mkdir(parents=True, exist_ok=True)
        up = "../" * self.env.docname.count("/")
        out: list[nodes.Node] = []
        for path, labels in films():
            film = read_film(path)
            found = detect_markers(film.values, bits=film.bits)
            seen = draw(film, found.images, labels, folder / f"{path.stem}.png")
            caption = nodes.caption(text=f"{path.parent.name}/{path.name}: {seen}")
            source = f"{up}_images/real_films/{path.stem}.png"
            picture = f'<a href="{source}"><img src="{source}" alt="{path.stem}"/></a>'
            out.append(nodes.figure("", nodes.raw("", picture, format="html"), caption))
        return out


def setup(app: Any) -> dict[str, bool]:
    """Register the directive."""
    app.add_config_value("draw_real_films", False, "env", bool)
    app.add_directive("real-films", RealFilms)
    return {"parallel_read_safe": True}
