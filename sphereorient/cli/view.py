"""`sphereorient view`."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar
from sphereorient.files.outputs import put_aside


@app.command()
def view(
    track: Annotated[Path, typer.Argument(metavar="TRACK", help="track.h5 that `sphereorient track` wrote.")],
    experiment: Annotated[
        Path | None, typer.Option(help="experiment.yaml of the track: adds cameras, texture and pictures.")
    ] = None,
    save: Annotated[Path | None, typer.Option(help="Write this .rrd instead of opening a window.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Include the pictures of one of so many frames.")] = 1,
    pictures: Annotated[bool, typer.Option(help="Include the pictures of the movies.")] = True,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Show a track in space and time with Rerun: cameras, pictures, the sphere, its motion, its warnings."""
    if save is not None:
        check_writable(save)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.recording import view_track
    from sphereorient.trajectory import Trajectory

    measured = Trajectory.load(track)
    seen = None if experiment is None else load_experiment(experiment)
    with progress_bar(quiet) as advance, ExitStack() as opened:
        place = None if save is None else opened.enter_context(put_aside(save))
        view_track(
            measured,
            experiment=seen,
            save=place,
            every=every,
            pictures=pictures,
            progress=lambda done, total: advance("pictures", done, total),
        )
    if not quiet and save is not None:
        typer.echo(f"Wrote {save}: {len(measured)} frames; look at it with `rerun {save}`")
