"""Cameras and scenes that the tests of this room share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import PinholeCamera
from sphereorient.synth import Scene, SynthSettings, make_scene

NOISELESS = {"read_noise": 0.0, "shot_noise": 0.0, "blur_px": 0.0}
WHITE_MAP = torch.ones(8, 16)


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def camera(size: tuple[int, int] = (200, 160), f_px: float = 800.0) -> PinholeCamera:
    """A camera in a general pose, 400 mm from the lab's origin, which it sees near the middle."""
    return PinholeCamera(
        image_size=size,
        R_cam_lab=so3.exp(f64([0.4, -1.1, 0.7])),
        T_cam_lab_mm=f64([3, -4, 400]),
        centre_px=f64([(size[0] - 1) / 2, (size[1] - 1) / 2]),
        f_px=f64(f_px),
    )


def seen_at(lens: PinholeCamera, right_deg: float, down_deg: float, depth_mm: float = 400.0) -> Tensor:
    """The lab point at a depth before the camera and angles beside its axis, (3,) mm."""
    slope = f64([math.tan(math.radians(right_deg)), math.tan(math.radians(down_deg)), 1.0])
    return lens.R_cam_lab.T @ (depth_mm * slope - lens.T_cam_lab_mm)


def scene(texture: Tensor = WHITE_MAP, **changes: object) -> Scene:
    """Even light, no blur, no noise, unless changed."""
    settings = {"ambient": 1.0, "background": 0.0, "diameter_mm": 18.0, "diameter_px": 36.0, "distance_mm": 400.0}
    return make_scene(texture, SynthSettings(**(settings | NOISELESS | changes)))
