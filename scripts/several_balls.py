"""Measure tracks of several balls, with their maps and with maps learnt from the movie: the table of docs/tracking.md.

    scripts/several_balls.py FOLDER

The folder holds experiment.yaml and truth.h5. Balls with one map are named as is best for their positions. With learnt
maps all balls are, and a constant rotation of each ball's body axes is removed. Prints one Markdown table of the worst
ball, and a line with the median error of each. A quarter of an hour on one core.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sphereorient.bench.score import given_to_others, named_as_true, score_track
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.methods.map import learn_map
from sphereorient.report.texture_map import write_texture
from sphereorient.run.stages import track_movies

COLUMNS = (
    "cameras",
    "worst ball: orientation p50 / p95 / max",
    "position p50 / p95",
    "errors over sigmas",
    "valid",
    "frames given to another ball",
)


def main() -> None:
    """Track with each choice of cameras, and with learnt maps; print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    experiment, truth = load_experiment(options.folder / "experiment.yaml"), options.folder / "truth.h5"
    cameras = list(experiment.cameras)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    medians = {}
    for count in (3, 2, 1):
        names = cameras[:count]
        medians[", ".join(names)] = measured(experiment, truth, names, alike(experiment), ", ".join(names))
    with tempfile.TemporaryDirectory() as name:
        learnt = with_learnt_maps(experiment, Path(name))
        label = "all, with learnt maps"
        medians[label] = measured(learnt, truth, cameras, experiment.names, label, "body")
    for label, found in medians.items():
        print(f"\n{label}: median error of each ball " + ", ".join(f"{median:.3f}" for median in found))


def alike(experiment: Experiment) -> list[str]:
    """Return the names of balls that share a map with another."""
    maps = [sphere.texture_path for sphere in experiment.spheres]
    return [sphere.name for sphere in experiment.spheres if maps.count(sphere.texture_path) > 1]


def with_learnt_maps(experiment: Experiment, folder: Path) -> Experiment:
    """Learn the maps from the movie alone; return the experiment with them."""
    spheres = []
    found = learn_map(experiment)
    for sphere in experiment.spheres:
        one = found[sphere.name]
        path = folder / f"{one.paint_of}.png"
        write_texture(one.texture, path)
        spheres.append(replace(sphere, texture_path=path))
    return replace(experiment, spheres=tuple(spheres))


def measured(
    experiment: Experiment,
    truth: Path,
    cameras: Sequence[str],
    exchanged: Sequence[str],
    label: str,
    align: str = "none",
) -> list[float]:
    """Track, print a row; return the median error of each ball, degrees."""
    tracks = named_as_true(track_movies(experiment, cameras=cameras), truth, exchanged)
    scores = [score_track(track, truth, align) for track in tracks.values()]
    worst_deg = max((score.percentiles_deg() for score in scores), key=lambda found: found[0])
    worst_mm = max((score.percentiles_mm() for score in scores), key=lambda found: found[0])
    over = zip(*(score.over_stated() for score in scores), strict=True)  # orientations, positions
    valid, frames = sum(int(score.valid.sum()) for score in scores), sum(score.frames for score in scores)
    cells = [
        label,
        " / ".join(f"{value:.3f}" for value in worst_deg[[0, 1, 3]]),
        " / ".join(f"{value:.4f}" for value in worst_mm[:2]),
        ", ".join(f"{min(found):.2f} to {max(found):.2f}" for found in over),
        "all" if valid == frames else f"{valid} of {frames}",
        str(sum(count for count, _ in given_to_others(tracks, truth).values())),
    ]
    print("| " + " | ".join(cells) + " |", flush=True)
    return [float(score.percentiles_deg()[0]) for score in scores]


if __name__ == "__main__":
    main()
