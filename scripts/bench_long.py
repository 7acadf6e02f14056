"""Time, rate and peak memory of `sphereorient track` over a long movie, and over its beginning.

    scripts/bench_long.py FOLDER/experiment.yaml [--frames 500 15000] [--jobs 1 2]

A movie that is not there is rendered: 15,000 frames of two cameras, 480 x 480 px, a ball of 80 px. Each run is a
process of its own, start-up included; the tracks of one length must have the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch
from experiment_file import write_experiment

from sphereorient import so3
from sphereorient.experiment import load_experiment
from sphereorient.synth import SynthSettings, write_synthetic_experiment

SCENE = SynthSettings(frames=15000, image_size=(480, 480), diameter_px=80.0, exposure_samples=1)


def digest(path: Path) -> str:
    """Return a digest of all datasets of a track."""
    hasher = hashlib.sha256()

    def add(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            hasher.update(name.encode() + np.asarray(item[()]).tobytes())

    with h5py.File(path, "r") as file:
        file.visititems(add)
    return hasher.hexdigest()[:12]


def errors(track: Path, truth: Path) -> str:
    """Return the median and 95 % errors of orientation."""
    if not truth.is_file():
        return ""
    with h5py.File(track) as measured, h5py.File(truth) as true:
        valid, R = measured["valid"][()], torch.from_numpy(measured["orientation"][()])
        S = torch.from_numpy(true["orientation"][: len(R)])
    off = torch.rad2deg(so3.geodesic_distance(R[valid], S[valid]))
    p50, p95 = off.quantile(0.5), off.quantile(0.95)
    return f", valid {int(valid.sum())}, error p50 {p50:.3f} p95 {p95:.3f} max {off.max():.3f} deg"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[500, 15000])
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    if not arguments.experiment.is_file():
        write_synthetic_experiment(arguments.experiment.parent, SCENE)
    experiment = load_experiment(arguments.experiment.resolve())
    with tempfile.TemporaryDirectory() as name:
        for frames in arguments.frames:
            part = replace(experiment, path=Path(name) / "experiment.yaml", frames=(0, frames))
            write_experiment(part)
            for jobs in arguments.jobs:
                out = Path(name) / f"track-{frames}-{jobs}.h5"
                words = [sys.executable, "-m", "sphereorient.cli", "track", part.path, "--out", out, "-q", "-j", jobs]
                begin = time.perf_counter()
                process = subprocess.Popen(list(map(str, words)))
                # wait4 returns the peak of this child and of its own children.
                _, status, usage = os.wait4(process.pid, 0)
                seconds = time.perf_counter() - begin
                print(
                    f"{frames:6d} frames, {jobs} worker(s): exit {status}, {seconds:.0f} s wall "
                    f"({frames / seconds:.0f} frames/s), {usage.ru_utime + usage.ru_stime:.0f} s CPU, peak "
                    f"{usage.ru_maxrss / 1024:.0f} MiB a process, datasets {digest(out)}"
                    + errors(out, arguments.experiment.parent / "truth.h5"),
                    flush=True,
                )


if __name__ == "__main__":
    main()
