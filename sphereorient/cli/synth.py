"""`sphereorient synth`."""

from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import app, check_writable, progress_bar


@app.command()
def synth(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write the experiment into.")],
    settings: Annotated[Path | None, typer.Option(help="YAML with keys of configs/synth.yaml.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="Override one key, e.g. --set frames=60.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
) -> None:
    """Render an experiment of two cameras with exact truth."""
    check_writable(out)
    from sphereorient.methods.settings import load_synth_settings
    from sphereorient.synth import write_synthetic_experiment

    chosen = load_synth_settings(settings, set_ or [])
    total = 2 * chosen.frames
    with progress_bar(quiet) as advance:
        done = 0

        def rendered(count: int) -> None:
            nonlocal done
            done += count
            advance("render", done, total)

        path = write_synthetic_experiment(out, chosen, rendered)
    if not quiet:
        typer.echo(f"Wrote {path}. Next: sphereorient track {path} --out {out / 'track.h5'}")
