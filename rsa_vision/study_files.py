"""Which films belong together: a folder of files -> examinations (docs/quickstart.md, "Measure your own films")."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rsa_vision.errors import SettingsError, UsageError
from rsa_vision.ordering import natural_key
from rsa_vision.settings import FilmMode

FILM_SUFFIXES: Final = frozenset({".tif", ".tiff", ".png", ".jpg", ".jpeg", ".jp2", ".bmp", ".dcm", ".dicom", ".ima"})
# EXAM must not be `f1` or `cage` itself: `S01_f1.tif` is a film whose examination was forgotten, not the examination "f1"
NAME_RULE: Final = re.compile(
    r"(?P<subject>.+)_(?!f\d+(?:_|$)|cage(?:_|$))(?P<exam>[^_]+)(?:_f(?P<focus>\d+))?(?P<cage>_cage)?", re.IGNORECASE
)
_NO_UTF8: Final = re.compile("[\ud800-\udfff]")  # as Python decodes them
_UNPRINTABLE: Final = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # what ends lines or steers terminals
Tags = Mapping[str, str]
TagReader = Callable[[Path], Tags | None]


@dataclass(frozen=True, slots=True)
class FilmFile:
    """A file and what it shows; ``focus`` is None for a film that carries all foci."""

    path: Path
    focus: int | None
    cage_only: bool = False


@dataclass(frozen=True, slots=True)
class ExamFiles:
    """The films of one examination; ``problem`` is a reason code and a message where they do not make one up."""

    subject: str
    exam: str
    films: tuple[FilmFile, ...]
    problem: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class Grouping:
    """The examinations of a folder in order, and the entries that are no films with the reason why."""

    exams: tuple[ExamFiles, ...]
    ignored: tuple[tuple[Path, str], ...]


def printable(text: str) -> str:
    r"""Return a text, as of a file name, that can be printed: control characters and bytes that are no UTF-8 as ``\x1b``, ``\udcff``."""
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def is_utf8(name: str) -> bool:
    """Tell whether a file name is UTF-8; tables cannot say another."""
    return not _NO_UTF8.search(name)


def compile_pattern(pattern: str | None) -> re.Pattern[str] | None:
    """Compile ``file_pattern``.

    Parameters
    ----------
    pattern : str or None
        Regular expression for whole file names (extension included) with the groups ``subject`` and ``exam``, and optionally ``focus``
        (digits) and ``cage`` (any text: the cage alone).

    Returns
    -------
    re.Pattern or None

    Raises
    ------
    SettingsError
        If it is no regular expression or lacks a group.
    """
    if pattern is None:
        return None
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise SettingsError(f"file_pattern: not a regular expression ({error})") from error
    if missing := {"subject", "exam"} - set(compiled.groupindex):
        raise SettingsError(
            f"file_pattern: the named groups (?P<subject>...) and (?P<exam>...) are needed; add {', '.join(sorted(missing))}"
        )
    return compiled


def group_films(
    folder: Path,
    foci: Sequence[int],
    film_mode: FilmMode | None = None,
    *,
    shared_possible: bool = True,
    file_pattern: str | None = None,
    read_tags: TagReader | None = None,
) -> Grouping:
    """Group the films of a folder into examinations, sorted by subject and examination.

    Parameters
    ----------
    folder : Path
        Only its own files are films; sub-folders are not entered.
    foci : sequence of int
        The foci of the cage or of the calibration; each needs a film, or one film carries all.
    film_mode : "shared", "separate" or None
        What the study says; None: what the file names say.
    shared_possible : bool
        Whether one film can carry all foci (they have one fiducial plane).
    file_pattern : str or None
        As in :func:`compile_pattern`; names like ``SUBJECT_EXAM[_fK][_cage].EXT`` where None.
    read_tags : callable or None
        Returns the DICOM tags of a file, or None if it is no DICOM file; for names that follow no rule and files without extension.

    Returns
    -------
    Grouping

    Raises
    ------
    UsageError
        If the folder cannot be listed or holds no film at all.
    SettingsError
        If the pattern is wrong.
    """
    pattern = compile_pattern(file_pattern)
    tags_of = read_tags or _no_tags
    try:
        entries = sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
    except OSError as error:
        raise UsageError(f"{folder}: not a folder that can be read ({error.strerror}); give the folder of the films") from error
    ignored = [(path, why) for path in entries if (why := _no_film(path, tags_of))]
    films = [path for path in entries if path not in {path for path, _ in ignored}]
    if not films:
        folders = sum(why == "folder" for _, why in ignored)
        hint = f"; it has {folders} sub-folders: give one of these" if folders else ""
        raise UsageError(f"{folder}: no film in it (tif, png, jpg, jp2, bmp, dcm or DICOM without extension){hint}")
    grouped: dict[tuple[str, str], list[FilmFile]] = {}
    unnamed: list[ExamFiles] = []
    for path in films:
        if not is_utf8(path.name):
            problem = "film-name", f"{printable(path.name)}: the name is no UTF-8, and tables could not say it; rename the file"
            unnamed.append(ExamFiles(printable(path.stem), "", (FilmFile(path, None),), problem))
            continue
        named = _name(path, pattern) or _name_by_tags(tags_of(path) or {}, path)
        if named is None:
            problem = "film-name", f"{path.name}: the name is not {_rule(file_pattern)}; rename the file or set file_pattern in study.toml"
            unnamed.append(ExamFiles(path.stem, "", (FilmFile(path, None),), problem))
        else:
            subject, exam, film = named
            grouped.setdefault((subject, exam), []).append(film)
    exams = [_examination(*key, group, foci, film_mode, shared_possible) for key, group in grouped.items()]
    exams.sort(key=lambda e: (natural_key(e.subject), natural_key(e.exam)))
    return Grouping((*exams, *unnamed), tuple(ignored))


def _no_tags(_: Path) -> None:
    return None


def _no_film(path: Path, tags_of: TagReader) -> str | None:
    if path.name.startswith("."):
        return "hidden"
    if path.is_dir():
        return "folder"
    if path.suffix.lower() in FILM_SUFFIXES:
        return None
    if not path.is_file() and path.exists():  # a pipe or a device: reading may never end
        return "no regular file"
    if not path.suffix or path.suffix[1:].isdigit():  # DICOM files are often named by their UID: the "suffix" is its last number
        return None if tags_of(path) is not None else "no DICOM file"
    return "no film by its extension"


def _rule(pattern: str | None) -> str:
    return "SUBJECT_EXAM[_fK][_cage].EXT" if pattern is None else f"as file_pattern says ({pattern})"


def _name(path: Path, pattern: re.Pattern[str] | None) -> tuple[str, str, FilmFile] | None:
    stem = path.stem if path.suffix.lower() in FILM_SUFFIXES else path.name
    match = pattern.fullmatch(path.name) if pattern else NAME_RULE.fullmatch(stem)
    if match is None:
        return None
    found = match.groupdict()
    subject, exam, focus = found["subject"], found["exam"], found.get("focus")
    if not subject or not exam or (focus and not focus.isdecimal()):
        return None
    return subject, exam, FilmFile(path, int(focus) if focus else None, bool(found.get("cage")))


def _name_by_tags(tags: Tags, path: Path) -> tuple[str, str, FilmFile] | None:
    """PatientID, and date and time to the minute: both films of an examination are exposed within it or carry the same time."""
    subject, date, time = tags.get("patient_id", ""), tags.get("acquisition_date", ""), tags.get("acquisition_time", "")
    if not subject or not date:
        return None
    focus = re.search(r"(?:^|[^a-z0-9])f(?:ocus)?[ _-]?(\d+)$", tags.get("view", ""), re.IGNORECASE)
    return subject, date + time[:4], FilmFile(path, int(focus[1]) if focus else None)


def _examination(
    subject: str, exam: str, films: Iterable[FilmFile], foci: Sequence[int], film_mode: FilmMode | None, shared_possible: bool
) -> ExamFiles:
    ordered = tuple(sorted(films, key=lambda film: (film.cage_only, film.focus or 0, film.path.name)))
    cage_films = [film for film in ordered if film.cage_only]
    objects = [film for film in ordered if not film.cage_only]
    problem = _problem(objects, foci, film_mode, shared_possible)
    if problem is None and cage_films and [f.focus for f in cage_films] != [f.focus for f in objects]:
        problem = "film-missing", "the films with _cage are not those of the same foci as the films without; look at the file names"
    return ExamFiles(subject, exam, ordered, problem)


def _problem(films: list[FilmFile], foci: Sequence[int], film_mode: FilmMode | None, shared_possible: bool) -> tuple[str, str] | None:
    names = ", ".join(film.path.name for film in films)
    given = [film.focus for film in films]
    needed = ", ".join(f"_f{focus}" for focus in foci)
    if len(set(given)) < len(given):
        return "film-unexpected", f"several films for the same focus ({names}): keep one, or mark a repeat by a letter after EXAM"
    if None in given and len(given) > 1:
        return "film-unexpected", f"a film of all foci beside films of single foci ({names}): keep one kind"
    if unknown := [film.path.name for film in films if film.focus is not None and film.focus not in foci]:
        return "film-unexpected", f"{', '.join(unknown)}: no such focus; there are {needed}"
    if given == [None]:
        if film_mode == "separate" or not shared_possible:
            return "film-missing", f"{names}: one film without _fK, but every focus needs a film of its own ({needed})"
        return None
    if film_mode == "shared":
        return "film-unexpected", f'film = "shared", but there are films of single foci ({names}); remove the setting or _fK'
    if missing := [f"_f{focus}" for focus in foci if focus not in given]:
        return "film-missing", f"no film for {', '.join(missing)} (found: {names or 'none'}); look for a missing or misnamed file"
    return None
