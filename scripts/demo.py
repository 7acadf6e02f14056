"""Track the bundled excerpt, compare it with its exact truth, and draw the result.

scripts/demo.py [--out out/demo]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from demo_figure import demo_figure
from rich.console import Console

from sphereorient.bench import score_track
from sphereorient.cli.app import progress_bar
from sphereorient.cli.bench import error_table
from sphereorient.experiment import load_experiment
from sphereorient.run.stages import track_movies

REPO = Path(__file__).resolve().parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=REPO / "out" / "demo")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    excerpt = REPO / "synthetic_data" / "excerpt"
    experiment = load_experiment(excerpt / "experiment.yaml")
    with progress_bar() as advance:
        track = track_movies(experiment, progress=advance)
    track.save(out / "track.h5")
    score = score_track(track, excerpt / "truth.h5")
    Console().print(error_table(score))
    demo_figure(track, experiment, out / "demo.png", score)
    print(f"Track: {out / 'track.h5'}\nPicture: {out / 'demo.png'}")


if __name__ == "__main__":
    main()
