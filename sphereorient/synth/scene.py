"""Pictures of the scene: the sphere in perspective through a real camera, shaded, blurred, noisy, in 8 bits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.sphere import reduced_texture, sample_texture, sphere_normals
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.window import reach_px

SUPERSAMPLING = 3  # rays per pixel and axis: the paint's edges and the limb then are right to a few per cent

# Three lamps, unit directions from the sphere (lab), and their shares: two bright and one weak, so that no side is
# quite dark and the underside is dim.
LAMPS = ((-0.6, -0.5, 0.6, 0.55), (0.7, -0.3, 0.65, 0.35), (0.0, 0.9, -0.4, 0.1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """What does not move: map, sphere, light, levels; made by synth, read by `render_frame`."""

    texture: Tensor  # (H, 2 H) float32, reduced to the picture's resolution
    settings: SynthSettings


def make_scene(texture: Tensor, settings: SynthSettings) -> Scene:
    """Prepare a scene from a full-size map."""
    return Scene(texture=reduced_texture(texture, SUPERSAMPLING * settings.diameter_px), settings=settings)


def render_frame(
    scene: Scene, camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Render one exposure.

    Args:
        scene: map, light, levels.
        camera: any model; its rays make the perspective and the distortion.
        position_lab_mm: (E, 3), centre at the E instants of the exposure.
        R_lab_body: (E, 3, 3), orientation at these instants.
        rng: of the noise.

    Returns:
        (H, W) uint8.

    Raises:
        CameraError: a ball that is not wholly before the camera, or not wholly in the liquid.
    """
    picture, _ = expose(scene, camera, position_lab_mm, R_lab_body)
    return digitise(picture, scene.settings, rng)


def expose(
    scene: Scene, camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the light of one exposure without noise, grey levels, and the share of each pixel that the ball fills.

    Args:
        scene: map, light, levels.
        camera: any model.
        position_lab_mm: (E, 3), centre at the E instants of the exposure.
        R_lab_body: (E, 3, 3), orientation at these instants.

    Returns:
        (H, W) float32 both, blurred by the optics.

    Raises:
        CameraError: a ball that is not wholly before the camera, or not wholly in the liquid.
    """
    settings = scene.settings
    width, height = camera.image_size
    picture = np.full((height, width), settings.background, np.float32)
    cover = np.zeros((height, width), np.float32)
    for position, R in zip(position_lab_mm, R_lab_body, strict=True):
        _add_sphere(picture, cover, scene, camera, position, R, 1.0 / len(position_lab_mm))
    if settings.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), settings.blur_px))
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), settings.blur_px))
    return picture, cover


def digitise(picture: NDArray[np.float32], settings: SynthSettings, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Add the camera's noise to grey levels (H, W) and round them to 8 bits."""
    sigma = np.sqrt(settings.read_noise**2 + settings.shot_noise**2 * np.maximum(picture, 0))
    noisy = picture + sigma * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _add_sphere(
    picture: NDArray[np.float32],
    cover: NDArray[np.float32],
    scene: Scene,
    camera: Camera,
    position: Tensor,
    R_lab_body: Tensor,
    share: float,
) -> None:
    """Blend the sphere at one instant over the background with weight `share`, and add what it covers to `cover`."""
    settings = scene.settings
    u, v = camera.project(position).tolist()
    height, width = picture.shape
    reach = math.ceil(reach_px(camera, position[None], settings.diameter_mm / 2)) + 2
    left, right = max(0, round(u) - reach), min(width, round(u) + reach + 1)
    top, bottom = max(0, round(v) - reach), min(height, round(v) + reach + 1)
    if left >= right or top >= bottom:
        return
    at = (torch.arange(SUPERSAMPLING, dtype=torch.float64) + 0.5) / SUPERSAMPLING - 0.5
    columns = (torch.arange(left, right)[:, None] + at).reshape(-1)
    rows = (torch.arange(top, bottom)[:, None] + at).reshape(-1)
    vv, uu = torch.meshgrid(rows, columns, indexing="ij")
    rays = camera.rays(torch.stack([uu, vv], dim=-1))
    normal, hit = sphere_normals(rays.origin_lab_mm, rays.direction_lab, position, settings.diameter_mm / 2)
    paint = sample_texture(scene.texture, (normal @ R_lab_body).float()).double()
    lamps = torch.tensor(LAMPS, dtype=torch.float64)
    direction = lamps[:, :3] / lamps[:, :3].norm(dim=-1, keepdim=True)
    lit = ((normal @ direction.T).clamp_min(0) * lamps[:, 3]).sum(-1) / 0.75
    light = settings.ambient + (1 - settings.ambient) * lit
    grey = (settings.black + (settings.white - settings.black) * paint) * light
    fine = torch.stack([torch.where(hit, grey, 0.0), hit.double()])
    mean = torch.nn.functional.avg_pool2d(fine[None], SUPERSAMPLING)[0].numpy().astype(np.float32)
    picture[top:bottom, left:right] += share * (mean[0] - mean[1] * settings.background)
    cover[top:bottom, left:right] += share * mean[1]
