"""How good the paint is: contrast, balance over all views, size of its patches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.preflight.finding import Finding, Severity
from sphereorient.sphere import reduced_texture, sample_texture

ROWS = 32  # of the reduced map on which views are averaged: 5.6 degrees
ONE_COLOUR, FAINT = 0.02, 0.12  # standard deviation of the paint, 0 black .. 1 white
LOPSIDED = (0.1, 0.9)  # brightness of a view beyond which one paint is nearly all that is seen
FINE_PX, COARSE_DEG = 5.0, 70.0  # patches of less cannot be resolved; of more, many views have hardly a border
DRAWS = 4000  # random places at which the paint is compared with its neighbourhood


@dataclass(frozen=True, kw_only=True, eq=False)
class Paint:
    """Measures of a texture map; made by `measure_paint`, read by the finding and the figure."""

    contrast: float  # standard deviation over the sphere, 0 black .. 1 white
    view_brightness: Tensor  # (ROWS, 2 ROWS), mean brightness of the hemisphere seen from each direction, as a map
    patch_rad: float  # typical width of a patch


def measure_paint(texture: Tensor) -> Paint:
    """Measure a map, (H, 2 H), 0 black .. 1 white."""
    height = texture.shape[0]
    factor = max(1, height // ROWS)
    while height % factor:
        factor -= 1
    small = torch.nn.functional.avg_pool2d(texture[None, None].double(), factor)[0, 0]
    area = _area(small)
    mean = (small * area).sum() / area.sum()
    fine = reduced_texture(texture, 200.0).double()
    spread = _area(fine)
    deviation = ((fine - (fine * spread).sum() / spread.sum()).square() * spread).sum() / spread.sum()
    seen = _directions(ROWS).reshape(-1, 3)
    weight = (seen @ _directions(small.shape[0]).reshape(-1, 3).T).clamp_min(0) * area.reshape(-1)
    brightness = (weight @ small.reshape(-1)) / weight.sum(1)
    return Paint(
        contrast=float(deviation.sqrt()),
        view_brightness=brightness.reshape(ROWS, 2 * ROWS),
        patch_rad=_patch_rad(fine.float(), float(mean)),
    )


def _directions(rows: int) -> Tensor:
    """Body directions of the texels of a map, (H, 2 H, 3) float64."""
    latitude = math.pi / 2 - math.pi * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    longitude = math.pi * (torch.arange(2 * rows, dtype=torch.float64) + 0.5) / rows - math.pi
    lat, lon = torch.meshgrid(latitude, longitude, indexing="ij")
    return torch.stack([lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()], dim=-1)


def _area(picture: Tensor) -> Tensor:
    """Area of each texel of a map (H, 2 H), any unit."""
    rows = len(picture)
    latitude = math.pi / 2 - math.pi * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    return latitude.cos()[:, None].expand(rows, picture.shape[1])


def _patch_rad(texture: Tensor, mean: float) -> float:
    """Width of a patch: of stripes it is twice the angle at which paint and paint beside it have nothing in common."""
    rng = torch.Generator().manual_seed(0)
    at, side = torch.nn.functional.normalize(torch.randn(2, DRAWS, 3, generator=rng), dim=-1)
    side = torch.nn.functional.normalize(side - (side * at).sum(-1, keepdim=True) * at, dim=-1)
    angle = torch.deg2rad(torch.cat([torch.arange(0, 10, 0.5), torch.arange(10, 91, 2.0)]))
    here = sample_texture(texture, at) - mean
    beside = at * angle.cos()[:, None, None] + side * angle.sin()[:, None, None]
    there = sample_texture(texture, beside) - mean
    alike = (here * there).mean(1) / here.square().mean().clamp_min(1e-12)
    below = torch.nonzero(alike < 0.5)
    if not len(below):
        return math.pi
    k = int(below[0, 0])
    share = float((alike[k - 1] - 0.5) / (alike[k - 1] - alike[k]).clamp_min(1e-9)) if k else 0.0
    half = float(angle[k - 1] + share * (angle[k] - angle[k - 1])) if k else 0.0
    return 4 * half  # where the likeness of stripes has fallen to a half, a quarter of their width is passed


def paint(measures: Paint, radius_px: float) -> Finding:
    """Judge the paint.

    Args:
        measures: of the map.
        radius_px: of the ball in the pictures.
    """
    title = "paint"
    low, high = float(measures.view_brightness.min()), float(measures.view_brightness.max())
    patch_px = measures.patch_rad * radius_px
    measured = (
        f"views are {100 * low:.0f} to {100 * high:.0f} % bright; patches of about "
        f"{math.degrees(measures.patch_rad):.0f} degrees, {patch_px:.0f} px; contrast {measures.contrast:.2f}"
    )
    severity, advice = Severity.WARNING, ""
    if measures.contrast < ONE_COLOUR:
        severity, advice = Severity.FAULT, "check the map: it is of one colour, and no orientation can be told from it"
    elif measures.contrast < FAINT:
        advice = "paint with more contrast, or check that the map was exported from black to white"
    elif patch_px < FINE_PX:
        advice = "paint larger patches, or bring the ball larger into the picture: such detail is blurred away"
    elif math.degrees(measures.patch_rad) > COARSE_DEG:
        advice = "paint smaller patches: many views show hardly a border"
    elif low < LOPSIDED[0] or high > LOPSIDED[1]:
        advice = "balance black and white: from some sides the ball shows hardly more than one of them"
    else:
        severity = Severity.OK
    return Finding(title=title, severity=severity, measured=measured, advice=advice)
