"""The dynamic programming layer: the cheapest path through candidates, whole movies at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.semiring import MIN_PLUS, Semiring
from sphereorient.assemble.visits import Visits, visits_of
from sphereorient.errors import ShapeError, check_tail, refusal

PAIRS_AT_ONCE = 1 << 16  # candidate pairs whose 3 x 3 products are held at once, 5 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class Swept:
    """What `sweep` carried along M steps; a state is the last one (C) or two (C, C) candidates of a path."""

    totals: Tensor  # (..., M, *state), less the levels of the step and of all before it
    level: Tensor  # (..., M), taken off in each step
    origins: Tensor | None  # (..., M - 1, *state) int64, the oldest candidate of the state before; None: all of them


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
    check_edges(edge_cost, mask)
    if 0 in mask.shape[-2:]:
        choice = mask.new_full(mask.shape[:-1], -1, dtype=torch.int64)
        return ShortestPath(choice=choice, cost=edge_cost.sum((-3, -2, -1)))
    visits = visits_of(mask)
    swept = sweep(*first_order(edge_cost.detach(), visits), MIN_PLUS)
    assert swept.origins is not None
    last = swept.totals[..., -1, :]
    held = _walk_back(last.argmin(-1, keepdim=True), swept.origins).gather(-1, visits.rank)
    blocked = torch.isinf(last).all(-1)
    choice = torch.where(visits.visited & ~blocked[..., None], held, -1)
    cost = torch.where(blocked, torch.inf, _cost_along(edge_cost, held, visits.visited))
    return ShortestPath(choice=choice, cost=cost)


def check_edges(edge_cost: Tensor, mask: Tensor) -> None:
    """Refuse edges (..., N - 1, C, C) that do not belong to a mask (..., N, C).

    Raises:
        ShapeError: they do not.
    """
    *_, steps, width = mask.shape
    if edge_cost.shape != (*mask.shape[:-2], max(steps - 1, 0), width, width):
        got = f"{tuple(edge_cost.shape)} and {tuple(mask.shape)}"
        do = "compute edges between neighbours"
        raise ShapeError(refusal("edge_cost and mask", expected="(..., N - 1, C, C) and (..., N, C)", got=got, do=do))


def first_order(edge_cost: Tensor, visits: Visits, node_cost: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return what `sweep` takes: totals of the first step (..., C) and edges (..., M - 1, C, C), without holes.

    Args:
        edge_cost: (..., N - 1, C, C), as `shortest_path`.
        visits: of the mask.
        node_cost: (..., N, C), what a candidate costs whatever comes before; None: nothing.
    """
    edges, start = visits.rows(edge_cost, back=1, first=1), edge_cost.new_zeros(visits.mask[..., 0, :].shape)
    if node_cost is not None:
        node = visits.rows(node_cost)
        edges, start = edges + node[..., 1:, None, :], start + node[..., 0, :]
    edges = torch.where(visits.real[..., 1:, None, None], edges, 0.0)
    usable = visits.mask[..., :-1, :, None] & visits.mask[..., 1:, None, :]
    start = torch.where(visits.real[..., :1], start, 0.0)
    return torch.where(visits.mask[..., 0, :], start, torch.inf), torch.where(usable, edges, torch.inf)


def sweep(start: Tensor, edges: Tensor, semiring: Semiring, order: int = 1) -> Swept:
    """Carry totals from the first step to the last: the recursion, whatever the semiring and the order.

    Args:
        start: (..., *state), totals of the first step: of each candidate (C,) in the first order, of each pair of the
            candidate before and this one (C, C) in the second; inf where there is none.
        edges: (..., M - 1, *state, C), cost of going on from each state to each candidate of the next step, inf where
            there is no way.
        semiring: the sum over origins, the oldest candidates of the states; the product along the way.
        order: 1 or 2, the number of candidates in a state.
    """
    axis = -order - 1  # of the origins, once the candidates of the next step stand behind the state
    level = start.new_zeros(start.shape[: start.ndim - order])
    total, totals, levels, origins = start, [start], [level], []
    for edge in edges.unbind(axis - 1):  # a recursion: each step needs the one before
        total, origin = semiring.sum(semiring.product(total.unsqueeze(-1), edge), axis)
        if semiring.levelled:
            level = total.amin(tuple(range(-order, 0)), keepdim=True).clamp_max(torch.finfo(total.dtype).max)
            total, level = total - level, level.flatten(-order)[..., 0]
        totals.append(total)
        levels.append(level)
        if origin is not None:
            origins.append(origin)
    none = edges.new_zeros((*start.shape[: start.ndim - order], 0, *start.shape[start.ndim - order :]))
    known = torch.stack(origins, dim=axis) if origins else none.to(torch.int64)
    return Swept(
        totals=torch.stack(totals, dim=axis),
        level=torch.stack(levels, dim=-1),
        origins=None if semiring.levelled else known,
    )


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
