"""Forward and backward over all paths, with first and second derivatives and no memory but the forward totals."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from sphereorient.assemble.semiring import log_sum_exp
from sphereorient.assemble.trellis import sweep


def all_paths(start: Tensor, edges: Tensor, order: int, temperature: float) -> tuple[Tensor, Tensor, Tensor]:
    """Sum over all paths of a trellis without holes.

    Args:
        start: (..., *state), as `trellis.sweep`.
        edges: (..., M - 1, *state, C), as `trellis.sweep`.
        order: 1 or 2.
        temperature: above 0, unit of the costs.

    Returns:
        Free energy (...), -T log of the sum of exp(-cost / T) over all paths; probability of each state of the first
        step (..., *state); probability of each edge (..., M - 1, *state, C). The probabilities are the free energy's
        gradient. All can be differentiated; the free energy twice, the probabilities once. Where there is no path the
        free energy is inf, all probabilities and all gradients are 0.

    Source: Baum and others 1970; Mensch and Blondel 2018, Differentiable dynamic programming, algorithms 1 and 2.
    """
    free, first, links = _AllPaths.apply(start, edges, order, temperature)  # type: ignore[no-untyped-call]
    return free, first, links


class _AllPaths(Function):
    """`all_paths`; backwards its probabilities, and behind them their own slope."""

    @staticmethod
    def forward(ctx: Any, start: Tensor, edges: Tensor, order: int, temperature: float) -> tuple[Tensor, ...]:
        """Forward totals in the log domain, then probabilities from the end back."""
        swept = sweep(start, edges, log_sum_exp(temperature), order)
        last, state = swept.totals.select(-order - 1, -1), tuple(range(-order, 0))
        free = -temperature * torch.logsumexp(last / -temperature, state) + swept.level.sum(-1)
        shares, end = _shares(swept.totals, edges, order, temperature)
        weights = _backward(shares, end, None, order)
        links = shares.mul_(weights.narrow(-order - 1, 1, weights.shape[-order - 1] - 1).unsqueeze(-order - 1))
        first = weights.select(-order - 1, 0).clone()
        ctx.save_for_backward(edges, swept.totals, first, links)
        ctx.order, ctx.temperature = order, temperature
        ctx.set_materialize_grads(False)
        return free, first, links

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, Tensor | None, None, None]:
        """Probabilities times the free energy's slope, and the curvature along those of the probabilities."""
        edges, totals, first, links = ctx.saved_tensors
        of_free, of_first, of_links = slopes
        to_start: Tensor | None = None
        to_edges: Tensor | None = None
        if of_free is not None:
            row = of_free[(..., *[None] * ctx.order)]
            to_start, to_edges = row * first, row[..., None, None] * links
        if of_first is not None or of_links is not None:
            # The edges go in as they are, so that a further derivative ends in a refusal and not in a silent 0.
            along = of_first, of_links, edges, totals, ctx.order, ctx.temperature
            bend = _Curvature.apply(*along)  # type: ignore[no-untyped-call]
            to_start = bend[0] if to_start is None else to_start + bend[0]
            to_edges = bend[1] if to_edges is None else to_edges + bend[1]
        return to_start, to_edges, None, None


class _Curvature(Function):
    """The free energy's Hessian, symmetric, times a direction: how the probabilities change along it."""

    @staticmethod
    def forward(
        ctx: Any,
        to_first: Tensor | None,
        to_links: Tensor | None,
        edges: Tensor,
        totals: Tensor,
        order: int,
        temperature: float,
    ) -> tuple[Tensor, Tensor]:
        """Carry the direction forward through the totals, then back through the probabilities."""
        axis, state = -order - 1, tuple(range(-order, 0))
        steps = totals.shape[axis]
        shares, end = _shares(totals, edges, order, temperature)
        weights = _backward(shares, end, None, order)
        after = weights.narrow(axis, 1, steps - 1).unsqueeze(axis)
        moved = _forward(shares, to_first, to_links, totals, order)
        ahead, behind = moved.narrow(axis, 1, steps - 1), moved.narrow(axis, 0, steps - 1)
        # A share exp((total after - total before - edge) / T) changes with all three.
        change = ahead.unsqueeze(axis) - behind.unsqueeze(-1)
        if to_links is not None:
            change = change - to_links
        bent = shares * change / temperature * after
        last = moved.select(axis, -1)
        bent_end = end * ((end * last).sum(state, keepdim=True) - last) / temperature
        bent_weights = _backward(shares, bent_end, bent.sum(-1), order)
        bent_links = bent + shares * bent_weights.narrow(axis, 1, steps - 1).unsqueeze(axis)
        return bent_weights.select(axis, 0).clone(), bent_links

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[None, ...]:
        """Refuse."""
        raise NotImplementedError("soft path: derivatives of the probabilities beyond the first are not there.")


def _shares(totals: Tensor, edges: Tensor, order: int, temperature: float) -> tuple[Tensor, Tensor]:
    """Of what arrives in each state, the share of each origin, like edges; and the share of each last state."""
    axis = -order - 1
    arriving = totals.narrow(axis, 0, totals.shape[axis] - 1).unsqueeze(-1) + edges
    last = totals.select(axis, -1).flatten(-order)
    end = torch.softmax(last / -temperature, -1).masked_fill(torch.isinf(last), 0.0)
    shares = torch.softmax(arriving / -temperature, axis).masked_fill_(torch.isinf(arriving), 0.0)
    return shares, end.reshape(totals.select(axis, -1).shape)


def _backward(shares: Tensor, end: Tensor, added: Tensor | None, order: int) -> Tensor:
    """Probabilities of all states (..., M, *state) from those of the last, `added` (..., M - 1, *state) on top."""
    weight, weights = end, [end]
    more = added.unbind(-order - 1) if added is not None else ()
    for k, share in reversed(list(enumerate(shares.unbind(-order - 2)))):
        weight = (share * weight.unsqueeze(-order - 1)).sum(-1)
        weight = weight + more[k] if more else weight
        weights.append(weight)
    return torch.stack(weights[::-1], dim=-order - 1)


def _forward(shares: Tensor, to_first: Tensor | None, to_links: Tensor | None, totals: Tensor, order: int) -> Tensor:
    """Change of all totals (..., M, *state) along a direction in the first totals and the edges."""
    axis = -order - 1
    change = to_first if to_first is not None else torch.zeros_like(totals.select(axis, 0))
    changes = [change]
    more = (shares * to_links).sum(axis).unbind(axis) if to_links is not None else ()
    for k, share in enumerate(shares.unbind(axis - 1)):
        change = (share * change.unsqueeze(-1)).sum(axis)
        change = change + more[k] if more else change
        changes.append(change)
    return torch.stack(changes, dim=axis)
