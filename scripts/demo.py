"""Track the bundled excerpt, compare it with its exact truth, and draw what came out.

scripts/demo.py [--out out/demo]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from demo_figure import demo_figure
from rich.console import Console
from rich.table import Table

from sphereorient.cli.app import progress_bar
from sphereorient.evaluate import Score, score_track
from sphereorient.experiment import load_experiment
from sphereorient.run.track import track_movies

REPO = Path(__file__).resolve().parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=REPO / "out" / "demo")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    excerpt = REPO / "synthetic_data" / "excerpt"
    experiment = load_experiment(excerpt / "experiment.yaml")
    with progress_bar() as advance:
        track = track_movies(experiment, progress=advance, command="scripts/demo.py")
    track.save(out / "track.h5")
    score = score_track(track, excerpt / "truth.h5")
    Console().print(error_table(score))
    demo_figure(track, experiment, out / "demo.png", score)
    print(f"Track: {out / 'track.h5'}\nPicture: {out / 'demo.png'}")


def error_table(score: Score) -> Table:
    """The errors that a user asks for first."""
    title = f"Errors against the exact truth, {score.valid.sum()} of {score.frames} frames valid"
    table = Table("quantity", "median", "95 %", "largest", title=title)
    p50, p95, _, largest = score.percentiles_deg()
    table.add_row("orientation (degrees)", f"{p50:.3f}", f"{p95:.3f}", f"{largest:.3f}")
    p50, p95, _, largest = score.percentiles_mm()
    table.add_row("position (mm)", f"{p50:.4f}", f"{p95:.4f}", f"{largest:.4f}")
    table.add_section()
    table.add_row("quantity", "rms error / rms", "frames", "", style="bold")
    for key in ("velocity", "omega_lab", "omega_body"):
        table.add_row(key, f"{100 * score.relative_rms[key]:.2f} %", f"{100 * score.coverage[key]:.0f} %", "")
    return table


if __name__ == "__main__":
    main()
