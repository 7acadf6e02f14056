"""The trellis whose states are pairs of candidates: what the next one must fit is the turn between the last two."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.assemble.semiring import MIN_PLUS
from sphereorient.assemble.soft_path import SoftPath, check_nodes, laid_out, nothing
from sphereorient.assemble.soft_recursion import all_paths
from sphereorient.assemble.trellis import ShortestPath, check_edges, sweep
from sphereorient.assemble.visits import Visits, visits_of
from sphereorient.errors import ShapeError, refusal


def shortest_path_of_pairs(
    triple_cost: Tensor, mask: Tensor, pair_cost: Tensor | None = None, node_cost: Tensor | None = None
) -> ShortestPath:
    """Find the global minimum over all paths, where a step's cost depends on the two steps visited before it.

    A step without candidates is skipped, as by `shortest_path`: the cost of entering step k + 2 is that of coming from
    the last two steps before it that have candidates.

    Args:
        triple_cost: (..., N - 2, C, C, C), of candidates in the order of time, inf where there is no way; what stands
            at masked candidates does not matter.
        mask: (..., N, C) bool, True where there is a candidate.
        pair_cost: (..., N - 1, C, C), as `shortest_path`'s edges, on top; None: nothing.
        node_cost: (..., N, C), what a candidate costs whatever comes before, on top; None: nothing.

    Returns:
        The path, its cost differentiable in all three; of equally cheap ones the one that ends in, and then comes
        from, the lowest index. Where no path has a finite cost, choice is -1 in all steps and the cost inf.

    Raises:
        ShapeError: costs and mask do not belong together.

    Source: Viterbi 1967 on pairs.
    """
    _check(triple_cost, mask, pair_cost, node_cost)
    if 0 in mask.shape[-2:]:
        none = nothing(triple_cost, mask)
        return ShortestPath(choice=mask.new_full(mask.shape[:-1], -1, dtype=torch.int64), cost=none.free_energy)
    visits = visits_of(mask)
    start, edges = _second_order(triple_cost, pair_cost, node_cost, visits)
    swept = sweep(start.detach(), edges.detach(), MIN_PLUS, order=2)
    assert swept.origins is not None
    last = swept.totals[..., -1, :, :]
    walk = _walk_back(last, swept.origins)
    blocked = torch.isinf(last).all(-1).all(-1)
    held = walk[..., 1:].gather(-1, visits.rank)
    choice = torch.where(visits.visited & ~blocked[..., None], held, -1)
    return ShortestPath(choice=choice, cost=torch.where(blocked, torch.inf, _cost_along(start, edges, walk)))


def soft_path_of_pairs(
    triple_cost: Tensor,
    mask: Tensor,
    temperature: float = 1.0,
    pair_cost: Tensor | None = None,
    node_cost: Tensor | None = None,
) -> SoftPath:
    """Weigh all paths, where a step's cost depends on the two steps visited before it.

    Args:
        triple_cost: (..., N - 2, C, C, C), as `shortest_path_of_pairs`.
        mask: (..., N, C) bool.
        temperature: above 0, unit of the costs; where it is learnt, pass costs divided by it and 1 here.
        pair_cost: (..., N - 1, C, C), on top; None: nothing.
        node_cost: (..., N, C), on top; None: nothing.

    Raises:
        ShapeError: costs and mask do not belong together.
        SettingsError: a temperature that is not above 0.

    Source: as `soft_path`, on pairs.
    """
    _check(triple_cost, mask, pair_cost, node_cost)
    if 0 in mask.shape[-2:]:
        return nothing(triple_cost, mask)
    visits = visits_of(mask)
    free, first, links = all_paths(*_second_order(triple_cost, pair_cost, node_cost, visits), 2, temperature)
    pairs = links.sum(-3)
    nodes = torch.cat([first.sum(-2, keepdim=True), pairs.sum(-2)], -2)
    return laid_out(free, nodes, pairs, visits)


def _check(triple_cost: Tensor, mask: Tensor, pair_cost: Tensor | None, node_cost: Tensor | None) -> None:
    *batch, steps, width = mask.shape
    expected = (*batch, max(steps - 2, 0), width, width, width)
    if triple_cost.shape != expected:
        do = "compute the cost of every three candidates in a row"
        got = str(tuple(triple_cost.shape))
        raise ShapeError(refusal("triple_cost", expected=f"shape {expected} for this mask", got=got, do=do))
    if pair_cost is not None:
        check_edges(pair_cost, mask)
    check_nodes(node_cost, mask)


def _second_order(
    triple_cost: Tensor, pair_cost: Tensor | None, node_cost: Tensor | None, visits: Visits
) -> tuple[Tensor, Tensor]:
    """Totals (..., C, C) and edges (..., M - 1, C, C, C) for `sweep`; before the first step stands place 0, alone."""
    mask, real, axis = visits.mask, visits.real, triple_cost.ndim - 4
    width = mask.shape[-1]
    waiting = (torch.arange(width, device=mask.device) == 0).expand_as(mask[..., :1, :])
    before = torch.cat([waiting, mask], -2)
    steps = mask.shape[-2]
    free = triple_cost.new_zeros((*triple_cost.shape[:axis], min(steps - 1, 1), width, width, width))
    late = visits.rows(triple_cost, back=2, first=2) if steps > 2 else free[..., :0, :, :, :]
    edges, start = torch.cat([free, late], axis), triple_cost.new_zeros(mask[..., 0, :].shape)
    if pair_cost is not None:
        edges = edges + visits.rows(pair_cost, back=1, first=1)[..., None, :, :]
    if node_cost is not None:
        node = visits.rows(node_cost)
        edges, start = edges + node[..., 1:, None, None, :], start + node[..., 0, :]
    usable = before[..., :-2, :, None, None] & before[..., 1:-1, None, :, None] & before[..., 2:, None, None, :]
    edges = torch.where(real[..., 1:, None, None, None], edges, 0.0)
    start = torch.where(real[..., :1], start, 0.0)
    first = before[..., 0, :, None] & before[..., 1, None, :]
    return torch.where(first, start[..., None, :], torch.inf), torch.where(usable, edges, torch.inf)


def _walk_back(last: Tensor, origins: Tensor) -> Tensor:
    """Follow the origins (..., M - 1, C, C) from the cheapest last pair: (..., M + 1), with the place before."""
    width = last.shape[-1]
    end = last.mT.flatten(-2).argmin(-1, keepdim=True)  # of equals the lowest last place, then the lowest before
    here, before = end // width, end % width
    walk = [here, before]
    for origin in reversed(origins.flatten(-2).unbind(-2)):
        here, before = before, origin.gather(-1, before * width + here)
        walk.append(before)
    return torch.cat(walk[::-1], dim=-1)


def _cost_along(start: Tensor, edges: Tensor, walk: Tensor) -> Tensor:
    """Sum of what is paid along a path, (...); its gradient is the minimum's subgradient."""
    width = edges.shape[-1]
    pair = walk[..., :-1] * width + walk[..., 1:]
    triple = pair[..., :-1] * width + walk[..., 2:]
    along = edges.flatten(-3).gather(-1, triple[..., None])[..., 0]
    return start.flatten(-2).gather(-1, pair[..., :1])[..., 0] + along.sum(-1)
