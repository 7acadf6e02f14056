"""Weighted sums over windows of neighbouring frames, with separate weights for each frame; derivatives by them.

A stencil is a tensor of weights (..., N, 2 h + 1): entry [k, h + j] is the weight of frame k + j in the result for
frame k. Missing frames have weight 0; a frame with an undetermined result has NaN weights.
"""

import math
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from sphereorient.errors import SettingsError, refusal

Order = Literal[0, 1, 2]
TRUNCATE = 3.0  # holds 99.7 % of the Gaussian


def windows(x: Tensor, half: int, fill: float = torch.nan) -> Tensor:
    """Return the neighbours of every frame of x (..., N): entry [k, half + j] of (..., N, 2 half + 1) is x[k + j]."""
    # Padded by one more than needed, for N = 0.
    return pad(x, (half, half + 1), value=fill).unfold(-1, 2 * half + 1, 1)[..., : x.shape[-1], :]


def neighbours_there(there: Tensor, segment: Tensor | None, half: int) -> Tensor:
    """Return which neighbours (..., N, 2 half + 1) of a frame were measured and belong to its segment.
    `there` (..., N) bool marks measured frames; segment (..., N) is -1 outside any, None is one segment.
    """
    near = windows(there.to(torch.int8), half, fill=0).bool()
    if segment is None:
        return near
    return near & (windows(segment, half, fill=-1) == segment[..., None]) & (segment >= 0)[..., None]


def paired(there: Tensor, segment: Tensor | None, half: int) -> Tensor:
    """Return which of the `neighbours_there` are in pairs k - j, k + j: their weights have one parity in time."""
    near = neighbours_there(there, segment, half)
    return near & near.flip(-1)


def apply(stencil: Tensor, x: Tensor) -> Tensor:
    """Return the weighted sums (..., N, D) of x (..., N, D), NaN where the stencil is; x of weight 0 may be NaN."""
    undetermined = stencil.isnan().any(-1)[..., None]
    # replace NaN first, whose gradient is NaN even if not selected
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


def gaussian_derivative(
    x: Tensor, dt_s: float, sigma_frames: float, order: Order, truncate: float = TRUNCATE
) -> Tensor:
    """Return the derivative (..., N, D) of x (..., N, D), in its unit / s^order, by a Gaussian kernel; order 0 smooths.
    NaN where the window (`truncate` sigmas on each side) reaches a missing value or an end. Exact for polynomials up to
    degree order + 1. A sine of f cycles per frame is damped by about exp(-(2 pi f sigma)^2 / 2).
    Raises SettingsError (an order other than 0, 1, 2, or a width that is not positive).
    Source: the paper, section III, differentiation of trajectories with a Gaussian kernel.
    """
    kernel = _with_exact_moments(*_gaussian(sigma_frames, order, truncate, x), order)
    return (windows(x.mT, len(kernel) // 2) * kernel).sum(-1).mT / dt_s**order


def gaussian_kernel(sigma_frames: float, order: Order, truncate: float = TRUNCATE) -> Tensor:
    """Return the weights (2 h + 1) of the frames k - h .. k + h in `gaussian_derivative` with dt_s = 1.
    Their norm is the gain of white noise: for sigma above 1.5 frames, orders 0, 1, 2: 0.531 sigma^-0.5,
    0.376 sigma^-1.5, 0.460 sigma^-2.5.
    """
    return _with_exact_moments(*_gaussian(sigma_frames, order, truncate, torch.empty(0, dtype=torch.float64)), order)


def gap_aware_stencil(
    there: Tensor,
    segment: Tensor | None,
    sigma_frames: float,
    order: Order,
    *,
    truncate: float = TRUNCATE,
    min_share: float = 1.0,
) -> Tensor:
    """Return the kernel of `gaussian_derivative` at every frame, (..., N, 2 h + 1) float64, also beside missing frames.
    A neighbour is used if its mirror image is measured and both are in the segment; polynomials stay exact. `there`
    (..., N) marks measured frames; segment (..., N) is -1 outside any, None is one segment. NaN if less than
    `min_share` of the Gaussian's weight is measured. Raises SettingsError (an order other than 0, 1, 2, or a width that
    is not positive).
    """
    like = torch.empty(0, dtype=torch.float64, device=there.device)
    gauss, step = _gaussian(sigma_frames, order, truncate, like)
    kept = gauss * paired(there, segment, len(step) // 2)
    share = kept.sum(-1) / gauss.sum()
    # sums of equal terms may differ in their last digits, in float32 by 1e-6
    m0, m2, m4 = ((kept * step**power).sum(-1) for power in (0, 2, 4))
    determinant = (m0, m2, m0 * m4 - m2**2)[order]  # 0: the derivative is undetermined
    enough = (share >= min_share - 1e-5) & (determinant > 0)
    stencil = _with_exact_moments(torch.where(enough[..., None], kept, gauss), step, order)
    return torch.where(enough[..., None], stencil, torch.nan)


def _gaussian(sigma_frames: float, order: int, truncate: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Gaussian and its abscissae, frames, with at least one on either side, as a derivative needs."""
    if order not in (0, 1, 2):
        raise SettingsError(refusal("order", expected="0, 1 or 2", got=str(order), do="differentiate twice"))
    if not (sigma_frames > 0 and truncate > 0):
        got = f"sigma_frames {sigma_frames}, truncate {truncate}"
        raise SettingsError(refusal("Gaussian", expected="a positive width", got=got, do="raise it"))
    half = max(1, math.ceil(truncate * sigma_frames))
    step = torch.arange(-half, half + 1, dtype=like.dtype, device=like.device)
    return torch.exp(-0.5 * (step / sigma_frames) ** 2), step


def _with_exact_moments(gauss: Tensor, step: Tensor, order: int) -> Tensor:
    """Correct weights (..., 2 h + 1) to exact moments 0 .. order + 1, as a weighted Savitzky-Golay fit."""
    m0, m2, m4 = ((gauss * step**power).sum(-1, keepdim=True) for power in (0, 2, 4))
    return (gauss / m0, gauss * step / m2, gauss * 2 * (m0 * step**2 - m2) / (m0 * m4 - m2**2))[order]
