"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sphereorient import __version__
from sphereorient.errors import ExperimentError, OutputError, SphereOrientError, refusal

if TYPE_CHECKING:
    from sphereorient.trajectory import Trajectory

app = typer.Typer(
    name="sphereorient",
    help="Measure position and absolute orientation of a painted sphere from high-speed movies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

EXIT_REFUSED = 2  # something that the user can mend
EXIT_INTERRUPTED = 130  # Ctrl-C, as shells have it

ExperimentPath = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="experiment.yaml (docs/data-format.md)")]


@app.callback(invoke_without_command=True)
def common(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Measure position and absolute orientation of a painted sphere from high-speed movies."""
    if version:
        typer.echo(f"sphereorient {__version__}")
        raise typer.Exit


@app.command()
def track(
    experiment: ExperimentPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="HDF5 file to write (schema sphereorient-track/1).")],
    method: Annotated[
        str, typer.Option(help="precise: refined poses with covariances; paper: Zimmermann et al. 2011, corrected.")
    ] = "precise",
    settings: Annotated[Path | None, typer.Option(help="YAML as `sphereorient settings` writes it.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override one setting, e.g. --set orient.fine_step_deg=2.")
    ] = None,
    cameras: Annotated[str | None, typer.Option(help="Use these cameras only, e.g. cam1 or cam1,cam2.")] = None,
    device: Annotated[str, typer.Option(help="Where fits are computed: cpu, cuda, cuda:1.")] = "cpu",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Track the sphere of an experiment: position and orientation of every frame."""
    _check_writable(out)
    from sphereorient.pipeline import track_movies
    from sphereorient.settings import load_settings

    chosen = load_settings(settings, set_ or [])
    command = " ".join(["sphereorient", *sys.argv[1:]])
    names = None if cameras is None else [name.strip() for name in cameras.split(",") if name.strip()]
    with progress_bar(quiet) as advance:
        result = track_movies(
            experiment,
            method=method,
            settings=chosen,
            cameras=names,
            device=device,
            progress=advance,
            command=command,
        )
    result.save(out)
    if not quiet:
        _print_summary(result, out)


@app.command()
def synth(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write the experiment into.")],
    settings: Annotated[Path | None, typer.Option(help="YAML with keys of configs/synth.yaml.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override one key, e.g. --set frames=60.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Render a two-camera experiment with exact truth, to try the tracker or to test another."""
    _check_writable(out)
    from sphereorient.settings import load_synth_settings
    from sphereorient.synth import write_experiment

    chosen = load_synth_settings(settings, set_ or [])
    total = 2 * chosen.frames
    with progress_bar(quiet) as advance:
        done = 0

        def rendered(count: int) -> None:
            nonlocal done
            done += count
            advance("render", done, total)

        path = write_experiment(out, chosen, rendered)
    if not quiet:
        typer.echo(f"Wrote {path}. Next: sphereorient track {path} --out {out / 'track.h5'}")


@app.command()
def calibrate(
    source: Annotated[
        Path, typer.Argument(metavar="FILE", help="calibration.yaml; with --refine-with the cameras.yaml to repair.")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="cameras.yaml to write; its picture goes beside it.")],
    refine_with: Annotated[
        Path | None, typer.Option(help="track.h5 made with these cameras: repair them by the sphere itself.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no tables.")] = False,
) -> None:
    """Find cameras from pictures of a plate, or repair bumped ones from a track of both."""
    _check_writable(out)
    _check_other_yaml(out, source)
    command = " ".join(["sphereorient", *sys.argv[1:]])
    if refine_with is not None:
        _repair(source, refine_with, out, command, quiet)
        return
    from sphereorient.calibrate import calibrate_cameras
    from sphereorient.cameras import save_cameras
    from sphereorient.report import calibration_figure

    with progress_bar(quiet) as advance:
        result = calibrate_cameras(source, advance)
    picture = out.with_suffix(".png")
    with _put_aside(picture) as partial:
        calibration_figure(result, partial)
        save_cameras(out, result.cameras, f"X_cam = R X_lab + T, mm; made by {command}", result.covariance)
    if quiet:
        return
    from rich.console import Console

    from sphereorient.calibrate.table import parameters_table, pictures_table, summary

    console = Console()
    console.print(pictures_table(result))
    console.print(parameters_table(result))
    for line in [*summary(result), f"Wrote {out} and {picture}"]:
        typer.echo(line)


def _repair(cameras: Path, track: Path, out: Path, command: str, quiet: bool) -> None:
    """Repair cameras by the sphere."""
    from sphereorient.calibrate import refine_with_track
    from sphereorient.calibrate.table import repair_lines
    from sphereorient.cameras import load_cameras, save_cameras

    result = refine_with_track(cameras, track)
    save_cameras(out, load_cameras(cameras) | dict(result.cameras), f"repaired by {command}")
    if not quiet:
        for line in [*repair_lines(result), f"Wrote {out}. Track again with it; a second repair is finer still."]:
            typer.echo(line)


@app.command("check-cameras")
def check_cameras(
    experiment: ExperimentPath,
    track: Annotated[
        Path | None, typer.Option(help="track.h5 of this experiment; without it the movies are tracked first.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Tell by how much the lines of sight of the cameras miss each other at the sphere, over a movie."""
    from sphereorient.calibrate import check_cameras as checked
    from sphereorient.calibrate.table import check_lines, contradiction_lines
    from sphereorient.experiment import load_experiment
    from sphereorient.pipeline import track_movies
    from sphereorient.trajectory import Trajectory

    known = load_experiment(experiment)
    if len(known.cameras) < 2:
        do = "check an experiment of two cameras"
        raise ExperimentError(refusal(str(experiment), expected="two cameras or more", got="one", do=do))
    if track is not None:
        result = Trajectory.load(track)
    else:
        with progress_bar(quiet) as advance:
            result = track_movies(known, progress=advance)
    lines = check_lines(checked(known.cameras, result))
    for line in [*(lines or ["no frame in which two cameras see the sphere"]), *contradiction_lines(result)]:
        typer.echo(line)


@app.command()
def settings(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write; the screen without it.")] = None,
) -> None:
    """Write all settings of the method with their defaults, each one explained."""
    from sphereorient.settings import settings_yaml

    if out is None:
        typer.echo(settings_yaml())
        return
    _check_writable(out)
    aside = out.with_name(out.name + ".partial")
    aside.write_text(settings_yaml(), encoding="utf-8")
    aside.replace(out)


@app.command()
def info() -> None:
    """Print versions, threads and device."""
    import torch

    from sphereorient.provenance import versions

    for package, number in versions().items():
        typer.echo(f"{package:24} {number}")
    typer.echo(f"{'threads':24} {torch.get_num_threads()} of {os.cpu_count()} cores")
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu (no GPU found)"
    typer.echo(f"{'device':24} {device}")


def _check_writable(out: Path) -> None:
    """Refuse an output place before hours of work, not after."""
    folder = out.parent
    do = "choose another --out"
    if not folder.is_dir():
        raise OutputError(
            refusal(f"--out {out}", expected=f"an existing folder {folder}", got="none", do="make it first")
        )
    if not os.access(folder, os.W_OK):
        raise OutputError(refusal(f"--out {out}", expected="a writable folder", got=f"{folder}, which is not", do=do))


def _check_other_yaml(out: Path, source: Path) -> None:
    """Refuse to write cameras over what they are made of, or to a file whose picture would have its own name."""
    do = "choose another --out, such as cameras.yaml"
    if out.suffix not in (".yaml", ".yml"):
        raise OutputError(refusal(f"--out {out}", expected="a name that ends in .yaml", got=f"'{out.name}'", do=do))
    if out.resolve() == source.resolve():
        raise OutputError(refusal(f"--out {out}", expected="another file than the input", got="the input", do=do))


@contextmanager
def _put_aside(path: Path) -> Iterator[Path]:
    """Give a name to write under; what was written takes its place at the end, or vanishes where something failed."""
    aside = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        yield aside
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


Advance = Callable[[str, int, int], None]


@contextmanager
def progress_bar(quiet: bool = False) -> Iterator[Advance]:
    """Show one line of progress a stage, with frames per second and time left; nothing where `quiet`."""
    if quiet:
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: list[Any] = [
        TextColumn("{task.description:13}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:>14}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    ]
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, Any] = {}

        def advance(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, rate="")
            elapsed = bar.tasks[bar.task_ids.index(tasks[stage])].elapsed
            rate = f"{done / elapsed:.1f} frames/s" if done and elapsed else ""
            bar.update(tasks[stage], completed=done, rate=rate)

        yield advance


def _print_summary(result: Trajectory, out: Path) -> None:
    """Say what came out: frames valid, what each camera lost and why, what to do about cameras that moved."""
    from sphereorient.calibrate.table import contradiction_lines

    summary = result.summary()
    typer.echo(f"{summary['valid']} of {summary['frames']} frames valid (position and orientation measured)")
    for name, lost in summary["lost"].items():
        text = ", ".join(f"{count} {reason}" for reason, count in lost.items()) or "none"
        typer.echo(f"  {name}: frames lost: {text}")
    for line in [*contradiction_lines(result), f"Wrote {out}"]:
        typer.echo(line)


def main() -> None:
    """Run the command line; errors that a user can mend become one line and a non-zero exit code."""
    # On a busy machine torch's threads spin while they wait for a core that another program has: 136 s instead of 9 s
    # for the excerpt beside two busy processes. Read by OpenMP when torch is imported, so before any command.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_INTERRUPTED))
    try:
        # Without its standalone mode the parser hands exit codes back, that of Ctrl-C among them.
        code = app(standalone_mode=False) or 0
    except SphereOrientError as error:
        typer.echo(f"sphereorient: {error}", err=True)
        code = EXIT_REFUSED
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    except Exception as error:
        code = _usage_error(error)
    if code == EXIT_INTERRUPTED:
        typer.echo("sphereorient: interrupted; nothing was written.", err=True)
    sys.exit(code)


def _usage_error(error: Exception) -> int:
    """Print a mistake in the arguments as the parser words it; let faults of the program through."""
    show = getattr(error, "show", None)
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", EXIT_REFUSED))


if __name__ == "__main__":
    main()
