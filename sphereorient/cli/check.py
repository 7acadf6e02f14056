"""`sphereorient check`."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, check_writable, echo_lines, progress_bar
from sphereorient.cli.options import ExperimentPath, Overrides, SettingsPath
from sphereorient.files.outputs import put_aside

if TYPE_CHECKING:
    from sphereorient.preflight import Finding

EXIT_FAULT = 1  # a run fails, or its numbers are wrong
COLOURS = {"ok": typer.colors.GREEN, "warning": typer.colors.YELLOW, "fault": typer.colors.RED}
MARK, TITLE = 9, 25  # columns of the list


@app.command()
def check(
    experiment: ExperimentPath,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Figure to write (.png, .pdf); EXPERIMENT.check.png here without it."),
    ] = None,
    settings: SettingsPath = None,
    set_: Overrides = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and only warnings and faults.")] = False,
) -> None:
    """Check an experiment in seconds before tracking: findings, and what to do. Exit code 1: there is a fault."""
    picture = Path(f"{experiment.stem}.check.png") if out is None else out
    check_writable(picture)
    from sphereorient.methods.settings import load_settings
    from sphereorient.preflight import Severity, preflight
    from sphereorient.report import preflight_figure

    chosen = load_settings(settings, set_ or [])
    with progress_bar(quiet) as advance:
        result = preflight(experiment, chosen, advance)
        advance("figure", 0, 1)
        with put_aside(picture) as partial:
            preflight_figure(result, partial)
        advance("figure", 1, 1)
    _print(result.findings, quiet)
    if not quiet:
        counts = [sum(one.severity is severity for one in result.findings) for severity in Severity]
        typer.echo(f"faults: {counts[2]}, warnings: {counts[1]}, without complaint: {counts[0]}. Wrote {picture}")
    if result.severity is Severity.FAULT:
        raise typer.Exit(EXIT_FAULT)


def _print(findings: Sequence[Finding], quiet: bool) -> None:
    """Print a paragraph for each finding: mark, title, measurement; below it the advice."""
    width = max(60, shutil.get_terminal_size().columns)
    margin = " " * (MARK + TITLE)
    for finding in findings:
        if quiet and finding.severity == "ok":
            continue
        mark = typer.style(f"{finding.severity:{MARK}}", fg=COLOURS[finding.severity], bold=finding.severity != "ok")
        measured = textwrap.wrap(finding.measured, width - len(margin)) or [""]
        advice = f"do: {finding.advice}" if finding.advice else ""
        typer.echo(f"{mark}{finding.title:{TITLE}}{measured[0]}")
        below = measured[1:] + textwrap.wrap(advice, width - len(margin), subsequent_indent="    ")
        echo_lines(margin + line for line in below)
