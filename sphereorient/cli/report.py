"""`sphereorient report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar
from sphereorient.errors import TrackError, refusal

if TYPE_CHECKING:
    from sphereorient.report.verdicts import Verdict
    from sphereorient.trajectory import Trajectory


@app.command()
def report(
    tracks: Annotated[list[Path], typer.Argument(metavar="TRACK...", help="track.h5 of `sphereorient track`.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write: index.html, figures, tables.")],
    experiment: Annotated[
        list[Path] | None,
        typer.Option(
            help="experiment.yaml of a track: pictures of the frames, the sphere's size, the flow. Repeat it."
        ),
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="YAML as `sphereorient settings` writes it.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", help="Override one setting, e.g. --set statistics.min_frames=30.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, only what is in doubt.")] = False,
) -> None:
    """Turn tracks into statistics with error bars, figures, and one page to read them on."""
    check_writable(out)
    from sphereorient.experiment import load_experiment
    from sphereorient.methods.settings import load_settings
    from sphereorient.report.build import write_report

    chosen = load_settings(settings, set_ or []).statistics
    known = [load_experiment(path) for path in experiment or ()]
    loaded = _load(tracks)
    command = " ".join(["sphereorient", *sys.argv[1:]])
    with progress_bar(quiet, unit="") as advance:
        words = write_report(loaded, out, experiments=known, settings=chosen, progress=advance, command=command)
    _print(words, quiet)
    if not quiet:
        typer.echo(f"Wrote {out / 'index.html'}")


def _load(paths: list[Path]) -> dict[str, Trajectory]:
    """Read the tracks, each under the shortest end of its path that tells it from the others."""
    from sphereorient.trajectory import Trajectory

    whole = [path.resolve() for path in paths]
    for path in whole:
        if whole.count(path) > 1:
            do = "name it once: it would count as new evidence"
            raise TrackError(refusal(str(path), expected="each track once", got="it twice", do=do))
    most = max(len(path.parts) for path in whole)
    ends = [0] * len(whole)
    for size in range(1, most + 1):
        names = ["/".join(path.parts[-size:]) for path in whole]
        ends = [end or (size if names.count(name) == 1 else 0) for end, name in zip(ends, names, strict=True)]
    return {"/".join(path.parts[-end:]): Trajectory.load(path) for path, end in zip(whole, ends, strict=True)}


def _print(words: list[Verdict], quiet: bool) -> None:
    """Print the verdicts, those in doubt to stderr."""
    for verdict in words:
        doubt = verdict.grade == "doubt"
        if doubt or not quiet:
            typer.echo(f"{verdict.title}: {verdict.words}", err=doubt)
