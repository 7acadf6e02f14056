"""Random small graphs, and all their paths one by one, as the oracle of every recursion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from sphereorient.assemble import ShortestPath, SoftPath, shortest_path, soft_path

ORDERS = pytest.mark.parametrize("order", [1, 2])


@dataclass(frozen=True)
class Costs:
    """A movie's costs, each as the package takes it; of the first order where triple is None."""

    mask: Tensor  # (N, C)
    pair: Tensor  # (N - 1, C, C)
    node: Tensor  # (N, C)
    triple: Tensor | None = None  # (N - 2, C, C, C)

    @property
    def parts(self) -> dict[str, Tensor]:
        """All costs by name, without the mask."""
        return {name: part for name, part in vars(self).items() if name != "mask" and part is not None}

    def each(self, change: Callable[[Tensor], Tensor]) -> Costs:
        """Change all costs."""
        return replace(self, **{name: change(part) for name, part in self.parts.items()})

    def __getitem__(self, at: tuple[int, ...]) -> Costs:
        """One movie of a batch."""
        return replace(self.each(lambda part: part[at]), mask=self.mask[at])


def cheapest(costs: Costs) -> ShortestPath:
    return shortest_path(costs.pair, costs.mask, costs.node, costs.triple)


def soft(costs: Costs, temperature: float = 1.0) -> SoftPath:
    return soft_path(costs.pair, costs.mask, temperature, costs.node, costs.triple)


def random_costs(
    shape: tuple[int, ...], width: int, seed: int, *, order: int, scale: float = 1.0, walls: float = 0.0
) -> Costs:
    """Costs of either sign, holes anywhere, the ends too, and a share of edges that are walls."""
    rng = torch.Generator().manual_seed(seed)
    *batch, steps = shape

    def draw(*tail: int) -> Tensor:
        cost = scale * torch.randn(*batch, *tail, generator=rng, dtype=torch.float64)
        return torch.where(torch.rand(cost.shape, generator=rng) < walls, torch.inf, cost)

    mask = (torch.rand(*shape, width, generator=rng) < 0.7) & (torch.rand(*shape, 1, generator=rng) < 0.75)
    node = scale * torch.randn(*shape, width, generator=rng, dtype=torch.float64)
    pair = draw(max(steps - 1, 0), width, width)
    triple = draw(max(steps - 2, 0), width, width, width) if order == 2 else None
    return Costs(mask=mask, pair=pair, node=node, triple=triple)


def even_costs(steps: int, width: int, *, order: int) -> Costs:
    """Each pair and each triple costs 1, a candidate by itself nothing; without holes."""
    pair, triple = (torch.ones(max(steps - back, 0), *[width] * (back + 1), dtype=torch.float64) for back in (1, 2))
    mask = torch.ones(steps, width, dtype=torch.bool)
    return Costs(mask=mask, pair=pair, node=torch.zeros(steps, width).double(), triple=triple if order == 2 else None)


def batched(movies: Sequence[Costs]) -> Costs:
    """Movies of different length as one batch; the padding would be cheap."""

    def joined(name: str) -> Tensor:
        parts = [getattr(movie, name) for movie in movies]
        longest = max(parts, key=len)
        whole = torch.full_like(longest, -50.0) if name != "mask" else torch.zeros_like(longest)
        return torch.stack([torch.cat([part, whole[len(part) :]]) for part in parts])

    return Costs(**{name: joined(name) for name in ("mask", *movies[0].parts)})


def cost_of(costs: Costs, steps: list[int], places: tuple[int, ...]) -> float:
    """Cost of one path: edges into a step come from the steps visited last."""
    total = sum(float(costs.node[step, place]) for step, place in zip(steps, places, strict=True))
    for n in range(1, len(steps)):
        total += float(costs.pair[steps[n] - 1, places[n - 1], places[n]])
        if costs.triple is not None and n >= 2:
            total += float(costs.triple[steps[n] - 2, places[n - 2], places[n - 1], places[n]])
    return total


def all_paths(costs: Costs) -> tuple[list[int], dict[tuple[int, ...], float]]:
    """Steps visited, and the cost of every path over them."""
    steps = torch.nonzero(costs.mask.any(-1))[:, 0].tolist()
    there = [torch.nonzero(costs.mask[step])[:, 0].tolist() for step in steps]
    return steps, {places: cost_of(costs, steps, places) for places in itertools.product(*there)}


def enumerated(costs: Costs, temperature: float) -> tuple[Tensor, Tensor, Tensor]:
    """Free energy, marginals (N, C) and pair marginals (N - 1, C, C) by summing over all paths."""
    steps, paths = all_paths(costs)
    cost = torch.tensor(list(paths.values()), dtype=torch.float64)
    marginals, pairs = torch.zeros_like(costs.node), torch.zeros_like(costs.pair)
    free = -temperature * torch.logsumexp(-cost / temperature, 0)
    if torch.isinf(free):
        return free, marginals, pairs
    for places, weight in zip(paths, torch.softmax(-cost / temperature, 0), strict=True):
        for step, place in zip(steps, places, strict=True):
            marginals[step, place] += weight
        for step, before, here in zip(steps[1:], places[:-1], places[1:], strict=True):
            pairs[step - 1, before, here] += weight
    return free, marginals, pairs
