"""`sphereorient report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar, settings_of
from sphereorient.errors import TrackError, refusal

if TYPE_CHECKING:
    from sphereorient.trajectory import Trajectory


@app.command()
def report(
    tracks: Annotated[list[Path], typer.Argument(metavar="TRACK...", help="track.h5 of `sphereorient track`.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write: index.html, figures, tables.")],
    experiment: Annotated[
        list[Path] | None,
        typer.Option(help="experiment.yaml of a track, for pictures, the sphere's size and the flow; repeatable."),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="YAML as `sphereorient settings` writes it.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override one setting, e.g. --set statistics.min_frames=30.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, only warnings.")] = False,
) -> None:
    """Write statistics of tracks with error bars, figures, and a page with the findings."""
    check_writable(out)
    from sphereorient.experiment import load_experiment
    from sphereorient.report.build import write_report

    chosen = settings_of(settings, set_, "report").statistics
    known = [load_experiment(path) for path in experiment or ()]
    loaded = _load(tracks)
    command = " ".join(["sphereorient", *sys.argv[1:]])
    with progress_bar(quiet, unit="") as advance:
        words = write_report(loaded, out, experiments=known, settings=chosen, progress=advance, command=command)
    for verdict in words:
        doubt = verdict.grade == "doubt"
        if doubt or not quiet:
            typer.echo(f"{verdict.title}: {verdict.words}", err=doubt)
    if not quiet:
        typer.echo(f"Wrote {out / 'index.html'}")


def _load(paths: list[Path]) -> dict[str, Trajectory]:
    """Read the tracks; the name of each is the shortest unique end of its path."""
    from sphereorient.trajectory import Trajectory

    whole = [path.resolve() for path in paths]
    for path in whole:
        if whole.count(path) > 1:
            do = "name it once: twice it would count as new data"
            raise TrackError(refusal(str(path), expected="each track once", got="it twice", do=do))
    most = max(len(path.parts) for path in whole)
    ends = [0] * len(whole)
    for size in range(1, most + 1):
        names = ["/".join(path.parts[-size:]) for path in whole]
        ends = [end or (size if names.count(name) == 1 else 0) for end, name in zip(ends, names, strict=True)]
    return {"/".join(path.parts[-end:]): Trajectory.load(path) for path, end in zip(whole, ends, strict=True)}
