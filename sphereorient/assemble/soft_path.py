"""All paths through candidates at once: how probable each candidate is, and what depends on that smoothly."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.soft_recursion import all_paths
from sphereorient.assemble.trellis import check_edges, first_order
from sphereorient.assemble.visits import Visits, visits_of
from sphereorient.errors import ShapeError, check_tail, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftPath:
    """Probabilities of the candidates of each step of each movie, each path weighing exp(-cost / temperature).

    Made by `soft_path` and `soft_path_of_pairs`. All are differentiable in the costs.
    """

    free_energy: Tensor  # (...), -T log of the sum over all paths; inf where there is none, 0 without candidates
    marginals: Tensor  # (..., N, C), sum 1 in steps with candidates, 0 in others and where there is no path
    pair_marginals: Tensor  # (..., N - 1, C, C), of edge k into step k + 1, from the step visited last; 0 into others


def soft_path(edge_cost: Tensor, mask: Tensor, temperature: float = 1.0, node_cost: Tensor | None = None) -> SoftPath:
    """Weigh all paths that visit one candidate in each step; towards temperature 0 only `shortest_path`'s counts.

    Args:
        edge_cost: (..., N - 1, C, C), as `shortest_path`: from row to column, inf where there is no way, an edge into
            a step comes from the last step before it that has candidates.
        mask: (..., N, C) bool, True where there is a candidate.
        temperature: above 0, unit of the costs; where it is learnt, pass costs divided by it and 1 here.
        node_cost: (..., N, C), what a candidate costs whatever comes before; None: nothing. What stands at masked
            candidates does not matter.

    Raises:
        ShapeError: costs and mask do not belong together.
        SettingsError: a temperature that is not above 0.

    Source: Baum and others 1970 (forward-backward); Mensch and Blondel 2018, Differentiable dynamic programming.
    """
    check_edges(edge_cost, mask)
    check_nodes(node_cost, mask)
    if 0 in mask.shape[-2:]:
        return nothing(edge_cost, mask)
    visits = visits_of(mask)
    free, first, links = all_paths(*first_order(edge_cost, visits, node_cost), 1, temperature)
    nodes = torch.cat([first[..., None, :], links.sum(-2)], -2)
    return laid_out(free, nodes, links, visits)


def check_nodes(node_cost: Tensor | None, mask: Tensor) -> None:
    """Refuse costs of candidates that are not of the mask's shape.

    Raises:
        ShapeError: they are not.
    """
    if node_cost is not None and node_cost.shape != mask.shape:
        do, expected = "give every place of the mask its cost", f"shape {tuple(mask.shape)}"
        raise ShapeError(refusal("node_cost", expected=expected, got=str(tuple(node_cost.shape)), do=do))


def nothing(edge_cost: Tensor, mask: Tensor) -> SoftPath:
    """Return the soft path of movies without steps or without places."""
    *batch, steps, width = mask.shape
    pairs = edge_cost.new_zeros((*batch, max(steps - 1, 0), width, width))
    return SoftPath(
        free_energy=edge_cost.flatten(len(batch)).sum(-1),
        marginals=edge_cost.new_zeros(mask.shape),
        pair_marginals=pairs,
    )


def laid_out(free: Tensor, nodes: Tensor, pairs: Tensor, visits: Visits) -> SoftPath:
    """Bring probabilities from the steps visited back to all steps.

    Args:
        free: (...), free energy.
        nodes: (..., M, C), of the candidates.
        pairs: (..., M - 1, C, C), of the edges.
        visits: of the mask.
    """
    # Behind its end a movie waits in place 0 with probability 1: spread leaves that out, M's real steps come first.
    before = torch.zeros_like(nodes[..., :1, :, None] * nodes[..., :1, None, :])
    whole = pairs if visits.whole else visits.spread(torch.cat([before, pairs], -3))[..., 1:, :, :]
    return SoftPath(free_energy=free, marginals=visits.spread(nodes), pair_marginals=whole)


def expected_orientation(R_lab_body: Tensor, marginals: Tensor) -> Tensor:
    """Return the rotation with the least mean squared chord to the candidates, each with its probability.

    Args:
        R_lab_body: (..., N, C, 3, 3), candidates; those that are NaN do not count.
        marginals: (..., N, C), not negative.

    Returns:
        (..., N, 3, 3), differentiable in both; NaN where all marginals are 0. Where several rotations are equally near
        one of them comes, and its gradient is finite.

    Raises:
        ShapeError: candidates and marginals do not belong together.

    Source: chordal mean, Hartley et al. 2013, Rotation averaging, 5.1; projected by `so3.nearest_rotation`.
    """
    check_tail("R_lab_body", R_lab_body, *marginals.shape[-1:], 3, 3)
    known = torch.where(R_lab_body.isnan(), 0.0, R_lab_body)
    mean = so3.nearest_rotation((marginals[..., None, None].to(known) * known).sum(-3))
    return torch.where((marginals.sum(-1) > 0)[..., None, None], mean, torch.nan)
