"""`detect`: the marker images of single films."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsa_vision.errors import FilmError, UsageError
from rsa_vision.preparation import settle
from rsa_vision.store import parquet_bytes, to_csv, write_atomic

if TYPE_CHECKING:
    import polars as pl


def detect(
    images: Sequence[str | Path],
    out: str | Path | None = None,
    *,
    overlay: str | Path | None = None,
    response: str = "auto",
    failures: list[tuple[Path, str]] | None = None,
    watch: Callable[[Path, int], None] | None = None,
) -> pl.DataFrame:
    """Find the marker images of single films; no cage and no pixel pitch is needed.

    Parameters
    ----------
    images : sequence of path
    out : path, optional
        File for the result: Parquet where it ends in ``.parquet``, else CSV.
    overlay : path, optional
        PNG file for a drawing; with several images the name of each is added to it, and a number where names are the same.
    response : str
        Film response, as in the study file.
    failures : list, optional
        Films that cannot be used are added to it as (path, message); without it the first one is raised.
    watch : callable, optional
        Is called after every film with its path and the number of markers found, -1 where it failed.

    Returns
    -------
    polars.DataFrame
        Columns file, shape, col_px, row_px, sd_col_px, sd_row_px, cov_col_row_px2, radius_px, angle_deg, contrast, snr, flags.

    Raises
    ------
    FilmError
        If a film cannot be used and there is no list of failures.
    SettingsError
        If the response is unknown.
    UsageError
        If no image is given, or a result cannot be written or would take the place of a film or of another result.
    """
    from rsa_vision.detect import detect_markers
    from rsa_vision.images import read_film
    from rsa_vision.overlay import overlay_png
    from rsa_vision.tables import DETECTIONS, detection_rows, frame

    if not images:
        raise UsageError("no image given; name the films to look at")
    settle(None, {"response": response})  # refuses an unknown one
    drawings = [] if overlay is None else _overlay_paths(Path(overlay), [Path(name) for name in images])
    _check_targets(([] if out is None else [Path(out)]) + drawings, [Path(name) for name in images])
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(images):
        try:
            film = read_film(Path(name))
            found = detect_markers(film.values, bits=film.bits, response=response).images
        except FilmError as error:
            if failures is None:
                raise
            failures.append((Path(name), str(error)))
            if watch:
                watch(Path(name), -1)
            continue
        rows += detection_rows(str(name), found)
        if drawings:
            write_atomic(drawings[number], overlay_png(film.values, found))
        if watch:
            watch(Path(name), len(found))
    table = frame(rows, DETECTIONS)
    if out is not None:
        write_atomic(Path(out), parquet_bytes(table) if Path(out).suffix == ".parquet" else to_csv(table))
    return table


def _overlay_paths(overlay: Path, images: Sequence[Path]) -> list[Path]:
    """One for each image, told apart by the image's name, and by a number where names are the same."""
    if len(images) == 1:
        return [overlay]
    stems = [f"{overlay.stem}_{image.stem}" for image in images]
    numbers = [f"_{stems[:k].count(stem) + 1}" if stems.count(stem) > 1 else "" for k, stem in enumerate(stems)]
    return [overlay.with_name(f"{stem}{number}{overlay.suffix or '.png'}") for stem, number in zip(stems, numbers, strict=True)]


def _check_targets(targets: Sequence[Path], images: Sequence[Path]) -> None:
    """Refuse, before any work is done, results that would take the place of a film, of each other or of a folder."""
    films, taken = {image.resolve() for image in images}, set[Path]()
    for target in targets:
        place = target.resolve()
        if place in films:
            raise UsageError(f"{target}: is one of the films, which the result would overwrite; choose another name")
        if place in taken:
            raise UsageError(f"{target}: two results of one name; choose another for the drawing")
        if place.is_dir():
            raise UsageError(f"{target}: is a folder; name a file in it")
        taken.add(place)
