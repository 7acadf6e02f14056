"""An experiment of two small movies whose frames hold their own number."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from sphereorient.cameras import PinholeCamera, save_cameras

FULL = """
schema: sphereorient-experiment/1
name: mixer-3Hz
frame_rate: 600.0
exposure: 0.0004
sphere: {diameter: 18.0, texture: texture.png}
masks: {cam1: mask.png}
cameras: cameras.yaml
movies: {cam1: cam1.npy, cam2: films/cam2.npy}
start: {cam2: 3}
frames: [2, 10]
flow: {viscosity: 8.0e-6, dissipation: 1.7}
"""
SHORT = """
schema: sphereorient-experiment/1
frame_rate: 30
sphere: {diameter: null, fixed: true}
cameras: cameras.yaml
movies: {cam1: cam1.npy}
"""
BOTH = SHORT.replace("{cam1: cam1.npy}", "{cam1: cam1.npy, cam2: films/cam2.npy}")
HEIGHT, WIDTH = 6, 8


def camera() -> PinholeCamera:
    zero = torch.zeros(3, dtype=torch.float64)
    view = torch.eye(3, dtype=torch.float64)
    focal = torch.tensor(10.0, dtype=torch.float64)
    return PinholeCamera(image_size=(WIDTH, HEIGHT), R_cam_lab=view, T_cam_lab_mm=zero, centre_px=zero[:2], f_px=focal)


def save_movie(path: Path, frames: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(exist_ok=True)
    numbered = np.arange(frames, dtype=np.uint8)[:, None, None]
    np.save(path, np.broadcast_to(numbered, (frames, *shape)).copy())


def make_folder(folder: Path) -> Path:
    """Write cameras and movies, 12 and 15 frames."""
    save_cameras(folder / "cameras.yaml", {"cam1": camera(), "cam2": camera()})
    save_movie(folder / "cam1.npy", 12)
    save_movie(folder / "films" / "cam2.npy", 15)
    return folder


def written(folder: Path, text: str) -> Path:
    path = folder / "experiment.yaml"
    path.write_text(text, encoding="utf-8")
    return path
