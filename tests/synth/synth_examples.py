import math
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, PinholeCamera, Port, PortCamera
from sphereorient.experiment import load_experiment, open_movies
from sphereorient.synth import RenderedScene, SynthSettings, make_scene

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


def frames_of(path: Path) -> dict[str, np.ndarray]:
    """All frames (N, H, W) of each movie of an experiment."""
    return {name: np.stack(list(movie.frames())) for name, movie in open_movies(load_experiment(path)).items()}


def seen_at(lens: PinholeCamera, right_deg: float, down_deg: float, depth_mm: float = 400.0) -> Tensor:
    """The lab point at a depth before the camera and angles beside its axis, (3,) mm."""
    slope = f64([math.tan(math.radians(right_deg)), math.tan(math.radians(down_deg)), 1.0])
    return lens.R_cam_lab.T @ (depth_mm * slope - lens.T_cam_lab_mm)


def scene(texture: Tensor = WHITE_MAP, **changes: object) -> RenderedScene:
    """Even light, no blur, no noise, unless changed."""
    settings = {"ambient": 1.0, "background": 0.0, "diameter_mm": 18.0, "diameter_px": 36.0, "distance_mm": 400.0}
    return make_scene(texture, SynthSettings(**(settings | NOISELESS | changes)))


def behind_wall(lens: PinholeCamera, n_fluid: float = 1.36, offset_mm: float = 120.0) -> PortCamera:
    """The camera before 12 mm of Plexiglas that stands 9 degrees from square to it, the lab's origin in the liquid."""
    normal = -so3.exp(f64([0.1, 0.05, -0.1])) @ lens.R_cam_lab[2]
    port = Port(normal=normal, offset_mm=f64(offset_mm), thickness_mm=f64(12), n_glass=f64(1.49), n_fluid=f64(n_fluid))
    return PortCamera(camera=lens, port=port)


def on_the_sphere(centre: Tensor, radius_mm: float, count: int = 20000) -> Tensor:
    """Points spread evenly over a sphere, (count, 3) (Fibonacci's lattice)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    up = 1 - 2 * k / count
    turn = k * math.pi * (3 - math.sqrt(5))
    ring = (1 - up * up).sqrt()
    return centre + radius_mm * torch.stack([ring * turn.cos(), ring * turn.sin(), up], dim=-1)


def outline_of(lens: Camera, centre: Tensor, radius_mm: float) -> tuple[float, Tensor]:
    """Area, px^2, and centre of mass (2,), px, of a sphere's picture: the hull of the pictures of its points.

    The front half of the sphere hides the other; both have the same outline.
    """
    pixels = lens.project(on_the_sphere(centre, radius_mm))
    middle = pixels.mean(0)
    hull = cv2.convexHull((pixels - middle).float().numpy())[:, 0].astype(np.float64)
    x, y = hull.T
    xn, yn = np.roll(hull, -1, axis=0).T
    cross = x * yn - xn * y
    area = cross.sum() / 2
    mass = np.array([((x + xn) * cross).sum(), ((y + yn) * cross).sum()]) / (6 * area)
    return abs(float(area)), middle + torch.from_numpy(mass)
