"""Plant faults while `live` tracks: a black-out, a hand before the ball, a jump of 60 degrees, a lamp.

    scripts/live_faults.py EXPERIMENT [--cameras cam1]

Without a map, a first map is learnt before. The changed frames of the experiment arrive one by one; errors are
against truth.h5 beside it. Prints Markdown, for each fault: frames without a pose or flagged, wrong frames without a
flag, and the time from the arrival of the first good frame to its pose.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import torch

from sphereorient import so3
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.files.threads import silent
from sphereorient.live.feed import Arrival
from sphereorient.live.live import Measured, measured
from sphereorient.live.loop import open_live
from sphereorient.live.sources import movie_frames
from sphereorient.methods.map import first_map_of
from sphereorient.methods.settings import Settings
from sphereorient.report.texture_map import write_map

FIRST, LONG_S, JUMP_DEG = 60, 0.5, 60.0
HAND_GREY, HAND_SHARE, LAMP = 128, 0.7, 0.6
WRONG_DEG = 1.0  # from truth, one rotation of the body frame removed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--cameras", nargs="+")
    arguments = parser.parse_args()
    experiment = load_experiment(arguments.experiment)
    with tempfile.TemporaryDirectory() as folder:
        if experiment.mapless:
            texture = Path(folder) / "texture.png"
            write_map(first_map_of(experiment, Settings(), arguments.cameras, silent)[0], texture)
            experiment = experiment.with_sphere(texture_path=texture)
        show(experiment, arguments.cameras)


def show(experiment: Experiment, cameras: Sequence[str] | None) -> None:
    """Track the movie with each fault and print the table."""
    with h5py.File(experiment.path.parent / "truth.h5", "r") as file:
        R_true = torch.from_numpy(file["orientation"][()])
    print("| fault | frames of it | of these flagged | wrong without a flag | back after | error before, after |")
    print("|---|---|---|---|---|---|")
    for name in ("black-out", "hand", "turn", "lamp"):
        with open_live(experiment, Settings(), cameras, None) as opened:
            frames = list(movie_frames(opened.recording, paced=False))
            views = opened.tracker.appearances[""].fitter.views
            middle = measured(opened.tracker, views, [replace(frames[0], time_s=-1.0)])
            X = torch.from_numpy(next(iter(middle)).position_lab_mm)
            disks = [(*view.camera.project(X).tolist(), view.diameter_px / 2) for view in views]
            rows, shown, fault = changed(name, frames, R_true, disks)
            found = list(measured(opened.tracker, views, arriving(shown)))
        print(f"| {name} | {cells_of(found, rows, fault, R_true)} |", flush=True)


def arriving(frames: Sequence[Arrival]) -> Iterator[Arrival]:
    """Yield frames; each arrives when it is read."""
    for frame in frames:
        yield replace(frame, arrived_s=time.perf_counter())


def changed(
    name: str, frames: list[Arrival], R: torch.Tensor, disks: Sequence[tuple[float, float, float]]
) -> tuple[list[int], list[Arrival], range]:
    """Return the rows of the movie that are shown, these as evenly spaced frames, and the range with the fault."""
    step_s = frames[1].time_s - frames[0].time_s
    rows, fault = list(range(len(frames))), range(FIRST, FIRST + round(LONG_S / step_s))
    if name == "turn":
        away = torch.rad2deg(so3.geodesic_distance(R[FIRST], R[FIRST + 1 :]))
        rows = [*range(FIRST + 1), *range(FIRST + 1 + int((away > JUMP_DEG).int().argmax()), len(frames))]
        fault = range(FIRST + 1, FIRST + 2)
    elif name == "lamp":
        fault = range(FIRST, len(frames))
    shown = []
    for number, row in enumerate(rows):
        pictures = [np.asarray(picture).copy() for picture in frames[row].pictures]
        for picture, (u, v, radius) in zip(pictures, disks, strict=True):
            if number in fault and name == "black-out":
                picture[:] = 0
            elif number in fault and name == "hand":
                y, x = np.ogrid[: picture.shape[0], : picture.shape[1]]
                picture[(x < u + radius * (2 * HAND_SHARE - 1)) & (abs(y - v) < 2 * radius)] = HAND_GREY
            elif number in fault and name == "lamp":
                picture[:] = (LAMP * picture).astype(picture.dtype)
        shown.append(replace(frames[row], number=number, time_s=number * step_s, pictures=pictures))
    return rows, shown, fault


def cells_of(found: list[Measured], rows: list[int], fault: range, R_true: torch.Tensor) -> str:
    """Return the cells of a fault's row."""
    valid = np.array([now.valid for now in found])
    flagged = ~valid | np.array([now.found for now in found])
    R, true = torch.from_numpy(np.stack([now.R_lab_body for now in found])).nan_to_num(), R_true[rows]
    number = np.arange(len(found))
    before, good = valid & (number < fault.start), number >= fault.stop  # good frames again
    if len(fault) == 1 or fault.stop == len(found):  # the fault is a change, after which pictures are good
        good = number >= fault.start
    Q = so3.nearest_rotation((true[before].mT @ R[before]).mean(0))
    off = torch.rad2deg(so3.geodesic_distance(R, true @ Q)).numpy()
    back = int(np.flatnonzero(good & valid)[0])
    when = f"{back - int(np.flatnonzero(good)[0])} frames, {1e3 * found[back].latency_s:.0f} ms"
    silent = int((valid & ~flagged & (off > WRONG_DEG)).sum())
    errors = f"{np.median(off[before]):.3f}°, {np.median(off[good & valid]):.3f}°"
    return f"{len(fault)} | {int(flagged[fault.start : fault.stop].sum())} | {silent} | {when} | {errors}"


if __name__ == "__main__":
    main()
