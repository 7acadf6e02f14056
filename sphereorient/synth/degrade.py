"""Degradations of picture batches, without kornia's augmentations, which draw from torch's global generator."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.synth.severities import DEGRADATIONS, check_values, degradation

WHITE_LEVEL = 255
VEIL = 95.0  # grey level of turbid liquid
OCCLUDER, SPECK, GLINT = 30.0, 12.0, 120.0  # grey levels of an occluder, of dirt, of a bubble's glint
LOBES, LOBE_RADII = 2, 0.12  # highlights: number, and sigma in sphere radii
BUBBLE_RADII = 0.12  # bubble radius in sphere radii
SPECKS_PER_PX2 = 6e-4  # three on the paper's disk
CLUTTER_PX = 6.0  # sigma of the background structure: about as coarse as the paint
DARKEST = 1.0  # least grey level for shot noise, as the root has infinite slope at 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Disk:
    """The sphere's disk in pictures (..., H, W)."""

    centre_px: Tensor  # (..., 2) as (u, v)
    radius_px: Tensor  # (...)
    cover: Tensor | None = None  # (..., H, W), coverage of each pixel; None: a round disk
    behind: Tensor | None = None  # grey levels behind it, like the pictures; None: as bright as the sphere

    def __post_init__(self) -> None:
        check_tail("centre_px", self.centre_px, 2)

    def offset(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return each pixel's offset from the centre to the right and down, (..., H, W) each, px."""
        height, width = pictures.shape[-2:]
        centre = self.centre_px.to(pictures)[..., None, None, :]
        right = torch.arange(width, dtype=pictures.dtype, device=pictures.device)
        down = torch.arange(height, dtype=pictures.dtype, device=pictures.device)[:, None]
        return right - centre[..., 0], down - centre[..., 1]

    def radius(self, pictures: Tensor) -> Tensor:
        """Return the radius, px, (..., 1, 1), to broadcast over pixels."""
        return self.radius_px.to(pictures)[..., None, None]

    def within(self, window: tuple[slice, slice]) -> Self:
        """Return the disk in a part of the pictures: rows and columns."""
        corner = self.centre_px.new_tensor([side.start for side in window[::-1]])
        return replace(self, centre_px=self.centre_px - corner)

    def covered(self, pictures: Tensor) -> Tensor:
        """Return the coverage of each pixel, (..., H, W), 0 to 1."""
        if self.cover is not None:
            return self.cover.to(pictures)
        return _round(*self.offset(pictures), self.radius(pictures))


Operation = Callable[[Tensor, float, Disk, torch.Generator], Tensor]
Draw = Callable[[Tensor, float, torch.Generator], Tensor]
Put = Callable[[Tensor, Tensor, Disk], Tensor]


def degrade(pictures: Tensor, disk: Disk, values: Mapping[str, float], rng: torch.Generator) -> Tensor:
    """Return pictures (..., H, W), unrounded and unclipped floats, with degradations in a fixed order.
    `values` maps names to physical values, see `severity`.
    Raises SettingsError: unknown name, no picture degradation, or impossible value; ShapeError: not pictures.
    """
    if pictures.ndim < 2 or not pictures.is_floating_point():
        got, do = f"{tuple(pictures.shape)} {pictures.dtype}", "pass grey levels as floats"
        raise ShapeError(refusal("pictures", expected="(..., H, W) floats", got=got, do=do))
    check_values(values, OPERATIONS, "apply it with write_degraded, which films the scene")
    for name, operation in OPERATIONS.items():
        if name in values and values[name] != DEGRADATIONS[name].nothing:
            pictures = operation(pictures, values[name], disk, rng)
    return pictures


def uneven_light(pictures: Tensor, ratio: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Dim the sphere across the disk, to 1 / ratio at one limb, without the background."""
    angle = 2 * math.pi * _uniform(pictures, rng, 1)[..., 0, None, None]
    right, down = disk.offset(pictures)
    across = ((right * angle.cos() + down * angle.sin()) / disk.radius(pictures)).clamp(-1, 1)
    left = torch.exp(0.5 * math.log(ratio) * (across - 1))
    behind = pictures if disk.behind is None else disk.behind.to(pictures)
    return pictures + (left - 1) * (pictures - (1 - disk.covered(pictures)) * behind)


def highlights(pictures: Tensor, peak: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Add Gaussian lamp reflections of `peak` grey levels."""
    draw = _uniform(pictures, rng, 1 + LOBES)[..., None, None]
    radius = disk.radius(pictures)
    right, down = disk.offset(pictures)
    light = torch.zeros_like(pictures)
    for lobe in range(LOBES):
        angle = 2 * math.pi * (draw[..., 0, :, :] + lobe / LOBES)
        away = (0.2 + 0.5 * draw[..., 1 + lobe, :, :]) * radius
        light = light + _glow(right - away * angle.cos(), down - away * angle.sin(), LOBE_RADII * radius)
    return pictures + peak * disk.covered(pictures) * light


def background_clutter(pictures: Tensor, rms: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Add structure behind the sphere, see `clutter`."""
    return add_behind(pictures, clutter(pictures, rms, rng), disk)


def clutter(pictures: Tensor, rms: float, rng: torch.Generator) -> Tensor:
    """Draw structure (..., H, W), uniformly distributed, at least 0, standard deviation `rms` grey levels."""
    field = blurred(_normal(pictures, rng), CLUTTER_PX)
    field = (field - field.mean((-2, -1), keepdim=True)) / _spread(field)
    even = torch.special.ndtr(field)
    even = even - even.amin((-2, -1), keepdim=True)
    found: Tensor = (rms / _spread(even)) * even
    return found


def add_behind(pictures: Tensor, light: Tensor, disk: Disk) -> Tensor:
    """Add grey levels (..., H, W) behind the sphere."""
    return pictures + (1 - disk.covered(pictures)) * light


def occlusion(pictures: Tensor, share: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Hide this share of the disk behind an equal dark disk, on a random side."""
    if share == 0:
        return pictures
    angle = 2 * math.pi * _uniform(pictures, rng, 1)[..., 0, None, None]
    radius = disk.radius(pictures)
    from scipy.optimize import bisect  # imported late, as kornia below: tracking does not need it

    away = bisect(lambda apart: _overlap(apart) - share, 0.0, 2.0, xtol=1e-15) * radius
    right, down = disk.offset(pictures)
    hidden = _round(right - away * angle.cos(), down - away * angle.sin(), radius)
    return pictures + hidden * (OCCLUDER - pictures)


def bubbles(pictures: Tensor, number: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Draw bubbles in front of the disk: clear centre, dark rim, glint at the upper left."""
    count = round(number)
    draw = _uniform(pictures, rng, count, 2)
    radius = disk.radius(pictures)
    size = BUBBLE_RADII * radius
    right, down = disk.offset(pictures)
    pictures = pictures.clone()
    for k in range(count):
        angle = 2 * math.pi * draw[..., k, 0, None, None]
        away = draw[..., k, 1, None, None].sqrt() * radius
        x, y = right - away * angle.cos(), down - away * angle.sin()
        rows, columns = _reached(y.mT.abs() < size + 1), _reached(x.abs() < size + 1)
        x, y, there = x[..., columns], y[..., rows, :], pictures[..., rows, columns].clone()
        inside = _round(x, y, size)
        fourth = ((x.square() + y.square()) / size.square()).square()
        glint = _glow(x + 0.4 * size, y + 0.4 * size, 0.15 * size)
        there = there * (1 - inside * (0.15 + 0.6 * fourth).clamp_max(0.75)) + GLINT * inside * glint
        pictures[..., rows, columns] = there
    return pictures


def _reached(near: Tensor) -> slice:
    """Return the part of the last axis of (..., 1, N) bool with any true value."""
    places = near.flatten(0, -2).any(0).nonzero()[:, 0].tolist()
    return slice(places[0], places[-1] + 1) if places else slice(0)


def _glow(right: Tensor, down: Tensor, sigma: Tensor) -> Tensor:
    across, along = (torch.exp(-0.5 * (offset / sigma).square()) for offset in (right, down))
    return across * along


def dirt(pictures: Tensor, radius_px: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Draw dark round specks of this radius, px, anywhere in the picture."""
    return darken(pictures, specks(pictures, radius_px, rng), disk)


def specks(pictures: Tensor, radius_px: float, rng: torch.Generator) -> Tensor:
    """Return the share of each pixel hidden by drawn specks, (..., H, W)."""
    if radius_px == 0 or pictures.numel() == 0:
        return torch.zeros_like(pictures)
    height, width = pictures.shape[-2:]
    half = math.ceil(radius_px)
    # Centres lie beyond the border too, as specks reach in from there.
    wider = pictures.new_empty((*pictures.shape[:-2], height + 2 * half, width + 2 * half))
    middles = (torch.rand(wider.shape, generator=rng, dtype=wider.dtype, device=rng.device) < SPECKS_PER_PX2).to(wider)
    at = torch.arange(-half, half + 1, dtype=pictures.dtype, device=pictures.device)
    speck = _round(at, at[:, None], pictures.new_tensor(radius_px))
    from kornia.filters import filter2d

    flat = middles.reshape(-1, 1, *wider.shape[-2:])
    hidden: Tensor = filter2d(flat, speck[None], border_type="constant", padding="valid").clamp_max(1)
    return hidden.reshape(pictures.shape)


def darken(pictures: Tensor, hidden: Tensor, disk: Disk) -> Tensor:
    """Hide shares (..., H, W) of the pixels behind specks."""
    return pictures + hidden * (SPECK - pictures)


def contrast_loss(pictures: Tensor, share: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Move all grey levels towards VEIL by this share."""
    return pictures + share * (VEIL - pictures)


def defocus(pictures: Tensor, sigma_px: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Blur with a Gaussian of this standard deviation, px."""
    return blurred(pictures, sigma_px)


def saturation(pictures: Tensor, share: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Brighten each picture until this share of its white paint (above the mean of the extremes) exceeds 255."""
    if share == 0:
        return pictures
    inside = (disk.covered(pictures) > 0.99).expand(pictures.shape).flatten(-2)
    grey = pictures.flatten(-2)
    low = grey.masked_fill(~inside, math.inf).amin(-1, keepdim=True)
    high = grey.masked_fill(~inside, -math.inf).amax(-1, keepdim=True)
    return pictures * gain_to_clip(grey, inside & (grey > 0.5 * (low + high)), share)[..., None, None]


def gain_to_clip(grey: Tensor, white: Tensor, share: float) -> Tensor:
    """Return the gain (...), at least 1, that raises a share of the white pixels above 255; both tensors (..., P)."""
    count = white.sum(-1, keepdim=True)
    falling = grey.masked_fill(~white, -math.inf).sort(-1, descending=True).values
    limit = (share * count).round().long().minimum((count - 1).clamp_min(0))
    level = falling.gather(-1, limit)[..., 0]
    level = torch.where(level > 0, level, torch.full_like(level, WHITE_LEVEL))  # no white paint visible
    gain: Tensor = (WHITE_LEVEL / level).clamp_min(1)
    return gain


def shot_noise(pictures: Tensor, per_root: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Add white noise of `per_root` times the root of the grey level."""
    return pictures + per_root * pictures.clamp_min(DARKEST).sqrt() * _normal(pictures, rng)


def read_noise(pictures: Tensor, sigma: float, disk: Disk, rng: torch.Generator) -> Tensor:
    """Add white noise of this standard deviation, grey levels."""
    return pictures + sigma * _normal(pictures, rng)


_ALL = (uneven_light, highlights, background_clutter, occlusion, bubbles, dirt, contrast_loss, defocus, saturation)
OPERATIONS: Mapping[str, Operation] = MappingProxyType({one.__name__: one for one in (*_ALL, shot_noise, read_noise)})

# Degradations with a field of the whole picture: how it is drawn, and how it is applied.
FIELDS: Mapping[str, tuple[Draw, Put]] = MappingProxyType(
    {"background_clutter": (clutter, add_behind), "dirt": (specks, darken)}
)
NOISE = ("shot_noise", "read_noise")  # of every pixel in every frame
BEYOND = {"occlusion": 2.0, "bubbles": BUBBLE_RADII}  # reach beyond the disk, radii
ON_THE_BALL = ("uneven_light", "highlights")  # change the ball's light, before the blur of the optics
OF_ONE_BALL = (*ON_THE_BALL, "occlusion", "bubbles")  # lie on the disk of a ball


def lost_frames(like: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Draw the lost frames, (..., N) bool, for a tensor (..., N): round(share N) per row, one at least."""
    count = like.shape[-1]
    draw = torch.rand(like.shape, generator=rng, dtype=torch.float64, device=rng.device).to(like.device)
    return draw.argsort(-1).argsort(-1) < max(round(share * count), share > 0)


def centre_error(disk: Disk, error_px: float, rng: torch.Generator) -> Disk:
    """Return the disk with its centre moved by `error_px` in a random direction."""
    degradation("centre_error").check(error_px)
    centre = disk.centre_px
    draw = torch.rand((*centre.shape[:-1], 1), generator=rng, dtype=centre.dtype, device=rng.device).to(centre)
    angle = 2 * math.pi * draw
    off = error_px * torch.cat([angle.cos(), angle.sin()], dim=-1)
    return Disk(centre_px=centre + off, radius_px=disk.radius_px)


def radius_error(disk: Disk, error_px: float) -> Disk:
    """Return the disk with its radius increased by `error_px`."""
    degradation("radius_error").check(error_px)
    return Disk(centre_px=disk.centre_px, radius_px=disk.radius_px + error_px)


def blurred(pictures: Tensor, sigma_px: float) -> Tensor:
    """Blur pictures (..., H, W) with a Gaussian, px; the border is replicated."""
    if sigma_px == 0 or pictures.numel() == 0:
        return pictures
    from kornia.filters import gaussian_blur2d

    size = 2 * blur_reach(sigma_px) + 1
    flat = pictures.reshape(-1, 1, *pictures.shape[-2:])
    smooth: Tensor = gaussian_blur2d(flat, (size, size), (sigma_px, sigma_px), border_type="replicate")
    return smooth.reshape(pictures.shape)


def blur_reach(sigma_px: float) -> int:
    """Return the reach of `blurred`, px."""
    return math.ceil(4 * sigma_px)


def _round(right: Tensor, down: Tensor, radius_px: Tensor) -> Tensor:
    """Return the share of each pixel inside a circle whose edge is one pixel wide."""
    square = right.square() + down.square()
    # The root has no slope at the centre, where the share is constant anyway.
    distance = square.clamp_min(1e-6).sqrt()
    return (radius_px - distance + 0.5).clamp(0, 1)


def _overlap(apart: float) -> float:
    """Return the share of a circle hidden by an equal one at a distance of `apart` radii."""
    return (2 * math.acos(apart / 2) - apart * math.sqrt(1 - apart**2 / 4)) / math.pi


def _uniform(pictures: Tensor, rng: torch.Generator, *tail: int) -> Tensor:
    shape = (*pictures.shape[:-2], *tail)
    return torch.rand(shape, generator=rng, dtype=pictures.dtype, device=rng.device).to(pictures.device)


def _normal(pictures: Tensor, rng: torch.Generator) -> Tensor:
    draw = torch.randn(pictures.shape, generator=rng, dtype=pictures.dtype, device=rng.device)
    return draw.to(pictures.device)


def _spread(field: Tensor) -> Tensor:
    return (field - field.mean((-2, -1), keepdim=True)).square().mean((-2, -1), keepdim=True).sqrt()
