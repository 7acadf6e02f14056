"""`sphereorient track`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import ExperimentPath, app, check_writable, progress_bar

if TYPE_CHECKING:
    from sphereorient.trajectory import Trajectory


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
    check_writable(out)
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
