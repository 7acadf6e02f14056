"""Pictures of single balls, cropped as a proposer wants them, by the thousand: for training and for its benchmark."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, refusal
from sphereorient.sphere import reduced_texture, sample_texture
from sphereorient.sphere.view import disk_offsets
from sphereorient.synth.degrade import OPERATIONS, Disk, blurred, centre_error, degrade, radius_error
from sphereorient.synth.severities import DEGRADATIONS
from sphereorient.synth.textures import random_directions

MARGIN = 0.2  # of the radius: what is filmed beside the ball
BLUR_INSTANTS = 8  # of an exposure during which the ball turns
LEVELS = (120.0, 200.0), (8.0, 30.0), (8.0, 40.0)  # grey of white paint, of black paint, of what is behind, drawn
AMBIENT = (0.3, 1.0)  # share of the light that comes evenly from everywhere, drawn
LAMPS = 2
READ_NOISE, SHOT_NOISE, BLUR_PX = 1.5, 0.3, 0.55  # as `SynthSettings`: there always
IN_PX = ("dirt", "defocus", "centre_error", "radius_error")  # values that shrink with the picture
# One picture of one ball: what acts on movies, and what two cameras disagree about, has no place here.
DISK_DEGRADATIONS = tuple(
    name
    for name in DEGRADATIONS
    if name in OPERATIONS
    or name in ("ball_size", "motion_blur", "paint_wear", "centre_error", "radius_error", "texture_error")
)


class DiskSettings(BaseModel):
    """How single balls are filmed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size_px: int = Field(40, ge=16, le=128, description="side of the disks that come out, px")
    diameter_px: float = Field(78.0, ge=16, description="of the ball where `ball_size` says nothing, px")
    scale: float = Field(
        1.0, gt=0.2, le=1, description="pictures are taken with pixels this much coarser: 0.5 is four times as fast"
    )
    centre_sigma_px: float = Field(0.4, ge=0, description="usual error of an outline's centre, px")
    radius_sigma: float = Field(0.01, ge=0, description="usual error of its radius, share")


def film_disks(
    texture: Tensor, R_view_body: Tensor, values: Mapping[str, float], rng: torch.Generator, settings: DiskSettings
) -> Tensor:
    """Film a ball in several attitudes under light that is drawn anew each time, and crop the disks.

    Args:
        texture: (H, 2 H), the paint that is on the ball, worn where it is.
        R_view_body: (F, 3, 3), the attitudes.
        values: name of `DISK_DEGRADATIONS` -> physical value; `paint_wear` and `texture_error`, which change maps, are
            not looked at.
        rng: of all that is random.
        settings: of the pictures.

    Returns:
        (F, S, S) float32, grey levels in whole numbers before resampling, as `crop_disk` gives them.

    Raises:
        SettingsError: an unknown name, or an impossible value.
    """
    _check(values)
    scale = settings.scale
    diameter = values.get("ball_size", settings.diameter_px)
    if diameter < settings.diameter_px:
        scale = max(scale, min(1.0, settings.size_px / diameter))  # what is coarse already stays as it is
    radius = diameter * scale / 2
    count = len(R_view_body)
    side = 2 * math.ceil(radius * (1 + MARGIN)) + 2
    middle = side / 2 - 0.5 + torch.rand((count, 2), generator=rng) - 0.5
    disk = Disk(centre_px=middle, radius_px=torch.full((count,), radius))
    grey = _lit(texture, R_view_body.float(), values, disk, side, rng)
    within = {name: value * (scale if name in IN_PX else 1.0) for name, value in values.items() if name in OPERATIONS}
    grey = degrade(_optics(grey, scale), disk, within, rng)
    noise = (READ_NOISE**2 + SHOT_NOISE**2 * grey.clamp_min(0)).sqrt()
    grey = (grey + noise * torch.randn(grey.shape, generator=rng)).round().clamp(0, 255)
    return _cropped(grey, _told(disk, values, scale, rng, settings), settings.size_px)


def _check(values: Mapping[str, float]) -> None:
    for name, value in values.items():
        if name not in DISK_DEGRADATIONS:
            expected, do = f"one of {', '.join(DISK_DEGRADATIONS)}", "film a movie: write_degraded"
            raise SettingsError(refusal("degradation of single balls", expected=expected, got=name[:40], do=do))
        DEGRADATIONS[name].check(value)


def _lit(
    texture: Tensor, R: Tensor, values: Mapping[str, float], disk: Disk, side: int, rng: torch.Generator
) -> Tensor:
    """Grey levels (F, side, side) of balls before what is behind them."""
    count, radius = len(R), float(disk.radius_px.amax()) if len(R) else 1.0  # all have the same
    right, down = disk.offset(torch.empty(count, side, side))
    x, y = (right / radius).expand(-1, side, -1), (down / radius).expand(-1, -1, side)
    depth = (1 - x.square() - y.square()).clamp_min(1e-6).sqrt()
    normal = torch.stack([x, y, -depth], -1).flatten(1, 2)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    paint = _turning_paint(texture, R, normal, radius, values.get("motion_blur", 0.0), rng)
    levels = [low + (high - low) * torch.rand((count, 1), generator=rng) for low, high in LEVELS]
    white, black, behind = levels
    grey = ((black + (white - black) * paint) * _light(normal, rng)).reshape(count, side, side)
    cover = disk.covered(grey)
    return behind[..., None] + cover * (grey - behind[..., None])


def _turning_paint(
    texture: Tensor, R: Tensor, normal: Tensor, radius: float, degrees: float, rng: torch.Generator
) -> Tensor:
    """Paint at normals (F, P, 3) in the view frame, the mean over an exposure, (F, P)."""
    reduced = reduced_texture(texture, 2 * radius)
    if degrees == 0:
        return sample_texture(reduced, normal @ R)
    # Components normally distributed, as those of a sphere in turbulence.
    turn = math.radians(degrees) / math.sqrt(3) * torch.randn((len(R), 3), generator=rng)
    at = (torch.arange(BLUR_INSTANTS) + 0.5) / BLUR_INSTANTS - 0.5
    instants = so3.exp(at[:, None, None] * turn) @ R
    return torch.stack([sample_texture(reduced, normal @ each) for each in instants]).mean(0)


def _light(normal: Tensor, rng: torch.Generator) -> Tensor:
    """Light on normals (F, P, 3): an even part and lamps anywhere on the camera's side, 1 at most nearly everywhere."""
    count = len(normal)
    ambient = AMBIENT[0] + (AMBIENT[1] - AMBIENT[0]) * torch.rand((count, 1), generator=rng)
    lamps = random_directions(count * LAMPS, rng).float().reshape(count, LAMPS, 3)
    lamps = torch.cat([lamps[..., :2], -lamps[..., 2:].abs()], -1)
    lit = (normal @ lamps.mT).clamp_min(0).mean(-1) / 0.75
    return ambient + (1 - ambient) * lit


def _optics(grey: Tensor, scale: float) -> Tensor:
    """Blur of the lens; of coarser pixels a floor, below which their own is all there is."""
    return blurred(grey, max(BLUR_PX * scale, 0.3))


def _told(disk: Disk, values: Mapping[str, float], scale: float, rng: torch.Generator, settings: DiskSettings) -> Disk:
    """Where an outline says that the disks are."""
    count = len(disk.radius_px)
    if "centre_error" in values:
        disk = centre_error(disk, values["centre_error"] * scale, rng)
    if "radius_error" in values:
        disk = radius_error(disk, values["radius_error"] * scale)
    centre = disk.centre_px + settings.centre_sigma_px * scale * torch.randn((count, 2), generator=rng)
    radius = disk.radius_px * (1 + settings.radius_sigma * torch.randn(count, generator=rng))
    return Disk(centre_px=centre, radius_px=radius)


def _cropped(grey: Tensor, disk: Disk, size_px: int) -> Tensor:
    """Resample disks to a common size, bilinear, as `crop_disk` does, (F, S, S)."""
    side = grey.shape[-1]
    at = disk.centre_px[:, None, None, :] + disk.radius_px[:, None, None, None] * disk_offsets(size_px).float()
    place = (2 * at + 1) / side - 1
    found: Tensor = torch.nn.functional.grid_sample(
        grey[:, None], place, mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[:, 0]
