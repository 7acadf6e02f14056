"""Synthetic movies with exact truth: `sphereorient synth`, `score`, and `bench`, the robustness benchmark."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from sphereorient.cli.app import Commands, app, check_writable, echo_lines, new_table, print_table, progress_bar
from sphereorient.cli.options import (
    Align,
    Cameras,
    ExperimentPath,
    Quiet,
    SphereName,
    TrackPath,
    ball_words,
    cameras_of,
    names_in,
    tracks_in,
)
from sphereorient.errors import SettingsError, refusal
from sphereorient.files.hdf5 import UNNAMED
from sphereorient.files.provenance import without_nan
from sphereorient.files.threads import counted
from sphereorient.files.whole_file import write_text, writing

if TYPE_CHECKING:
    from rich.table import Table

    from sphereorient.bench import BenchSettings, Results, Score
    from sphereorient.bench.score import Floats
    from sphereorient.statistics import Interval
    from sphereorient.statistics.behaviour import Behaviour


APART_DEG = 1.0  # angle between axes that is worth a remark
EXPLAINED = 0.5  # share of the median error; a constant rotation that leaves less is worth one

bench = Commands(no_args_is_help=True, help="Benchmarks on synthetic scenes with exact truth.")
app.add_typer(bench, name="bench")


@app.command()
def synth(
    out: Annotated[Path, Option("--out", "-o", help="Folder to write the experiment into.")],
    settings: Annotated[Path | None, Option(help="YAML with keys of configs/synth.yaml.")] = None,
    set_: Annotated[list[str] | None, Option("--set", help="Override one key, e.g. --set frames=60.")] = None,
    quiet: Quiet = False,
) -> None:
    """Render an experiment with exact truth."""
    check_writable(out, folder_made=True)
    from sphereorient.methods.settings import read_model
    from sphereorient.synth import SynthSettings, write_synthetic_experiment

    chosen = read_model(SynthSettings, settings, set_ or [])
    total = chosen.cameras * chosen.frames
    with progress_bar(quiet) as advance:
        done = 0

        def rendered(count: int) -> None:
            nonlocal done
            done += count
            advance("render", done, total)

        path = write_synthetic_experiment(out, chosen, rendered)
    if not quiet:
        typer.echo(f"Wrote {path}. Next: sphereorient track {path} --out {out / 'track.h5'}")


@app.command()
def score(
    track: TrackPath,
    reference: Annotated[
        Path, Argument(metavar="REFERENCE", help="truth.h5; or another tracker's: track.h5, or FicTrac's .dat.")
    ],
    sphere: SphereName = None,
    alike: Annotated[list[str] | None, Option(help="Balls whose names may be exchanged: a,c; repeatable.")] = None,
    align: Align = "none",
    as_json: Annotated[bool, Option("--json", help="Print orientation errors and behaviour as JSON.")] = False,
) -> None:
    """Print errors of a track against exact truth; gain, drift and walk against truth or another tracker.
    FicTrac's .dat in place of a track is compared with the truth.
    """
    import numpy as np

    from sphereorient.bench import score_track
    from sphereorient.bench.score import against, another_result, given_to_others, named_as_true, reference_of
    from sphereorient.trajectory import Tracks

    theirs, numbers = track.suffix.lower() == ".dat", []
    tracks = Tracks({UNNAMED: another_result(track, reference)}) if theirs else tracks_in(track, None)
    given: dict[str, tuple[int, int]] = {}
    for names in alike or ():
        tracks = named_as_true(tracks, reference, names_in(names))
    for name, one in tracks.picked(sphere).items():
        of = reference_of(reference, one)
        errors, behaviour = against(of, one, align)
        if as_json:
            numbers.append({"ball": name, "exact": of.exact, **error_numbers(errors), **behaviour.numbers()})
            continue
        if of.exact and align != "both" and not theirs:
            print_table(error_table(score_track(one, reference, align), name))
        else:
            print_errors(errors, name, "error" if of.exact else "difference")
        print_table(behaviour_table(behaviour, name, exact=of.exact))
        if align != "both" and behaviour.apart_deg > APART_DEG:
            typer.echo(
                f"The lab axes are {behaviour.apart_deg:.1f} degrees apart: --align both removes that.", err=True
            )
        if align == "none" and np.isfinite(errors).any():
            usual, left = (float(np.nanmedian(part)) for part in (errors, against(of, one, "body")[0]))
            if usual > APART_DEG and left < EXPLAINED * usual:
                words = f"--align body removes a constant rotation: the median falls from {usual:.2f}° to {left:.3g}°"
                typer.echo(f"{words}. A learnt map has its own body axes.", err=True)
        given = given or (given_to_others(tracks, reference) if of.exact and len(tracks) > 1 else {})
        if name in given:
            wrong, changes = given[name]
            typer.echo(f"ball {name}: {wrong} frames given to another ball, {changes} exchanges")
    if as_json:
        about = {"track": str(track), "reference": str(reference), "align": align, "balls": numbers}
        typer.echo(json.dumps(without_nan(about)))


def error_numbers(errors_deg: "Floats") -> dict[str, Any]:
    """Return how many errors of orientation (N,), degrees, are known, and their percentiles, for JSON."""
    import numpy as np

    known = errors_deg[np.isfinite(errors_deg)]
    percentiles = np.percentile(known, (50, 95, 100)).tolist() if len(known) else [np.nan] * 3
    return {"known": len(known), "error_deg": dict(zip(("median", "95 %", "largest"), percentiles, strict=True))}


def print_errors(errors_deg: "Floats", ball: str, word: str = "error") -> None:
    """Print how many errors of orientation (N,), degrees, are known, and their percentiles."""
    from sphereorient.bench.results import WRONG_DEG

    found = error_numbers(errors_deg)
    typer.echo(f"{ball_words(ball)}{found['known']} of {len(errors_deg)} frames have an orientation")
    if found["known"]:
        percentiles = ", ".join(f"{name} {value:.4g}" for name, value in found["error_deg"].items())
        wrong = float((errors_deg > WRONG_DEG).sum()) / found["known"]
        typer.echo(f"{word}, degrees: {percentiles}; above {WRONG_DEG:g}: {100 * wrong:.3g} %")


def behaviour_table(found: "Behaviour", ball: str = "", *, exact: bool) -> "Table":
    """Return gain, drift, heading and path against a reference as a table."""
    of, against = f" of ball {ball}" if ball else "", "the exact truth" if exact else "another tracker"
    title = f"Behaviour{of} against {against}, {found.pairs} rotations between frames"
    table = new_table("quantity", "x", "y", "z", "along the rotation", title=title)

    def gains(name: str, gain: "Interval") -> None:
        table.add_row(name, *(f"{value:.4f}" for value in gain.value))
        table.add_row("  95 %", *(f"{a:.4f} .. {b:.4f}" for a, b in zip(gain.low, gain.high, strict=True)))

    gains("gain", found.gain)
    if not exact:
        table.add_row("  bounds", *(f"{a:.4f} .. {b:.4f}" for a, b in found.gain_bounds.T))
    if found.gain_smooth is not None:
        gains("gain, smoothed", found.gain_smooth)
    drifts = zip(found.drift_deg_min, found.drift_sigma_deg_min, strict=True)
    table.add_row("drift (degrees a minute)", *(f"{value:.3f} \u00b1 {sigma:.3f}" for value, sigma in drifts))
    table.add_section()
    if found.length_ratio == found.length_ratio:
        table.add_row("difference of final heading (rad)", f"{found.heading_rad:.4f}")
        table.add_row("ratio of path lengths", f"{found.length_ratio:.4f}")
        table.add_row("distance of path ends, of the length", f"{100 * found.end_share:.3f} %")
    table.add_row("angle between lab axes (degrees)", f"{found.apart_deg:.3f}")
    table.caption = found.reason and f"no gain, no drift: {found.reason}"
    return table


def error_table(found: "Score", ball: str | None = None) -> "Table":
    """Return errors of orientation and position, and relative errors of the rates, as a table."""
    of = f" of ball {ball}" if ball else ""
    title = f"Errors{of} against the exact truth, {found.valid.sum()} of {found.frames} frames valid"
    table = new_table("quantity", "median", "95 %", "largest", title=title)
    p50, p95, _, largest = found.percentiles_deg()
    table.add_row("orientation (degrees)", f"{p50:.3f}", f"{p95:.3f}", f"{largest:.3f}")
    p50, p95, _, largest = found.percentiles_mm()
    table.add_row("position (mm)", f"{p50:.4f}", f"{p95:.4f}", f"{largest:.4f}")
    turn, place = found.over_stated()
    inside, stated = found.inside()
    table.add_section()
    table.add_row("errors over stated sigmas", "rms", "", "", style="bold")
    table.add_row("orientation", f"{turn:.2f}", "", "")
    table.add_row("position", f"{place:.2f}", "", "")
    table.add_row("true orientations in the stated 95 %", f"{inside} of {stated}", "", "")
    table.add_section()
    table.add_row("quantity", "rms error / rms", "frames", "", style="bold")
    for key, error in found.relative_rms.items():
        table.add_row(key, f"{100 * error:.2f} %", f"{100 * found.coverage[key]:.0f} %", "")
    return table


RunFolder = Annotated[Path, Option("--out", "-o", help="Folder of the run; continues an unfinished one.")]
Jobs = Annotated[int, Option("--jobs", "-j", min=1, help="Processes.")]


def _numbers_in(option: str, text: str) -> tuple[int, ...]:
    if not names_in(text) or not all(part.isdecimal() for part in names_in(text)):
        expected, got, do = "whole numbers between commas", repr(text)[:40], f"write e.g. {option} 1,3,5"
        raise SettingsError(refusal(option, expected=expected, got=got, do=do))
    return tuple(map(int, names_in(text)))


@dataclass(frozen=True, kw_only=True)
class _SceneOptions:
    out: RunFolder
    degradations: Annotated[str | None, Option(help="Some of docs/degradations.md: defocus,spin; else all.")] = None
    levels: Annotated[str | None, Option(help="Severities, e.g. 1,2,3,4,5; 1,3,5 without it.")] = None
    seeds: Annotated[int | None, Option(min=1, max=100, help="Movies of each degradation and severity.")] = None
    frames: Annotated[int | None, Option(min=12, help="Frames of each movie.")] = None
    full: Annotated[bool, Option("--full", help="All severities, three movies of 60 frames each (hours).")] = False
    settings: Annotated[Path | None, Option(help="YAML with keys of configs/robustness.yaml.")] = None
    quiet: Quiet = False

    def plan(self) -> "BenchSettings":
        """Return the settings: file or defaults, then --full, then the options."""
        from sphereorient.bench.scenes import FULL, BenchSettings
        from sphereorient.methods.settings import read_model

        changes: dict[str, Any] = FULL.model_dump(exclude_unset=True) if self.full else {}
        if self.degradations is not None:
            changes["degradations"] = tuple(names_in(self.degradations))
        if self.levels is not None:
            changes["levels"] = _numbers_in("--levels", self.levels)
        if self.seeds is not None:
            changes["seeds"] = tuple(range(self.seeds))
        if self.frames is not None:
            changes["frames"] = self.frames
        return read_model(BenchSettings, self.settings, **changes)


@dataclass(frozen=True, kw_only=True)
class _RobustnessOptions(_SceneOptions):
    methods: Annotated[str, Option(help="Methods to compare.")] = "precise,paper"
    baseline: Annotated[Path | None, Option(help="results.json of an older run to compare with.")] = None
    jobs: Jobs = 2


@bench.command()
def robustness(given: _RobustnessOptions) -> None:
    """Measure the effect of noise, blur, dirt, wrong cameras and more on a track (minutes by default)."""
    check_writable(given.out, folder_made=True)
    chosen = given.plan()
    from sphereorient.bench import load_results, run_benchmark
    from sphereorient.bench.figures import robustness_figure, write_table
    from sphereorient.bench.run import trackers_of
    from sphereorient.report.plots.style import write_figure

    trackers = trackers_of(names_in(given.methods))
    older = None if given.baseline is None else load_results(given.baseline)
    with progress_bar(given.quiet, unit="") as advance:
        found = run_benchmark(given.out, chosen, trackers, jobs=given.jobs, progress=partial(advance, "scenes"))
    with writing(force=True):  # its plan proves that this run made the folder
        write_table([found], given.out / "results.csv")
        write_figure(robustness_figure(found), given.out / "robustness")
    if not given.quiet:
        _print(found)
        typer.echo(f"Wrote {given.out}: results.json, results.csv, robustness.png, .pdf")
    if older is not None:
        _print_changes(found, older, given.quiet)


@dataclass(frozen=True, kw_only=True)
class _BallsOptions:
    out: RunFolder
    balls: Annotated[str, Option(help="Numbers of balls, 1 to 8, all in one volume.")] = "1,2,4,8"
    cameras: Annotated[str, Option(help="Numbers of cameras, 1 to 4: one curve each.")] = "2,3"
    paints: Annotated[int, Option(min=1, max=8, help="Different paints; with fewer than balls some look alike.")] = 2
    volume: Annotated[float, Option(help="Balls stay within about this distance of the origin, mm.")] = 45.0
    seeds: Annotated[int, Option(min=1, max=100, help="Movies of each point of a curve.")] = 1
    frames: Annotated[int, Option(min=12, help="Frames of each movie.")] = 48
    jobs: Jobs = 2
    quiet: Quiet = False


@bench.command("balls")
def balls_curve(given: _BallsOptions) -> None:
    """Measure errors and identity against the number density of balls that hide each other."""
    check_writable(given.out, folder_made=True)
    from sphereorient.bench import BenchSettings, run_benchmarks
    from sphereorient.bench.figures import density_figure, write_table
    from sphereorient.bench.run import trackers_of
    from sphereorient.methods.settings import read_model
    from sphereorient.report.plots.style import write_figure

    plain: dict[str, Any] = {"degradations": (), "seeds": tuple(range(given.seeds)), "frames": given.frames}
    # A short correlation time of the velocity: balls hide each other in a short movie.
    plain |= {"paints": given.paints, "volume_mm": given.volume, "velocity_time": 0.03}
    plans = {
        f"{b}-balls-{c}-cameras": read_model(BenchSettings, **plain, balls=b, cameras=c)
        for c in _numbers_in("--cameras", given.cameras)
        for b in _numbers_in("--balls", given.balls)
    }
    with progress_bar(given.quiet, unit="") as advance:
        trackers = trackers_of(["precise"])
        runs = run_benchmarks(given.out, plans, trackers, jobs=given.jobs, progress=partial(advance, "scenes"))
    with writing(force=True):  # its plans prove that this run made the folder
        write_table(runs, given.out / "results.csv")
        write_figure(density_figure(runs), given.out / "density")
    if not given.quiet:
        _print_balls(runs)
        typer.echo(f"Wrote {given.out}: results.csv, density.png, .pdf, and a folder of each point")


@dataclass(frozen=True, kw_only=True)
class _BallOptions:
    out: RunFolder
    scenes: Annotated[str | None, Option(help="Scenes, e.g. clean_fly,noisy; default: all.")] = None
    frames: Annotated[int, Option(min=300, help="Frames of each movie, 100 Hz; 6000 show the drift.")] = 1000
    seed: Annotated[int, Option(min=0, help="Seed of paint and motion.")] = 0
    first: Annotated[bool, Option("--first", help="Only the first pass, not the precise method.")] = False
    quiet: Quiet = False


@bench.command("ball")
def ball_scenes(given: _BallOptions) -> None:
    """Track a ball under an animal without prior knowledge, in scenes like those published for spintrack."""
    check_writable(given.out, folder_made=True)
    from sphereorient.bench.ball import SCENES, measure_scene, write_ball_scene
    from sphereorient.methods.settings import Settings

    names = list(SCENES) if given.scenes is None else names_in(given.scenes)
    for name in names:
        if name not in SCENES:
            expected, got = ", ".join(SCENES), repr(name)[:40]
            raise SettingsError(refusal("--scenes", expected=expected, got=got, do="choose some of these"))
    rows = []
    for name in names:
        done = given.out / f"{name}-{given.frames}-{given.seed}{'-first' if given.first else ''}.json"
        if not done.exists():
            folder = done.with_suffix("")
            with progress_bar(given.quiet) as advance, writing(force=True):  # of this run
                path = write_ball_scene(folder, SCENES[name], given.frames, given.seed, advance)
                row = measure_scene(path, Settings(), not given.first, advance)
                write_text(done, json.dumps({"scene": name, **row.numbers()}, indent=1))
        rows.append(json.loads(done.read_text()))
    if not given.quiet:
        _print_scenes(rows)


def _print_scenes(rows: Sequence[dict[str, Any]]) -> None:
    from sphereorient.bench.ball import SCENES

    title = "No prior knowledge; degrees, 95 % in brackets; FicTrac, spintrack: as spintrack publishes them"
    columns = ("scene", "found", "first pass: step", "orientation", "refined: step", "orientation")
    more = ("gain, axes", "drift/min", "step / sigma", "CPU ms", "FicTrac", "spintrack")
    table = new_table(*columns, *more, title=title)
    table.columns[0].no_wrap = True
    for row in rows:
        first, refined = row["first"], row.get("refined")
        best, scene = refined or first, SCENES[row["scene"]]
        walk = best["behaviour"]
        drift = (f"{a:.2f}±{b:.2f}" for a, b in zip(walk["drift_deg_min"], walk["drift_sigma_deg_min"], strict=True))
        table.add_row(
            row["scene"],
            f"{first['found']}",
            *(_errors_of(first)),
            *(_errors_of(refined) if refined else ("", "")),
            " ".join(f"{one:.4f}" for one in walk["gain"]["value"][:3]),
            " ".join(drift),
            " ".join(f"{one['over_sigma']:.2f}" for one in (first, refined) if one),
            f"{row['cpu_ms']:.1f}",
            *("" if math.isnan(at) else f"{at:.3f} ({most:.3f})" for at, most, _ in (scene.fictrac, scene.spintrack)),
        )
    print_table(table)


def _errors_of(of: dict[str, Any]) -> tuple[str, str]:
    return (
        f"{of['step_p50_deg']:.4f} ({of['step_p95_deg']:.3f})",
        f"{of['orientation_p50_deg']:.4f} ({of['orientation_p95_deg']:.3f})",
    )


@dataclass(frozen=True, kw_only=True)
class _LiveDelayOptions:
    experiment: ExperimentPath
    rate: Annotated[str, Option(help="Frames per second; several run in turn: 100,200,500.")] = "200"
    seconds: Annotated[float, Option(min=1.0, help="Duration; the movie runs forwards, then backwards.")] = 20.0
    loop: Annotated[bool, Option("--loop", help="Restart the movie at its end: it closes on itself.")] = False
    load: Annotated[int, Option(min=0, max=64, help="Other programs, each keeping a core busy.")] = 0
    faults: Annotated[bool, Option("--faults", help="Black for 0.5 s of each 5 s; the tracker stops once.")] = False
    learnt: Annotated[Path | None, Option(help="As for `live`.")] = None
    cameras: Cameras = None
    quiet: Quiet = False


@bench.command("live")
def live_delay(given: _LiveDelayOptions) -> None:
    """Measure latency of `live`, picture in memory to line on a socket; and errors, if truth.h5 is beside the movie."""
    from sphereorient.bench.live import COLUMNS, LiveTiming, delays, neighbours

    rates = [_rate_hz(part) for part in names_in(given.rate) or [given.rate]]
    options = [] if given.learnt is None else ["--learnt", str(given.learnt)]
    found, names = [], cameras_of(given.cameras)
    with neighbours(given.load):
        for rate_hz in rates:
            timing = LiveTiming(
                experiment=given.experiment,
                rate_hz=rate_hz,
                seconds=given.seconds,
                options=options,
                cameras=names,
                loop=given.loop,
                faults=given.faults,
            )
            with progress_bar(given.quiet, unit="lines") as advance:
                found.append(delays(timing, advance))
    if len(found) == 1:
        echo_lines(found[0].summary())
        return
    table = new_table("Hz", *COLUMNS, title=f"From a picture in memory to its line, other busy programs: {given.load}")
    for rate_hz, one in zip(rates, found, strict=True):
        table.add_row(f"{rate_hz:g}", *one.row())
    print_table(table)


def _rate_hz(text: str) -> float:
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 1.0 <= rate_hz < 1e5:
        do = "write e.g. --rate 100,200,500"
        raise SettingsError(refusal("--rate", expected="frames per second, at least 1", got=repr(text)[:40], do=do))
    return rate_hz


@bench.command("compare")
def compare_results(
    now: Annotated[Path, Argument(metavar="NOW", help="results.json of a run.")],
    baseline: Annotated[Path, Argument(metavar="BASELINE", help="results.json of an older one.")],
    quiet: Annotated[bool, Option("--quiet", "-q", help="Only what got worse.")] = False,
) -> None:
    """List the numbers that got worse by more than their scatter. Exit code 1: there are some."""
    from sphereorient.bench import load_results

    _print_changes(load_results(now), load_results(baseline), quiet)


@bench.command("scenes")
def write_scenes(given: _SceneOptions) -> None:
    """Render the scenes of the benchmark with their truth, for other programs (docs/robustness.md)."""
    check_writable(given.out, folder_made=True)
    from sphereorient.bench import scenes_of, write_scene

    scenes = scenes_of(given.plan())
    with progress_bar(given.quiet, unit="") as advance:
        for scene in counted("scenes", scenes, len(scenes), advance):
            write_scene(given.out / scene.name, scene)
    index = [{"name": scene.name, "degradations": dict(scene.degradations), "seed": scene.seed} for scene in scenes]
    write_text(given.out / "scenes.json", json.dumps(index, indent=1) + "\n")
    if not given.quiet:
        typer.echo(f"Wrote {given.out}: {len(scenes)} scenes, each with experiment.yaml and truth.h5")


def _print(found: "Results") -> None:
    from sphereorient.bench.results import summaries

    table = new_table(
        "degradation", "level", "method", "median", "95 %", "wrong", "lost", "first", "inside", "over sigma", "frames/s"
    )
    for line in summaries(found):
        shares = (line.wrong_after, line.lost, line.recall["1"], line.inside)
        table.add_row(
            line.kind,
            str(line.level),
            line.method,
            f"{line.p50_deg:.3g}\u00b0",
            f"{line.p95_deg:.3g}\u00b0",
            *(f"{100 * share:.0f} %" for share in shares),
            f"{line.over_stated:.2f}",
            f"{line.frames_per_s:.1f}",
        )
    print_table(table)


def _print_balls(runs: "Sequence[Results]") -> None:
    from sphereorient.bench.results import summaries

    table = new_table(
        *("cameras", "balls", "per litre", "hidden", "valid", "degrees, median", "95 %", "mm, median", "95 %"),
        *("given to another", "exchanges", "over sigma", "balls x frames/s"),
    )
    for run in runs:
        line, plan = summaries(run)[0], run.settings
        table.add_row(
            *(str(plan.cameras), str(plan.balls), f"{plan.per_litre:.1f}", f"{100 * line.hidden:.0f} %"),
            *(f"{100 * (1 - line.lost):.1f} %", f"{line.p50_deg:.3f}", f"{line.p95_deg:.3f}"),
            *(f"{line.p50_mm:.4f}", f"{line.p95_mm:.4f}", f"{100 * line.given:.1f} %", str(line.exchanges)),
            *(f"{line.over_stated:.2f}", f"{line.frames_per_s:.1f}"),
        )
        if line.refused:
            typer.echo(f"{plan.balls} balls, {plan.cameras} cameras: {line.refused}")
    print_table(table)


def _print_changes(now: "Results", baseline: "Results", quiet: bool) -> None:
    """Print the changes; exit 1 if a number got worse."""
    from sphereorient.bench import compare_runs

    changes = compare_runs(now, baseline)
    worse, better = [one for one in changes if one.worse], [one for one in changes if one.better]
    for word, some in (("worse", worse), ("better", [] if quiet else better)):
        for one in some:
            typer.echo(f"{word}: {one.kind} {one.level}, {one.method}: {one.what} {one.before:.4g} -> {one.now:.4g}")
    if not quiet:
        counts = f"{len(worse)} worse, {len(better)} better, by more than their scatter"
        typer.echo(f"{len(changes)} numbers compared: {counts}")
    if worse:
        raise typer.Exit(1)
