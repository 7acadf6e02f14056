"""Weighted sums over windows of neighbouring frames, each frame with weights of its own.

A stencil is a tensor of weights (..., N, 2 h + 1): entry [k, h + j] is the weight of frame k + j in the result for
frame k. Missing frames have weight 0; a frame whose result is not determined has NaN weights.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad


def windows(x: Tensor, half: int, fill: float = torch.nan) -> Tensor:
    """Return the neighbours of every frame of x (..., N): entry [k, half + j] of (..., N, 2 half + 1) is x[k + j]."""
    if x.shape[-1] == 0:
        return x.new_empty(*x.shape, 2 * half + 1)
    return pad(x, (half, half), value=fill).unfold(-1, 2 * half + 1, 1)


def neighbours_there(there: Tensor, segment: Tensor | None, half: int) -> Tensor:
    """Return which neighbours (..., N, 2 half + 1) of a frame were measured and belong to its segment.
    `there` (..., N) bool marks measured frames; segment (..., N) is -1 outside any, None is one segment.
    """
    near = windows(there.to(torch.int8), half, fill=0).bool()
    if segment is None:
        return near
    return near & (windows(segment, half, fill=-1) == segment[..., None]) & (segment >= 0)[..., None]


def paired(there: Tensor, segment: Tensor | None, half: int) -> Tensor:
    """Return which neighbours of a frame can be used in pairs k - j, k + j; arguments as `neighbours_there`.
    The weights of pairs have one parity: no lower power of time enters the result, whichever frames are missing.
    """
    near = neighbours_there(there, segment, half)
    return near & near.flip(-1)


def apply(stencil: Tensor, x: Tensor) -> Tensor:
    """Return the weighted sums (..., N, D) of x (..., N, D), NaN where the stencil is; x of weight 0 may be NaN."""
    undetermined = stencil.isnan().any(-1)[..., None]
    # zeros in place of NaN first: the gradient of an unselected NaN is NaN, too
    weights = torch.where(undetermined, 0.0, stencil)[..., None, :]
    near = windows(x.mT, stencil.shape[-1] // 2).transpose(-3, -2)  # (..., N, D, 2 h + 1)
    sums = (weights * torch.where(weights == 0, 0.0, near)).sum(-1)
    return torch.where(undetermined, torch.nan, sums)


def propagated_sigma(stencil: Tensor, sigma: Tensor) -> Tensor:
    """Return the standard deviation (..., N, D) of the weighted sums, for independent errors of sigma (..., N, D)."""
    return apply(stencil.square(), sigma.square()).sqrt()


def compose(outer: Tensor, inner: Tensor) -> Tensor:
    """Return the stencil (..., N, 2 (a + b) + 1) of `outer` (2 a + 1) applied to the result of `inner` (2 b + 1)."""
    a = outer.shape[-1] // 2
    near = windows(inner.mT, a).movedim(-3, -1)  # (..., N, 2 a + 1, 2 b + 1)
    weights = outer[..., None]
    product = weights * torch.where(weights == 0, 0.0, near)
    rows = [pad(product[..., i, :], (i, 2 * a - i)) for i in range(2 * a + 1)]
    return torch.stack(rows).sum(0)
