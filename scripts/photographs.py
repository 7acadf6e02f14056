"""Measure how many photographs a map needs: `sphereorient map` learns from sets at random attitudes.

    scripts/photographs.py [--counts 8 12 20 30] [--sets 6] [--moves] [--diameter 200] [--pairs-only]

Each set shows a ball of random paint at uniformly random attitudes, seen by one camera, at one position or, with
`--moves`, anywhere in the picture and without a picture of the empty scene. `sphereorient map --photographs` learns the
map in a process of its own, one thread; with `--pairs-only` attitudes are found from pairs of pictures alone, the first
step of `map`, which is quicker. Attitudes are compared after one rotation of the body frame, maps by `compare_maps`.
Prints one row per set, and one in bold per number of pictures.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import torch
import yaml
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import save_cameras
from sphereorient.errors import PaintError
from sphereorient.experiment.recording import open_recording
from sphereorient.files.threads import silent
from sphereorient.mapping import take_crops
from sphereorient.mapping.disks import disks_of
from sphereorient.mapping.photographs import find_photographs, finer_settings
from sphereorient.methods.settings import Settings
from sphereorient.pose.camera_view import widest_px
from sphereorient.sphere import load_texture, read_seen, seen_path
from sphereorient.sphere.compare import compare_maps
from sphereorient.sphere.texture import KINDS, random_texture
from sphereorient.synth import SynthSettings
from sphereorient.synth.scene import make_scene, render_frame, seeded
from sphereorient.synth.write import default_cameras
from sphereorient.trajectory import Trajectory

SIDE, WIDE_SIDE = 1.4, 2.6  # of the picture, in diameters of the ball, fixed and moving
DISTANCE_MM = 400.0
WRONG_DEG = 8.0  # a larger error is a wrong attitude


@dataclass(frozen=True, kw_only=True)
class Stills:
    """A set of photographs to be rendered."""

    count: int
    seed: int
    paint: str = "patches"
    moves: bool = False
    diameter_px: float = 200.0


def write_stills(folder: Path, stills: Stills) -> Path:
    """Render a set of photographs as an experiment without map; its truth and its map lie beside it.

    Returns:
        Path of experiment.yaml. Beside it: photographs/, cameras.yaml, texture.png, truth.h5.
    """
    side = round((WIDE_SIDE if stills.moves else SIDE) * stills.diameter_px)
    settings = SynthSettings(
        image_size=(side, side), diameter_px=stills.diameter_px, distance_mm=DISTANCE_MM, seed=stills.seed
    )
    camera = default_cameras(settings)["cam1"]
    texture = random_texture(stills.paint, stills.seed)
    rng = torch.Generator().manual_seed(1000 + stills.seed)
    R = so3.random_rotations(stills.count, generator=rng)
    reach_mm = 0.5 * (WIDE_SIDE - 1.2) * settings.diameter_mm if stills.moves else 0.0
    X = (2 * torch.rand(stills.count, 3, generator=rng, dtype=torch.float64) - 1) * reach_mm
    scene, noise = make_scene(texture, settings), seeded(stills.seed)
    (folder / "photographs").mkdir(parents=True, exist_ok=True)
    for k in range(stills.count):
        grey = render_frame(scene, camera, X[k : k + 1], R[k : k + 1], noise)
        cv2.imwrite(str(folder / "photographs" / f"{k:03d}.png"), grey)
    cv2.imwrite(str(folder / "texture.png"), (255 * texture).round().byte().numpy())
    save_cameras(folder / "cameras.yaml", {"cam1": camera})
    with h5py.File(folder / "truth.h5", "w") as file:
        file["orientation"], file["position"] = R.numpy(), X.numpy()
    path = folder / "experiment.yaml"
    sphere = {"diameter": settings.diameter_mm} | ({} if stills.moves else {"fixed": True})
    document = {"schema": "sphereorient-experiment/1", "name": "photographs", "frame_rate": 1.0, "sphere": sphere}
    document |= {"cameras": "cameras.yaml", "movies": {"cam1": "photographs"}}
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Result of a set."""

    used: int
    error_deg: Tensor  # of the pictures that have an attitude
    map_rms_deg: float
    cpu_s: float


def main() -> None:
    """Print a row per set, and one per number of pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[8, 10, 12, 16, 20, 30, 40])
    parser.add_argument("--sets", type=int, default=6, help="number for each number of pictures, paints alternate")
    parser.add_argument("--diameter", type=float, default=200.0, help="of the ball, px")
    parser.add_argument("--moves", action="store_true", help="the position of the ball differs between pictures")
    parser.add_argument("--pairs-only", action="store_true", help="attitudes from pairs of pictures alone: no map")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| pictures | paint, seed | used | attitudes p50 / p95 (°) | paint displaced, rms (°) | CPU s |", flush=True)
    print("|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as work:
        for count in options.counts:
            every = []
            for seed in range(options.sets):
                paint = list(KINDS)[seed % len(KINDS)]
                stills = Stills(count=count, seed=seed, paint=paint, moves=options.moves, diameter_px=options.diameter)
                path = write_stills(Path(work) / f"{count}_{seed}", stills)
                every.append(paired(path) if options.pairs_only else learnt(path))
                print(row(f"{count} | {paint}, {seed}", every[-1:], count), flush=True)
            print(row(f"**{count}** | {len(every)} sets, whole: {whole(every, count)}", every, count), flush=True)


def whole(every: list[Solved], count: int) -> int:
    """Return the number of sets whose pictures are all right."""
    return sum(one.used == count and bool((one.error_deg < WRONG_DEG).all()) for one in every)


def row(name: str, every: list[Solved], count: int) -> str:
    """Return the row of one set, or of several together."""
    used = sum(one.used for one in every)
    error = torch.cat([one.error_deg for one in every])
    wrong = int((error > WRONG_DEG).sum())
    words = f"{100 * used / (count * len(every)):.0f} %" + (f", {wrong} of them wrong" if wrong else "")
    angles = f"{float(error.quantile(0.5)):.3f} / {float(error.quantile(0.95)):.3f}" if len(error) else "none"
    moved = float(torch.tensor([one.map_rms_deg for one in every]).nanmedian())
    return f"| {name} | {words} | {angles} | {moved:.3f} | {np.mean([one.cpu_s for one in every]):.0f} |"


def errors_deg(R: Tensor, truth: Path) -> Tensor:
    """Return the angles of known attitudes to the truth, after the best rotation of the body frame."""
    with h5py.File(truth) as file:
        true = torch.from_numpy(file["orientation"][()])
    known = torch.isfinite(R).flatten(1).all(1)
    if not known.any():
        return torch.zeros(0, dtype=torch.float64)
    # Best of many: a wrong attitude must not rotate all others.
    tried = R[known].mT @ true[known]
    apart = so3.geodesic_distance((R[known] @ tried[:, None]), true[known])
    Q = tried[int(apart.median(1).values.argmin())]
    near = so3.geodesic_distance(R[known] @ Q, true[known]) < np.deg2rad(WRONG_DEG)
    Q = so3.nearest_rotation(tried[near].mean(0))
    return torch.rad2deg(so3.geodesic_distance(R[known] @ Q, true[known]))


def paired(experiment: Path) -> Solved:
    """Find attitudes from pairs of pictures alone, as `map` begins."""
    settings, begun = Settings(), time.process_time()
    paint = settings.paint
    with h5py.File(experiment.parent / "truth.h5") as file:
        R = torch.full(file["orientation"].shape, torch.nan, dtype=torch.float64)
    try:
        with open_recording(experiment, textured=False) as recording:
            crops = take_crops(recording, paint, settings.locate, silent)
        frames = torch.nonzero(crops.seen.any(1))[:, 0]
        finer = finer_settings(paint, widest_px(crops.views))
        chain = find_photographs(disks_of(crops, frames, paint), disks_of(crops, frames, finer), paint)
        R[frames[chain.rows]] = chain.R_lab_body
    except PaintError as error:
        print(f"refused: {error}", file=sys.stderr)
    error_deg = errors_deg(R, experiment.parent / "truth.h5")
    return Solved(used=len(error_deg), error_deg=error_deg, map_rms_deg=np.nan, cpu_s=time.process_time() - begun)


def learnt(experiment: Path) -> Solved:
    """Learn a map by the command line, and compare."""
    texture = experiment.parent / "learnt.png"
    words = [sys.executable, "-m", "sphereorient.cli", "map", str(experiment), "--out", str(texture)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    process = subprocess.Popen([*words, "--photographs", "--quiet"], env=environment)
    _, status, usage = os.wait4(process.pid, 0)  # time of this child
    cpu_s = usage.ru_utime + usage.ru_stime
    if status:  # its message is printed
        return Solved(used=0, error_deg=torch.zeros(0, dtype=torch.float64), map_rms_deg=np.nan, cpu_s=cpu_s)
    track = Trajectory.load(texture.with_name("learnt_map.h5"))
    R = torch.from_numpy(np.where(track.valid[:, None, None], track.orientation, np.nan))
    seen, grey = read_seen(seen_path(texture)), load_texture(texture)
    grey = grey if seen is None else torch.where(seen > 0, grey, torch.nan)
    comparison = compare_maps(grey, load_texture(experiment.parent / "texture.png"))
    error_deg = errors_deg(R, experiment.parent / "truth.h5")
    return Solved(
        used=len(error_deg), error_deg=error_deg, map_rms_deg=float(np.rad2deg(comparison.rms_rad)), cpu_s=cpu_s
    )


if __name__ == "__main__":
    main()
