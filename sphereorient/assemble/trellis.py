"""The dynamic programming layer: the cheapest path through candidates, whole movies at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError, refusal

PAIRS_AT_ONCE = 1 << 20  # candidate pairs whose 3 x 3 products are held at once, 75 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortestPath:
    """One candidate in each step of each movie; made by `shortest_path`, read by path."""

    choice: Tensor  # (..., N) int64, -1 in steps without candidates
    cost: Tensor  # (...), sum of the path's edges; differentiable in the edge costs


def edge_costs(R_lab_body: Tensor, score: Tensor, time_s: Tensor) -> Tensor:
    """Return the paper's cost of going from each candidate of a step to each of the next.

    Args:
        R_lab_body: (..., N, C, 3, 3).
        score: (..., N, C), quality T.
        time_s: (..., N), increasing.

    Returns:
        (..., N - 1, C, C), d(A, B) (2 - T_A - T_B) / dt, rad/s; row: from, column: to.

    Source: paper section III D; ERRATA A6 for its hole (a standstill costs nothing).
    """
    batch, (steps, width) = score.shape[:-2], score.shape[-2:]
    before, after = (R.reshape(-1, width, 3, 3) for R in (R_lab_body[..., :-1, :, :, :], R_lab_body[..., 1:, :, :, :]))
    chunk = max(1, PAIRS_AT_ONCE // width**2)
    parts = [
        so3.geodesic_distance(a[:, :, None], b[:, None])
        for a, b in zip(torch.split(before, chunk), torch.split(after, chunk), strict=True)
    ]
    distance = torch.cat(parts).reshape(*batch, max(steps - 1, 0), width, width)
    doubt = 2 - score[..., :-1, :, None] - score[..., 1:, None, :]
    return distance * doubt / time_s.diff()[..., None, None]


def shortest_path(edge_cost: Tensor, mask: Tensor) -> ShortestPath:
    """Find the global minimum over all paths that visit one candidate in each step.

    A step without candidates passes the state on unchanged and costs nothing: movies of different length are padded
    with such steps at their ends. Holes inside a movie are closed before (`path.py`), so that edges lead over them.

    Args:
        edge_cost: (..., N - 1, C, C), from row to column; finite between candidates.
        mask: (..., N, C) bool, True where there is a candidate.

    Returns:
        The path; of equally cheap ones the one that ends, and then comes from, the lowest index.

    Raises:
        ShapeError: costs and mask do not belong together.
    Source: Bellman 1957, Viterbi 1967; min-plus algebra.
    """
    *_, steps, width = mask.shape
    if edge_cost.shape != (*mask.shape[:-2], max(steps - 1, 0), width, width):
        got = f"{tuple(edge_cost.shape)} and {tuple(mask.shape)}"
        do = "compute edges between neighbours"
        raise ShapeError(refusal("edge_cost and mask", expected="(..., N - 1, C, C) and (..., N, C)", got=got, do=do))
    if steps == 0:
        return ShortestPath(choice=mask.new_zeros(mask.shape[:-1], dtype=torch.int64), cost=edge_cost.sum((-3, -2, -1)))
    last, origin = _forward(edge_cost.detach(), mask)
    choice = _backward(last, origin, mask)
    return ShortestPath(choice=choice, cost=_cost_along(edge_cost, choice))


def _forward(edge_cost: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Cheapest total at each candidate of the last step (..., C), and each one's best origin (..., N - 1, C)."""
    width = mask.shape[-1]
    total = torch.where(mask[..., 0, :], 0.0, torch.inf).to(edge_cost.dtype)
    stay = torch.arange(width, device=mask.device).expand_as(total)
    origins = []
    for k in range(mask.shape[-2] - 1):  # a recursion: each step needs the one before
        here = mask[..., k + 1, :]
        arriving = total[..., :, None] + edge_cost[..., k, :, :]
        origin = arriving.argmin(-2)  # the first of equals: the lowest index
        best = arriving.gather(-2, origin[..., None, :])[..., 0, :]
        empty = ~here.any(-1, keepdim=True)
        # Before the first candidate of a movie all totals are infinite: it begins here.
        begins = torch.isinf(total).all(-1, keepdim=True)
        best = torch.where(begins, torch.zeros_like(best), best)
        total = torch.where(empty, total, torch.where(here, best, torch.inf))
        origins.append(torch.where(empty, stay, origin))
    return total, torch.stack(origins, dim=-2) if origins else mask.new_zeros(
        (*total.shape[:-1], 0, width), dtype=torch.int64
    )


def _backward(last: Tensor, origin: Tensor, mask: Tensor) -> Tensor:
    """Walk back from the cheapest end, (..., N); -1 in steps without candidates."""
    at = last.argmin(-1, keepdim=True)
    walk = [at]
    for k in range(origin.shape[-2] - 1, -1, -1):
        at = origin[..., k, :].gather(-1, at)
        walk.append(at)
    choice = torch.cat(walk[::-1], dim=-1)
    return torch.where(mask.any(-1), choice, -1)


def _cost_along(edge_cost: Tensor, choice: Tensor) -> Tensor:
    """Sum of the edges of a path, (...): the minimum's subgradient is 1 on these edges and 0 elsewhere."""
    width = edge_cost.shape[-1]
    linked = (choice[..., :-1] >= 0) & (choice[..., 1:] >= 0)
    flat = choice[..., :-1].clamp_min(0) * width + choice[..., 1:].clamp_min(0)
    along = edge_cost.flatten(-2).gather(-1, flat[..., None])[..., 0]
    return torch.where(linked, along, torch.zeros_like(along)).sum(-1)
