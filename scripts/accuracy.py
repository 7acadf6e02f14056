"""Measure the errors of docs/accuracy.md: a method against exact truth.

    scripts/accuracy.py EXPERIMENT_FOLDER [...] [--method precise] [--no-synth] [--windows 48]
                        [--benchmark RESULTS.json]

Each folder holds experiment.yaml and truth.h5. Tracks it with all cameras and with each alone; then three synthetic
movies of other paints (seeded). Prints one Markdown table. With `paper` the table has more columns, rms values over
those of the truth: the errors that the kernels cause in the rates, the noise, the stated sigmas. A sentence states the
share of frames inside the stated errors, of these movies and of the scenes of a robustness benchmark. A second table
lists the scenes with fewer than 95 %.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import torch

from sphereorient.bench import Score, score_track
from sphereorient.bench.results import SceneResult, load_results, summarised
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.methods.settings import DEFAULT_METHOD
from sphereorient.motion import MotionSettings, datasets_of, measure_motion
from sphereorient.run.stages import track_movies
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Trajectory

COLUMNS = (
    "movie",
    "valid",
    "orientation p50 / p95 / max (°)",
    "rms (°)",
    "position p50 / p95 (mm)",
    "omega lab",
    "alpha lab",
    "velocity",
    "over the stated errors, rms",
    "in the stated 95 %",
    "s",
)
PARTS = ("velocity", "acceleration", "omega_lab", "alpha_lab")
PAPER = tuple(f"{'/'.join(PARTS)} {part}" for part in ("by kernels", "by noise", "by sigmas", "of the track"))
PAPER += ("smooth orientation (°) / position (mm), rms",)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--method", default=DEFAULT_METHOD)
    parser.add_argument("--no-synth", action="store_true")
    parser.add_argument("--benchmark", type=Path, help="results.json of `sphereorient bench robustness`")
    parser.add_argument("--windows", type=int, help="track parts of this many frames, all cameras only")
    arguments = parser.parse_args()
    columns = COLUMNS + PAPER * (arguments.method == "paper")
    print("| " + " | ".join(columns) + " |\n|" + "---|" * len(columns))
    stated = []
    for folder in arguments.folders:
        experiment = load_experiment(folder / "experiment.yaml")
        names = list(experiment.cameras)
        if arguments.windows is not None:
            stated += windows(folder, experiment, arguments.windows, arguments.method)
            continue
        for cameras in [names] + ([[name] for name in names] if len(names) > 1 else []):
            stated.append(measured(folder, f"{folder.name}, {' + '.join(cameras)}", cameras, arguments.method))
    if not arguments.no_synth:
        for seed, texture in enumerate(("blobs", "patches", "dots"), 1):
            with tempfile.TemporaryDirectory() as name:
                write_synthetic_experiment(Path(name), SynthSettings.model_validate({"texture": texture, "seed": seed}))
                stated.append(measured(Path(name), f"synthetic, {texture}", ("cam1", "cam2"), arguments.method))
    print(honesty(stated, of_benchmark(arguments.benchmark, arguments.method) if arguments.benchmark else []))


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Agreement of a track's stated errors with its errors."""

    pictures: str
    frames: int  # with a stated error of the orientation
    inside: int  # of these, with the truth in the stated 95 % region
    over: float  # rms error over the stated sigmas


def honesty(movies: Sequence[Stated], cells: Sequence[Stated]) -> str:
    """Return the share of truths inside as a sentence, and a table of the benchmark's cells with fewer than 95 %."""
    frames, inside = (sum(getattr(one, key) for one in (*movies, *cells)) for key in ("frames", "inside"))
    lines = ["", f"**{100 * inside / max(frames, 1):.1f} % of {frames} truths lie in the stated 95 %.**"]
    low = [one for one in cells if one.inside < 0.95 * one.frames]
    if cells:
        head = (
            "",
            f"Fewer than 95 % in {len(low)} of {sum(one.frames > 0 for one in cells)} cells of the benchmark:",
            "",
        )
        lines += [*head, "| degradation | in the stated 95 % | errors over the stated ones, rms |", "|---|---|---|"]
    lines += [f"| {one.pictures} | {100 * one.inside / one.frames:.0f} % | {one.over:.2f} |" for one in low]
    return "\n".join(lines)


def of_benchmark(results: Path, method: str) -> list[Stated]:
    """Return the agreement of stated errors for each degradation and level, over all seeds."""
    found = load_results(results)
    cells: dict[tuple[str, int], list[SceneResult]] = {}
    for one in found.outcomes:
        if one.method == method:
            cells.setdefault((one.kind, one.level), []).append(one)
    return [
        Stated(
            pictures=f"{kind.replace('_', ' ')}, level {level}",
            frames=sum(one.stated for one in group),
            inside=sum(one.inside for one in group),
            over=summarised(group).over_stated,
        )
        for (kind, level), group in cells.items()
    ]


def windows(folder: Path, experiment: Experiment, count: int, method: str) -> list[Stated]:
    """Measure parts of a movie, each of `count` frames."""
    with h5py.File(folder / "truth.h5") as file:
        frames = len(file["time"])
    return [
        measured(folder, f"{folder.name}, {a}:{a + count}", list(experiment.cameras), method, (a, a + count))
        for a in range(0, frames - count + 1, count)
    ]


def measured(
    folder: Path, label: str, cameras: Sequence[str], method: str, frames: tuple[int, int] | None = None
) -> Stated:
    """Track one movie, print its errors as a row of the table, and return the agreement of its stated errors."""
    experiment = replace(load_experiment(folder / "experiment.yaml"), frames=frames)
    begin = time.perf_counter()
    track = track_movies(experiment, method=method, cameras=cameras)
    seconds = time.perf_counter() - begin
    score = score_track(track, folder / "truth.h5")
    inside, count = score.inside()
    error = score.orientation_deg[score.valid]
    position = score.percentiles_mm()
    cells = [
        label,
        f"{score.valid.sum()}" if score.valid.all() else f"{score.valid.sum()} of {score.frames}",
        " / ".join(f"{value:.3f}" for value in np.delete(score.percentiles_deg(), 2)),  # without 99 %
        f"{np.sqrt(np.mean(error**2)):.3f}",
        f"{position[0]:.4f} / {position[1]:.4f}" if len(cameras) == 2 else "",
        _share(score, "omega_lab"),
        _share(score, "alpha_lab"),
        _share(score, "velocity") if len(cameras) == 2 else "",
        " / ".join(f"{value:.2f}" if np.isfinite(value) else "–" for value in score.over_stated()),
        f"{inside}" if inside == count else f"{inside} of {count}",
        f"{seconds:.0f}",
    ]
    if method == "paper":
        cells += parts(track, folder / "truth.h5") if len(cameras) == 2 else [""] * len(PAPER)
    print("| " + " | ".join(cells) + " |", flush=True)
    return Stated(pictures=label, frames=count, inside=inside, over=score.over_stated()[0])


def parts(track: Trajectory, truth_path: Path) -> list[str]:
    """Return rms values of PARTS over the truth's: errors by kernels, noise, stated sigmas, rates; smooth poses."""
    with h5py.File(truth_path) as file:
        true = {name: file[name][: len(track)] for name in ("position", "orientation", *PARTS)}
    position, R, segment = (torch.from_numpy(x) for x in (true["position"], true["orientation"], track.segment))
    ideal = datasets_of(measure_motion(position, R, segment, track.frame_rate, MotionSettings()))
    shares = []
    for key in PARTS:
        x, sigma = getattr(track, key), getattr(track, f"{key}_sigma")
        known = np.isfinite(x + ideal[key]).all(1)
        whole = np.linalg.norm(true[key][known])
        shares.append([np.linalg.norm(y[known]) / whole for y in (ideal[key] - true[key], x - ideal[key], sigma, x)])
    smooth = score_track(
        replace(track, position=track.position_smooth, orientation=track.orientation_smooth), truth_path
    )
    poses = (np.sqrt(np.nanmean(np.square(error))) for error in (smooth.orientation_deg, smooth.position_mm))
    words = [" / ".join(f"{share:.3f}" for share in row) for row in zip(*shares, strict=True)]
    return [*words, " / ".join(f"{error:.3f}" for error in poses)]


def _share(score: Score, key: str) -> str:
    known = f" ({100 * score.coverage[key]:.0f} %)" if score.coverage[key] < 0.995 else ""
    return f"{score.relative_rms[key]:.4f}{known}"


if __name__ == "__main__":
    main()
