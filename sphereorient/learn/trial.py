"""A checkpoint tried on balls that no training has seen, one degradation after the other, and on mixed pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import CheckpointError, refusal
from sphereorient.learn.checkpoint import Checkpoint, check_texture, correlator_of
from sphereorient.learn.density import first_right, tops_of
from sphereorient.learn.draws import generator_of
from sphereorient.learn.judge import CANDIDATES, WITHIN_DEG, Answers, Judged, judge
from sphereorient.learn.network import Correlator
from sphereorient.learn.pictures import Balls, film_group, film_with, make_balls
from sphereorient.learn.settings import PictureSettings
from sphereorient.sphere import load_texture
from sphereorient.synth.severities import severity

TRIAL_SEED = 1 << 21  # maps of the trial begin here, those of the validation at half of it
MAPS = 24
LEVELS = (3, 4, 5)
MIXED = 999  # stream of random numbers of the mixed pictures; those of the degradations are below
BATCH = 32  # pictures at once while speed is measured
Advance = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class FamilyRecall:
    """Recall under one degradation at one level."""

    family: str
    level: int
    pictures: int
    recall_1: float  # share whose first candidate is within 10 degrees of the truth
    recall_5: float  # likewise, of the first five


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Figures of a checkpoint; made by `try_checkpoint`."""

    families: tuple[FamilyRecall, ...]
    mixed: Judged  # on pictures like those of the training
    pictures_per_s: float  # of proposing alone, with the map's features at hand
    threads: int  # of torch, that they were measured with


def try_checkpoint(
    checkpoint: Checkpoint, settings: PictureSettings, pictures: int, advance: Advance, seed: int = 0
) -> Trial:
    """Try a checkpoint on maps and pictures that no training sees.

    Args:
        checkpoint: of the network; one that was fine-tuned is tried on its own map.
        settings: of the pictures; its map is that of the fine-tuning.
        pictures: of each degradation and level, and of the mixed ones ten times as many; whole groups, so a few more.
        advance: told stage, maps done and maps in all.
        seed: of attitudes, light and degradations; the maps are always the same ones.

    Raises:
        CheckpointError: pictures of another size, or another map than that of the fine-tuning.
        TextureError: the map cannot be read.
    """
    _check(checkpoint, settings)
    network = correlator_of(checkpoint)
    count = 1 if settings.texture is not None else min(MAPS, pictures)
    balls = make_balls(settings, network.settings.nodes, count=count, first_seed=TRIAL_SEED)
    each = -(-pictures // count)
    ranks: dict[tuple[str, int], list[Tensor]] = {}
    mixed, truth, filmed, taken_s = [], [], 0, 0.0
    for k in range(count):
        advance("evaluate", k, count)
        with torch.no_grad():
            bank = network.bank(balls.blurs[k])
            for key, disks, R in _by_degradation(balls, k, settings, each, seed):
                ranks.setdefault(key, []).append(_ranks(network, bank, disks, R, checkpoint.temperature))
            disks, R = _mixed(balls, k, settings, each, seed)
            began = time.perf_counter()
            logits = [_proposed(network, bank, some) for some in torch.split(disks, BATCH)]
            taken_s, filmed = taken_s + time.perf_counter() - began, filmed + len(disks)
        mixed += logits
        truth.append(R)
    advance("evaluate", count, count)
    answers = Answers(logits=torch.cat(mixed), R_view_body=torch.cat(truth))
    spread = math.radians(checkpoint.settings.training.spread_deg)
    return Trial(
        families=tuple(_recall(*key, torch.cat(found)) for key, found in ranks.items()),
        mixed=judge(answers, network.grid, spread, checkpoint.temperature),
        pictures_per_s=filmed / taken_s,
        threads=torch.get_num_threads(),
    )


def _check(checkpoint: Checkpoint, settings: PictureSettings) -> None:
    size, own = settings.disks.size_px, checkpoint.settings.network.size_px
    if size != own:
        do = "set pictures.disks.size_px"
        raise CheckpointError(refusal("checkpoint", expected=f"disks of {own} px", got=f"{size} px", do=do))
    if checkpoint.texture_sha256 is not None:
        if settings.texture is None:
            do = "name that map as pictures.texture in --config"
            raise CheckpointError(
                refusal("checkpoint", expected="the map that it was fine-tuned on", got="none", do=do)
            )
        check_texture(checkpoint, load_texture(Path(settings.texture)))


def _by_degradation(
    balls: Balls, k: int, settings: PictureSettings, count: int, seed: int
) -> list[tuple[tuple[str, int], Tensor, Tensor]]:
    """Film ball k with each degradation alone at each level: what it was, disks, attitudes."""
    filmed = []
    for number, name in enumerate(settings.degradations):
        for level in LEVELS:
            rng = generator_of(seed, TRIAL_SEED, k, number, level)
            R = so3.random_rotations(count, generator=rng).float()
            disks = film_with(balls.textures[k], R, {name: severity(name, level)}, rng, settings)
            filmed.append(((name, level), disks, R))
    return filmed


def _mixed(balls: Balls, k: int, settings: PictureSettings, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Film ball k in ten groups, each with degradations that are drawn as those of the training."""
    rng = generator_of(seed, TRIAL_SEED, k, MIXED)
    R = so3.random_rotations(10 * count, generator=rng).float()
    return torch.cat([film_group(balls.textures[k], some, settings, rng) for some in torch.split(R, count)]), R


def _proposed(network: Correlator, bank: Tensor, disks: Tensor) -> Tensor:
    """Return the logits; the candidates are found too, so that the time is that of proposing."""
    logits = network.logits(network.seen(disks), bank)
    tops_of(logits, network.grid, CANDIDATES)
    return logits


def _ranks(network: Correlator, bank: Tensor, disks: Tensor, R: Tensor, temperature: float) -> Tensor:
    tops = tops_of(network.logits(network.seen(disks), bank), network.grid, CANDIDATES, temperature)
    return first_right(tops, R, WITHIN_DEG)


def _recall(family: str, level: int, rank: Tensor) -> FamilyRecall:
    first, five = ((rank < among).double().mean().item() for among in (1, 5))
    return FamilyRecall(family=family, level=level, pictures=len(rank), recall_1=first, recall_5=five)
