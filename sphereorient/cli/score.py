"""`sphereorient score`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app

if TYPE_CHECKING:
    from rich.table import Table

    from sphereorient.evaluate import Score


@app.command()
def score(
    track: Annotated[Path, typer.Argument(metavar="TRACK", help="track.h5 of `sphereorient track`.")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="truth.h5 of the synthetic experiment.")],
) -> None:
    """Print the errors of a track against the exact truth of a synthetic experiment."""
    from rich.console import Console

    from sphereorient.evaluate import score_track
    from sphereorient.trajectory import Trajectory

    Console().print(error_table(score_track(Trajectory.load(track), truth)))


def error_table(found: Score) -> Table:
    """Return errors of orientation and position, and relative errors of the rates, as a table."""
    from rich.table import Table

    title = f"Errors against the exact truth, {found.valid.sum()} of {found.frames} frames valid"
    table = Table("quantity", "median", "95 %", "largest", title=title)
    p50, p95, _, largest = found.percentiles_deg()
    table.add_row("orientation (degrees)", f"{p50:.3f}", f"{p95:.3f}", f"{largest:.3f}")
    p50, p95, _, largest = found.percentiles_mm()
    table.add_row("position (mm)", f"{p50:.4f}", f"{p95:.4f}", f"{largest:.4f}")
    table.add_section()
    table.add_row("quantity", "rms error / rms", "frames", "", style="bold")
    for key in ("velocity", "omega_lab", "omega_body"):
        table.add_row(key, f"{100 * found.relative_rms[key]:.2f} %", f"{100 * found.coverage[key]:.0f} %", "")
    return table
