"""Paint to put on a ball: two paints of a chosen coarseness, and how coarse, bordered and balanced a map is."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.sphere import sample_texture
from sphereorient.synth.textures import map_directions, random_directions

POINTS = 40_000  # at which a map's parts are measured: 1 degree apart
CIRCLES, AROUND = 400, 1440  # great circles on which borders are counted, and points of each
LOST_SHARE = 0.02  # of the sphere that a round brush may miss: corners of patches
BRUSHES_DEG = tuple(float(width) for width in range(2, 61))  # widths that are tried
WAVES = 60  # of a random function
SIZES_DEG = (3.0, 60.0)  # of patches that can be asked for
PUSHES = 40  # steps in which dots push each other apart


def view_directions(count: int) -> Tensor:
    """Return directions spread evenly over the sphere, (count, 3) float64, on a spiral from pole to pole.

    Source: Swinbank and Purser 2006, Fibonacci grids.
    """
    at = torch.arange(count, dtype=torch.float64) + 0.5
    up = 1 - 2 * at / count
    around = math.pi * (3 - math.sqrt(5)) * at
    across = (1 - up.square()).sqrt()
    return torch.stack([across * around.cos(), across * around.sin(), up], dim=-1)


def facing(direction_body: Tensor) -> Tensor:
    """Return attitudes R_view_body (..., 3, 3) that turn body directions (..., 3) to the camera, north up.

    At the poles, where no north is up, +x of the body is (at the north pole to the bottom).
    """
    x, y, z = torch.nn.functional.normalize(direction_body, dim=-1).unbind(-1)
    level = torch.hypot(x, y)
    polar = level < 1e-9
    east = torch.stack([torch.where(polar, 0.0, -y), torch.where(polar, 1.0, x), torch.zeros_like(x)], -1)
    east = torch.nn.functional.normalize(east, dim=-1)
    outward = torch.stack([x, y, z], -1)
    return torch.stack([east, -torch.linalg.cross(outward, east), -outward], dim=-2)


def scaled_paint(kind: str, size_deg: float, seed: int, height: int = 512) -> Tensor:
    """Draw a map of two paints whose patches are of a size.

    Args:
        kind: of `PAINTS`: blobs (wavy patches), patches (polygons) or dots (round and black on white).
        size_deg: typical width of a patch, degrees on the sphere.
        seed: same seed, same map.
        height: of the map.

    Returns:
        (height, 2 height) float32, 0 black .. 1 white.

    Raises:
        PaintError: an unknown kind, or a size that no ball has room for.
    """
    if kind not in PAINTS:
        raise PaintError(refusal("kind of paint", expected=" or ".join(PAINTS), got=f"'{kind}'", do="name one of them"))
    low, high = SIZES_DEG
    if not low <= size_deg <= high:
        expected, do = f"{low:g} .. {high:g} degrees", "choose a size that a brush and a ball allow"
        raise PaintError(refusal("size of patches", expected=expected, got=f"{size_deg:g}", do=do))
    return PAINTS[kind](math.radians(size_deg), height, torch.Generator().manual_seed(seed))


def stroke_deg(texture: Tensor) -> float:
    """Return the width of the widest round brush that paints a map, both paints, but for 2 % of the sphere.

    Args:
        texture: (H, 2 H), 0 black .. 1 white; above one half is white.

    Returns:
        Degrees on the sphere, in whole degrees; 0 where even the finest brush that is tried is too wide.

    Source: opening by a disk, Matheron 1975; on points of a sphere.
    """
    points, white = _sampled(texture)
    if white.all() or not white.any():
        return BRUSHES_DEG[-1]
    trees = {side: cKDTree(points[white == side]) for side in (False, True)}
    depth = np.empty(len(points))
    for side in (False, True):
        chord, _ = trees[not side].query(points[white == side])
        depth[white == side] = _angle(np.asarray(chord, np.float64))
    best = 0.0
    for width in BRUSHES_DEG:
        if _lost(points, white, depth, math.radians(width / 2)) > LOST_SHARE:
            break
        best = width
    return best


def border_length(texture: Tensor) -> float:
    """Return the length of all borders between the two paints on a ball of radius 1; a great circle has 2 pi.

    Good to 2 %; borders that are steps of whole texels count up to 7 % longer.

    Source: Crofton's formula: a great circle crosses borders of length L in the mean L / pi times.
    """
    R = facing(view_directions(CIRCLES)).float()  # each circle is the outline of a view
    around = 2 * math.pi * torch.arange(AROUND) / AROUND
    rim = torch.stack([around.cos(), around.sin(), torch.zeros(AROUND)], -1)
    white = sample_texture(texture.float(), rim @ R) >= 0.5
    return math.pi * float((white != white.roll(1, -1)).sum(-1).double().mean())


def _sampled(texture: Tensor) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    points = view_directions(POINTS)
    return points.numpy(), (sample_texture(texture.double(), points) >= 0.5).numpy()


def _lost(points: NDArray[np.float64], white: NDArray[np.bool_], depth: NDArray[np.float64], radius: float) -> float:
    """Share of points that no brush of a radius reaches that stays within its own paint."""
    # The nearest point of the other paint lies half a step of the lattice beyond the border.
    middle = depth >= radius + 0.5 * math.sqrt(4 * math.pi / POINTS)
    lost = 0
    for side in (False, True):
        own, middles = points[white == side], points[(white == side) & middle]
        if len(middles):
            reach = 2 * math.sin(min(radius, math.pi) / 2) + 0.5 * math.sqrt(4 * math.pi / POINTS)
            lost += int((np.asarray(cKDTree(middles).query(own)[0]) > reach).sum())
        else:
            lost += len(own)
    return lost / len(points)


def _angle(chord: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(2 * np.arcsin(np.clip(chord / 2, 0, 1)))


def _blobs(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """The sign of a random function whose waves are two patches long."""
    number = math.pi / size_rad
    spread = 0.7 + 0.6 * torch.rand(WAVES, 1, generator=rng, dtype=torch.float64)
    wave = random_directions(WAVES, rng) * number * spread
    phase = 2 * math.pi * torch.rand(WAVES, generator=rng, dtype=torch.float64)
    value = torch.cos(map_directions(height) @ wave.T + phase).sum(-1)
    area = torch.cos((torch.arange(height, dtype=torch.float64) + 0.5) * math.pi / height - math.pi / 2)
    order = value.flatten().argsort()
    share = area[:, None].expand(-1, 2 * height).flatten()[order].cumsum(0)
    median = value.flatten()[order][int(torch.searchsorted(share, 0.5 * share[-1]))]
    slope = number * math.sqrt(WAVES / 2) / math.sqrt(3)  # rms of the slope along a line, per radian
    return (0.5 + (value - median) / (slope * math.pi / height * 2)).clamp(0, 1).float()


def _patches(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """The regions nearest to points that keep apart, painted black or white at random, half of each."""
    count = max(4, round(4 * math.pi / size_rad**2))
    points = _apart(random_directions(count, rng))
    white = torch.randperm(count, generator=rng) % 2
    owner = (map_directions(height).float() @ points.T.float()).argmax(-1)
    return white[owner].float()


def _dots(size_rad: float, height: int, rng: torch.Generator) -> Tensor:
    """Black dots as wide as the size, two thirds to four thirds of it, with as much white between them."""
    count = max(4, round(4 * math.pi / (1.9 * size_rad) ** 2))
    points = _apart(random_directions(count, rng))
    radius = 0.5 * size_rad * (2 + 2 * torch.rand(count, generator=rng, dtype=torch.float64)) / 3
    away = torch.full((height, 2 * height), torch.inf, dtype=torch.float64)
    directions = map_directions(height)
    for point, own in zip(points, radius, strict=True):
        away = torch.minimum(away, torch.acos((directions @ point).clamp(-1, 1)) - own)
    return (0.5 + away * height / math.pi).clamp(0, 1).float()


def _apart(points: Tensor) -> Tensor:
    """Push points (D, 3) apart, as like charges are, until they keep their distance but not a lattice."""
    step = 0.1 * math.sqrt(4 * math.pi / len(points))
    for _ in range(PUSHES):
        away = points[:, None] - points
        push = (away / (away.norm(dim=-1, keepdim=True) ** 3 + 1e-9)).sum(1)
        push = push / push.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        points = torch.nn.functional.normalize(points + 0.25 * step * push, dim=-1)
    return points


PAINTS: dict[str, Callable[[float, int, torch.Generator], Tensor]] = {
    "blobs": _blobs,
    "patches": _patches,
    "dots": _dots,
}
