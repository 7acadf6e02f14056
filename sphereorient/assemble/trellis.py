"""Dynamic programming over candidates of whole movies: the cheapest path, or the probabilities of all paths.

A state is the last candidate (first order) or the last two (second order). Costs add along a path. Paths that meet in a
state are combined by the least cost (min-plus semiring), or by -T log sum exp(-cost / T) (log semiring).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, ShapeError, check_tail, refusal

PAIRS_AT_ONCE = 1 << 16  # candidate pairs with 3 x 3 products held at once, 5 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortestPath:
    """One candidate in each step of each movie."""

    choice: Tensor  # (..., N) int64, -1 in steps without candidates, and in all where no path has a finite cost
    cost: Tensor  # (...), of the path, inf without a path; differentiable in all costs


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftPath:
    """Probabilities of the candidates, with paths weighted by exp(-cost / temperature); differentiable in all costs."""

    free_energy: Tensor  # (...), -T log of the sum over all paths; inf without a path, 0 without candidates
    marginals: Tensor  # (..., N, C), sum 1 in steps with candidates, 0 in others and without a path
    pair_marginals: Tensor  # (..., N - 1, C, C), of edge k into step k + 1, from the last visited step; 0 into others


def shortest_path(
    edge_cost: Tensor | None, mask: Tensor, node_cost: Tensor | None = None, triple_cost: Tensor | None = None
) -> ShortestPath:
    """Find the cheapest path that visits one candidate in each step; of equal ones, that with the lowest last index.
    Steps without candidates are skipped: an edge into step k + 1 comes from the last step before it with candidates.
    Raises ShapeError (costs and mask differ in shape).
    Source: Bellman 1957, Viterbi 1967.

    Args:
        edge_cost: (..., N - 1, C, C), from row to column, inf for a wall; None: 0, with `triple_cost` only.
        mask: (..., N, C) bool, True for a candidate; costs of masked candidates are ignored.
        node_cost: (..., N, C), of a single candidate.
        triple_cost: (..., N - 2, C, C, C), of three candidates in the order of time; makes the order second.
    """
    order, like = _checked(edge_cost, mask, node_cost, triple_cost)
    if 0 in mask.shape[-2:]:
        none = mask.new_full(mask.shape[:-1], -1, dtype=torch.int64)
        return ShortestPath(choice=none, cost=like.new_zeros(mask.shape[:-2]))
    start, edges = _laid_out(like, edge_cost, node_cost, triple_cost, mask)
    visited, width, older = mask.any(-1), mask.shape[-1], mask.shape[-1] ** (order - 1)
    total, origins = start, []
    for edge, here in _steps(edges.detach(), visited, order):  # recursive in the steps
        arriving = total.unsqueeze(-1) + edge
        # Not min(): it starts all threads even for small tensors, ten times slower on busy cores.
        origin = arriving.argmin(-order - 1)
        arrived = arriving.gather(-order - 1, origin.unsqueeze(-order - 1)).squeeze(-order - 1)
        total = torch.where(here, arrived, total)
        origins.append((origin.flatten(-order), here.flatten(-order)))
    # A state (i, j) has the number i C + j. Of equal ones, the lowest j is taken, then the lowest i.
    end = total.reshape(*total.shape[: total.ndim - order], older, width).mT.flatten(-2).argmin(-1, keepdim=True)
    walk = [end % older * width + end // older]
    for origin, here in reversed(origins):
        before = origin.gather(-1, walk[-1]) * older + walk[-1] // width
        walk.append(torch.where(here, before, walk[-1]))
    states = torch.cat(walk[::-1], -1)
    choice = states[..., 1:] % width
    along = edges.flatten(-order - 1).gather(-1, (states[..., :-1] * width + choice)[..., None])[..., 0]
    blocked = total.flatten(-order).amin(-1) >= _wall(total) / 2
    cost = torch.where(blocked, torch.inf, torch.where(visited, along, 0.0).sum(-1))
    return ShortestPath(choice=torch.where(visited & ~blocked[..., None], choice, -1), cost=cost)


def soft_path(
    edge_cost: Tensor | None,
    mask: Tensor,
    temperature: float = 1.0,
    node_cost: Tensor | None = None,
    triple_cost: Tensor | None = None,
) -> SoftPath:
    """Weigh all paths by exp(-cost / temperature), temperature > 0; other arguments as in `shortest_path`.
    Raises ShapeError (costs and mask differ in shape), SettingsError (the temperature is not above 0).
    Source: Baum and others 1970 (forward-backward); Mensch and Blondel 2018, Differentiable dynamic programming.
    """
    order, like = _checked(edge_cost, mask, node_cost, triple_cost)
    if not 0 < temperature < torch.inf:
        do = "for temperature 0 use the shortest path"
        raise SettingsError(refusal("temperature", expected="a number above 0", got=str(temperature), do=do))
    if 0 in mask.shape[-2:]:
        pairs = like.new_zeros((*mask.shape[:-2], max(mask.shape[-2] - 1, 0), *[mask.shape[-1]] * 2))
        return SoftPath(free_energy=pairs.sum((-3, -2, -1)), marginals=like.new_zeros(mask.shape), pair_marginals=pairs)
    start, edges = _laid_out(like, edge_cost, node_cost, triple_cost, mask)
    free, links = _all_paths(start, edges, mask.any(-1), order, temperature)
    blocked = free >= _wall(free) / 2
    links = torch.where(blocked[..., None, None, None], 0.0, links.sum(-3) if order == 2 else links)
    second = (mask.any(-1).cumsum(-1) > 1)[..., None, None]  # no edge enters the first visited step
    pairs = torch.where(second, links, 0.0)[..., 1:, :, :]
    free_energy = torch.where(blocked, torch.inf, free)
    return SoftPath(free_energy=free_energy, marginals=links.sum(-2), pair_marginals=pairs)


def visited_before(mask: Tensor) -> Tensor:
    """Return the last step with candidates in a mask (..., N, C) before each step, (..., N) int64; 0: none."""
    step = torch.arange(mask.shape[-2], device=mask.device)
    held = torch.where(mask.any(-1), step, 0).cummax(-1).values if len(step) else mask[..., 0].long()
    return torch.cat([torch.zeros_like(held[..., :1]), held[..., :-1]], -1)


def taken(part: Tensor, step: Tensor, tail: int) -> Tensor:
    """Return the rows (..., N, *tail) of a part (..., M, *tail) at steps (..., N); `tail` is the number of axes."""
    index = step[(..., *[None] * tail)]
    return part.gather(-tail - 1, index.expand(*step.shape, *part.shape[part.ndim - tail :]))


def _all_paths(start: Tensor, edges: Tensor, visited: Tensor, order: int, temperature: float) -> tuple[Tensor, Tensor]:
    """Sum over all paths: free energy (...), and probability of each edge, like `edges`, 0 into steps not visited."""
    axis, state = -order - 1, tuple(range(-order, 0))  # of the origins in an edge; of a state
    total, totals, levels = start, [start], [start.new_zeros(start.shape[: start.ndim - order])]
    for edge, here in _steps(edges, visited, order):
        arrived = -temperature * torch.logsumexp((total.unsqueeze(-1) + edge) / -temperature, axis)
        total = torch.where(here, arrived, total)
        # Subtract each step's least total: long movies keep their digits in single precision.
        level = total.detach().amin(state, keepdim=True)
        total = total - level
        totals.append(total)
        levels.append(level.flatten(-order)[..., 0])
    free = -temperature * torch.logsumexp(total / -temperature, state) + torch.stack(levels).sum(0)
    shares = torch.softmax((torch.stack(totals[:-1], axis).unsqueeze(-1) + edges) / -temperature, axis)
    weight = torch.softmax((total / -temperature).flatten(-order), -1).reshape(total.shape)
    links = []
    for share, here in reversed(list(_steps(shares, visited, order))):
        link = share * weight.unsqueeze(axis)
        links.append(torch.where(here.unsqueeze(-1), link, 0.0))
        weight = torch.where(here, link.sum(-1), weight)
    return free, torch.stack(links[::-1], axis - 1)


def _steps(edges: Tensor, visited: Tensor, order: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the edges (..., *state, C) into each step, and whether it is visited, (..., *[1] * order)."""
    return zip(edges.unbind(-order - 2), visited[(..., *[None] * order)].unbind(-order - 1), strict=True)


def _laid_out(
    like: Tensor, edge_cost: Tensor | None, node_cost: Tensor | None, triple_cost: Tensor | None, mask: Tensor
) -> tuple[Tensor, Tensor]:
    """Return totals before the first step (..., *state), 0 in place 0 only, and edges (..., N, *state, C) into each."""
    steps, width = mask.shape[-2:]
    rank, last = mask.any(-1).cumsum(-1), visited_before(mask)
    first = torch.arange(width, device=mask.device) == 0

    def rows(cost: Tensor, back: int) -> Tensor:
        """Return the cost that enters each step; 0 if fewer than `back` steps were visited before."""
        led = torch.nn.functional.pad(cost, (*[0, 0] * (back + 1), steps - cost.shape[-back - 2], 0))
        return torch.where((rank > back)[(..., *[None] * (back + 1))], led, 0.0)

    def places_before(here: Tensor) -> Tensor:
        """Return the places (..., N, C) of the last visited step, `first` if there is none."""
        begun = torch.nn.functional.pad(rank, (1, -1)) > 0
        return torch.where(begun[..., None], taken(here, last, 1), first)

    before = places_before(mask)
    edges = like.new_zeros((*mask.shape, width)) if edge_cost is None else rows(edge_cost, 1)
    edges = edges if node_cost is None else edges + rows(node_cost, 0)[..., None, :]
    there = before[..., :, None] & mask[..., None, :]
    if triple_cost is not None:
        edges = rows(triple_cost, 2) + edges[..., None, :, :]
        there = places_before(before)[..., :, None, None] & there[..., None, :, :]
    edges = torch.where(there, edges, torch.inf)
    # Finite walls, far above costs: differences of infinities are NaN.
    state = edges.shape[mask.ndim - 1 : -1]
    start = edges.new_full((math.prod(state),), _wall(edges))
    start[0] = 0.0
    return start.reshape(state).expand(*mask.shape[:-2], *state), edges.clamp_max(_wall(edges))


def _wall(like: Tensor) -> float:
    return float(torch.finfo(like.dtype).max ** 0.5)


def _checked(
    edge_cost: Tensor | None, mask: Tensor, node_cost: Tensor | None, triple_cost: Tensor | None
) -> tuple[int, Tensor]:
    """Raise if costs do not fit the mask; return the order of the path, and costs in their common dtype."""
    order, like = (1, edge_cost) if triple_cost is None else (2, triple_cost)
    if like is None:
        raise ShapeError(refusal("edge_cost", expected="costs of edges or triples", got="none", do="pass one of them"))
    *batch, steps, width = mask.shape
    for name, cost, back in (("node_cost", node_cost, 0), ("edge_cost", edge_cost, 1), ("triple_cost", triple_cost, 2)):
        expected = (*batch, max(steps - back, 0), *[width] * (back + 1))
        if cost is not None and cost.shape != expected:
            got, do = str(tuple(cost.shape)), "compute the costs of all candidates of the mask"
            raise ShapeError(refusal(name, expected=f"shape {expected} for this mask", got=got, do=do))
    return order, like


def edge_costs(R_lab_body: Tensor, score: Tensor, time_s: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the paper's cost d(A, B) (2 - T_A - T_B) / dt, rad/s, from each candidate (row) to each of the next step.
    Shapes: R_lab_body (..., N, C, 3, 3), score T (..., N, C), increasing time_s (..., N), result (..., N - 1, C, C).
    With a mask (..., N, C), each edge comes from the last step before it with candidates. Raises ShapeError (the inputs
    differ in steps or candidates).
    Source: the paper's assembly of III; a standstill costs nothing (docs/errata.md A6).
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    check_tail("score", score, *R_lab_body.shape[-4:-2])
    check_tail("time_s", time_s, *score.shape[-2:-1])
    mask = torch.ones_like(score, dtype=torch.bool) if mask is None else mask
    last, time_s = visited_before(mask)[..., 1:], time_s.expand(score.shape[:-1])
    dt = time_s[..., 1:] - taken(time_s, last, 0)  # in this order, as single precision cannot separate late times
    turn = turns_over_gaps(R_lab_body, mask)
    doubt = 2 - taken(score, last, 1)[..., :, None] - score[..., 1:, None, :]
    return turn * doubt / dt.to(turn)[..., None, None]


def turns_over_gaps(R_lab_body: Tensor, mask: Tensor) -> Tensor:
    """Return the angles (..., N - 1, C, C), rad, from candidates (..., N, C, 3, 3) to those of the next step.
    Each comes from the last step before it with candidates in the mask (..., N, C).
    """
    last, width = visited_before(mask)[..., 1:], mask.shape[-1]
    before, after = (R.flatten(0, -4) for R in (taken(R_lab_body, last, 3), R_lab_body[..., 1:, :, :, :]))
    chunk = max(1, PAIRS_AT_ONCE // max(width, 1) ** 2)
    pieces = zip(torch.split(before, chunk), torch.split(after, chunk), strict=True)
    turns = torch.cat([so3.geodesic_distance(a[:, :, None], b[:, None]) for a, b in pieces])
    return turns.reshape(*last.shape, width, width)
