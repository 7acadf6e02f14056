"""The dynamic programming layer: the cheapest path through candidates, whole movies at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError, check_tail, refusal

PAIRS_AT_ONCE = 1 << 16  # candidate pairs whose 3 x 3 products are held at once, 5 MB

Reduction = Callable[[Tensor], tuple[Tensor, Tensor]]  # totals (..., from, to) -> total and origin of each `to`


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortestPath:
    """One candidate in each step of each movie; made by `shortest_path`, read by path."""

    choice: Tensor  # (..., N) int64, -1 in steps without candidates
    cost: Tensor  # (...), sum of the path's edges; differentiable in the edge costs


def edge_costs(R_lab_body: Tensor, score: Tensor, time_s: Tensor) -> Tensor:
    """Return the paper's cost of going from each candidate of a step to each of the next.

    Args:
        R_lab_body: (..., N, C, 3, 3), rotations, not checked.
        score: (..., N, C), quality T, 0 .. 1.
        time_s: (..., N), increasing.

    Returns:
        (..., N - 1, C, C), d(A, B) (2 - T_A - T_B) / dt, rad/s; row: from, column: to; dtype of
        the rotations, whatever that of the times.

    Raises:
        ShapeError: the inputs are not of the same steps and candidates.

    Source: the paper's assembly of III; ERRATA A6 for its hole (a standstill costs nothing).
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    check_tail("score", score, *R_lab_body.shape[-4:-2])
    check_tail("time_s", time_s, *score.shape[-2:-1])
    batch, (steps, width) = score.shape[:-2], score.shape[-2:]
    before, after = (
        R.flatten(0, -4) for R in (R_lab_body[..., : max(steps - 1, 0), :, :, :], R_lab_body[..., 1:, :, :, :])
    )
    chunk = max(1, PAIRS_AT_ONCE // max(width, 1) ** 2)
    parts = [
        so3.geodesic_distance(a[:, :, None], b[:, None])
        for a, b in zip(torch.split(before, chunk), torch.split(after, chunk), strict=True)
    ]
    distance = torch.cat(parts).reshape(*batch, max(steps - 1, 0), width, width)
    doubt = 2 - score[..., : max(steps - 1, 0), :, None] - score[..., 1:, None, :]
    return distance * doubt / time_s.diff().to(distance)[..., None, None]


def shortest_path(edge_cost: Tensor, mask: Tensor) -> ShortestPath:
    """Find the global minimum over all paths that visit one candidate in each step.

    A step without candidates is skipped: an edge that leads into step k + 1 comes from the last step before it that
    has candidates. So movies with different holes, or of different length (empty steps at the end), go in one batch.

    Args:
        edge_cost: (..., N - 1, C, C), from row to column, any sign, inf where there is no way; what stands on edges
            of masked candidates does not matter.
        mask: (..., N, C) bool, True where there is a candidate.

    Returns:
        The path; of equally cheap ones the one that ends in, and then comes from, the lowest index. Where no path has
        a finite cost, choice is -1 in all steps and the cost inf. A movie without candidates costs 0.

    Raises:
        ShapeError: costs and mask do not belong together.

    Source: Bellman 1957, Viterbi 1967; min-plus algebra.
    """
    *_, steps, width = mask.shape
    if edge_cost.shape != (*mask.shape[:-2], max(steps - 1, 0), width, width):
        got = f"{tuple(edge_cost.shape)} and {tuple(mask.shape)}"
        do = "compute edges between neighbours"
        raise ShapeError(refusal("edge_cost and mask", expected="(..., N - 1, C, C) and (..., N, C)", got=got, do=do))
    if steps == 0 or width == 0:
        choice = mask.new_full(mask.shape[:-1], -1, dtype=torch.int64)
        return ShortestPath(choice=choice, cost=edge_cost.sum((-3, -2, -1)))
    last, origin = sweep(edge_cost.detach(), mask, _least)
    held = _walk_back(last.argmin(-1, keepdim=True), origin)
    visited = mask.any(-1)
    blocked = torch.isinf(last).all(-1) & visited.any(-1)
    choice = torch.where(visited & ~blocked[..., None], held, -1)
    cost = torch.where(blocked, torch.inf, _cost_along(edge_cost, held, visited))
    return ShortestPath(choice=choice, cost=cost)


def _least(arriving: Tensor) -> tuple[Tensor, Tensor]:
    """Reduce (..., from, to) to the cheapest total and its origin; of equals the lowest index."""
    # Not min(-2): it wakes all threads for the smallest tensor, on busy cores the sweep then takes ten times as long.
    origin = arriving.argmin(-2)
    return arriving.gather(-2, origin[..., None, :])[..., 0, :], origin


def sweep(edge_cost: Tensor, mask: Tensor, reduce: Reduction) -> tuple[Tensor, Tensor]:
    """Carry totals from the first step to the last: the recursion, whatever the semiring.

    Args:
        edge_cost: (..., N - 1, C, C), as `shortest_path`.
        mask: (..., N, C) bool, N and C at least 1.
        reduce: the semiring's sum over origins; its product is +, its zero inf.

    Returns:
        Totals of the last step visited (..., C), inf where masked, and the origins that `reduce` names,
        (..., N - 1, C); into an empty step each index comes from itself.
    """
    width = mask.shape[-1]
    visited = mask.any(-1)
    edges = torch.where(_usable(mask, visited), edge_cost, torch.inf)
    first = visited & (visited.cumsum(-1) == 1)
    start = torch.where(mask, 0.0, torch.inf).to(edge_cost.dtype)
    stay = torch.arange(width, device=mask.device)
    total, origins = start[..., 0, :], []
    for k in range(mask.shape[-2] - 1):  # a recursion: each step needs the one before
        best, origin = reduce(total[..., :, None] + edges[..., k, :, :])
        best = torch.where(first[..., k + 1, None], start[..., k + 1, :], best)
        total = torch.where(visited[..., k + 1, None], best, total)
        origins.append(torch.where(visited[..., k + 1, None], origin, stay))
    none = mask.new_zeros((*total.shape[:-1], 0, width), dtype=torch.int64)
    return total, torch.stack(origins, dim=-2) if origins else none


def _usable(mask: Tensor, visited: Tensor) -> Tensor:
    """Edges between candidates, (..., N - 1, C, C) bool; those over empty steps come from the last step visited."""
    step = torch.arange(mask.shape[-2], device=mask.device)
    held = torch.where(visited, step, 0).cummax(-1).values[..., :-1]
    origin = mask.gather(-2, held[..., None].expand(*held.shape, mask.shape[-1]))
    return origin[..., :, None] & mask[..., 1:, None, :]


def _walk_back(end: Tensor, origin: Tensor) -> Tensor:
    """Follow the origins from the end (..., 1), (..., N): the index held in each step, also in empty ones."""
    walk = [end]
    for k in range(origin.shape[-2] - 1, -1, -1):
        walk.append(origin[..., k, :].gather(-1, walk[-1]))
    return torch.cat(walk[::-1], dim=-1)


def _cost_along(edge_cost: Tensor, held: Tensor, visited: Tensor) -> Tensor:
    """Sum of the edges of a path, (...): the minimum's subgradient is 1 on these edges and 0 elsewhere."""
    width = edge_cost.shape[-1]
    linked = visited[..., 1:] & (visited.cumsum(-1) > 0)[..., :-1]
    flat = held[..., :-1] * width + held[..., 1:]
    along = edge_cost.flatten(-2).gather(-1, flat[..., None])[..., 0]
    return torch.where(linked, along, 0.0).sum(-1)
