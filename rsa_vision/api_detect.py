"""`detect`: the marker images of single films."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from os import PathLike
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rsa_vision.errors import FilmError, UsageError
from rsa_vision.preparation import settle
from rsa_vision.store import check_target, parquet_bytes, to_csv, write_atomic
from rsa_vision.study_files import is_utf8, printable

if TYPE_CHECKING:
    import polars as pl

    from rsa_vision.types import Film


def detect(
    images: str | Path | Sequence[str | Path],
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
    images : path or sequence of path
    out : path, optional
        File for the result: Parquet where it ends in ``.parquet``, else CSV. Where no film can be used an older one is left as it was.
    overlay : path, optional
        PNG file for a drawing; with several images the name of each is added to it, and a number where names are the same.
    response : str
        Film response, as in the study file. Nothing depends on it here: the film itself tells.
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
        If no image is given, or a result cannot be written, would take the place of a film, or is a drawing that does not end in ``.png``.
    """
    from rsa_vision.detect import detect_markers
    from rsa_vision.overlay import overlay_png
    from rsa_vision.tables import DETECTIONS, detection_rows, frame

    names = [images] if isinstance(images, str | PathLike) else images
    films = [Path(name) for name in names]
    if not films:
        raise UsageError("no image given; name the films to look at")
    settle(None, {"response": response})  # refuses an unknown one
    drawings = [] if overlay is None else _overlay_paths(Path(overlay), films)
    _check_targets([] if out is None else [Path(out)], "-o", films)
    _check_targets(drawings, "--overlay", films)
    if any(drawing.suffix.lower() not in ("", ".png") for drawing in drawings):
        raise UsageError(f"{overlay}: drawings are PNG; with --overlay, name a file that ends in .png")
    rows: list[dict[str, Any]] = []
    usable = 0
    for number, path in enumerate(films):
        try:
            film = _read(path)
            found = detect_markers(film.values, bits=film.bits, response=response).images
        except FilmError as error:
            if failures is None:
                raise
            failures.append((path, str(error)))
            if watch:
                watch(path, -1)
            continue
        usable += 1
        rows += detection_rows(str(names[number]), found)
        if drawings:
            write_atomic(drawings[number], overlay_png(film.values, found), "--overlay")
        if watch:
            watch(path, len(found))
    table = frame(rows, DETECTIONS)
    if out is not None and (usable or not Path(out).exists()):
        write_atomic(Path(out), parquet_bytes(table) if Path(out).suffix.lower() == ".parquet" else to_csv(table))
    return table


def _read(path: Path) -> Film:
    from rsa_vision.images import read_film

    if not is_utf8(str(path)):
        raise FilmError(f"{printable(str(path))}: the name is no UTF-8, and tables could not say it; rename the file")
    return read_film(path)


def _overlay_paths(overlay: Path, images: Sequence[Path]) -> list[Path]:
    """One for each image, told apart by the image's name, and by a number where names are the same."""
    if len(images) == 1:
        return [overlay]
    stems = [image.stem for image in images]
    taken = {stem for stem in stems if stems.count(stem) == 1}
    paths = []
    for stem in stems:
        name = stem
        if stems.count(stem) > 1:
            name = next(numbered for k in count(1) if (numbered := f"{stem}_{k}") not in taken)
            taken.add(name)
        paths.append(overlay.with_name(f"{overlay.stem}_{name}{overlay.suffix or '.png'}"))
    return paths


def _check_targets(targets: Sequence[Path], option: str, images: Sequence[Path]) -> None:
    """Refuse, before any work is done, results that would take the place of a film or cannot be written."""
    films = {realpath(image) for image in images}
    for target in targets:
        if realpath(target) in films:
            raise UsageError(f"{target}: is one of the films, which the result would overwrite; choose another name with {option}")
        check_target(target, option)
