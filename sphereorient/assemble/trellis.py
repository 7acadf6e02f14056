"""Dynamic programming over candidates of whole movies: the cheapest path, or the probabilities of all paths.

A state is the last candidate (first order) or the last two (second order). Costs add along a path. Paths that meet in a
state are combined by the least cost (min-plus semiring), or by -T log sum exp(-cost / T) (log semiring).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import SettingsError, ShapeError, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortestPath:
    """One candidate in each step of each movie."""

    choice: Tensor  # (..., N) int64, -1 in steps without candidates, and in all where no path has a finite cost
    cost: Tensor  # (...), of the path, inf without a path; differentiable in all costs


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftPath:
    """Probabilities of the candidates, each path weighing exp(-cost / temperature); differentiable in all costs."""

    free_energy: Tensor  # (...), -T log of the sum over all paths; inf without a path, 0 without candidates
    marginals: Tensor  # (..., N, C), sum 1 in steps with candidates, 0 in others and without a path
    pair_marginals: Tensor  # (..., N - 1, C, C), of edge k into step k + 1, from the step visited last; 0 into others


def shortest_path(
    edge_cost: Tensor | None, mask: Tensor, node_cost: Tensor | None = None, triple_cost: Tensor | None = None
) -> ShortestPath:
    """Find the cheapest path that visits one candidate in each step; of equal paths, the one with the lowest last
    index.
    Steps without candidates are skipped: an edge into step k + 1 comes from the last step before it with candidates.
    Source: Bellman 1957, Viterbi 1967.

    Args:
        edge_cost: (..., N - 1, C, C), from row to column, inf for a wall; None: 0, with `triple_cost` only.
        mask: (..., N, C) bool, True for a candidate; costs of masked candidates do not matter.
        node_cost: (..., N, C), of a candidate by itself.
        triple_cost: (..., N - 2, C, C, C), of three candidates in the order of time; makes the order second.

    Raises:
        ShapeError: costs and mask differ in shape.
    """
    order = _checked_order(edge_cost, mask, node_cost, triple_cost)
    if 0 in mask.shape[-2:]:
        none = mask.new_full(mask.shape[:-1], -1, dtype=torch.int64)
        return ShortestPath(choice=none, cost=_like(edge_cost, triple_cost).new_zeros(mask.shape[:-2]))
    visits = _visits_of(mask)
    start, edges = _laid_out(edge_cost, node_cost, triple_cost, visits)
    total, origins = start.detach(), []
    for edge in edges.detach().unbind(-order - 2):  # a recursion: each step needs the one before
        arriving = total.unsqueeze(-1) + edge
        # Not min(): it wakes all threads for the smallest tensor, which on busy cores takes ten times as long.
        origin = arriving.argmin(-order - 1)
        total = arriving.gather(-order - 1, origin.unsqueeze(-order - 1)).squeeze(-order - 1)
        origins.append(origin)
    walk = _walk_back(total, origins, order)
    blocked = total.flatten(-order).amin(-1) >= _wall(total) / 2
    held = walk[..., order - 1 :].gather(-1, visits.rank)
    return ShortestPath(
        choice=torch.where(visits.visited & ~blocked[..., None], held, -1),
        cost=torch.where(blocked, torch.inf, _cost_along(start, edges, walk, order)),
    )


def soft_path(
    edge_cost: Tensor | None,
    mask: Tensor,
    temperature: float = 1.0,
    node_cost: Tensor | None = None,
    triple_cost: Tensor | None = None,
) -> SoftPath:
    """Weigh all paths by exp(-cost / temperature), temperature > 0; the other arguments are those of `shortest_path`.
    Source: Baum and others 1970 (forward-backward); Mensch and Blondel 2018, Differentiable dynamic programming.

    Raises:
        ShapeError: costs and mask differ in shape.
        SettingsError: the temperature is not above 0.
    """
    order = _checked_order(edge_cost, mask, node_cost, triple_cost)
    if not 0 < temperature < torch.inf:
        do = "for temperature 0 take the shortest path"
        raise SettingsError(refusal("temperature", expected="a number above 0", got=str(temperature), do=do))
    like, width = _like(edge_cost, triple_cost), mask.shape[-1]
    if 0 in mask.shape[-2:]:
        pairs = like.new_zeros((*mask.shape[:-2], max(mask.shape[-2] - 1, 0), width, width))
        return SoftPath(free_energy=pairs.sum((-3, -2, -1)), marginals=like.new_zeros(mask.shape), pair_marginals=pairs)
    visits = _visits_of(mask)
    free, first, links = _all_paths(*_laid_out(edge_cost, node_cost, triple_cost, visits), order, temperature)
    if order == 2:
        first, links = first.sum(-2), links.sum(-3)
    nodes = torch.cat([first[..., None, :], links.sum(-2)], -2)
    blocked = free >= _wall(free) / 2
    nodes, links = (torch.where(blocked[(..., *[None] * tail)], 0.0, part) for tail, part in ((2, nodes), (3, links)))
    # Behind its end a movie waits in place 0 with probability 1: `spread` leaves that out.
    before = torch.zeros_like(nodes[..., :1, :, None] * nodes[..., :1, None, :])
    return SoftPath(
        free_energy=torch.where(blocked, torch.inf, free),
        marginals=visits.spread(nodes),
        pair_marginals=visits.spread(torch.cat([before, links], -3))[..., 1:, :, :],
    )


def _all_paths(start: Tensor, edges: Tensor, order: int, temperature: float) -> tuple[Tensor, Tensor, Tensor]:
    """Sum over all paths: free energy (...), probability of each first state, and of each edge, like `edges`."""
    axis, state = -order - 1, tuple(range(-order, 0))  # of the origins in an edge; of a state
    total, totals, levels = start, [start], [start.new_zeros(start.shape[: start.ndim - order])]
    for edge in edges.unbind(axis - 1):
        total = -temperature * torch.logsumexp((total.unsqueeze(-1) + edge) / -temperature, axis)
        # Only differences count: less each step's least total, long movies keep their digits in single precision.
        level = total.detach().amin(state, keepdim=True)
        total = total - level
        totals.append(total)
        levels.append(level.flatten(-order)[..., 0])
    free = -temperature * torch.logsumexp(total / -temperature, state) + torch.stack(levels).sum(0)
    if len(totals) > 1:
        shares = torch.softmax((torch.stack(totals[:-1], axis).unsqueeze(-1) + edges) / -temperature, axis)
    else:
        shares = edges
    weight = torch.softmax((total / -temperature).flatten(-order), -1).reshape(total.shape)
    weights = [weight]
    for share in reversed(shares.unbind(axis - 1)):
        weight = (share * weight.unsqueeze(axis)).sum(-1)
        weights.append(weight)
    links = shares * torch.stack(weights[-2::-1], axis).unsqueeze(axis) if len(weights) > 1 else edges
    return free, weight, links


def _laid_out(
    edge_cost: Tensor | None, node_cost: Tensor | None, triple_cost: Tensor | None, visits: _Visits
) -> tuple[Tensor, Tensor]:
    """Return totals of the first step (..., *state) and edges (..., M - 1, *state, C) of the steps visited."""
    mask, real = visits.mask, visits.real
    start = _like(edge_cost, triple_cost).new_zeros(mask[..., 0, :].shape)
    edges = start.new_zeros((*mask[..., 1:, :].shape, mask.shape[-1]))
    if edge_cost is not None:
        edges = edges + visits.rows(edge_cost, 1)
    if node_cost is not None:
        node = visits.rows(node_cost, 0)
        edges, start = edges + node[..., 1:, None, :], start + node[..., 0, :]
    start = torch.where(mask[..., 0, :], torch.where(real[..., :1], start, 0.0), torch.inf)
    edges = torch.where(real[..., 1:, None, None], edges, 0.0)
    edges = torch.where(mask[..., :-1, :, None] & mask[..., 1:, None, :], edges, torch.inf)
    if triple_cost is not None:
        alone = (torch.arange(mask.shape[-1], device=mask.device) == 0).expand_as(mask[..., :1, :])
        start = torch.where(alone[..., 0, :, None], start[..., None, :], torch.inf)
        triples = edges.new_zeros((*edges.shape[:-3], min(edges.shape[-3], 1), *[mask.shape[-1]] * 3))
        if edges.shape[-3] > 1:
            late = torch.where(real[..., 2:, None, None, None], visits.rows(triple_cost, 2), 0.0)
            triples = torch.cat([triples, late], -4)
        older = torch.cat([alone, mask[..., :-2, :]], -2)[..., : edges.shape[-3], :, None, None]
        edges = torch.where(older, triples + edges[..., None, :, :], torch.inf)
    # Finite walls: differences of infinities would be NaN. Costs are far smaller.
    return start.clamp_max(_wall(start)), edges.clamp_max(_wall(edges))


def _wall(like: Tensor) -> float:
    return float(torch.finfo(like.dtype).max ** 0.5)


def _walk_back(last: Tensor, origins: list[Tensor], order: int) -> Tensor:
    """Follow the origins from the cheapest last state: (..., M), in the second order (..., M + 1)."""
    width = last.shape[-1]
    if order == 1:
        walk = [last.argmin(-1, keepdim=True)]
    else:
        end = last.mT.flatten(-2).argmin(-1, keepdim=True)  # of equals the lowest last place, then the lowest before
        walk = [end // width, end % width]
    for origin in reversed(origins):
        state = walk[-1] if order == 1 else walk[-1] * width + walk[-2]
        walk.append(origin.flatten(-order).gather(-1, state))
    return torch.cat(walk[::-1], dim=-1)


def _cost_along(start: Tensor, edges: Tensor, walk: Tensor, order: int) -> Tensor:
    power = edges.shape[-1] ** torch.arange(order, -1, -1, device=walk.device)
    steps = walk.shape[-1] - order
    edge = (torch.stack([walk[..., i : i + steps] for i in range(order + 1)], -1) * power).sum(-1)
    first = (walk[..., :order] * power[1:]).sum(-1, keepdim=True)
    along = edges.flatten(-order - 1).gather(-1, edge[..., None])[..., 0]
    return start.flatten(-order).gather(-1, first)[..., 0] + along.sum(-1)


def _like(edge_cost: Tensor | None, triple_cost: Tensor | None) -> Tensor:
    found = triple_cost if triple_cost is not None else edge_cost
    if found is None:
        raise ShapeError(refusal("edge_cost", expected="costs of edges or triples", got="none", do="pass one of them"))
    return found


def _checked_order(edge_cost: Tensor | None, mask: Tensor, node_cost: Tensor | None, triple_cost: Tensor | None) -> int:
    """Raise where costs do not fit the mask; return the order of the path."""
    _like(edge_cost, triple_cost)
    *batch, steps, width = mask.shape
    for name, cost, back in (
        ("node_cost", node_cost, 0),
        ("edge_cost", edge_cost, 1),
        ("triple_cost", triple_cost, 2),
    ):
        expected = (*batch, max(steps - back, 0), *[width] * (back + 1))
        if cost is not None and cost.shape != expected:
            got, do = str(tuple(cost.shape)), "compute the costs of all candidates of the mask"
            raise ShapeError(refusal(name, expected=f"shape {expected} for this mask", got=got, do=do))
    return 1 if triple_cost is None else 2


@dataclass(frozen=True, kw_only=True, eq=False)
class _Visits:
    """The at most M steps that a movie visits; one that visits fewer waits behind its end in place 0, at no cost."""

    step: Tensor  # (..., M) int64, of the N steps; behind the end any
    real: Tensor  # (..., M) bool, False behind the end
    mask: Tensor  # (..., M, C) bool, candidates; behind the end place 0 alone
    rank: Tensor  # (..., N) int64, which of the M is the last one visited up to each step, 0 before the first
    visited: Tensor  # (..., N) bool
    whole: bool  # no movie has a gap

    def rows(self, part: Tensor, back: int) -> Tensor:
        """Return rows (..., M - back, *tail) of a part (..., N - back, *tail) whose row k belongs to step k + back."""
        if self.whole:
            return part
        index = (self.step[..., back:] - back).clamp_min(0)
        axis = self.step.ndim - 1
        tail = part.shape[axis + 1 :]
        return part.gather(axis, index[(..., *[None] * len(tail))].expand(*index.shape, *tail))

    def spread(self, part: Tensor) -> Tensor:
        """Return (..., N, *tail) of a part (..., M, *tail), 0 in the steps that are not visited."""
        if self.whole:
            return part
        axis = self.step.ndim - 1
        tail = part.shape[axis + 1 :]
        shape = (..., *[None] * len(tail))
        held = part.gather(axis, self.rank[shape].expand(*self.rank.shape, *tail))
        return torch.where(self.visited[shape], held, 0)


def _visits_of(mask: Tensor) -> _Visits:
    """Return which steps each movie of a mask (..., N, C) visits; N and C at least 1."""
    visited = mask.any(-1)
    count = visited.sum(-1)
    most = max(int(count.max()), 1) if count.numel() else mask.shape[-2]
    step = torch.argsort(visited.logical_not().to(torch.uint8), dim=-1, stable=True)[..., :most]
    real = torch.arange(most, device=mask.device) < count[..., None]
    waiting = torch.arange(mask.shape[-1], device=mask.device) == 0
    here = mask.gather(-2, step[..., None].expand(*step.shape, mask.shape[-1]))
    return _Visits(
        step=step,
        real=real,
        mask=torch.where(real[..., None], here, waiting),
        rank=(visited.cumsum(-1) - 1).clamp_min(0),
        visited=visited,
        whole=bool(visited.all()),
    )
