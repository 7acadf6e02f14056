from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.learn.density import find_modes, first_right, smoothed_target
from sphereorient.learn.network import Correlator
from sphereorient.learn.pictures import TrainingBatch
from sphereorient.statistics.reliability import reliability

WITHIN_DEG = 10.0  # of the truth counts as right: the pose fit converges from there
CANDIDATES = 8
TEMPERATURES = tuple(2 ** (k / 2) for k in range(-4, 5))  # tried first: 1/4 .. 4
NEARER = tuple(2 ** (k / 8) for k in (-3, -2, -1, 1, 2, 3))  # then the best one times these


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """Output of a network for N pictures; made by `predict`."""

    logits: Tensor  # (N, G), on the grid
    R_view_body: Tensor  # (N, 3, 3), the truth

    @classmethod
    def joined(cls, parts: Sequence[Predictions]) -> Predictions:
        """Join several predictions."""
        return cls(
            logits=torch.cat([one.logits for one in parts]), R_view_body=torch.cat([one.R_view_body for one in parts])
        )


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


@torch.no_grad()
def predict_all(network: Correlator, batches: Iterable[TrainingBatch]) -> Predictions:
    """Apply a network to several batches, without gradients."""
    return Predictions.joined([predict(network, batch) for batch in batches])


def cross_entropy(predictions: Predictions, grid: Tensor, spread_rad: float) -> Tensor:
    """Return the cross entropy of the predictions with the smoothed target, (N,) nats."""
    logits, target = predictions.logits, smoothed_target(predictions.R_view_body, grid, spread_rad)
    return torch.logsumexp(logits, 1) - (target * logits).sum(1)


def metrics_of(predictions: Predictions, grid: Tensor, spread_rad: float, temperature: float = 1.0) -> Metrics:
    """Compute the metrics; the temperature changes order and probability of the candidates, not their orientation."""
    rank, probability = _ranked(predictions, grid, temperature)
    right = rank < 1
    return Metrics(
        pictures=len(predictions.logits),
        nll=float(cross_entropy(predictions, grid, spread_rad).mean()),
        recall_1=float(right.double().mean()),
        recall_5=float((rank < 5).double().mean()),
        probability=float(probability.double().mean()),
        ece=reliability(probability.clamp(0, 1).cpu().numpy(), right.cpu().numpy()).error,
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


def _ranked(predictions: Predictions, grid: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """Return the rank of the right candidate and the probability of the first one, (N,) each."""
    ranks, probabilities = [], []
    parts = (torch.split(one, 64) for one in (predictions.logits, predictions.R_view_body))
    for logits, R in zip(*parts, strict=True):
        modes = find_modes(logits, grid, CANDIDATES, temperature)
        ranks.append(first_right(modes, R, WITHIN_DEG))
        probabilities.append(modes.probability[:, 0])
    return torch.cat(ranks), torch.cat(probabilities)
