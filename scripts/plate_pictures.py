"""Measure how well the dots of a plate are found, identified and located in the pictures of an exact calibration.

scripts/plate_pictures.py ../shared/experiment

The folder holds cameras.yaml (exact) and calibration/ with calibration.yaml, the pictures and truth.h5 (exact poses).
A dot lies wholly in a picture where its rim does. `misplaced` counts dots farther than a pixel from their grid index's
position. The last two columns are measured minus exact pictures of the dots' centres, rms of u and v together, first
as measured, then less the perspective bias.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import process_time

import cv2
import h5py
import numpy as np
import torch
import yaml
from rich.console import Console
from rich.table import Table
from torch import Tensor

from sphereorient.calibration.boards import see_plate
from sphereorient.calibration.bundle import disk_centre_shift
from sphereorient.calibration.targets import DotPlate, PlateView, plate_from_entry
from sphereorient.cameras import Camera, load_cameras

RIM = 64  # points of a dot's rim that must all be in the picture


def wholly_inside(camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, plate: DotPlate) -> set[tuple[int, int]]:
    """Return the grid indices of the dots whose rims lie in the picture."""
    angle = torch.arange(RIM) * (2 * torch.pi / RIM)
    circle = torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=-1).double()
    index = plate.indices
    radius = torch.from_numpy(plate.diameters(index))[:, None, None] / 2
    rim = torch.from_numpy(plate.points(index))[:, None] + radius * circle
    uv_px = camera.project(rim @ R_lab_plate.mT + T_lab_plate)
    inside = ((uv_px >= -0.5) & (uv_px <= torch.tensor(camera.image_size) - 0.5)).all(-1).all(-1)
    return {(int(i), int(j)) for i, j in index[inside.numpy()]}


def misses(camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, view: PlateView) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 2) px: measured minus exact centres, and the same less the perspective bias."""
    points = torch.from_numpy(view.points_plate_mm)
    exact = camera.project(points @ R_lab_plate.mT + T_lab_plate)
    shift = disk_centre_shift(camera, R_lab_plate, T_lab_plate, points, torch.from_numpy(view.diameter_mm))
    raw = view.uv_px - exact.numpy()
    return raw, raw - shift.numpy()


def rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2))) if values else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    cameras = load_cameras(folder / "cameras.yaml")
    document = yaml.safe_load((folder / "calibration" / "calibration.yaml").read_text())
    plate = plate_from_entry(document["plate"])
    with h5py.File(folder / "calibration" / "truth.h5") as truth:
        R, T = (torch.from_numpy(truth[name][:]) for name in ("R_lab_plate", "T_lab_plate"))
    table = Table("picture", "state", "in picture", "found", "not in picture", "misplaced", "rms px", "less bias", "s")
    totals = {name: [0, 0, 0, 0, [], []] for name in cameras}
    for entry in document["pictures"]:
        for name in (name for name in cameras if name in entry):
            pose = (R[entry["pose"]], T[entry["pose"]])
            picture = cv2.imread(str(folder / "calibration" / entry[name]), cv2.IMREAD_UNCHANGED)
            start = process_time()
            view = see_plate(picture, plate, entry[name])
            spent = process_time() - start
            there = wholly_inside(cameras[name], *pose, plate)
            seen = {(int(i), int(j)) for i, j in view.index}
            raw, corrected = misses(cameras[name], *pose, view)
            wrong = np.abs(raw).max(axis=1, initial=0.0) > 1
            counts = [len(there), len(seen & there), len(seen - there), int(wrong.sum())]
            total = totals[name]
            total[:4] = [a + b for a, b in zip(total[:4], counts, strict=True)]
            total[4].append(raw[~wrong])
            total[5].append(corrected[~wrong])
            figures = [f"{rms([part[~wrong]]):.4f}" for part in (raw, corrected)]
            table.add_row(entry[name], view.state, *map(str, counts), *figures, f"{spent:.2f}")
    for name, (there, found, beyond, wrong, raw, corrected) in totals.items():
        share = f"{found} ({100 * found / max(there, 1):.2f} %)"
        table.add_row(name, "", str(there), share, str(beyond), str(wrong), f"{rms(raw):.4f}", f"{rms(corrected):.4f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
