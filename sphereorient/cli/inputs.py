"""`sphereorient check`, `movie` and `convert`: inputs before a run."""

import re
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import Progress, app, check_writable, echo_lines, progress_bar
from sphereorient.cli.options import ExperimentPath, NoCache, Overrides, Quiet, SettingsPath, frames_of
from sphereorient.errors import MovieError
from sphereorient.files.whole_file import check_ending, writing

if TYPE_CHECKING:
    from sphereorient.movies import Grey, Movie
    from sphereorient.movies.survey import Survey
    from sphereorient.preflight import Finding

_Movie = Annotated[str, Argument(metavar="FILE", help="A movie, a folder of pictures, a pattern, or file.h5::dataset.")]
Flip = Annotated[str, Option(help="Mirror: none, vertical (rows), horizontal (columns), both, transpose.")]
SHOWN = 12  # numbers of frames named in a line
LINE = 100  # characters
COLOURS = {"ok": typer.colors.GREEN, "warning": typer.colors.YELLOW, "fault": typer.colors.RED}
MARK, TITLE = 9, 25  # columns of the list


@app.command()
def check(
    experiment: ExperimentPath,
    out: Annotated[Path | None, Option("--out", "-o", help="Figure (.png, .pdf); else EXPERIMENT.check.png.")] = None,
    settings: SettingsPath = None,
    set_: Overrides = None,
    no_cache: NoCache = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress, and only warnings and faults.")] = False,
) -> None:
    """Check an experiment in seconds before tracking: findings, and what to do. Exit code 1: there is a fault."""
    picture = Path(f"{experiment.stem}.check.png") if out is None else out
    check_writable(picture)
    from sphereorient.methods.settings import load_settings
    from sphereorient.preflight import Severity, preflight
    from sphereorient.report import preflight_figure

    chosen = load_settings(settings, set_ or [])
    with progress_bar(quiet) as advance:
        result = preflight(experiment, chosen, advance)
        advance("figure", 0, 1)
        preflight_figure(result, picture)
        advance("figure", 1, 1)
    _print_findings(result.findings, quiet)
    if not quiet:
        counts = [sum(one.severity is severity for one in result.findings) for severity in Severity]
        typer.echo(f"faults: {counts[2]}, warnings: {counts[1]}, ok: {counts[0]}. Wrote {picture}")
    if result.severity is Severity.FAULT:
        raise typer.Exit(1)


def _print_findings(findings: "Sequence[Finding]", quiet: bool) -> None:
    """Print a paragraph for each finding: mark, title, measurement; below it the advice."""
    width = max(60, shutil.get_terminal_size().columns)
    margin = " " * (MARK + TITLE)
    for finding in findings:
        if quiet and finding.severity == "ok":
            continue
        mark = typer.style(f"{finding.severity:{MARK}}", fg=COLOURS[finding.severity], bold=finding.severity != "ok")
        measured = textwrap.wrap(finding.measured, width - len(margin)) or [""]
        advice = f"do: {finding.advice}" if finding.advice else ""
        typer.echo(f"{mark}{finding.title:{TITLE}}{measured[0]}")
        below = measured[1:] + textwrap.wrap(advice, width - len(margin), subsequent_indent="    ")
        echo_lines(margin + line for line in below)


@app.command("movie")
def show_movie(
    source: _Movie,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Contact sheet (.png, .pdf); else FILE.contact.png.")
    ] = None,
    count: Annotated[int, Option(min=1, max=240, help="Frames on the sheet.")] = 24,
    every: Annotated[bool, Option("--all", help="Examine every frame, not only those of the sheet.")] = False,
    flip: Flip = "none",
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Print what is in a movie, and draw a contact sheet of it."""
    # the name of the movie without characters that file names cannot have
    stem = re.sub(r"[^\w.+-]+", "_", Path(source.replace("::", "_").rstrip("/")).name) or "movie"
    sheet = Path(f"{stem}.contact.png") if out is None else out
    check_ending(sheet, "--out", [".png", ".pdf", ".svg"])  # before the movie is read
    check_writable(sheet)
    from sphereorient.movies import flipped, open_movie
    from sphereorient.movies.survey import survey
    from sphereorient.report.inputs import contact_sheet

    with flipped(open_movie(source), flip) as opened:
        with progress_bar(quiet) as advance:
            seen = survey(opened, count, every, lambda *at: advance("look", *at))
            advance("sheet", 0, 1)
            contact_sheet(opened, seen, sheet)
            advance("sheet", 1, 1)
        for title, text in [*_facts(opened, seen), ("sheet", str(sheet))]:
            typer.echo(textwrap.fill(text, LINE, initial_indent=f"{title:14}", subsequent_indent=" " * 14))


@app.command()
def convert(
    source: _Movie,
    target: Annotated[Path, Argument(metavar="OUT", help="Movie to write: .mkv (FFV1), .h5 or .hdf5.")],
    frames: Annotated[str, Option(metavar="A:B", help="Only frames A to B - 1; 100: means from 100 on.")] = ":",
    flip: Flip = "none",
    rate: Annotated[float | None, Option(min=1e-3, max=1e6, help="Hz, of .mkv in players; else the movie's.")] = None,
    quiet: Quiet = False,
) -> None:
    """Write a movie of any format as FFV1 (.mkv) or HDF5 (.h5), grey values unchanged."""
    from sphereorient.movies import flipped, movie_files, open_movie, write_movie
    from sphereorient.movies.write import times_path

    with writing(movie_files(source)), flipped(open_movie(source), flip) as opened:
        check_writable(target)
        first, last = frames_of(frames, MovieError, len(opened))
        assert last is not None  # a number of frames was given
        times_s = None if opened.times_s is None or opened.likely_units else opened.times_s[first:last]
        rate_hz = rate or opened.played_hz or 25.0
        dead: list[int] = []
        with progress_bar(quiet) as advance:
            count = write_movie(target, _pictures(opened, first, last, dead, advance), times_s, rate_hz)
        if quiet:
            return
        echo_lines(f"{source}: {remark}" for remark in opened.remarks)
        if dead:
            left = "black" if target.suffix.lower() == ".mkv" else "left out, numbers kept"
            typer.echo(f"Not decodable, {left}: {_numbers(dead, ', ')}")
        typer.echo(f"Wrote {target}: {_frames(count)}" + (f", {first} .. {last - 1} of the movie" if first else ""))
        if opened.likely_units:
            typer.echo("The times are left out: the file does not state their unit, and seconds are implausible.")
        if times_s is not None and target.suffix.lower() == ".mkv":
            typer.echo(f"Wrote {times_path(target)}: their times (experiment.yaml, times:)")


def _facts(opened: "Movie", seen: "Survey") -> list[tuple[str, str]]:
    """Return the properties of the file and the result of the survey, as title and text."""
    from sphereorient.movies import movie_files

    height, width = opened.frame_shape
    size = sum(file.stat().st_size for file in movie_files(opened.path))
    whole = "all frames" if seen.looked == len(opened) else f"{seen.looked} of {len(opened)} frames"
    return [
        ("file", f"{opened.path}" + (f", {size / 1e6:.1f} MB" if size else "")),
        ("format", opened.format),
        ("pictures", f"{width} x {height} px, {8 * opened.dtype.itemsize} bit"),
        ("frames", str(len(opened))),
        ("times", _times(opened)),
        *(("remark", remark) for remark in opened.remarks),
        ("looked at", f"{whole}: grey levels {seen.lowest} .. {seen.highest}"),
        *((fault, _numbers(numbers) if numbers else "none") for fault, numbers in seen.faults.items()),
    ]


def _times(opened: "Movie") -> str:
    from sphereorient.movies.stamps import spacing

    times_s = opened.times_s
    if times_s is None:
        shown = f"only the rate of players, {opened.played_hz:.6g} Hz" if opened.played_hz else "none"
        return f"{shown}: give frame_rate or times in experiment.yaml"
    if len(times_s) < 2:
        return f"{times_s[0]:.9g} s"
    unit = f"; no unit is stated, their size suggests {opened.likely_units}" if opened.likely_units else ""
    return f"{times_s[0]:.9g} .. {times_s[-1]:.9g} s, {spacing(times_s)[1]}{unit}"


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _numbers(numbers: Sequence[int], after: str = ": ") -> str:
    more = f" and {len(numbers) - SHOWN} more" if len(numbers) > SHOWN else ""
    return _frames(len(numbers)) + after + ", ".join(map(str, numbers[:SHOWN])) + more


def _pictures(opened: "Movie", first: int, last: int, dead: list[int], advance: Progress) -> "Iterator[Grey | None]":
    """Yield the frames to write; append the numbers of those that cannot be decoded to `dead`."""
    for number, picture in enumerate(opened.readable(first, last), start=first):
        if picture is None:
            dead.append(number)
        yield picture
        advance("convert", number + 1 - first, last - first)
