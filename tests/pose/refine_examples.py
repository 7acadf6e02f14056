"""Balls seen by one or two cameras, in grey levels that are not rounded, for the tests of the precise refinement."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, PinholeCamera, TsaiCamera
from sphereorient.locate import Background, CameraScene
from sphereorient.pose.camera_view import CameraView
from sphereorient.pose.compiled import body_of
from sphereorient.pose.fitter import Fitter, first_fitter
from sphereorient.pose.lights.disk import DiskLight
from sphereorient.pose.model import LATER, Shading, SphereModel
from sphereorient.pose.pixels import LinesOfSight, Pixels, cut_pixels, disk_stencil, stacked
from sphereorient.pose.poses import FittedPoses, PoseStart
from sphereorient.sphere import Sampling, SphereRenderer
from sphereorient.sphere.texture_table import BASE_RAD, TextureTable, texture_table
from sphereorient.synth import random_texture

RADIUS_MM, DISTANCE_MM = 9.0, 260.0
OPTICS_PX = 0.55
BLUR_PX = math.hypot(OPTICS_PX, math.sqrt(1 / 12))  # the optics' and the pixel's own, as one Gaussian
BLACK, WHITE, BEHIND = 40.0, 200.0, 15.0  # grey levels
LOOKS = ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[1, 0, 0], [0, -1, 0], [0, 0, -1]])  # along lab +y, along lab -z
KAPPA = 5e-3  # 1/mm^2; 1.5 % of the place 60 px off the axis


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@cache
def paint_of(kind: str) -> Tensor:
    return random_texture(kind, 3, 256)


@cache
def base_of(kind: str) -> TextureTable:
    return texture_table(paint_of(kind), BASE_RAD)


@cache
def table_of(kind: str, blur_rad: float) -> TextureTable:
    return base_of(kind).blurred(blur_rad)


@dataclass(frozen=True)
class Rig:
    """Cameras about a ball, and cached tables of them."""

    cameras: tuple[Camera, ...]
    sights: tuple[LinesOfSight, ...]
    diameter_px: float

    @property
    def px_mm(self) -> float:
        """Size of a pixel at the ball."""
        return 2 * RADIUS_MM / self.diameter_px

    def table(self, kind: str) -> TextureTable:
        return table_of(kind, 2 * BLUR_PX / self.diameter_px)


def camera_of(model: str, look: list[list[int]], diameter_px: float, size_px: int) -> Camera:
    """A near camera, so that perspective counts."""
    f_px = diameter_px / (2 * RADIUS_MM) * DISTANCE_MM
    common = {
        "image_size": (size_px, size_px),
        "R_cam_lab": f64(look),
        "T_cam_lab_mm": f64([0, 0, DISTANCE_MM]),
        "centre_px": f64([0.5 * (size_px - 1)] * 2),
    }
    if model == "pinhole":
        return PinholeCamera(f_px=f64(f_px), **common)
    pitch = 0.02
    return TsaiCamera(f_mm=f64(f_px * pitch), pixel_pitch_mm=f64([pitch] * 2), sx=f64(1), kappa1=f64(KAPPA), **common)


@cache
def rig_of(diameter_px: float = 64.0, models: tuple[str, ...] = ("pinhole", "tsai")) -> Rig:
    size = round(2.5 * diameter_px)
    cameras = tuple(
        camera_of(model, look, diameter_px, size) for model, look in zip(models, LOOKS[: len(models)], strict=True)
    )
    return Rig(cameras, tuple(LinesOfSight(camera) for camera in cameras), diameter_px)


def balls(count: int, seed: int, reach_mm: float = 4.0) -> tuple[Tensor, Tensor]:
    """Places near the origin and attitudes, (count, 3) and (count, 3, 3)."""
    rng = torch.Generator().manual_seed(seed)
    X = reach_mm * (2 * torch.rand(count, 3, generator=rng, dtype=torch.float64) - 1)
    return X, so3.random_rotations(count, generator=rng)


def share_pictures(rig: Rig, kind: str, X: Tensor, R: Tensor, blur_px: float = OPTICS_PX) -> tuple[Tensor, Tensor]:
    """White paint's and the ball's share of every pixel, (B, C, H, W) each: linear, so that any light can be put on."""
    sampling = Sampling(blur_px=blur_px)
    shares = []
    for paint in (paint_of(kind), torch.ones(32, 64)):
        renderers = [SphereRenderer(paint, radius_mm=RADIUS_MM, camera=one, sampling=sampling) for one in rig.cameras]
        shares.append(torch.stack([render(R, X).float() for render in renderers], dim=1))
    return shares[0], shares[1]


def pictures_of(rig: Rig, kind: str, X: Tensor, R: Tensor) -> Tensor:
    """Evenly lit pictures, (B, C, H, W), grey levels."""
    paint, ball = share_pictures(rig, kind, X, R)
    return BEHIND + (BLACK - BEHIND) * ball + (WHITE - BLACK) * paint


def noisy(pictures: Tensor, sigma: float, seed: int) -> Tensor:
    return pictures + sigma * torch.randn(pictures.shape, generator=torch.Generator().manual_seed(seed))


def scene_of(
    mean: NDArray[np.float32], shown: NDArray[np.bool_] | None = None, full_scale: float = math.inf
) -> Background:
    """The background with this mean picture."""
    return Background(mean=mean, noise=np.ones_like(mean), full_scale=full_scale, shown=shown)


def cut(rig: Rig, pictures: Tensor, X: Tensor, behind: float = BEHIND, full_scale: float = math.inf) -> Pixels:
    """The pixels of all disks, cameras of a pose next to each other, about inexact positions."""
    stencil = disk_stencil(1.06 * rig.diameter_px / 2 + 2.5 * BLUR_PX)
    background = scene_of(np.full(pictures.shape[-2:], behind, np.float32), full_scale=full_scale)
    disks = []
    for one, frames in zip(X, pictures, strict=True):
        for camera, sight, frame in zip(rig.cameras, rig.sights, frames, strict=True):
            u, v = camera.project(one).tolist()
            disks.append(cut_pixels(frame.numpy(), background, sight, (u, v), stencil))
    return stacked(disks)


def flat_light(cameras: int, sigma: float) -> DiskLight:
    """Settings with learnt noise alone."""
    return DiskLight.unknown(cameras, torch.tensor([[sigma**2, 0.0, 0.0, 0.0]] * cameras))


def model_of(paint: TextureTable, sigma: float = 1.0, shading: Shading = LATER) -> SphereModel:
    """Views of two cameras before any light is learnt."""
    light = flat_light(2, sigma)
    return SphereModel(radius_mm=RADIUS_MM, paint=paint, blur_px=BLUR_PX, light=light, shading=shading)


def refined(
    pixels: Pixels, begin: PoseStart, model: SphereModel, iterations: int = 4, most_hidden: float = 0.0
) -> FittedPoses:
    """Fit by compiled code, where there is any."""
    return body_of(begin.position_lab_mm).refine(pixels, begin, model, iterations, most_hidden)


def fitted(rig: Rig, kind: str, pixels: Pixels, X: Tensor, R: Tensor, sigma: float, **changes: object) -> FittedPoses:
    """Refine with all cameras by default."""
    use = changes.pop("use", torch.ones(len(X), len(rig.cameras), dtype=torch.bool))
    iterations, known = changes.pop("iterations", 6), changes.pop("place_precision", None)
    given = {"radius_mm": RADIUS_MM, "paint": rig.table(kind), "blur_px": BLUR_PX}
    model = SphereModel(**given | {"light": flat_light(len(rig.cameras), sigma)} | changes)
    return refined(pixels, PoseStart(X, R, use, known), model, iterations)


def turned(R: Tensor, angle_deg: float, seed: int) -> Tensor:
    """Rotations at an angle from R (B, 3, 3), about axes of any direction in the lab."""
    axis = torch.randn(len(R), 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return so3.exp(math.radians(angle_deg) * torch.nn.functional.normalize(axis, dim=1)) @ R


def moved(X: Tensor, distance_mm: float, seed: int) -> Tensor:
    """Places at a distance from X (B, 3), in any direction."""
    axis = torch.randn(len(X), 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return X + distance_mm * torch.nn.functional.normalize(axis, dim=1)


def turn_errors(fit: FittedPoses, R: Tensor) -> Tensor:
    """delta of R = exp(delta) R_fitted, (B, 3), rad, lab."""
    return so3.log(R @ fit.R_lab_body.mT)


def fitter_of(rig: Rig, blur_px: float = BLUR_PX) -> Fitter:
    """A fitter of the rig's cameras without light, with a guessed blur."""
    views = []
    for k, camera in enumerate(rig.cameras):
        scene = CameraScene(background=scene_of(np.full((120, 120), BEHIND, np.float32)), diameter_px=rig.diameter_px)
        views.append(CameraView.of(f"cam{k + 1}", camera, scene))
    return first_fitter(views, RADIUS_MM, base_of("patches"), blur_px)
