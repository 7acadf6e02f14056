"""How good proposals are: the right orientation among the first few, and probabilities that keep what they promise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.learn.density import first_right, spread_answer, tops_of
from sphereorient.learn.network import Correlator
from sphereorient.learn.pictures import Lesson
from sphereorient.statistics.reliability import reliability

WITHIN_DEG = 10.0  # of the truth: right, because the fit finds its way from there
CANDIDATES = 8
TEMPERATURES = tuple(2 ** (k / 2) for k in range(-4, 5))  # that are tried first: 1/4 .. 4
NEARER = tuple(2 ** (k / 8) for k in (-3, -2, -1, 1, 2, 3))  # then these times the best one


@dataclass(frozen=True, kw_only=True, eq=False)
class Answers:
    """What a network said of N pictures; made by `answers_of`."""

    logits: Tensor  # (N, G), of the grid
    R_view_body: Tensor  # (N, 3, 3), the truth


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Figures of a network; made by `judge`."""

    pictures: int
    nll: float  # of the spread answer, nats; whatever the temperature
    recall_1: float  # share whose first candidate is within `WITHIN_DEG` of the truth
    recall_5: float  # likewise, of the first five
    probability: float  # mean, of the first candidate
    ece: float  # expected calibration error of that probability


def answers_of(network: Correlator, lessons: Iterable[Lesson]) -> Answers:
    """Ask a network about all pictures of lessons."""
    logits, truth = [], []
    with torch.no_grad():
        for lesson in lessons:
            logits.append(logits_of(network, lesson))
            truth.append(lesson.R_view_body.flatten(0, 1))
    return Answers(logits=torch.cat(logits), R_view_body=torch.cat(truth))


def logits_of(network: Correlator, lesson: Lesson) -> Tensor:
    """Return logits (M F, G) of a lesson's M maps with F pictures each."""
    maps, each = lesson.disks.shape[:2]
    seen = network.seen(lesson.disks.flatten(0, 1)).reshape(maps, each, -1)
    return torch.cat([network.logits(seen[m], network.bank(lesson.blurs[m])) for m in range(maps)])


def cross_entropy(logits: Tensor, R: Tensor, grid: Tensor, spread_rad: float) -> Tensor:
    """Return what it costs to say `logits` (N, G) where R (N, 3, 3) is right, spread over the grid, (N,) nats."""
    answer = spread_answer(R, grid, spread_rad)
    return torch.logsumexp(logits, 1) - (answer * logits).sum(1)


def judge(answers: Answers, grid: Tensor, spread_rad: float, temperature: float = 1.0) -> Judged:
    """Judge answers; the temperature acts on the candidates' order and probabilities, not on where they are."""
    rank, said = _ranked(answers, grid, temperature)
    right = rank < 1
    return Judged(
        pictures=len(answers.logits),
        nll=float(cross_entropy(answers.logits, answers.R_view_body, grid, spread_rad).mean()),
        recall_1=float(right.double().mean()),
        recall_5=float((rank < 5).double().mean()),
        probability=float(said.double().mean()),
        ece=reliability(said.clamp(0, 1).cpu().numpy(), right.cpu().numpy()).error,
    )


def fitted_temperature(answers: Answers, grid: Tensor) -> float:
    """Return the temperature with which the first candidate's probability says best whether it is right.

    The likelihood of right and wrong decides, which is best where probabilities are those of the outcomes: the
    likelihood of the density would be that of the spread answer, which is wider than the truth.

    Source: Guo et al. 2017 (temperature scaling).
    """

    def cost(temperature: float) -> float:
        rank, said = _ranked(answers, grid, temperature)
        said = said.double().clamp(1e-6, 1 - 1e-6)
        return float(torch.nn.functional.binary_cross_entropy(said, (rank < 1).double()))

    costs = {temperature: cost(temperature) for temperature in TEMPERATURES}
    best = min(costs, key=costs.__getitem__)
    costs |= {best * factor: cost(best * factor) for factor in NEARER}
    return min(costs, key=costs.__getitem__)


def _ranked(answers: Answers, grid: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """Return at which place the right candidate is, and the first one's probability, (N,) each."""
    ranks, said = [], []
    for some, truth in zip(torch.split(answers.logits, 64), torch.split(answers.R_view_body, 64), strict=True):
        tops = tops_of(some, grid, CANDIDATES, temperature)
        ranks.append(first_right(tops, truth, WITHIN_DEG))
        said.append(tops.probability[:, 0])
    return torch.cat(ranks), torch.cat(said)
