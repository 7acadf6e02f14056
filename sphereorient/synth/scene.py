import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera, centre_lab_mm
from sphereorient.sphere import reduced_texture, see_sphere
from sphereorient.sphere.renderer import fine_pixels, lambert, reach_px
from sphereorient.synth.settings import SynthSettings

SUPERSAMPLING = 3  # rays per pixel and axis: edges are accurate to a few per cent

# Lamp directions from the sphere (lab) and shares: two bright, one weak, so that no side is black.
LAMPS = ((-0.6, -0.5, 0.6, 0.55), (0.7, -0.3, 0.65, 0.35), (0.0, 0.9, -0.4, 0.1))
LIT = 0.75  # share of the lamps that the brightest side receives


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedScene:
    """Static part of the scene: texture map, light, grey levels; made by `make_scene`."""

    texture: Tensor  # (H, 2 H) float32, reduced to the picture's resolution
    settings: SynthSettings


def make_scene(texture: Tensor, settings: SynthSettings) -> RenderedScene:
    """Prepare a scene from a texture map (H, 2 H)."""
    return RenderedScene(texture=reduced_texture(texture, SUPERSAMPLING * settings.diameter_px), settings=settings)


def render_frame(
    scene: RenderedScene, camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Render one noisy exposure, (H, W); arguments as in `expose`."""
    return digitise(expose(scene, camera, position_lab_mm, R_lab_body)[0], scene.settings, rng)


def expose(
    scene: RenderedScene, camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return one exposure of one ball at poses (E, 3) and (E, 3, 3), as `expose_several` does."""
    return expose_several([scene], camera, position_lab_mm[None], R_lab_body[None])


def expose_several(
    scenes: Sequence[RenderedScene], camera: Camera, position_lab_mm: Tensor, R_lab_body: Tensor
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return one exposure of K balls without noise, and what they cover, (H, W) float32 each, blurred by the optics.

    `position_lab_mm` (K, E, 3) and `R_lab_body` (K, E, 3, 3) are the poses at E instants of the exposure; no instants:
    empty. Nearer balls cover those behind them; balls cast no shadows.

    Raises:
        CameraError: sphere not wholly in front of the camera, or not wholly in the liquid.
    """
    settings = scenes[0].settings
    width, height = camera.image_size
    picture = np.full((height, width), settings.background, np.float32)
    cover = np.zeros((height, width), np.float32)
    share = 1.0 / max(1, position_lab_mm.shape[1])
    for places, rotations in zip(position_lab_mm.unbind(1), R_lab_body.unbind(1), strict=True):
        boxes = [_box(camera, X, one.settings.diameter_mm / 2) for X, one in zip(places, scenes, strict=True)]
        seen = [k for k, (left, right, top, bottom) in enumerate(boxes) if left < right and top < bottom]
        if not seen:
            continue
        first, last = np.min([boxes[k] for k in seen], axis=0), np.max([boxes[k] for k in seen], axis=0)
        left, right, top, bottom = (int(x) for x in (first[0], last[1], first[2], last[3]))
        grey, hit = both = np.zeros((2, bottom - top, right - left), np.float32)
        away = (places - centre_lab_mm(camera)).norm(dim=-1)
        for k in sorted(seen, key=lambda k: -float(away[k])):
            one = _window(scenes[k], camera, boxes[k], places[k], rotations[k])
            window = both[:, boxes[k][2] - top : boxes[k][3] - top, boxes[k][0] - left : boxes[k][1] - left]
            window[...] = (1 - one[1]) * window + one
        picture[top:bottom, left:right] += share * (grey - hit * settings.background)
        cover[top:bottom, left:right] += share * hit
    if settings.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), settings.blur_px))
        cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), settings.blur_px))
    return picture, cover


def _box(camera: Camera, position: Tensor, radius_mm: float) -> tuple[int, int, int, int]:
    """Return left, right, top and bottom (the second of each excluded) of a ball in a picture, px, with a margin."""
    (width, height), (u, v) = camera.image_size, camera.project(position).tolist()
    reach = math.ceil(reach_px(camera, position[None], radius_mm)) + 2
    left, right = max(0, round(u) - reach), min(width, round(u) + reach + 1)
    top, bottom = max(0, round(v) - reach), min(height, round(v) + reach + 1)
    return left, right, top, bottom


def digitise(picture: NDArray[np.float32], settings: SynthSettings, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Add camera noise to grey levels (H, W) and round to 8 bits."""
    sigma = np.sqrt(settings.read_noise**2 + settings.shot_noise**2 * np.maximum(picture, 0))
    noisy = picture + sigma * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _window(
    scene: RenderedScene, camera: Camera, box: tuple[int, int, int, int], position: Tensor, R_lab_body: Tensor
) -> NDArray[np.float32]:
    """Return shaded paint times coverage, and coverage, (2, h, w), in the box left, right, top, bottom."""
    settings = scene.settings
    left, right, top, bottom = box
    within = fine_pixels(1, SUPERSAMPLING)
    columns = (torch.arange(left, right)[:, None] + within).reshape(-1)
    rows = (torch.arange(top, bottom)[:, None] + within).reshape(-1)
    vv, uu = torch.meshgrid(rows, columns, indexing="ij")
    rays = camera.rays(torch.stack([uu, vv], dim=-1).flatten(0, 1))
    seen = see_sphere(rays, position, R_lab_body, scene.texture, settings.diameter_mm / 2)
    hit = seen.depth2 > 0
    lamps = torch.tensor(LAMPS, dtype=torch.float64)
    direction = lamps[:, :3] / lamps[:, :3].norm(dim=-1, keepdim=True)
    lit = lambert(seen.normal, direction, lamps[:, 3]) / LIT
    light = settings.ambient + (1 - settings.ambient) * lit
    grey = (settings.black + (settings.white - settings.black) * seen.paint) * light
    fine = torch.stack([torch.where(hit, grey, 0.0), hit.double()]).reshape(2, *uu.shape)
    return torch.nn.functional.avg_pool2d(fine[None], SUPERSAMPLING)[0].numpy().astype(np.float32)
