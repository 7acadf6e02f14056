"""`sphereorient doctor`: what is installed, what this machine can do, and what is broken."""

import json
from typing import Annotated, Any

import typer
from typer import Option

from sphereorient.cli.app import app, print_table
from sphereorient.files.provenance import without_nan


@app.command()
def doctor(as_json: Annotated[bool, Option("--json", help="Print all of it as one JSON object.")] = False) -> None:
    """Tell what is installed, how fast a fit is here, which rates `live` can hold. Exit code 1: something is broken."""
    from sphereorient.files.provenance import lacking, package_faults, versions

    faults = package_faults()
    found: dict[str, Any] = {**versions(), "not_installed": lacking()}
    if not faults:  # else the rest could not be trusted, or not even be imported
        from sphereorient.bench.doctor import machine

        here, faults = machine()
        found |= here
    if as_json:
        typer.echo(json.dumps(without_nan({**found, "broken": faults}), indent=1))
    else:
        _print(found)
        for line in faults:
            typer.echo(f"broken: {line}", err=True)
    if faults:
        raise typer.Exit(1)


@app.command(hidden=True)
def info() -> None:
    """Do what `doctor` does, whose name this was."""
    typer.echo("note: `info` is called `doctor` now; its old name goes with the next version.", err=True)
    doctor(as_json=False)


def _print(found: dict[str, Any]) -> None:
    from rich.table import Table

    fits = found.pop("live_one_camera", [])
    for name, value in found.items():
        told = [f"{key}: {_words(one)}" for key, one in value.items()] if isinstance(value, dict) else [_words(value)]
        for words in told or ["none"]:
            typer.echo(f"{name.replace('_', ' '):24} {words}")
    if fits:
        table = Table(*fits[0], title="live, one camera: time of a frame, and the rates that can be held")
        for fit in fits:
            table.add_row(*(f"{number:.3g}" for number in fit.values()))
        print_table(table)
        typer.echo(f"now: as busy as the machine is, {found['free_cores']} of {found['cores']} cores free.")


def _words(value: Any) -> str:
    return (", ".join(value) if isinstance(value, list) else str(value if value is not None else "")) or "none"
