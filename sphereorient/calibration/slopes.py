"""Derivatives along directions: cheap where few parameters move many points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def slopes_along(function: Callable[[Tensor], Tensor], at: Tensor, directions: Sequence[Tensor] | Tensor) -> Tensor:
    """Return the derivatives of a function at a point along K directions, (..., K) where the function gives (...).

    What the backward pass returns is linear in the weights of the outputs; its derivative by them is the slope. So the
    function is called once, however many directions there are: forward differentiation takes ten times as long, for it
    calls the function for each and follows the steps of its root finders.

    Args:
        function: of one tensor.
        at: where.
        directions: K of the shape of `at`.

    Source: the double-vjp trick (Townsend 2017).
    """
    with torch.enable_grad():
        point = at.detach().requires_grad_()
        value = function(point)
        if not value.requires_grad:
            return value.new_zeros(*value.shape, len(directions))
        weight = torch.zeros_like(value, requires_grad=True)
        (pulled,) = torch.autograd.grad(value, point, weight, create_graph=True, materialize_grads=True)
    if not pulled.requires_grad:
        return torch.zeros_like(value)[..., None].expand(*value.shape, len(directions))
    columns = [torch.autograd.grad(pulled, weight, direction, retain_graph=True)[0] for direction in directions]
    return torch.stack(columns, dim=-1) if columns else value.detach().new_zeros(*value.shape, 0)
