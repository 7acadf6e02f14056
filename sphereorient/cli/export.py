"""`sphereorient export`."""

from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar

TrackPath = Annotated[Path, typer.Argument(metavar="TRACK", help="track.h5 that `sphereorient track` wrote.")]


@app.command()
def export(
    track: TrackPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")],
    to: Annotated[
        str | None, typer.Option(help="csv, parquet or mat; default: by the suffix of the name.", metavar="FORMAT")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Write a track for other programs: a table, or arrays for MATLAB, with units in the names."""
    from sphereorient.report.export import export_track, format_of
    from sphereorient.trajectory import Trajectory

    to = format_of(out, to)
    check_writable(out)
    loaded = Trajectory.load(track)
    with progress_bar(quiet) as advance:
        export_track(loaded, out, to, lambda done, total: advance("export", done, total))
    if not quiet:
        typer.echo(f"Wrote {out}: {len(loaded)} frames")
