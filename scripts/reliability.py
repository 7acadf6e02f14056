"""Measure the calibration of a track's confidence, on scenes with several degradations at once.

    scripts/reliability.py [--scenes 96] [--jobs 2] [--out out/reliability]

Renders mixed scenes of the robustness benchmark (three degradations each, levels 1 to 5 in turn, seeds that the
benchmark does not use), tracks them with `precise`, and compares the confidence of each frame's orientation with
whether it is within 10 degrees of the truth. An interrupted run continues. A quarter of an hour on two cores.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from sphereorient.bench import BenchSettings, SceneResult
from sphereorient.bench.results import WRONG_DEG
from sphereorient.bench.run import CACHE, KEPT, kept_results, run_all, run_scene, trackers_of
from sphereorient.bench.scenes import TOGETHER, BenchmarkScene, scenes_of
from sphereorient.cli.app import progress_bar
from sphereorient.learn.metrics import reliability
from sphereorient.synth.severities import LEVELS

DOCS = Path(__file__).resolve().parents[1] / "docs"
METHOD = "precise"
FIRST_SEED = 500


def main() -> None:
    """Read the options, run, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=96)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=DOCS.parent / "out" / "reliability")
    options = parser.parse_args()
    scenes = mixed_scenes(options.scenes)
    (options.out / KEPT).mkdir(parents=True, exist_ok=True)
    places = [options.out / KEPT / f"{scene.name}.{METHOD}.json" for scene in scenes]
    missing = [scene for scene, place in zip(scenes, places, strict=True) if not place.exists()]
    tasks = [partial(run_scene, options.out, scene, trackers_of([METHOD])) for scene in missing]
    with progress_bar(unit="") as advance:
        run_all(
            tasks, options.out / CACHE, options.jobs, lambda left: advance("scenes", len(scenes) - left, len(scenes))
        )
    outcomes = [one for place in places for one in kept_results(place)]
    print_reliability(outcomes)


def mixed_scenes(count: int) -> list[BenchmarkScene]:
    """Return scenes of three degradations each, levels in turn."""
    found: list[BenchmarkScene] = []
    seed = FIRST_SEED
    while len(found) < count:
        found += [scene for scene in scenes_of(BenchSettings(levels=LEVELS, seeds=(seed,))) if scene.kind == TOGETHER]
        seed += 1
    return found[:count]


def print_reliability(outcomes: list[SceneResult]) -> None:
    """Print the reliability and the wrong scenes."""
    refused = [one for one in outcomes if one.refused]
    claimed, right = [], []
    for one in outcomes:
        for confidence, error in zip(one.confidence, one.errors_deg.tolist(), strict=True):
            if confidence is not None and np.isfinite(error):
                claimed.append(confidence)
                right.append(error <= WRONG_DEG)
    found = reliability(claimed, right)
    print(f"{len(outcomes)} scenes, {len(refused)} of them refused; {len(claimed)} frames with an orientation")
    print(f"within {WRONG_DEG:g} degrees: {np.mean(right):.4f}; mean confidence {np.mean(claimed):.4f}")
    print(f"expected calibration error {found.error:.4f}; by chance {found.chance:.4f}")
    print("confidence, share right (95 % interval), frames")
    for confidence, share, low, high, count in zip(
        found.probability, found.share, found.low, found.high, found.count, strict=True
    ):
        print(f"{confidence:8.4f} {share:8.4f} ({low:.4f} to {high:.4f}) {count:6d}")
    for one in outcomes:
        if one.wrong:
            print(f"{one.scene}: {one.wrong} wrong of {one.frames - one.lost}: {dict(one.degradations)}")


if __name__ == "__main__":
    main()
