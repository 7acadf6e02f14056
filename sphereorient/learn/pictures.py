"""Pictures to learn from: random balls, attitudes, light and degradations, the same for the same seed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.learn.network import map_blurs
from sphereorient.learn.settings import PictureSettings
from sphereorient.sphere import load_texture
from sphereorient.synth.degrade_scene import misdrawn, worn
from sphereorient.synth.disks import film_disks
from sphereorient.synth.severities import DEGRADATIONS, LEVELS
from sphereorient.synth.textures import random_texture

VALIDATION_SEED = 1 << 20  # maps of the validation begin here, those of the training at 0
BLUR_BATCH = 64  # maps whose blurs are made at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Balls:
    """Painted balls; made by `make_balls`."""

    textures: Tensor  # (T, H, 2 H)
    blurs: Tensor  # (T, N, B), see `map_blurs`


@dataclass(frozen=True, kw_only=True, eq=False)
class Lesson:
    """Pictures of some balls, with what is right; made by `draw_lesson`, read by the training."""

    textures: Tensor  # (M, H, 2 H), the maps
    blurs: Tensor  # (M, N, B), see `map_blurs`
    disks: Tensor  # (M, F, S, S)
    R_view_body: Tensor  # (M, F, 3, 3) float32


def make_balls(settings: PictureSettings, nodes: int, *, count: int, first_seed: int) -> Balls:
    """Draw maps, or read the one that is to be learnt.

    Args:
        settings: kinds of paint, or the map's path.
        nodes: cells of the map's features along each axis.
        count: of maps.
        first_seed: of the first one, the others' follow.

    Raises:
        TextureError: a map that cannot be read.
    """
    rows = settings.texture_rows
    if settings.texture is not None:
        own = load_texture(Path(settings.texture))
        textures = torch.nn.functional.interpolate(own[None, None], (rows, 2 * rows), mode="area")[0]
    else:
        textures = torch.stack([_painted(settings, first_seed + k, k) for k in range(count)])
    blurs = [map_blurs(some, nodes) for some in torch.split(textures, BLUR_BATCH)]
    return Balls(textures=textures, blurs=torch.cat(blurs))


def _painted(settings: PictureSettings, seed: int, number: int) -> Tensor:
    """Draw a map: every second one of one kind, the others of two kinds in places that a third map tells."""
    kinds, rows = settings.kinds, settings.texture_rows
    first = random_texture(kinds[number // 2 % len(kinds)], seed, rows)
    if number % 2 == 0:
        return first
    other, where = number // 2 // len(kinds), seed + (1 << 19)
    second = random_texture(kinds[other % len(kinds)], where, rows)
    mask = random_texture(kinds[(other + 1) % len(kinds)], where + (1 << 18), rows)
    return torch.where(mask > 0.5, first, second)


def draw_lesson(
    balls: Balls, settings: PictureSettings, rng: torch.Generator, *, maps: int, groups: int, group: int
) -> Lesson:
    """Film balls, each in groups of pictures with degradations of their own."""
    chosen = torch.randint(len(balls.textures), (maps,), generator=rng)
    textures, blurs, disks, attitudes = [], [], [], []
    for k in chosen.tolist():
        negative = bool(torch.rand((), generator=rng) < 0.5) and settings.texture is None
        texture = 1 - balls.textures[k] if negative else balls.textures[k]
        R = so3.random_rotations(groups * group, generator=rng).float()
        filmed = [film_group(texture, some, settings, rng) for some in torch.split(R, group)]
        textures.append(texture)
        blurs.append(-balls.blurs[k] if negative else balls.blurs[k])
        disks.append(torch.cat(filmed))
        attitudes.append(R)
    return Lesson(
        textures=torch.stack(textures),
        blurs=torch.stack(blurs),
        disks=torch.stack(disks),
        R_view_body=torch.stack(attitudes),
    )


def film_group(texture: Tensor, R_view_body: Tensor, settings: PictureSettings, rng: torch.Generator) -> Tensor:
    """Film a ball with degradations drawn for all these pictures together, (F, S, S)."""
    return film_with(texture, R_view_body, draw_values(settings, rng), rng, settings)


def film_with(
    texture: Tensor, R_view_body: Tensor, values: Mapping[str, float], rng: torch.Generator, settings: PictureSettings
) -> Tensor:
    """Film a ball whose map is `texture`, with these degradations, (F, S, S)."""
    filmed = worn(texture, values.get("paint_wear", 0.0), rng)
    # Whether the map or the ball differs from the other is one and the same to who compares them.
    filmed = misdrawn(filmed, values.get("texture_error", 0.0), rng)
    return film_disks(filmed, R_view_body, values, rng, settings.disks)


def draw_values(settings: PictureSettings, rng: torch.Generator) -> dict[str, float]:
    """Draw which degradations there are and how hard."""
    names = settings.degradations
    most = min(settings.at_once, len(names))
    count = int(torch.randint(most + 1, (), generator=rng))
    chosen = torch.randperm(len(names), generator=rng)[:count].tolist()
    span = settings.hardest - LEVELS[0]
    levels = (LEVELS[0] + span * torch.rand(count, generator=rng)).tolist()
    return {names[k]: value_at(names[k], level) for k, level in zip(chosen, levels, strict=True)}


def value_at(name: str, level: float) -> float:
    """Return the value of a degradation between two levels, in between evenly in its logarithm."""
    values = DEGRADATIONS[name].values
    below = min(int(level), LEVELS[-1] - 1)
    low, high = values[below - 1], values[below]
    return float(math.exp(math.log(low) + (level - below) * (math.log(high) - math.log(low))))
