"""Draw docs/calibration.png: what `sphereorient calibrate` shows, for a plate in liquid that two cameras see.

    scripts/figure_calibration.py [--out docs/calibration.png] [--folder FOLDER]

The plate is drawn by the package's own cameras, behind 12 mm of Plexiglas: every pixel's lines of sight are followed
into the liquid and to the plate. With --folder the pictures and their calibration.yaml are kept there, to try the
command on. Prints the calibration, and its error within 60 mm against the exact cameras.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.calibrated import summary
from sphereorient.calibration.plates import calibrate_cameras
from sphereorient.calibration.targets import DotPlate
from sphereorient.cameras import Port, PortCamera, TsaiCamera, triangulate
from sphereorient.files.whole_file import writing
from sphereorient.report import calibration_figure

REPO = Path(__file__).resolve().parents[1]
SIZE, PITCH_MM, PER_SIDE = (420, 420), 0.02, 4
WIDTH = 1500  # of the figure, px: the command's own is larger
PLATE = DotPlate(
    columns=11,
    rows=11,
    pitch_mm=8.0,
    dot_diameter_mm=3.2,
    fiducial_diameter_mm=5.0,
    fiducials=((0, 0), (3, 0), (0, 2)),
)
PLACES = {"cam1": [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], "cam2": [[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]}
# The surveyed pose faces the middle between the cameras; the others are rotated from it (degrees) and moved (mm).
TURNS_DEG = [[0, 0, 0], [20, 5, 0], [-18, 10, 90], [5, 25, 40], [0, -24, -60], [14, -12, 180], [-12, -15, 130]]
MOVES_MM = [[0, 0, 0], [4, -3, 2], [-5, 4, 0], [0, 5, -4], [6, 0, 3], [-3, -5, -5], [2, 3, 6]]


def exact_cameras() -> dict[str, PortCamera]:
    made = {}
    for k, (name, axes) in enumerate(PLACES.items()):
        R = torch.tensor(axes, dtype=torch.float64)
        off = so3.exp(torch.deg2rad(torch.tensor([0.4, -0.6 + k, 0.8], dtype=torch.float64)))
        camera = TsaiCamera(
            image_size=SIZE,
            R_cam_lab=off @ R,
            T_cam_lab_mm=torch.tensor([2.0, -3.0, 560.0]),
            centre_px=torch.tensor([212.0, 205.0], dtype=torch.float64),
            f_mm=torch.tensor(36.0),
            pixel_pitch_mm=torch.tensor([PITCH_MM, PITCH_MM], dtype=torch.float64),
            sx=torch.tensor(1.0),
            kappa1=torch.tensor(2e-4 - 3e-4 * k, dtype=torch.float64),
        )
        made[name] = PortCamera(
            camera=camera, port=Port(normal=-R[2], offset_mm=120, thickness_mm=12, n_glass=1.49, n_fluid=1.36)
        )
    return made


def plate_poses() -> tuple[Tensor, Tensor]:
    first = so3.exp(torch.tensor([torch.pi / 4, 0.0, 0.0], dtype=torch.float64))
    turned = so3.exp(torch.deg2rad(torch.tensor(TURNS_DEG, dtype=torch.float64)))
    return first @ turned, torch.tensor(MOVES_MM, dtype=torch.float64)


def drawn(camera: PortCamera, R_lab_plate: Tensor, T_lab_plate_mm: Tensor, seed: int) -> NDArray[np.uint8]:
    """Draw one picture: dark dots on a white plate, seen through the camera's own lines of sight."""
    steps = (torch.arange(PER_SIDE, dtype=torch.float64) + 0.5) / PER_SIDE - 0.5
    u, v = ((torch.arange(n)[:, None] + steps).reshape(-1) for n in SIZE)
    rays = camera.rays(torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1))
    normal = R_lab_plate[:, 2]
    way = ((T_lab_plate_mm - rays.origin_lab_mm) @ normal) / (rays.direction_lab @ normal)
    on_plate = (rays.origin_lab_mm + way[..., None] * rays.direction_lab - T_lab_plate_mm) @ R_lab_plate
    x, y = on_plate[..., 0].numpy(), on_plate[..., 1].numpy()
    i, j = np.rint(x / PLATE.pitch_mm).astype(int), np.rint(y / PLATE.pitch_mm).astype(int)
    index = np.stack([i.ravel(), j.ravel()], axis=1)
    width = np.where(PLATE.holds(index), PLATE.dot_diameter_mm, 0.0)
    for at in PLATE.fiducials:
        width[(index == at).all(axis=1)] = PLATE.fiducial_diameter_mm
    dot = np.hypot(x - i * PLATE.pitch_mm, y - j * PLATE.pitch_mm) < width.reshape(x.shape) / 2
    half = (PLATE.columns + 0.5) * PLATE.pitch_mm / 2
    board = (abs(x) < half) & (abs(y) < half)
    grey = (
        np.where(board, np.where(dot, 0.05, 1.0), 0.02).reshape(SIZE[1], PER_SIDE, SIZE[0], PER_SIDE).mean(axis=(1, 3))
    )
    grey = cv2.GaussianBlur(grey, (0, 0), 0.55) * 180 + 8
    noise = np.random.default_rng(seed).normal(0, 1, grey.shape) * 3 * np.sqrt(grey / 180)
    return np.rint(grey + noise).clip(0, 255).astype(np.uint8)


def written(folder: Path) -> Path:
    """Write all pictures and calibration.yaml."""
    cameras = exact_cameras()
    R, T = plate_poses()
    entries = []
    for row in range(len(R)):
        entries.append({"pose": row} | {name: f"{name}_{row:02}.png" for name in cameras})
        for k, (name, camera) in enumerate(cameras.items()):
            cv2.imwrite(str(folder / f"{name}_{row:02}.png"), drawn(camera, R[row], T[row], 2 * row + k))
    wall = {"offset": 120.0, "thickness": 12.0, "n_glass": 1.49, "n_fluid": 1.36}
    plate = {"type": "dots", "columns": PLATE.columns, "rows": PLATE.rows, "pitch": PLATE.pitch_mm}
    plate |= {"dot_diameter": PLATE.dot_diameter_mm, "fiducial_diameter": PLATE.fiducial_diameter_mm}
    document = {
        "schema": "sphereorient-calibration/1",
        "image_size": list(SIZE),
        "pixel_pitch": [PITCH_MM, PITCH_MM],
        "plate": plate | {"fiducials": [list(at) for at in PLATE.fiducials], "dots": "dark"},
        "surveyed": {"pose": 0, "R_lab_plate": R[0].tolist(), "T_lab_plate": T[0].tolist()},
        "ports": {name: wall | {"normal": camera.port.normal.tolist()} for name, camera in cameras.items()},
        "pictures": entries,
    }
    path = folder / "calibration.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=REPO / "docs" / "calibration.png")
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as aside:
        folder = given.folder or Path(aside)
        folder.mkdir(parents=True, exist_ok=True)
        result = calibrate_cameras(written(folder))
        with writing(force=True):
            calibration_figure(result, given.out)
    large = cv2.imread(str(given.out))
    small = cv2.resize(large, (WIDTH, round(WIDTH * large.shape[0] / large.shape[1])), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(given.out), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    exact = exact_cameras()
    points = 60 * (2 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1)
    found, _ = triangulate(*(result.cameras[name].rays(camera.project(points)) for name, camera in exact.items()))
    missed = float((found - points).square().sum(-1).mean().sqrt())
    for line in [*summary(result), f"points within 60 mm are missed by {missed:.4f} mm rms"]:
        print(line)


if __name__ == "__main__":
    main()
