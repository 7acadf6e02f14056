"""Pictures of a dot plate by two cameras, drawn by the renderer of the tests, and the calibration.yaml of them."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from plate_drawing import SIZE, Scene
from torch import Tensor

from sphereorient.cameras import Camera, PinholeCamera

F_PX, PITCH = 900.0, (0.02, 0.02)
AT = torch.tensor([0.0, 0.0, 260.0], dtype=torch.float64)  # middle of the common view
APART_DEG = 50.0  # between the cameras' axes
# Tilt, direction of its axis, spin (degrees), and shift (mm) of each pose; none is seen from behind.
POSES = [
    (0.0, 0.0, 0.0, (0.0, 0.0)),
    (24.0, 10.0, 15.0, (2.0, 3.0)),
    (26.0, 100.0, -20.0, (-3.0, 2.0)),
    (22.0, 200.0, 80.0, (4.0, -4.0)),
    (25.0, 300.0, 170.0, (0.0, 2.0)),
    (18.0, 60.0, -100.0, (1.0, -2.0)),
]
ALONE = {(4, "cam2")}  # pictures that were not taken


@dataclass(frozen=True, kw_only=True)
class Posed(Scene):
    """A plate at any position before the camera."""

    R: Tensor = field(default_factory=lambda: torch.eye(3).double())
    T: Tensor = field(default_factory=lambda: AT)

    @property
    def R_lab_plate(self) -> Tensor:
        return self.R

    @property
    def T_lab_plate(self) -> Tensor:
        return self.T


def about_y(deg: float) -> Tensor:
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def true_cameras() -> dict[str, Camera]:
    """Cameras to the left and the right of the surveyed plate, whose frame is the lab's."""
    facing = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    middle = (torch.tensor(SIZE, dtype=torch.float64) - 1) / 2
    f = torch.tensor(F_PX, dtype=torch.float64)
    made: dict[str, Camera] = {}
    for name, deg in (("cam1", -APART_DEG / 2), ("cam2", APART_DEG / 2)):
        made[name] = PinholeCamera(
            image_size=SIZE, R_cam_lab=about_y(deg) @ facing, T_cam_lab_mm=AT, centre_px=middle, f_px=f
        )
    return made


def plate_poses() -> list[tuple[Tensor, Tensor]]:
    """R_lab_plate and T_lab_plate of every pose."""
    first = Scene()
    made = []
    for tilt, about, spin, (x, y) in POSES:
        turned = Scene(tilt_deg=tilt, about_deg=about, spin_deg=spin).R_lab_plate
        made.append((first.R_lab_plate.mT @ turned, torch.tensor([x, y, 0.0], dtype=torch.float64)))
    return made


@functools.cache
def pictures() -> Mapping[str, NDArray[np.uint8]]:
    """All pictures by their files' names, (H, W)."""
    drawn = {}
    for row, (R, T) in enumerate(plate_poses()):
        for k, (name, camera) in enumerate(true_cameras().items()):
            if (row, name) not in ALONE:
                scene = Posed(R=camera.R_cam_lab @ R, T=camera.R_cam_lab @ T + camera.T_cam_lab_mm)
                drawn[f"{name}_{row:02}.png"] = scene.picture(noise=1.0, seed=2 * row + k)
    return drawn


def document() -> dict[str, Any]:
    """Content of calibration.yaml."""
    entries = []
    for row in range(len(POSES)):
        names = {name: f"{name}_{row:02}.png" for name in ("cam1", "cam2") if (row, name) not in ALONE}
        entries.append({"pose": row, **names})
    plate = {"type": "dots", "columns": 11, "rows": 9, "pitch": 8.0, "dot_diameter": 3.2, "fiducial_diameter": 5.0}
    return {
        "schema": "sphereorient-calibration/1",
        "image_size": list(SIZE),
        "pixel_pitch": list(PITCH),
        "plate": plate | {"fiducials": [[0, 0], [3, 0], [0, 2]]},
        "surveyed": {"pose": 0, "R_lab_plate": torch.eye(3).tolist(), "T_lab_plate": [0.0, 0.0, 0.0]},
        "pictures": entries,
    }


def write_tables(folder: Path, count: int = 80, **changes: Any) -> Path:
    """Write calibration.yaml of a table of points with noise for each camera."""
    points = 35 * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(4)).double() - 1)
    for name, camera in true_cameras().items():
        uv = camera.project(points).numpy() + 0.02 * np.random.default_rng(0).normal(size=(count, 2))
        table = np.column_stack([points.numpy(), uv])
        np.savetxt(folder / f"{name}.csv", table, "%.6f", delimiter=",", header="x,y,z,u,v", comments="")
    tables = {"cam1": "cam1.csv", "cam2": "cam2.csv"}
    keys = {"plate": None, "surveyed": None, "pictures": None, "points": tables} | changes
    return write(folder, keys, drawn=False)


def write(folder: Path, changes: Mapping[str, Any] | None = None, drawn: bool = True) -> Path:
    """Write calibration.yaml and its pictures; a change to None takes a key away."""
    content = {key: value for key, value in (document() | dict(changes or {})).items() if value is not None}
    for name, picture in pictures().items() if drawn else ():
        cv2.imwrite(str(folder / name), picture)
    path = folder / "calibration.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
