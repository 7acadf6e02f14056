"""Training pictures: random textures, orientations, light and degradations, reproducible by seed."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.learn.network import map_blurs
from sphereorient.learn.settings import PictureSettings
from sphereorient.sphere import load_texture
from sphereorient.sphere.texture import random_texture
from sphereorient.synth.degrade_scene import misdrawn, worn
from sphereorient.synth.disks import film_disks
from sphereorient.synth.severities import DEGRADATIONS, LEVELS

MAPS = 24  # held out, of a validation or a benchmark
VALIDATION_SEED = 1 << 20  # of the first validation map; training maps start at 0
BLUR_BATCH = 64  # maps blurred at once


class RandomTextures(NamedTuple):
    """T texture maps; made by `make_textures`."""

    textures: Tensor  # (T, H, 2 H)
    blurs: Tensor  # (T, N, B), see `map_blurs`


class TrainingBatch(NamedTuple):
    """Pictures of M balls, F each, with the true orientations; made by `draw_batch`."""

    textures: Tensor  # (M, H, 2 H), the maps
    blurs: Tensor  # (M, N, B), see `map_blurs`
    disks: Tensor  # (M, F, S, S)
    R_view_body: Tensor  # (M, F, 3, 3) float32


def generator_of(*numbers: int) -> torch.Generator:
    """Return a generator seeded by whole numbers, not negative."""
    # torch reads 32 bits of its seed, so sums would repeat. The count comes first, else final zeros have no effect.
    return torch.Generator().manual_seed(int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1)[0]))


def make_textures(settings: PictureSettings, nodes: int, *, count: int, first_seed: int) -> RandomTextures:
    """Draw maps with consecutive seeds, or read the map of a fine-tuning; raise TextureError if it is unreadable."""
    rows = settings.texture_rows
    if settings.texture is not None:
        own = load_texture(Path(settings.texture))
        textures = torch.nn.functional.interpolate(own[None, None], (rows, 2 * rows), mode="area")[0]
    else:
        textures = torch.stack([_random_map(settings, first_seed + k, k) for k in range(count)])
    return RandomTextures(textures, torch.cat([map_blurs(some, nodes) for some in torch.split(textures, BLUR_BATCH)]))


def _random_map(settings: PictureSettings, seed: int, number: int) -> Tensor:
    """Draw a map: even numbers of one kind, odd numbers of two kinds, separated by a third map."""
    kinds, rows = settings.kinds, settings.texture_rows
    first = random_texture(kinds[number // 2 % len(kinds)], seed, rows)
    if number % 2 == 0:
        return first
    other, where = number // 2 // len(kinds), seed + (1 << 19)
    second = random_texture(kinds[other % len(kinds)], where, rows)
    mask = random_texture(kinds[(other + 1) % len(kinds)], where + (1 << 18), rows)
    return torch.where(mask > 0.5, first, second)


def draw_batch(
    maps: RandomTextures, settings: PictureSettings, rng: torch.Generator, shape: tuple[int, int, int]
) -> TrainingBatch:
    """Render random maps; `shape`: maps, groups of each, pictures of each group with its own degradations."""
    count, groups, group = shape
    rows = []
    for k in torch.randint(len(maps.textures), (count,), generator=rng).tolist():
        texture, blurs = maps.textures[k], maps.blurs[k]
        if bool(torch.rand((), generator=rng) < 0.5) and settings.texture is None:  # the negative
            texture, blurs = 1 - texture, -blurs
        R = so3.random_rotations(groups * group, generator=rng).float()
        filmed = [film(texture, some, draw_values(settings, rng), rng, settings) for some in torch.split(R, group)]
        rows.append((texture, blurs, torch.cat(filmed), R))
    return TrainingBatch(*(torch.stack(column) for column in zip(*rows, strict=True)))


def film(
    texture: Tensor, R_view_body: Tensor, values: Mapping[str, float], rng: torch.Generator, settings: PictureSettings
) -> Tensor:
    """Render a map with given degradations, (F, S, S)."""
    filmed = worn(texture, values.get("paint_wear", 0.0), rng)
    # An error of the sphere has the same effect as an error of the map.
    filmed = misdrawn(filmed, values.get("texture_error", 0.0), rng)
    return film_disks(filmed, R_view_body, values, rng, settings.disks)


def draw_values(settings: PictureSettings, rng: torch.Generator) -> dict[str, float]:
    """Draw degradations and their values."""
    names = settings.degradations
    most = min(settings.at_once, len(names))
    count = int(torch.randint(most + 1, (), generator=rng))
    chosen = torch.randperm(len(names), generator=rng)[:count].tolist()
    levels = (LEVELS[0] + (settings.hardest - LEVELS[0]) * torch.rand(count, generator=rng)).tolist()
    return {names[k]: value_at(names[k], level) for k, level in zip(chosen, levels, strict=True)}


def value_at(name: str, level: float) -> float:
    """Return the value of a degradation at a level, interpolated in its logarithm."""
    return float(np.exp(np.interp(level, LEVELS, np.log(DEGRADATIONS[name].values))))
