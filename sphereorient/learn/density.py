"""From a density over SO(3) to candidates: its tops, where in the grid's cells they are, and what they weigh."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.search.peaks import distinct

LOOKED_AT = 48  # best places of the grid among which tops are sought
APART_DEG = 25.0  # tops nearer than this to a better one belong to it
AROUND_DEG = 22.0  # places whose mean a top is


@dataclass(frozen=True, kw_only=True, eq=False)
class Tops:
    """Candidates of F disks, likeliest first, K each; made by `tops_of`."""

    R_view_body: Tensor  # (F, K, 3, 3) float32
    probability: Tensor  # (F, K), of the grid's places about each; 0 where there is no further top


def tops_of(logits: Tensor, grid: Tensor, count: int, temperature: float = 1.0) -> Tops:
    """Find the tops of densities on a grid.

    Args:
        logits: (F, G), logarithms of the density but for a constant of each disk.
        grid: (G, 3, 3) rotations, evenly spread.
        count: of tops, K.
        temperature: logits are divided by it for the probabilities and the order alone. Where tops are is asked of the
            density as it was learnt, spread over several places: a sharper one would draw them to the nearest place.
    """
    flat = grid.flatten(1)
    probability = logits.softmax(-1)
    place = logits.topk(min(LOOKED_AT, logits.shape[1]), dim=1).indices
    top = distinct(grid[place], math.radians(APART_DEG))
    # The first `count` that are tops; a stable sort keeps their order.
    order = (~top).int().argsort(dim=1, stable=True)[:, :count]
    chosen, there = place.gather(1, order), top.gather(1, order)
    near = flat[chosen] @ flat.T  # (F, K, G), trace of the rotation between them
    near = near.masked_fill(~there[..., None], -2.0)
    own = (near == near.amax(1, keepdim=True)) & (near > 1 + 2 * math.cos(math.radians(AROUND_DEG)))
    share = own * probability[:, None]
    weight = (own * (logits / temperature).softmax(-1)[:, None]).sum(-1)
    mean = (share @ flat).reshape(*weight.shape, 3, 3) / share.sum(-1).clamp_min(1e-30)[..., None, None]
    view = torch.eye(3, dtype=grid.dtype, device=grid.device)
    R = so3.nearest_rotation(torch.where(there[..., None, None], mean, view))
    weight = torch.where(there, weight, 0.0)
    best = weight.argsort(dim=1, descending=True, stable=True)
    return Tops(R_view_body=R.gather(1, best[..., None, None].expand_as(R)), probability=weight.gather(1, best))


def spread_answer(R: Tensor, grid: Tensor, spread_rad: float) -> Tensor:
    """Return right answers (F, 3, 3) as densities on the grid, (F, G), each summing to 1."""
    trace = R.flatten(1) @ grid.flatten(1).T
    # 3 - trace is the square of small angles.
    return ((trace - 3) / (2 * spread_rad**2)).softmax(-1)


def first_right(tops: Tops, R: Tensor, within_deg: float) -> Tensor:
    """Return at which place, 0 the likeliest, the right orientation (F, 3, 3) is, (F,); K where it is nowhere."""
    trace = (tops.R_view_body * R[:, None]).sum((-2, -1))
    right = (trace > 1 + 2 * math.cos(math.radians(within_deg))) & (tops.probability > 0)
    count = right.shape[1]
    rank: Tensor = torch.where(right, torch.arange(count, device=R.device), count).amin(1)
    return rank
