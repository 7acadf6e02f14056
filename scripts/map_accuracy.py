"""How good are maps learnt from movies alone: the table of docs/map.md, time and peak memory of each beside it.

    scripts/map_accuracy.py [--shared ../shared] [--work FOLDER] [--only synth_dots experiment] [--set paint.rounds=8]

Two synthetic movies of other paints, which this script renders; and the shared experiment, its camera cam1 alone, and
the ball fixed in its place, where they are there. Each movie goes through `sphereorient map`, and with the map learnt
through `sphereorient track`: processes of their own, one thread. The map is compared with the exact one by our own
`compare_maps` and, where it is there, by the shared score_map.py. Prints one Markdown table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.experiment import load_experiment, write_experiment
from sphereorient.paint.compare import compare_maps
from sphereorient.report.map_files import read_seen, seen_path, shares_seen
from sphereorient.sphere import load_texture
from sphereorient.synth import SynthSettings
from sphereorient.synth import write_experiment as render
from sphereorient.trajectory import Trajectory

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
OFTEN = 10  # pictures from which on a place counts as well seen
# Both show the ball from all sides within 240 frames.
SCENE = SynthSettings(frames=240, image_size=(360, 360), volume_mm=30.0, omega_rms=16.0, omega_time=0.06)
SYNTHETIC = {"synth_patches": ("patches", 4), "synth_dots": ("dots", 3)}  # paint and seed
COLUMNS = (
    "movie",
    "attitudes learnt with the map, p50 / p95 (°)",
    "tracked with the map, p50 / p95 (°)",
    "step p50 (°)",
    f"sphere seen >= {OFTEN} times",
    "paint displaced, rms / p50 / max (°), patches",
    "score_map.py: rms / p50 (°), patches",
    "map: CPU s, per frame, GB",
    "wall s",
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One movie to learn from."""

    name: str
    experiment: Path
    cameras: str | None = None
    both: bool = False  # whether a constant rotation is removed on both sides; else of the body frame alone
    tracked: bool = True


@dataclass(frozen=True, kw_only=True)
class Usage:
    """What a process took."""

    wall_s: float
    cpu_s: float
    memory_gb: float


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--work", type=Path, help="keep all files here")
    parser.add_argument("--only", nargs="+", help="these rows only, e.g. synth_dots experiment")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary) if options.work is None else options.work
        work.mkdir(parents=True, exist_ok=True)
        for name in [*SYNTHETIC, "experiment", "experiment_cam1", "fixed_ball"]:
            if options.only and name not in options.only:
                continue
            case = case_of(name, work, options.shared)
            if case is None:
                print(f"| {name} | not here: skipped |" + " |" * (len(COLUMNS) - 2), flush=True)
            else:
                print(row(case, work, options.shared / "score_map.py", options.overrides), flush=True)


def case_of(name: str, work: Path, shared: Path) -> Case | None:
    """Return a row's movie, rendered where it is synthetic; None where there is none."""
    if name in SYNTHETIC:
        kind, seed = SYNTHETIC[name]
        path = work / f"{name}_scene" / "experiment.yaml"
        if not path.is_file():
            render(path.parent, SCENE.model_copy(update={"texture": kind, "seed": seed}))
        return Case(name=name, experiment=path)
    path = shared / name.removesuffix("_cam1") / "experiment.yaml"
    if not path.is_file():
        return None
    fixed = name == "fixed_ball"
    camera = "cam1" if name.endswith("_cam1") else None
    return Case(name=name, experiment=path, cameras=camera, both=fixed, tracked=not fixed)


def row(case: Case, work: Path, yardstick: Path, overrides: list[str]) -> str:
    """Learn, track, compare, and word it."""
    texture = work / f"{case.name}.png"
    chosen = [word for override in overrides for word in ("--set", override)]
    learnt = run("map", withheld(case.experiment, None, work / f"{case.name}_bare.yaml"), texture, case.cameras, chosen)
    true_R = truth(case.experiment.parent / "truth.h5")
    R = attitudes(texture.with_name(f"{case.name}_map.h5"))
    tracked, steps = "", aligned(R, true_R, case.both)
    if case.tracked:
        track = work / f"{case.name}_track.h5"
        run("track", withheld(case.experiment, texture, work / f"{case.name}_painted.yaml"), track, case.cameras, [])
        steps = aligned(attitudes(track), true_R, case.both)
        tracked = percentiles(angles_deg(*steps))
    step = angles_deg(steps[0][1:] @ steps[0][:-1].mT, steps[1][1:] @ steps[1][:-1].mT).nanmedian()
    seen = read_seen(seen_path(texture))
    cells = [
        case.name,
        percentiles(angles_deg(*aligned(R, true_R, case.both))),
        tracked,
        f"{float(step):.3f}",
        "" if seen is None else f"{100 * shares_seen(seen, (OFTEN,))[0]:.1f} %",
        *displaced(texture, load_experiment(case.experiment).texture_path, yardstick),
        f"{learnt.cpu_s:.0f}, {learnt.cpu_s / len(true_R):.2f}, {learnt.memory_gb:.1f}",
        f"{learnt.wall_s:.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


def withheld(source: Path, texture: Path | None, path: Path) -> Path:
    """Write an experiment again with another map or none, and return where."""
    return write_experiment(replace(load_experiment(source), path=path, texture_path=texture))


def run(command: str, experiment: Path, out: Path, cameras: str | None, more: list[str]) -> Usage:
    """Run one command of ours to its end, on one thread."""
    words = [sys.executable, "-m", "sphereorient.cli", command, str(experiment), "--out", str(out), "--quiet", *more]
    words += [] if cameras is None else ["--cameras", cameras]
    begun = time.perf_counter()
    process = subprocess.Popen(words, env={**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"})
    # wait4 tells the peak of this one child.
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)}: failed")
    return Usage(
        wall_s=time.perf_counter() - begun, cpu_s=usage.ru_utime + usage.ru_stime, memory_gb=usage.ru_maxrss / 1e6
    )


def truth(path: Path) -> Tensor:
    """Read the true attitudes, (N, 3, 3)."""
    with h5py.File(path) as file:
        return torch.from_numpy(file["orientation"][()])


def attitudes(path: Path) -> Tensor:
    """Read a track's attitudes, (N, 3, 3), NaN where they are not valid."""
    track = Trajectory.load(path)
    return torch.from_numpy(np.where(track.valid[:, None, None], track.orientation, np.nan))


def aligned(R: Tensor, true_R: Tensor, both: bool) -> tuple[Tensor, Tensor]:
    """Return P R Q nearest to the truth, P the identity unless `both`; and the truth."""
    known = torch.isfinite(R).flatten(1).all(1)
    P = Q = torch.eye(3, dtype=torch.float64)
    for _ in range(100 if both else 1):
        Q = so3.nearest_rotation(((P @ R[known]).mT @ true_R[known]).mean(0))
        P = so3.nearest_rotation((true_R[known] @ (R[known] @ Q).mT).mean(0)) if both else P
    return P @ R @ Q, true_R


def angles_deg(R: Tensor, S: Tensor) -> Tensor:
    """Return the angles between rotations (N, 3, 3), degrees."""
    return torch.rad2deg(so3.geodesic_distance(R, S))


def percentiles(angle_deg: Tensor) -> str:
    """Word median and 95th percentile, and how many frames have none."""
    known = angle_deg[torch.isfinite(angle_deg)]
    words = f"{float(known.quantile(0.5)):.3f} / {float(known.quantile(0.95)):.3f}"
    return words if len(known) == len(angle_deg) else f"{words} ({len(angle_deg) - len(known)} frames without)"


def displaced(texture: Path, true: Path | None, yardstick: Path) -> list[str]:
    """Word how far paint lies from where it is: by our own measure, and by the shared one."""
    if true is None:
        return ["no true map", ""]
    seen = read_seen(seen_path(texture))
    learnt = load_texture(texture)
    learnt = learnt if seen is None else torch.where(seen >= OFTEN, learnt, torch.nan)
    try:
        comparison = compare_maps(learnt, load_texture(true))
        off = torch.rad2deg(comparison.length_rad)
        rms = float(np.rad2deg(comparison.rms_rad))
        own = f"{rms:.3f} / {float(off.median()):.3f} / {float(off.max()):.3f}, {len(off)}"
    except PaintError as error:
        own = str(error)
    if not yardstick.is_file():
        return [own, ""]
    words = [sys.executable, str(yardstick), str(texture), str(true), "--seen", str(seen_path(texture))]
    told = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    rms, p50, used = told["distortion_rms_deg"], told["distortion_p50_deg"], told["patches_used"]
    return [own, f"{rms:.3f} / {p50:.3f}, {used}"]


if __name__ == "__main__":
    main()
