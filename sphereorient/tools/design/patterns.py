"""Black and white texture maps to paint on a ball, and their coarseness."""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.sphere import sample_texture
from sphereorient.sphere.texture import fibonacci_directions, map_directions, random_directions

POINTS = 40_000  # samples of a map, 1 degree apart
CIRCLES, AROUND = 400, 1440  # great circles for counting borders, and points of each
LOST_SHARE = 0.02  # of the sphere (corners of patches) that a round brush may miss
BRUSHES_DEG = tuple(float(width) for width in range(2, 61))  # trial widths
WAVES = 60  # of a random function
SIZES_DEG = (3.0, 60.0)  # smallest and largest patch


def view_directions(count: int) -> Tensor:
    """Return directions spread evenly over the sphere, (count, 3) float64."""
    return fibonacci_directions(count) * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)


def facing(direction_body: Tensor) -> Tensor:
    """Return R_view_body (..., 3, 3) that rotate directions (..., 3) to the camera, north (at a pole: +x) up."""
    outward = torch.nn.functional.normalize(direction_body, dim=-1)
    x, y, _ = outward.unbind(-1)
    polar = torch.hypot(x, y) < 1e-9
    east = torch.stack([torch.where(polar, 0.0, -y), torch.where(polar, 1.0, x), torch.zeros_like(x)], -1)
    east = torch.nn.functional.normalize(east, dim=-1)
    return torch.stack([east, -torch.linalg.cross(outward, east), -outward], dim=-2)


def patterned_texture(kind: str, size_deg: float, seed: int, height: int = 512) -> Tensor:
    """Draw a map (height, 2 height) float32, 0 black .. 1 white, with patches about `size_deg` wide.
    `kind`: blobs (wavy), patches (polygons), dots (black on white). Raise PaintError if kind or size is invalid.
    """
    if kind not in PATTERNS:
        expected, do = " or ".join(PATTERNS), "name one of them"
        raise PaintError(refusal("kind of texture", expected=expected, got=f"'{kind}'", do=do))
    low, high = SIZES_DEG
    if not low <= size_deg <= high:
        expected, do = f"{low:g} .. {high:g} degrees", "choose a size in this range"
        raise PaintError(refusal("size of patches", expected=expected, got=f"{size_deg:g}", do=do))
    return PATTERNS[kind](math.radians(size_deg), height, torch.Generator().manual_seed(seed))


def stroke_deg(texture: Tensor) -> float:
    """Return the width, whole degrees, of the widest round brush that paints both colours except 2 % of the sphere.

    White is above one half; 0: no brush. Source: opening by a disk, Matheron 1975.
    """
    directions = view_directions(POINTS)
    points, white = directions.numpy(), (sample_texture(texture.double(), directions) >= 0.5).numpy()
    if white.all() or not white.any():
        return BRUSHES_DEG[-1]
    depth = np.empty(len(points))
    for side in (False, True):
        chord, _ = cKDTree(points[white != side]).query(points[white == side])
        depth[white == side] = 2 * np.arcsin(np.clip(chord / 2, 0, 1))
    too_wide = (k for k, w in enumerate(BRUSHES_DEG) if _lost(points, white, depth, math.radians(w / 2)) > LOST_SHARE)
    return (0.0, *BRUSHES_DEG)[next(too_wide, len(BRUSHES_DEG))]


def border_length(texture: Tensor) -> float:
    """Return the length of all borders, radii, to 2 %; along whole texels up to 7 % more (Crofton's formula)."""
    R = facing(view_directions(CIRCLES)).float()  # each circle is the outline of a view
    around = 2 * math.pi * torch.arange(AROUND) / AROUND
    rim = torch.stack([around.cos(), around.sin(), torch.zeros(AROUND)], -1)
    white = sample_texture(texture.float(), rim @ R) >= 0.5
    return math.pi * float((white != white.roll(1, -1)).sum(-1).double().mean())


def _lost(points: NDArray[np.float64], white: NDArray[np.bool_], depth: NDArray[np.float64], radius: float) -> float:
    """Return the share of points that a brush of this radius does not reach within its own colour."""
    # The nearest point of the other colour lies half a step of the lattice beyond the border.
    half_step = 0.5 * math.sqrt(4 * math.pi / POINTS)
    reach, lost = 2 * math.sin(min(radius, math.pi) / 2) + half_step, 0
    for side in (False, True):
        own, middles = points[white == side], points[(white == side) & (depth >= radius + half_step)]
        lost += int((np.asarray(cKDTree(middles).query(own)[0]) > reach).sum()) if len(middles) else len(own)
    return lost / len(points)


def _blobs(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """Draw the sign of a random function with waves two patches long."""
    number = math.pi / size_rad
    spread = 0.7 + 0.6 * torch.rand(WAVES, 1, generator=rng, dtype=torch.float64)
    wave = random_directions(WAVES, rng) * number * spread
    phase = 2 * math.pi * torch.rand(WAVES, generator=rng, dtype=torch.float64)
    value = torch.cos(map_directions(height) @ wave.T + phase).sum(-1)
    area = torch.cos((torch.arange(height, dtype=torch.float64) + 0.5) * math.pi / height - math.pi / 2)
    ranked, order = value.flatten().sort()
    share = area[:, None].expand(-1, 2 * height).flatten()[order].cumsum(0)
    median = ranked[int(torch.searchsorted(share, 0.5 * share[-1]))]
    slope = number * math.sqrt(WAVES / 2) / math.sqrt(3)  # rms of the slope along a line, per radian
    return (0.5 + (value - median) / (slope * math.pi / height * 2)).clamp(0, 1).float()


def _patches(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """Draw the Voronoi cells of spread points, half of them black and half white, at random."""
    count = max(4, round(4 * math.pi / size_rad**2))
    points = _apart(random_directions(count, rng))
    white = (torch.randperm(count, generator=rng) % 2).float()
    return white[(map_directions(height).float() @ points.T.float()).argmax(-1)]


def _dots(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """Draw black dots, two thirds to four thirds of the size wide, with as much white between them."""
    count = max(4, round(4 * math.pi / (1.9 * size_rad) ** 2))
    points = _apart(random_directions(count, rng))
    radius = 0.5 * size_rad * (2 + 2 * torch.rand(count, generator=rng, dtype=torch.float64)) / 3
    directions, away = map_directions(height), torch.full((height, 2 * height), torch.inf, dtype=torch.float64)
    for point, own in zip(points, radius, strict=True):
        away = torch.minimum(away, torch.acos((directions @ point).clamp(-1, 1)) - own)
    return (0.5 + away * height / math.pi).clamp(0, 1).float()


def _apart(points: Tensor) -> Tensor:
    """Push points (D, 3) apart, like charges, until they are spread but not a lattice."""
    step = 0.1 * math.sqrt(4 * math.pi / len(points))
    for _ in range(40):  # steps in which dots push each other apart
        away = points[:, None] - points
        push = (away / (away.norm(dim=-1, keepdim=True) ** 3 + 1e-9)).sum(1)
        push = push / push.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        points = torch.nn.functional.normalize(points + 0.25 * step * push, dim=-1)
    return points


PATTERNS: dict[str, Callable[[float, int, torch.Generator], Tensor]] = {
    "blobs": _blobs,
    "patches": _patches,
    "dots": _dots,
}
