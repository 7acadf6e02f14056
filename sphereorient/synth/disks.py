"""Random crops of single spheres, for training and benchmarks of proposers."""

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from pydantic import BaseModel, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Rays
from sphereorient.sphere import reduced_texture, see_sphere
from sphereorient.sphere.renderer import lambert
from sphereorient.sphere.texture import random_directions
from sphereorient.sphere.view import disk_offsets
from sphereorient.synth.degrade import ON_THE_BALL, OPERATIONS, Disk, blurred, centre_error, degrade, radius_error
from sphereorient.synth.scene import LIT
from sphereorient.synth.severities import DEGRADATIONS, check_values

BLUR_INSTANTS = 8  # sampled orientations per exposure
LEVELS = (120.0, 200.0), (8.0, 30.0), (8.0, 40.0)  # grey level ranges of white paint, black paint, background
AMBIENT = (0.3, 1.0)  # range of the ambient share
LAMPS = 2
READ_NOISE, SHOT_NOISE, BLUR_PX = 1.5, 0.3, 0.55  # always present, as in `SynthSettings`
IN_PX = ("dirt", "defocus", "centre_error", "radius_error")  # values that scale with the picture
OF_MAPS_AND_DISKS = {"ball_size", "motion_blur", "paint_wear", "centre_error", "radius_error", "texture_error"}
# without degradations of movies and of two cameras
DISK_DEGRADATIONS = tuple(name for name in DEGRADATIONS if name in OPERATIONS or name in OF_MAPS_AND_DISKS)


class DiskSettings(BaseModel, frozen=True, extra="forbid"):
    """How single balls are filmed."""

    size_px: int = Field(40, ge=16, le=128, description="side of the resulting disks, px")
    diameter_px: float = Field(78.0, ge=16, description="of the ball without `ball_size`, px")
    scale: float = Field(
        1.0, gt=0.2, le=1, description="pictures have pixels coarser by this factor: 0.5 is four times as fast"
    )
    centre_sigma_px: float = Field(0.4, ge=0, description="usual error of an outline's centre, px")
    radius_sigma: float = Field(0.01, ge=0, description="usual error of its radius, share")


def film_disks(
    texture: Tensor, R_view_body: Tensor, values: Mapping[str, float], rng: torch.Generator, settings: DiskSettings
) -> Tensor:
    """Film a sphere with random light per picture; return crops (F, S, S) float32, grey levels. `texture` is the worn
    map (H, 2 H), `R_view_body` (F, 3, 3), `values` of `DISK_DEGRADATIONS`, physical; those of maps are ignored. Raises
    SettingsError: unknown name or impossible value.
    """
    check_values(values, DISK_DEGRADATIONS, "film a movie: write_degraded")
    scale = settings.scale
    diameter = values.get("ball_size", settings.diameter_px)
    if diameter < settings.diameter_px:
        scale = max(scale, min(1.0, settings.size_px / diameter))  # coarse pictures keep their size
    radius = diameter * scale / 2
    count = len(R_view_body)
    side = 2 * math.ceil(radius * (1 + 0.2)) + 2  # margin beyond the limb, radii
    middle = side / 2 - 0.5 + torch.rand((count, 2), generator=rng) - 0.5
    disk = Disk(centre_px=middle, radius_px=torch.full((count,), radius))
    grey, behind = _lit(texture, R_view_body.float(), values, disk, side, rng)
    within = {name: value * (scale if name in IN_PX else 1.0) for name, value in values.items() if name in OPERATIONS}
    before, lamps = replace(disk, behind=behind), {name: within.pop(name) for name in ON_THE_BALL if name in within}
    grey = blurred(degrade(grey, before, lamps, rng), max(BLUR_PX * scale, 0.3))  # coarse pixels add blur
    grey = degrade(grey, before, within, rng)
    noise = (READ_NOISE**2 + SHOT_NOISE**2 * grey.clamp_min(0)).sqrt()
    grey = (grey + noise * torch.randn(grey.shape, generator=rng)).round().clamp(0, 255)
    return _cropped(grey, _outline(disk, values, scale, rng, settings), settings.size_px)


def _lit(
    texture: Tensor, R: Tensor, values: Mapping[str, float], disk: Disk, side: int, rng: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return pictures (F, S, S) without degradations, and the grey levels behind their balls, (F, 1, 1)."""
    count, radius = len(R), float(disk.radius_px.amax()) if len(R) else 1.0
    right, down = disk.offset(torch.empty(count, side, side))
    origin = torch.nn.functional.pad(
        torch.stack([right.expand(-1, side, -1), down.expand(-1, -1, side)], -1).flatten(1, 2), (0, 1)
    )
    rays = Rays(origin_lab_mm=origin, direction_lab=origin.new_tensor([0.0, 0.0, 1.0]))
    seen = see_sphere(rays, torch.zeros(3), _instants(R, values, rng), reduced_texture(texture, 2 * radius), radius)
    white, black, behind = (low + (high - low) * torch.rand((count, 1), generator=rng) for low, high in LEVELS)
    grey = (black + (white - black) * seen.paint.mean(0)) * _light(seen.normal, rng)
    grey, behind = grey.reshape(count, side, side), behind[..., None]
    return behind + disk.covered(grey) * (grey - behind), behind


def _instants(R: Tensor, values: Mapping[str, float], rng: torch.Generator) -> Tensor:
    """Return orientations (E, F, 3, 3) during the exposure, with normal rotation vectors."""
    degrees = values.get("motion_blur", 0.0)
    if degrees == 0:
        return R[None]
    rotation = math.radians(degrees) / math.sqrt(3) * torch.randn((len(R), 3), generator=rng)
    at = (torch.arange(BLUR_INSTANTS) + 0.5) / BLUR_INSTANTS - 0.5
    return so3.exp(at[:, None, None] * rotation) @ R


def _light(normal: Tensor, rng: torch.Generator) -> Tensor:
    """Return ambient light and random lamps on the camera's side for normals (F, P, 3)."""
    count = len(normal)
    ambient = AMBIENT[0] + (AMBIENT[1] - AMBIENT[0]) * torch.rand((count, 1), generator=rng)
    lamps = random_directions(count * LAMPS, rng).float().reshape(count, LAMPS, 3)
    lamps = torch.cat([lamps[..., :2], -lamps[..., 2:].abs()], -1)
    return ambient + (1 - ambient) * lambert(normal, lamps, 1 / LAMPS) / LIT


def _outline(
    disk: Disk, values: Mapping[str, float], scale: float, rng: torch.Generator, settings: DiskSettings
) -> Disk:
    count = len(disk.radius_px)
    if "centre_error" in values:
        disk = centre_error(disk, values["centre_error"] * scale, rng)
    if "radius_error" in values:
        disk = radius_error(disk, values["radius_error"] * scale)
    centre = disk.centre_px + settings.centre_sigma_px * scale * torch.randn((count, 2), generator=rng)
    radius = disk.radius_px * (1 + settings.radius_sigma * torch.randn(count, generator=rng))
    return Disk(centre_px=centre, radius_px=radius)


def _cropped(grey: Tensor, disk: Disk, size_px: int) -> Tensor:
    """Resample disks to a common size, bilinear, as `crop_disk` does."""
    side = grey.shape[-1]
    at = disk.centre_px[:, None, None, :] + disk.radius_px[:, None, None, None] * disk_offsets(size_px).float()
    place = (2 * at + 1) / side - 1
    found: Tensor = torch.nn.functional.grid_sample(
        grey[:, None], place, mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[:, 0]
