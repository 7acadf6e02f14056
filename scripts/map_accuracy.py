"""Measure maps learnt from movies alone: the table of docs/map.md, with time and peak memory.

    scripts/map_accuracy.py [--shared ../shared] [--work FOLDER] [--only synth_dots experiment] [--set paint.rounds=8]

Movies: two synthetic ones of other paints, rendered here; and, where they are there, the shared experiment, its camera
cam1 alone, and the fixed ball. `sphereorient map` learns each map and `sphereorient track` tracks with it, in processes
of their own, one thread. The map is compared with the exact one by the shared score_map.py, or, if that is not there,
by our `compare_maps`. Prints one Markdown table; after the row of the fixed ball a second one, with FicTrac's result on
the same movie beside ours; then a third one, of the shared experiment with a warped map, corrected by `map --init`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import torch
from experiment_file import write_experiment
from figure_map import warped
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.experiment import load_experiment
from sphereorient.report.texture_map import shares_seen, write_texture
from sphereorient.sphere import load_texture, read_seen, seen_path
from sphereorient.sphere.compare import compare_maps
from sphereorient.synth import SynthSettings
from sphereorient.synth import write_synthetic_experiment as render
from sphereorient.trajectory import Trajectory

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
OFTEN = 10  # pictures from which on a place counts as well seen
# Both show the ball from all sides within 240 frames.
SCENE = SynthSettings(frames=240, image_size=(360, 360), volume_mm=30.0, omega_rms=16.0, omega_time=0.06)
SYNTHETIC = {"synth_patches": ("patches", 4), "synth_dots": ("dots", 3)}  # paint and seed
MOVIES = {
    "experiment": "shared `experiment`, its map withheld, 240 frames of two cameras",
    "experiment_cam1": "its camera `cam1` alone",
    "synth_patches": "rendered, patches, 240 frames",
    "synth_dots": "rendered, dots, 240 frames",
    "fixed_ball": "shared `fixed_ball`: one camera, ball of unknown size in one place, 250 frames",
}
COLUMNS = (
    "movie",
    "attitudes learnt with the map, median / 95 %",
    "tracked with the map",
    f"seen {OFTEN} times",
    "texture displaced, rms / median",
    "`map`: CPU s, per frame, GB",
)
OLD, OLD_COLUMNS = "old", ("map", "texture displaced, rms / median", "orientation, median / 95 %")
BESIDE = ("program", "absolute error, median / 95 %", "step error, median", "CPU s per frame", "memory, GB")
# Its q_factor, and CPU s per frame on movies of this kind, measured on the same kind of machine (shared
# docs/ANCHORS.md, 2.1); its memory was not.
FICTRAC = {6: "0.007", 10: "0.012 to 0.014"}


@dataclass(frozen=True, kw_only=True)
class Case:
    """One movie to learn from."""

    name: str
    experiment: Path
    cameras: str | None = None
    both: bool = False  # whether a constant rotation is removed on both sides; else of the body frame alone


@dataclass(frozen=True, kw_only=True)
class Usage:
    """Time and memory of a process."""

    cpu_s: float
    memory_gb: float

    def words(self, frames: int) -> list[str]:
        """Return CPU s per frame, and GB."""
        return [f"{self.cpu_s / frames:.2g}", f"{self.memory_gb:.1f}"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Attitudes:
    """Measured orientations of one program and the truth."""

    R: Tensor  # (N, 3, 3), the arbitrary rotations removed; NaN: none
    R_true: Tensor  # (N, 3, 3)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.R_true)

    @property
    def errors_deg(self) -> Tensor:
        """Angles to the truth, (N,)."""
        return angles_deg(self.R, self.R_true)

    @property
    def step_deg(self) -> float:
        """Median error of the rotation from frame to frame."""
        return float(angles_deg(self.R[1:] @ self.R[:-1].mT, self.R_true[1:] @ self.R_true[:-1].mT).nanmedian())


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """Results of one movie and their cost; made by `measured`."""

    case: Case
    texture: Path
    learnt: Attitudes  # with the map
    learning: Usage
    tracked: Attitudes  # with the map learnt
    tracking: Usage


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=SHARED)
    parser.add_argument("--work", type=Path, help="keep all files here")
    parser.add_argument("--only", nargs="+", help="these movies only, e.g. synth_dots experiment; old: the third table")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS), flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary) if options.work is None else options.work
        work.mkdir(parents=True, exist_ok=True)
        for name in MOVIES:
            if options.only and name not in options.only:
                continue
            case = case_of(name, work, options.shared)
            if case is None:
                print(f"| {MOVIES[name]} | not here: skipped |" + " |" * (len(COLUMNS) - 2), flush=True)
                continue
            row = measured(case, work, options.overrides)
            print(row_text(row, options.shared / "score_map.py"), flush=True)
            if case.both:
                print("\n" + beside_fictrac(row) + "\n", flush=True)
        old = case_of("experiment", work, options.shared)
        if old is not None and (not options.only or OLD in options.only):
            print("\n" + corrected(old, work, options.shared / "score_map.py"), flush=True)


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
    return Case(name=name, experiment=path, cameras=camera, both=fixed)


def measured(case: Case, work: Path, overrides: list[str]) -> Row:
    """Learn the map, and track with it."""
    texture, track = work / f"{case.name}.png", work / f"{case.name}_track.h5"
    chosen = [word for override in overrides for word in ("--set", override)]
    bare = withheld(case.experiment, None, work / f"{case.name}_bare.yaml")
    learning = run("map", bare, texture, case.cameras, chosen)
    painted = withheld(case.experiment, texture, work / f"{case.name}_painted.yaml")
    tracking = run("track", painted, track, case.cameras, [])
    R_true = truth(case.experiment.parent / "truth.h5")
    learnt, tracked = (
        Attitudes(R=aligned(attitudes(path), R_true, case.both), R_true=R_true)
        for path in (texture.with_name(f"{case.name}_map.h5"), track)
    )
    return Row(case=case, texture=texture, learnt=learnt, learning=learning, tracked=tracked, tracking=tracking)


def row_text(row: Row, yardstick: Path) -> str:
    """Return the row of one movie."""
    case, frames = row.case, len(row.learnt)
    seen = read_seen(seen_path(row.texture))
    cells = [
        MOVIES[case.name],
        percentiles(row.learnt.errors_deg),
        percentiles(row.tracked.errors_deg),
        "" if seen is None else f"{100 * shares_seen(seen, (OFTEN,))[0]:.0f} %",
        displaced(row.texture, load_experiment(case.experiment).texture_path, yardstick),
        ", ".join([f"{row.learning.cpu_s:.0f}", *row.learning.words(frames)]),
    ]
    return "| " + " | ".join(cells) + " |"


def corrected(case: Case, work: Path, yardstick: Path) -> str:
    """Return the table of a warped map, the map that `map --init` makes of it, and the exact one."""
    exact = load_experiment(case.experiment).texture_path
    maps = {"warped": work / "warped.png", "corrected by `map --init`": work / "corrected.png", "exact": exact}
    warped_path, corrected_path, _ = maps.values()
    write_texture(warped(load_texture(exact)), warped_path)
    bare = withheld(case.experiment, None, work / "old_bare.yaml")
    run("map", bare, corrected_path, None, ["--init", str(warped_path)])
    R_true = truth(case.experiment.parent / "truth.h5")
    lines = ["| " + " | ".join(OLD_COLUMNS) + " |", "|" + "---|" * len(OLD_COLUMNS)]
    for number, (name, texture) in enumerate(maps.items()):
        track = work / f"old_{number}.h5"
        run("track", withheld(case.experiment, texture, work / f"old_{number}.yaml"), track, None, [])
        off_deg = angles_deg(aligned(attitudes(track), R_true, both=False), R_true)
        lines.append(f"| {name} | {displaced(texture, exact, yardstick)} | {percentiles(off_deg)} |")
    return "\n".join(lines)


def beside_fictrac(row: Row) -> str:
    """Return the table of one movie that FicTrac tracked as well."""
    frames, R_true = len(row.learnt), row.learnt.R_true
    programs = [
        ("`sphereorient map`", row.learnt, row.learning.words(frames)),
        ("`sphereorient track`, with the learnt map", row.tracked, row.tracking.words(frames)),
    ]
    for factor, cpu in FICTRAC.items():
        path = row.case.experiment.parent / f"s90_4_q{factor}.dat"
        if path.is_file():
            theirs = Attitudes(R=aligned(fictrac_attitudes(path), R_true, row.case.both), R_true=R_true)
            programs.append((f"FicTrac 2.1.2, q_factor {factor}", theirs, [cpu, ""]))
    lines = ["| " + " | ".join(BESIDE) + " |", "|" + "---|" * len(BESIDE)]
    for name, found, cost in programs:
        lines.append("| " + " | ".join([name, percentiles(found.errors_deg), f"{found.step_deg:.3f}", *cost]) + " |")
    return "\n".join(lines)


def fictrac_attitudes(path: Path) -> Tensor:
    """Read FicTrac's absolute rotations, (N, 3, 3): columns 9 to 11, a rotation vector in the camera's axes."""
    return so3.exp(torch.from_numpy(np.loadtxt(path, delimiter=",")[:, 8:11]))


def withheld(source: Path, texture: Path | None, path: Path) -> Path:
    """Write an experiment with another map or none; return its path."""
    return write_experiment(replace(load_experiment(source).with_sphere(texture_path=texture), path=path))


def run(command: str, experiment: Path, out: Path, cameras: str | None, more: list[str]) -> Usage:
    """Run one command of ours to its end, on one thread."""
    words = [sys.executable, "-m", "sphereorient.cli", command, str(experiment), "--out", str(out), "--quiet", *more]
    words += [] if cameras is None else ["--cameras", cameras]
    process = subprocess.Popen(words, env={**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"})
    # wait4 returns the peak of this child.
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(words)}: failed")
    return Usage(cpu_s=usage.ru_utime + usage.ru_stime, memory_gb=usage.ru_maxrss / 1e6)


def truth(path: Path) -> Tensor:
    """Read the true attitudes, (N, 3, 3)."""
    with h5py.File(path) as file:
        return torch.from_numpy(file["orientation"][()])


def attitudes(path: Path) -> Tensor:
    """Read a track's attitudes, (N, 3, 3), NaN where they are not valid."""
    track = Trajectory.load(path)
    return torch.from_numpy(np.where(track.valid[:, None, None], track.orientation, np.nan))


def aligned(R: Tensor, true_R: Tensor, both: bool) -> Tensor:
    """Return P R Q nearest to the truth, P the identity unless `both`."""
    known = torch.isfinite(R).flatten(1).all(1)
    P = Q = torch.eye(3, dtype=torch.float64)
    for _ in range(100 if both else 1):
        Q = so3.nearest_rotation(((P @ R[known]).mT @ true_R[known]).mean(0))
        P = so3.nearest_rotation((true_R[known] @ (R[known] @ Q).mT).mean(0)) if both else P
    return P @ R @ Q


def angles_deg(R: Tensor, S: Tensor) -> Tensor:
    """Return the angles between rotations (N, 3, 3), degrees."""
    return torch.rad2deg(so3.geodesic_distance(R, S))


def percentiles(angle_deg: Tensor) -> str:
    """Return median, 95th percentile, and the number of frames without a value, as text."""
    known = angle_deg[torch.isfinite(angle_deg)]
    words = f"{float(known.quantile(0.5)):.3f} / {float(known.quantile(0.95)):.3f}"
    return words if len(known) == len(angle_deg) else f"{words} ({len(angle_deg) - len(known)} frames without)"


def displaced(texture: Path, true: Path | None, yardstick: Path) -> str:
    """Return the displacement of the texture as text: by the shared measure if it is there, else by ours."""
    if true is None:
        return "no exact map"
    if yardstick.is_file():
        words = [sys.executable, str(yardstick), str(texture), str(true)]
        words += ["--seen", str(seen_path(texture))] if seen_path(texture).is_file() else []
        scores = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
        return f"{scores['distortion_rms_deg']:.3f} / {scores['distortion_p50_deg']:.3f}"
    seen, learnt = read_seen(seen_path(texture)), load_texture(texture)
    known = learnt if seen is None else torch.where(seen >= OFTEN, learnt, torch.nan)
    try:
        comparison = compare_maps(known, load_texture(true))
    except PaintError as error:
        return str(error)
    return f"{np.rad2deg(comparison.rms_rad):.3f} / {float(torch.rad2deg(comparison.length_rad).median()):.3f}"


if __name__ == "__main__":
    main()
