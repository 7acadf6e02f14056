"""The quality of a proposer: metrics; recall by degradation, speed and examples on held-out maps."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import CheckpointError, ShapeError, refusal
from sphereorient.files.threads import Progress, counted
from sphereorient.learn.checkpoint import Checkpoint, check_texture, correlator_of
from sphereorient.learn.network import CANDIDATES, Correlator, find_modes, first_right, smoothed_target
from sphereorient.learn.pictures import (
    MAPS,
    VALIDATION_SEED,
    TrainingBatch,
    draw_values,
    film,
    generator_of,
    make_textures,
)
from sphereorient.learn.settings import PictureSettings
from sphereorient.search.candidates import BATCH
from sphereorient.sphere import load_texture, orthographic_view, reduced_texture
from sphereorient.synth.severities import severity

Z95 = 1.959964  # normal quantile of a two-sided interval of 95 %
Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

WITHIN_DEG = 10.0  # of the truth is right: the pose fit converges from there
TEMPERATURES = tuple(2 ** (k / 2) for k in range(-4, 5))  # tried first: 1/4 .. 4
NEARER = tuple(2 ** (k / 8) for k in (-3, -2, -1, 1, 2, 3))  # then the best times these
BENCHMARK_SEED = 2 * VALIDATION_SEED  # of the first map
LEVELS = (3, 4, 5)
MIXED = 999  # random stream of the mixed pictures; those of the degradations are below
EXAMPLES, SHOWN = 7, 4  # random stream of the examples, and proposals of each


@dataclass(frozen=True, kw_only=True, eq=False)
class Reliability:
    """A reliability curve in B bins of increasing probability; made by `reliability`."""

    probability: Floats  # (B,), mean of the predictions
    share: Floats  # (B,), of the outcomes that are true
    low: Floats  # (B,), of the 95 % interval of the share
    high: Floats  # (B,)
    count: Counts  # (B,), outcomes in the bin
    error: float  # expected calibration error: mean |share - probability| over outcomes; NaN without outcomes
    chance: float  # the error expected by scatter alone if the probabilities are perfect


def reliability(probability: ArrayLike, outcome: ArrayLike, bins: int = 10) -> Reliability:
    """Compare probabilities (N,), 0 .. 1 or NaN (left out), with outcomes (N,), bool, in at most `bins` bins.
    Bins have equal counts, but equal probabilities stay in one bin.
    Raises ShapeError (unequal numbers of outcomes and probabilities, probabilities outside 0 .. 1, or no bin).
    Source: Naeini et al. 2015 (expected calibration error) with bins of equal count; interval: Wilson 1927.
    """
    said, came = np.asarray(probability, np.float64), np.asarray(outcome, np.bool_)
    if said.ndim != 1 or said.shape != came.shape:
        got, do = f"{said.shape} and {came.shape}", "pass one outcome for each probability"
        raise ShapeError(refusal("probability and outcome", expected="shapes (N,) and (N,)", got=got, do=do))
    known = np.isfinite(said)
    said, came = said[known], came[known]
    if bins < 1 or np.any((said < 0) | (said > 1 + 1e-9)):
        expected = "a bin or more, probabilities in 0 .. 1"
        got = f"{bins} bins, probabilities to {said.max(initial=0.0):g}"
        raise ShapeError(refusal("reliability", expected=expected, got=got, do="correct the arguments"))
    order = np.argsort(said, kind="stable")
    said, came = said[order], came[order]
    wanted = said[np.rint(np.linspace(0, len(said), bins + 1)[1:-1]).astype(np.int64)] if len(said) >= bins else said
    inner = np.searchsorted(said, wanted, side="left")
    edges = np.unique(np.concatenate([[0], inner, [len(said)]])).astype(np.int64)
    count = np.diff(edges)
    columns = np.stack([said, said * (1 - said), came.astype(np.float64)])
    sums = np.add.reduceat(columns, edges[:-1], axis=1) if len(edges) > 1 else np.zeros((3, 0))
    mean, spread, share = sums / count
    low, high = wilson(share, count)
    # The mean absolute deviation of a normal variable is sqrt(2 / pi) sigma.
    off = np.abs(share - mean), np.sqrt(2 / math.pi * np.maximum(spread, 0) / count)
    error, chance = (float((count / len(said) * each).sum()) if len(said) else math.nan for each in off)
    return Reliability(probability=mean, share=share, low=low, high=high, count=count, error=error, chance=chance)


def wilson(share: Floats, count: Counts) -> tuple[Floats, Floats]:
    """Return the ends of the 95 % interval of shares (B,) of `count` outcomes each (Wilson 1927)."""
    middle = (share + Z95**2 / (2 * count)) / (1 + Z95**2 / count)
    half = Z95 / (1 + Z95**2 / count) * np.sqrt(share * (1 - share) / count + Z95**2 / (4 * count**2))
    return np.maximum(middle - half, 0.0), np.minimum(middle + half, 1.0)


class Predictions(NamedTuple):
    """Output of a network for N pictures; made by `predict`."""

    logits: Tensor  # (N, G), on the grid
    R_view_body: Tensor  # (N, 3, 3), the truth


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Metrics of a network; made by `metrics_of`."""

    pictures: int
    nll: float  # of the smoothed target, nats; without the temperature
    recall_1: float  # share of the pictures whose first candidate is within `WITHIN_DEG` of the truth
    recall_5: float  # likewise, among the first five
    probability: float  # mean, of the first candidate
    ece: float  # expected calibration error of that probability


def predict(network: Correlator, batch: TrainingBatch) -> Predictions:
    """Apply a network to a batch of M maps with F pictures each, N = M F."""
    maps, each = batch.disks.shape[:2]
    seen = network.seen(batch.disks.flatten(0, 1)).reshape(maps, each, -1)
    logits = torch.cat([network.logits(seen[m], network.bank(batch.blurs[m])) for m in range(maps)])
    return Predictions(logits=logits, R_view_body=batch.R_view_body.flatten(0, 1))


def joined_predictions(parts: Sequence[Predictions]) -> Predictions:
    """Join several predictions."""
    return Predictions(*(torch.cat(column) for column in zip(*parts, strict=True)))


def cross_entropy(predictions: Predictions, grid: Tensor, spread_rad: float) -> Tensor:
    """Return the cross entropy of the predictions with the smoothed target, (N,) nats."""
    logits, target = predictions.logits, smoothed_target(predictions.R_view_body, grid, spread_rad)
    return torch.logsumexp(logits, 1) - (target * logits).sum(1)


def metrics_of(predictions: Predictions, grid: Tensor, spread_rad: float, temperature: float = 1.0) -> Metrics:
    """Compute the metrics; the temperature changes order and probability of the candidates, not their orientation."""
    rank, probability = _ranked(predictions, grid, temperature)
    return Metrics(
        **_recall(rank),
        nll=float(cross_entropy(predictions, grid, spread_rad).mean()),
        probability=float(probability.double().mean()),
        ece=reliability(probability.clamp(0, 1).cpu().numpy(), (rank < 1).cpu().numpy()).error,
    )


def fitted_temperature(predictions: Predictions, grid: Tensor) -> float:
    """Return the temperature that calibrates the first candidate's probability of being right (Guo et al. 2017)."""

    def cost(temperature: float) -> float:
        rank, probability = _ranked(predictions, grid, temperature)
        probability = probability.double().clamp(1e-6, 1 - 1e-6)
        return float(torch.nn.functional.binary_cross_entropy(probability, (rank < 1).double()))

    costs = {temperature: cost(temperature) for temperature in TEMPERATURES}
    best = min(costs, key=costs.__getitem__)
    costs |= {best * factor: cost(best * factor) for factor in NEARER}
    return min(costs, key=costs.__getitem__)


def _recall(rank: Tensor) -> dict[str, Any]:
    """Return the recall of pictures (N,) whose right candidate has this rank, as fields of the records."""
    first, five = (float((rank < among).double().mean()) for among in (1, 5))
    return {"pictures": len(rank), "recall_1": first, "recall_5": five}


def _ranked(predictions: Predictions, grid: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """Return the rank of the right candidate and the probability of the first one, (N,) each."""
    found = []
    for logits, R in zip(*(torch.split(one, 64) for one in predictions), strict=True):
        modes = find_modes(logits, grid, CANDIDATES, temperature)
        found.append((first_right(modes, R, WITHIN_DEG), modes.probability[:, 0]))
    rank, probability = (torch.cat(parts) for parts in zip(*found, strict=True))
    return rank, probability


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
    checkpoint: Checkpoint, settings: PictureSettings, pictures: int, progress: Progress
) -> ProposerBenchmark:
    """Measure a checkpoint on unseen maps and pictures; a fine-tuned one on its own map, that of `settings`.
    `pictures` of each degradation and level, ten times as many mixed; `progress` gets stage, finished maps, all maps.
    Raises CheckpointError: another picture size, or another map than that of the fine-tuning; TextureError: the map
    cannot be read.
    """
    _check(checkpoint, settings)
    network = correlator_of(checkpoint)
    count = 1 if settings.texture is not None else min(MAPS, pictures)
    maps = make_textures(settings, network.settings.nodes, count=count, first_seed=BENCHMARK_SEED)
    each = -(-pictures // count)
    ranks: dict[tuple[str, int], list[Tensor]] = {}
    mixed, taken_s = [], 0.0
    for k in counted("evaluate", range(count), count, progress):
        texture, bank = maps.textures[k], network.bank(maps.blurs[k])
        for number, name in enumerate(settings.degradations):
            for level in LEVELS:
                rng = generator_of(0, BENCHMARK_SEED, k, number, level)
                R = so3.random_rotations(each, generator=rng).float()
                disks = film(texture, R, {name: severity(name, level)}, rng, settings)
                logits = network.logits(network.seen(disks), bank)
                modes = find_modes(logits, network.grid, CANDIDATES, checkpoint.temperature)
                ranks.setdefault((name, level), []).append(first_right(modes, R, WITHIN_DEG))
        rng = generator_of(0, BENCHMARK_SEED, k, MIXED)
        R = so3.random_rotations(10 * each, generator=rng).float()
        groups = torch.split(R, each)
        disks = torch.cat([film(texture, some, draw_values(settings, rng), rng, settings) for some in groups])
        began = time.perf_counter()
        parts = [network.logits(network.seen(some), bank) for some in torch.split(disks, BATCH)]
        for part in parts:  # their time counts too
            find_modes(part, network.grid, CANDIDATES)
        taken_s += time.perf_counter() - began
        mixed.append(Predictions(logits=torch.cat(parts), R_view_body=R))
    predictions = joined_predictions(mixed)
    spread_rad = math.radians(checkpoint.settings.training.spread_deg)
    return ProposerBenchmark(
        families=tuple(
            DegradationRecall(family=name, level=level, **_recall(torch.cat(rank)))
            for (name, level), rank in ranks.items()
        ),
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


@torch.no_grad()
def make_examples(checkpoint: Checkpoint, count: int) -> tuple[Example, ...]:
    """Render `count` unseen maps (fine-tuned: its own), the first undegraded, and keep the first `SHOWN` proposals."""
    settings, network = checkpoint.settings.pictures, correlator_of(checkpoint)
    maps = make_textures(settings, network.settings.nodes, count=count, first_seed=VALIDATION_SEED)
    examples = []
    for k in range(count):
        rng = generator_of(0, EXAMPLES, k)
        R = so3.random_rotations(1, generator=rng).float()
        values = draw_values(settings, rng) if k else {}
        while k and not values and settings.degradations and settings.at_once:
            values = draw_values(settings, rng)
        texture = maps.textures[k % len(maps.textures)]
        disk = film(texture, R, values, rng, settings)
        logits = network(disk, maps.blurs[k % len(maps.blurs)])
        modes = find_modes(logits, network.grid, SHOWN, checkpoint.temperature)
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
    return orthographic_view(size_px).render(reduced_texture(texture, float(size_px)), R_view_body, math.nan)
