"""`sphereorient settings` and `info`."""

import os
from pathlib import Path
from typing import Annotated

import typer

from sphereorient.cli.app import app, check_writable
from sphereorient.files.outputs import put_aside


@app.command()
def settings(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write; the screen without it.")] = None,
) -> None:
    """Write all settings of the methods with defaults and explanations."""
    from sphereorient.methods.settings import settings_yaml

    if out is None:
        typer.echo(settings_yaml())
        return
    check_writable(out)
    with put_aside(out) as aside:
        aside.write_text(settings_yaml(), encoding="utf-8")


@app.command()
def info() -> None:
    """Print versions, threads and device."""
    import torch

    from sphereorient.files.provenance import versions

    for package, number in versions().items():
        typer.echo(f"{package:24} {number}")
    typer.echo(f"{'threads':24} {torch.get_num_threads()} of {os.cpu_count()} cores")
    device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu (no GPU found)"
    typer.echo(f"{'device':24} {device}")
