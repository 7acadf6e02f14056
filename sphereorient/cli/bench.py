"""`sphereorient bench`: the robustness benchmark, its scenes, and what got worse."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.outputs import put_aside

if TYPE_CHECKING:
    from sphereorient.evaluate.robustness import BenchSettings, Results

EXIT_WORSE = 1  # something got worse

bench = typer.Typer(no_args_is_help=True, help="Benchmarks on synthetic scenes with exact truth.")
app.add_typer(bench, name="bench")

Names = Annotated[str | None, typer.Option(help="Some of docs/degradations.md, e.g. defocus,spin; all without it.")]
Levels = Annotated[str | None, typer.Option(help="Severities, e.g. 1,2,3,4,5; 1,3,5 without it.")]
Seeds = Annotated[int | None, typer.Option(min=1, max=100, help="Movies of each degradation and severity.")]
Frames = Annotated[int | None, typer.Option(min=12, help="Of each movie.")]
Full = Annotated[bool, typer.Option("--full", help="All severities, three movies of 60 frames each: hours.")]


@bench.command()
def robustness(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the run; an unfinished one goes on.")],
    degradations: Names = None,
    levels: Levels = None,
    seeds: Seeds = None,
    frames: Frames = None,
    full: Full = False,
    methods: Annotated[str, typer.Option(help="Which are compared.")] = "precise,paper",
    baseline: Annotated[Path | None, typer.Option(help="results.json of an older run to compare with.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes.")] = 2,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Measure what noise, blur, dirt, wrong cameras and the like do to a track; the default ends in minutes."""
    check_writable(out)
    chosen = _settings(degradations, levels, seeds, frames, full)
    from sphereorient.evaluate.robustness import load_results, run_benchmark
    from sphereorient.evaluate.robustness.run import trackers_of
    from sphereorient.report.plots.style import write_figure
    from sphereorient.report.robustness import robustness_figure, write_table

    trackers = trackers_of([name.strip() for name in methods.split(",") if name.strip()])
    older = None if baseline is None else load_results(baseline)
    with progress_bar(quiet, unit="") as advance:
        found = run_benchmark(
            out, chosen, trackers, jobs=jobs, progress=lambda done, total: advance("scenes", done, total)
        )
    write_table(found, out / "results.csv")
    write_figure(robustness_figure(found), out / "robustness")
    if not quiet:
        _print(found)
        typer.echo(f"Wrote {out}: results.json, results.csv, robustness.png, .pdf")
    if older is not None:
        _tell(found, older, quiet)


@bench.command()
def compare(
    now: Annotated[Path, typer.Argument(metavar="NOW", help="results.json of a run.")],
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="results.json of an older one.")],
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only what got worse.")] = False,
) -> None:
    """Name what got worse from one run to another by more than its own scatter. Exit code 1: something did."""
    from sphereorient.evaluate.robustness import load_results

    _tell(load_results(now), load_results(baseline), quiet)


@bench.command()
def scenes(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the scenes.")],
    degradations: Names = None,
    levels: Levels = None,
    seeds: Seeds = None,
    frames: Frames = None,
    full: Full = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Render the scenes of the benchmark with their truth, for other programs (docs/robustness.md)."""
    check_writable(out)
    chosen = _settings(degradations, levels, seeds, frames, full)
    from sphereorient.evaluate.robustness import scenes_of, write_scene

    all_scenes = scenes_of(chosen)
    with progress_bar(quiet, unit="") as advance:
        for done, scene in enumerate(all_scenes, start=1):
            write_scene(out / scene.name, scene)
            advance("scenes", done, len(all_scenes))
    index = [{"name": scene.name, "degradations": dict(scene.degradations), "seed": scene.seed} for scene in all_scenes]
    with put_aside(out / "scenes.json") as aside:
        aside.write_text(json.dumps(index, indent=1) + "\n", "utf-8")
    if not quiet:
        typer.echo(f"Wrote {out}: {len(all_scenes)} scenes, each with experiment.yaml and truth.h5")


@bench.command()
def score(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="track.h5, or another program's file.")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="truth.h5 of the scene.")],
    of: Annotated[str, typer.Option("--format", help="sphereorient, or fictrac for its .dat.")] = "sphereorient",
    align: Annotated[
        str,
        typer.Option(
            help="Take a constant rotation off first: none; body: its axes are arbitrary; both: and so is the frame."
        ),
    ] = "none",
) -> None:
    """Print the errors of a track, or of another program's result, against the exact truth."""
    import numpy as np

    from sphereorient.evaluate.external import READERS, aligned_errors_deg
    from sphereorient.evaluate.robustness.measure import WRONG_DEG
    from sphereorient.evaluate.truth import orientations_at, true_orientations
    from sphereorient.trajectory import Trajectory

    if of == "sphereorient":
        track = Trajectory.load(result)
        R, R_true = track.orientation, true_orientations(truth, track.time)
    elif of in READERS:
        seen = READERS[of](result)
        R, R_true = seen.R, orientations_at(truth, seen.frame)
    else:
        known = ", ".join(["sphereorient", *READERS])
        raise SettingsError(refusal("--format", expected=known, got=repr(of)[:40], do="choose one"))
    errors = aligned_errors_deg(R, R_true, align)
    there = errors[np.isfinite(errors)]
    typer.echo(f"{len(there)} of {len(errors)} frames have an orientation")
    if len(there):
        p50, p95, largest = np.percentile(there, (50, 95, 100))
        wrong = float((there > WRONG_DEG).mean())
        typer.echo(
            f"error, degrees: median {p50:.4g}, 95 % {p95:.4g}, largest {largest:.4g}; "
            f"above {WRONG_DEG:g}: {100 * wrong:.3g} %"
        )


def _settings(
    degradations: str | None, levels: str | None, seeds: int | None, frames: int | None, full: bool
) -> BenchSettings:
    """Return the settings that the options make of the default, or of the full run."""
    from pydantic import ValidationError

    from sphereorient.evaluate.robustness.settings import FULL, BenchSettings

    tree = (FULL if full else BenchSettings()).model_dump()
    if degradations is not None:
        tree["degradations"] = tuple(name.strip() for name in degradations.split(",") if name.strip())
    if levels is not None:
        tree["levels"] = tuple(_whole(part) for part in levels.split(","))
    if seeds is not None:
        tree["seeds"] = tuple(range(seeds))
    if frames is not None:
        tree["frames"] = frames
    try:
        return BenchSettings(**tree)
    except ValidationError as error:
        words = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise SettingsError(words) from None


def _whole(text: str) -> int:
    if not text.strip().isdecimal():
        do = "write e.g. --levels 1,3,5"
        raise SettingsError(refusal("--levels", expected="whole numbers between commas", got=repr(text)[:40], do=do))
    return int(text)


def _print(found: Results) -> None:
    """Print one line a degradation, level and method."""
    from rich.console import Console
    from rich.table import Table

    from sphereorient.evaluate.robustness.results import lines_of

    table = Table("degradation", "level", "method", "median", "95 %", "wrong", "lost", "first", "inside", "frames/s")
    for line in lines_of(found):
        table.add_row(
            line.kind,
            str(line.level),
            line.method,
            f"{line.p50_deg:.3g}\u00b0",
            f"{line.p95_deg:.3g}\u00b0",
            f"{100 * line.wrong_after:.0f} %",
            f"{100 * line.lost:.0f} %",
            f"{100 * line.recall['1']:.0f} %",
            f"{100 * line.inside:.0f} %",
            f"{line.frames_per_s:.1f}",
        )
    Console().print(table)


def _tell(now: Results, baseline: Results, quiet: bool) -> None:
    """Print what changed; exit 1 where something got worse."""
    from sphereorient.evaluate.robustness import compare as compared

    changes = compared(now, baseline)
    worse = [change for change in changes if change.worse]
    better = [] if quiet else [change for change in changes if change.better]
    for word, some in (("worse", worse), ("better", better)):
        for one in some:
            typer.echo(f"{word}: {one.kind} {one.level}, {one.method}: {one.what} {one.before:.4g} -> {one.now:.4g}")
    if not quiet:
        typer.echo(
            f"{len(changes)} numbers compared: {len(worse)} worse, {len(better)} better, by more than their scatter"
        )
    if worse:
        raise typer.Exit(EXIT_WORSE)
