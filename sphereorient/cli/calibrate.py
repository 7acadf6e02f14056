"""`sphereorient calibrate` and `check-cameras`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import ExperimentPath, app, check_writable, progress_bar
from sphereorient.errors import ExperimentError, OutputError, refusal
from sphereorient.files.outputs import put_aside


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
    """Calibrate cameras from pictures of a plate, or repair cameras that moved, from a track of both."""
    check_writable(out)
    check_other_yaml(out, source)
    command = " ".join(["sphereorient", *sys.argv[1:]])
    if refine_with is not None:
        _repair(source, refine_with, out, command, quiet)
        return
    from sphereorient.calibration import calibrate_cameras
    from sphereorient.cameras import save_cameras
    from sphereorient.report import calibration_figure

    with progress_bar(quiet) as advance:
        result = calibrate_cameras(source, advance)
    picture = out.with_suffix(".png")
    with put_aside(picture) as partial:
        calibration_figure(result, partial)
        save_cameras(out, result.cameras, f"X_cam = R X_lab + T, mm; made by {command}", result.covariance)
    if quiet:
        return
    from rich.console import Console

    from sphereorient.calibration.table import parameters_table, pictures_table, summary

    console = Console()
    console.print(pictures_table(result))
    console.print(parameters_table(result))
    for line in [*summary(result), f"Wrote {out} and {picture}"]:
        typer.echo(line)


def _repair(cameras: Path, track: Path, out: Path, command: str, quiet: bool) -> None:
    from sphereorient.calibration import refine_with_track
    from sphereorient.calibration.table import repair_lines
    from sphereorient.cameras import load_cameras, save_cameras

    result = refine_with_track(cameras, track)
    save_cameras(out, load_cameras(cameras) | dict(result.cameras), f"repaired by {command}")
    if not quiet:
        for line in [*repair_lines(result), f"Wrote {out}. Track again with it; a second repair is finer still."]:
            typer.echo(line)


@app.command("check-cameras")
def check_cameras_command(
    experiment: ExperimentPath,
    track: Annotated[
        Path | None, typer.Option(help="track.h5 of this experiment; without it the movies are tracked first.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Report how far the cameras' lines of sight to the sphere miss each other, over a movie."""
    from sphereorient.calibration import check_cameras
    from sphereorient.calibration.table import check_lines, contradiction_lines
    from sphereorient.experiment import load_experiment
    from sphereorient.run.stages import track_movies
    from sphereorient.trajectory import Trajectory

    known = load_experiment(experiment)
    if len(known.cameras) < 2:
        do = "name an experiment of two cameras"
        raise ExperimentError(refusal(str(experiment), expected="two cameras or more", got="one", do=do))
    if track is not None:
        result = Trajectory.load(track)
    else:
        with progress_bar(quiet) as advance:
            result = track_movies(known, progress=advance)
    lines = check_lines(check_cameras(known.cameras, result))
    for line in [*(lines or ["no frame in which two cameras see the sphere"]), *contradiction_lines(result)]:
        typer.echo(line)


def check_other_yaml(out: Path, source: Path) -> None:
    """Refuse to write cameras over their source, or to a name that does not end in .yaml."""
    do = "choose another --out, such as cameras.yaml"
    if out.suffix not in (".yaml", ".yml"):
        raise OutputError(refusal(f"--out {out}", expected="a name that ends in .yaml", got=f"'{out.name}'", do=do))
    if out.resolve() == source.resolve():
        raise OutputError(refusal(f"--out {out}", expected="another file than the input", got="the input", do=do))
