"""Derivatives along directions, by forward differentiation: cheap where few parameters move many points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.autograd.forward_ad
from torch import Tensor


def slope_along(function: Callable[[Tensor], Tensor], at: Tensor, direction: Tensor) -> Tensor:
    """Return the derivative of a function at a point along a direction, in the function's shape.

    Args:
        function: of one tensor.
        at: where.
        direction: of the shape of `at`.
    """
    forward: Any = torch.autograd.forward_ad
    with torch.no_grad(), forward.dual_level():
        value, tangent = forward.unpack_dual(function(forward.make_dual(at, direction)))
    return torch.zeros_like(value) if tangent is None else torch.as_tensor(tangent)
