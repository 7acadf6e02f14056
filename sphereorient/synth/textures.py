"""Random texture maps of three kinds, seamless on the sphere."""

import math

import torch
from torch import Tensor

from sphereorient.sphere.texture import map_directions


def random_directions(count: int, rng: torch.Generator) -> Tensor:
    """Draw uniform unit directions, (count, 3) float64."""
    draw = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return torch.nn.functional.normalize(draw, dim=-1)


def blobs(height: int, rng: torch.Generator) -> Tensor:
    """Draw smooth blobs, half of the sphere white."""
    wave = random_directions(60, rng) * (5 + 5 * torch.rand(60, 1, generator=rng, dtype=torch.float64))
    phase = 2 * math.pi * torch.rand(60, generator=rng, dtype=torch.float64)
    rows = torch.split(map_directions(height), 2)  # all at once would fill 250 MB
    value = torch.cat([torch.cos(body @ wave.T + phase).sum(-1) for body in rows])
    return _edge(value - value.median(), 0.25)


def polygons(height: int, rng: torch.Generator) -> Tensor:
    """Draw black and white regions nearest to random points."""
    points = random_directions(60, rng)
    owner = (map_directions(height) @ points.T).argmax(-1)
    return (owner % 2).float()


def dots(height: int, rng: torch.Generator) -> Tensor:
    """Draw black dots of 8 to 14 degrees radius on white."""
    points = random_directions(34, rng)
    radius = torch.deg2rad(8 + 6 * torch.rand(34, generator=rng, dtype=torch.float64))
    outside = (torch.acos((map_directions(height) @ points.T).clamp(-1, 1)) - radius).amin(-1)
    return _edge(outside, math.pi / height)


def _edge(value: Tensor, width: float) -> Tensor:
    return (0.5 + value / width).clamp(0, 1).float()


KINDS = {"blobs": blobs, "patches": polygons, "dots": dots}


def random_texture(kind: str, seed: int, height: int = 512) -> Tensor:
    """Draw a texture map of a kind in `KINDS`, (H, 2 H) float32, 0 black .. 1 white; equal seeds give equal maps."""
    return KINDS[kind](height, torch.Generator().manual_seed(seed))
