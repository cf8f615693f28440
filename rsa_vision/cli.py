"""The command line: parses, calls, prints."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer

from rsa_vision import cli_motion

if TYPE_CHECKING:
    from rsa_vision.api import Summary
    from rsa_vision.batch import Outcome

app = typer.Typer(
    name="rsa-vision",
    help="Radiostereometric analysis without a click: folders of radiographs in, 3-D marker coordinates out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
cage_app = typer.Typer(help="Built-in cages, drawings of cages, checks of cage files.", no_args_is_help=True)
app.add_typer(cage_app, name="cage")
segments_app = typer.Typer(help="Known segments.", no_args_is_help=True)
app.add_typer(segments_app, name="segments")

cli_motion.register(app)

INTERRUPTED = 130  # as shells report Ctrl-C
LEFT: Final = {
    "measure": "the same command goes on with what is left",
    "demo": "the same command goes on with what is left",
    "detect": "its table is written at the end: an older one is as it was",
}
"""What a command leaves that was stopped."""

Out = Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")]
CageOption = Annotated[str | None, typer.Option("--cage", help="Built-in cage or cage file; `rsa-vision cage list` shows them.")]
StudyOption = Annotated[Path | None, typer.Option("--study", help="Study file.")]


def main() -> NoReturn:
    """Run the command line; expected failures become one message and their exit code, never a traceback."""
    _steady_streams()
    sys.exit(run_app(sys.argv[1:]))


def _steady_streams() -> None:
    """Let closed streams lead nowhere, and what an encoding lacks be printed as escapes: neither is to cost a result."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        else:
            stream.reconfigure(errors="backslashreplace")


def run_app(arguments: list[str]) -> int:
    """Run the command line with these arguments and return its exit code."""
    from rsa_vision.errors import RsaError

    try:
        code = int(app(arguments, prog_name="rsa-vision", standalone_mode=False) or 0)
        sys.stdout.flush()
    except RsaError as error:
        _complain(str(error))
        return error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except (Exception, SystemExit) as error:
        # typer makes an exit of a broken pipe by itself
        refused = error.__context__ if isinstance(error, SystemExit) else error
        if isinstance(refused, OSError) and refused.filename is None and refused.errno in (errno.EPIPE, errno.ENOSPC, errno.EIO):
            return _unprinted(refused)
        # a usage error of typer knows how to show itself, and its exit code
        show, exit_code = getattr(error, "show", None), getattr(error, "exit_code", None)
        if show is None or exit_code is None:
            _complain(f"unexpected failure, please report it: {type(error).__name__}: {error}")
            return 2
        show()
        return int(exit_code)
    if code == INTERRUPTED:  # typer makes an exit code of Ctrl-C by itself
        _complain(f"stopped; {LEFT.get(''.join(arguments[:1]), 'each file is the old or the new one, whole')}")
    return code


def _unprinted(error: OSError) -> int:
    """Return the exit code where standard output takes no more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python fails again at its end
    if isinstance(error, BrokenPipeError):  # the reader of a pipe has gone: nobody to tell
        return 0
    _complain(f"standard output cannot be written ({error.strerror}); send it to another place")
    return 2


def _show_version(wanted: bool) -> None:
    if wanted:
        from rsa_vision.provenance import version

        print(version())
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and stop.")] = False,
) -> None:
    pass


@app.command()
def measure(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the films, named SUBJECT_EXAM[_fK].EXT.")],
    out: Out,
    cage: CageOption = None,
    study: Annotated[Path | None, typer.Option("--study", help="Study file; default: study.toml in FOLDER, if there.")] = None,
    segments: Annotated[Path | None, typer.Option("--segments", help="CSV file of the known segments.")] = None,
    method: Annotated[str, typer.Option("--method", help="selvik (bundle is refused until built).")] = "selvik",
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Number of processes.")] = 1,
    dask: Annotated[str | None, typer.Option("--dask", help="Address of a scheduler (refused until built).")] = None,
    redo: Annotated[bool, typer.Option("--redo", help="Measure again what is finished.")] = False,
    timeout_s: Annotated[float | None, typer.Option("--timeout-s", help="Longest time for one examination, s.")] = None,
    film: Annotated[str | None, typer.Option("--film", help="shared or separate.")] = None,
    response: Annotated[str | None, typer.Option("--response", help="auto, density, transmission, linear or log.")] = None,
    pixel_pitch_mm: Annotated[float | None, typer.Option("--pixel-pitch-mm", help="Wins over what the files say, mm.")] = None,
    orientation: Annotated[str | None, typer.Option("--orientation", help="upright, any or mirrored.")] = None,
    temperature_c: Annotated[float | None, typer.Option("--temperature-c", help="Of the cage at the exposure, degrees C.")] = None,
    file_pattern: Annotated[str | None, typer.Option("--file-pattern", help="Regular expression with subject, exam[, focus].")] = None,
) -> int:
    """Measure every examination in a folder of films, unattended."""
    from rsa_vision import api
    from rsa_vision.study_files import printable

    with _progress() as watch:
        summary = api.measure(
            folder,
            out,
            study=study,
            segments=segments,
            method=method,
            jobs=jobs,
            dask=dask,
            redo=redo,
            timeout_s=timeout_s,
            watch=watch,
            cage=cage,
            film=film,
            response=response,
            pixel_pitch_mm=pixel_pitch_mm,
            orientation=orientation,
            temperature_c=temperature_c,
            file_pattern=file_pattern,
        )
    for path, why in summary.ignored:
        if why == "no DICOM file":  # all else that is ignored could not be taken for a film
            print(f"ignored: {printable(path.name)} ({why})", file=sys.stderr)
    _print_summary(summary)
    return summary.exit_code


@app.command()
def detect(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Films.", readable=False)],  # that fails for its film alone
    out: Annotated[Path, typer.Option("--out", "-o", help="File for the result: .csv or .parquet.")],
    overlay: Annotated[Path | None, typer.Option("--overlay", help="PNG for a drawing; of several images each NAME_IMAGE.png.")] = None,
    response: Annotated[
        str, typer.Option("--response", help="auto, density, transmission, linear or log; nothing depends on it: the film tells.")
    ] = "auto",
) -> int:
    """Find the marker images of single films: balls, pins and tees."""
    from rsa_vision import api
    from rsa_vision.study_files import printable

    failures: list[tuple[Path, str]] = []
    blank: list[str] = []

    def watch(path: Path, found: int) -> None:
        name = printable(str(path))
        if found == 0:
            blank.append(name)
        tell(f"{name}: {found} marker images" if found >= 0 else f"{name}: failed")

    with _counter(len(images)) as tell:
        table = api.detect(images, out, overlay=overlay, response=response, failures=failures, watch=watch)
    for _, message in failures:
        _complain(printable(message))
    if blank:  # the table does not name them
        _complain(f"no marker image on {', '.join(blank)}")
    if len(failures) == len(images):
        _complain("no film could be used; an older table is as it was")
        return 1
    print(f"{len(table)} marker images on {len(images) - len(failures)} films -> {out}")
    return 1 if failures else 0


@app.command()
def reconstruct(
    points: Annotated[Path, typer.Argument(metavar="POINTS.csv", help="Image coordinates: columns of images.csv, or id.")],
    out: Out,
    cage: CageOption = None,
    study: StudyOption = None,
    segments: Annotated[Path | None, typer.Option("--segments", help="CSV file of the known segments, to name the markers by.")] = None,
) -> int:
    """Reconstruct markers from image coordinates that were measured elsewhere."""
    from rsa_vision import api

    summary = api.reconstruct(points, out, cage=cage, study=study, segments=segments)
    _print_summary(summary)
    return summary.exit_code


@app.command()
def report(out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of results.")]) -> None:
    """Write report.html of a results folder again."""
    from rsa_vision import api

    print(api.report(out))


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder to make.")] = Path("rsa-vision-demo"),
) -> int:
    """Make a small study of synthetic films with three cages, and measure it."""
    from rsa_vision import api

    print(f"rendering films into {folder} ...", file=sys.stderr)
    with _progress() as watch:
        summaries = api.demo(folder, watch=watch)
    for summary in summaries:
        _print_summary(summary)
    return max(summary.exit_code for summary in summaries)


@cage_app.command("list")
def cage_list() -> None:
    """List the built-in cages."""
    from rsa_vision.cages import builtin_cages, load_cage

    for name in builtin_cages():
        cage = load_cage(name)
        counts = {role: sum(mark.role == role for mark in cage.mark) for role in ("fiducial", "control")}
        marks = f"{counts['fiducial']} fiducial marks, {counts['control']} control points"
        print(f"{name:8s} {cage.film:9s} {len(cage.foci)} foci  {marks}")


@cage_app.command("show")
def cage_show(
    cage: Annotated[str, typer.Argument(metavar="CAGE", help="Built-in cage or cage file.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="SVG file for a drawing.")] = None,
) -> None:
    """Describe a cage, and draw it with -o."""
    from rsa_vision.cages import load_cage, symmetries

    loaded = load_cage(cage)
    _describe_cage(loaded)
    ambiguities = [f"ambiguity: {symmetry}" for symmetry in symmetries(loaded)]
    print("\n".join(ambiguities or ["no ambiguity: the marks tell every orientation"]))
    if out is not None:
        from rsa_vision.cage_drawing import draw_cage
        from rsa_vision.store import write_atomic

        write_atomic(out, draw_cage(loaded).encode())
        print(f"drawing -> {out}")
    else:
        print("a drawing: add -o FILE.svg")


@cage_app.command("check")
def cage_check(file: Annotated[str, typer.Argument(metavar="FILE", help="Cage file.")]) -> None:
    """Check a cage file; every error is listed."""
    from rsa_vision.cages import load_cage

    cage = load_cage(file)
    print(f"{file}: valid, cage {cage.name} with {len(cage.mark)} marks, sha256 {cage.sha256[:16]}")


@segments_app.command("propose")
def segments_propose(
    results: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of results with several examinations of a subject.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="segments.csv to write.")] = None,
) -> None:
    """Suggest rigid groups of markers, with how sure each is; look at them before you use them."""
    from rsa_vision import api

    for p in api.propose_segments(results, out):
        figures = f"probability {p.probability:.4f}, distances change by {p.change_um:.0f} um (rms) in {p.n_exams} examinations"
        print(f"{p.subject} {p.segment.name}: {', '.join(p.segment.markers)}; {figures}")
    print(f"segments -> {out}" if out is not None else "to write them: add -o segments.csv")


def _describe_cage(cage: Any) -> None:
    print(f"cage {cage.name}: {cage.film} film, {cage.material}, calibrated at {cage.calibrated_at_c:g} degC, sha256 {cage.sha256[:16]}")
    for focus, place in sorted(cage.foci.items()):
        x, y, z = place
        fiducials, controls = (cage.marks_of(focus, role) for role in ("fiducial", "control"))
        numbers = [f"{len(marks)} {name} ({_span(marks)})" for marks, name in ((fiducials, "fiducial marks"), (controls, "control points"))]
        print(f"focus {focus}: nominal ({x:g}, {y:g}, {z:g}) mm; {', '.join(numbers)}")


def _span(marks: Any) -> str:
    numbers = [mark.number for mark in marks]
    return f"{numbers[0]}..{numbers[-1]}" if numbers else "none"


def _print_summary(summary: Summary) -> None:
    from rsa_vision.study_files import printable

    for outcome in summary.outcomes:
        if outcome.status != "ok":
            message = outcome.rows["exams"][0].get("message") or ""
            print(printable(f"{_name(outcome)}: {outcome.status} ({outcome.reasons}): {message}"))
    n = len(summary.outcomes)
    counts = ", ".join(f"{summary.count(status)} {status}" for status in ("ok", "review", "failed"))
    print(f"{n} examination{'s' if n != 1 else ''}: {counts} -> {summary.out / 'report.html'}")


def _name(outcome: Outcome) -> str:
    from rsa_vision.study_files import printable

    return printable(f"{outcome.subject} {outcome.exam}".strip())


@contextmanager
def _progress() -> Iterator[Callable[[Outcome, int], None]]:
    """Yield a watcher of outcomes: a bar on a terminal, a line for each otherwise."""

    def line(outcome: Outcome) -> str:
        took = "kept" if outcome.kept else f"{outcome.seconds:.1f} s"
        return f"{_name(outcome)}  {outcome.status}  {outcome.reasons or '-'}  {took}"

    if not sys.stderr.isatty():
        yield lambda outcome, _: print(line(outcome), file=sys.stderr, flush=True)
        return
    with _bar() as bar:
        tasks: dict[int, Any] = {}

        def watch(outcome: Outcome, total: int) -> None:
            key = tasks.setdefault(total, bar.add_task("examinations", total=total))
            if outcome.status != "ok":
                bar.console.print(line(outcome), highlight=False, markup=False)
            bar.advance(key)

        yield watch


@contextmanager
def _counter(total: int) -> Iterator[Callable[[str], None]]:
    """Yield a teller of finished films."""
    if not sys.stderr.isatty():
        yield lambda text: print(text, file=sys.stderr, flush=True)
        return
    with _bar() as bar:
        key = bar.add_task("films", total=total)
        yield lambda _: bar.advance(key)


def _bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=Console(stderr=True))


def _complain(message: str) -> None:
    from rsa_vision.study_files import printable

    lines = map(printable, message.split("\n"))  # some messages are lists
    print("rsa-vision:", "\n".join(lines), file=sys.stderr)


if __name__ == "__main__":
    main()
