"""A checkpoint on unseen maps: recall by degradation, metrics, speed, and example pictures."""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import CheckpointError, refusal
from sphereorient.experiment.recording import Progress
from sphereorient.learn.checkpoint import Checkpoint, check_texture, correlator_of
from sphereorient.learn.density import find_modes, first_right
from sphereorient.learn.metrics import CANDIDATES, WITHIN_DEG, Metrics, Predictions, metrics_of
from sphereorient.learn.pictures import (
    VALIDATION_SEED,
    draw_values,
    film_group,
    film_with,
    generator_of,
    make_textures,
)
from sphereorient.learn.settings import PictureSettings
from sphereorient.sphere import load_texture, orthographic_view, reduced_texture, sample_texture
from sphereorient.synth.severities import severity

BENCHMARK_SEED = 1 << 21  # of the first map; validation maps begin at half of it
MAPS = 24
LEVELS = (3, 4, 5)
MIXED = 999  # random stream of the mixed pictures; those of the degradations are below
EXAMPLES = 7  # random stream of the examples
BATCH = 32  # pictures at once in the measurement of speed


@dataclass(frozen=True, kw_only=True)
class DegradationRecall:
    """Recall with one degradation at one level."""

    family: str  # name of the degradation
    level: int
    pictures: int
    recall_1: float  # share of the pictures whose first candidate is within 10 degrees of the truth
    recall_5: float  # likewise, among the first five


@dataclass(frozen=True, kw_only=True)
class ProposerBenchmark:
    """Results of a checkpoint; made by `benchmark_checkpoint`."""

    families: tuple[DegradationRecall, ...]
    mixed: Metrics  # on pictures like those of the training
    pictures_per_s: float  # proposals alone; the features of the map are known
    threads: int  # of torch, in the measurement of speed


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """A picture, the truth and the first K proposals; made by `make_examples`, drawn by the report."""

    degradations: tuple[str, ...]
    disk: Tensor  # (S, S), grey levels
    true_view: Tensor  # (S, S), the map in the true orientation, without light; NaN outside the outline
    proposed_view: Tensor  # (K, S, S), likewise
    probability: Tensor  # (K,)
    off_deg: Tensor  # (K,), angle to the truth


@torch.no_grad()
def benchmark_checkpoint(
    checkpoint: Checkpoint, settings: PictureSettings, pictures: int, progress: Progress, seed: int = 0
) -> ProposerBenchmark:
    """Measure a checkpoint on unseen maps and pictures; a fine-tuned one on its own map, that of `settings`.

    `pictures` of each degradation and level, ten times as many mixed; `progress` gets stage, finished maps, all maps.

    Raises:
        CheckpointError: another picture size, or another map than that of the fine-tuning.
        TextureError: the map cannot be read.
    """
    _check(checkpoint, settings)
    network = correlator_of(checkpoint)
    count = 1 if settings.texture is not None else min(MAPS, pictures)
    maps = make_textures(settings, network.settings.nodes, count=count, first_seed=BENCHMARK_SEED)
    each = -(-pictures // count)
    ranks: dict[tuple[str, int], list[Tensor]] = {}
    mixed, taken_s = [], 0.0
    for k in range(count):
        progress("evaluate", k, count)
        texture, bank = maps.textures[k], network.bank(maps.blurs[k])
        for number, name in enumerate(settings.degradations):
            for level in LEVELS:
                rng = generator_of(seed, BENCHMARK_SEED, k, number, level)
                R = so3.random_rotations(each, generator=rng).float()
                disks = film_with(texture, R, {name: severity(name, level)}, rng, settings)
                logits = network.logits(network.seen(disks), bank)
                modes = find_modes(logits, network.grid, CANDIDATES, checkpoint.temperature)
                ranks.setdefault((name, level), []).append(first_right(modes, R, WITHIN_DEG))
        rng = generator_of(seed, BENCHMARK_SEED, k, MIXED)
        R = so3.random_rotations(10 * each, generator=rng).float()
        disks = torch.cat([film_group(texture, some, settings, rng) for some in torch.split(R, each)])
        began = time.perf_counter()
        parts = [network.logits(network.seen(some), bank) for some in torch.split(disks, BATCH)]
        for part in parts:  # their time counts too
            find_modes(part, network.grid, CANDIDATES)
        taken_s += time.perf_counter() - began
        mixed.append(Predictions(logits=torch.cat(parts), R_view_body=R))
    progress("evaluate", count, count)
    predictions = Predictions.joined(mixed)
    spread_rad = math.radians(checkpoint.settings.training.spread_deg)
    return ProposerBenchmark(
        families=tuple(_recall(*key, torch.cat(rank)) for key, rank in ranks.items()),
        mixed=metrics_of(predictions, network.grid, spread_rad, checkpoint.temperature),
        pictures_per_s=len(predictions.logits) / taken_s,
        threads=torch.get_num_threads(),
    )


def _check(checkpoint: Checkpoint, settings: PictureSettings) -> None:
    size, own = settings.disks.size_px, checkpoint.settings.network.size_px
    if size != own:
        do = "set pictures.disks.size_px"
        raise CheckpointError(refusal("checkpoint", expected=f"disks of {own} px", got=f"{size} px", do=do))
    if checkpoint.texture_sha256 is not None:
        if settings.texture is None:
            expected, do = "the map of its fine-tuning", "name that map as pictures.texture in --config"
            raise CheckpointError(refusal("checkpoint", expected=expected, got="none", do=do))
        check_texture(checkpoint, load_texture(Path(settings.texture)))


def _recall(name: str, level: int, rank: Tensor) -> DegradationRecall:
    first, five = ((rank < among).double().mean().item() for among in (1, 5))
    return DegradationRecall(family=name, level=level, pictures=len(rank), recall_1=first, recall_5=five)


@torch.no_grad()
def make_examples(checkpoint: Checkpoint, count: int, shown: int = 4, seed: int = 0) -> tuple[Example, ...]:
    """Render `count` unseen maps (fine-tuned: its own), the first undegraded, and keep the first `shown` proposals."""
    settings, network = checkpoint.settings.pictures, correlator_of(checkpoint)
    maps = make_textures(settings, network.settings.nodes, count=count, first_seed=VALIDATION_SEED)
    examples = []
    for k in range(count):
        rng = generator_of(seed, EXAMPLES, k)
        R = so3.random_rotations(1, generator=rng).float()
        values = draw_values(settings, rng) if k else {}
        while k and not values and settings.degradations and settings.at_once:
            values = draw_values(settings, rng)
        texture = maps.textures[k % len(maps.textures)]
        disk = film_with(texture, R, values, rng, settings)
        logits = network(disk, maps.blurs[k % len(maps.blurs)])
        modes = find_modes(logits, network.grid, shown, checkpoint.temperature)
        proposed = modes.R_view_body[0]
        examples.append(
            Example(
                degradations=tuple(values),
                disk=disk[0],
                true_view=clean_views(texture, R, disk.shape[-1])[0],
                proposed_view=clean_views(texture, proposed, disk.shape[-1]),
                probability=modes.probability[0],
                off_deg=torch.rad2deg(so3.geodesic_distance(proposed.double(), R.double())),
            )
        )
    return tuple(examples)


def clean_views(texture: Tensor, R_view_body: Tensor, size_px: int) -> Tensor:
    """Render a map in orientations (F, 3, 3), (F, S, S), without light, NaN outside the outline."""
    view = orthographic_view(size_px)
    reduced = reduced_texture(texture, float(size_px))
    pictures = torch.full((len(R_view_body), size_px, size_px), torch.nan)
    pictures[:, view.inside] = sample_texture(reduced, view.normal_view.float() @ R_view_body)
    return pictures
