import math
from typing import Literal

import torch
from torch import Tensor

from sphereorient.errors import SettingsError, refusal
from sphereorient.motion.stencil import paired, windows

Order = Literal[0, 1, 2]
TRUNCATE = 3.0  # holds 99.7 % of the Gaussian


def gaussian_derivative(
    x: Tensor, dt_s: float, sigma_frames: float, order: Order, truncate: float = TRUNCATE
) -> Tensor:
    """Return the derivative (..., N, D) of x (..., N, D), in its unit / s^order, by a Gaussian kernel; order 0 smooths.
    NaN where the window (`truncate` sigmas on each side) reaches a missing value or an end. Exact for polynomials up to
    degree order + 1. A sine of f cycles per frame is damped by about exp(-(2 pi f sigma)^2 / 2).
    Source: the paper, section III, differentiation of trajectories with a Gaussian kernel.

    Raises:
        SettingsError: an order other than 0, 1, 2, or a width that is not positive.
    """
    kernel = _full_kernel(sigma_frames, order, truncate, x)
    near = windows(x.mT, kernel.shape[-1] // 2)
    return (near * kernel).sum(-1).mT / dt_s**order


def noise_gain(sigma_frames: float, order: Order, truncate: float = TRUNCATE) -> float:
    """Return the standard deviation of white noise of standard deviation 1 after `gaussian_derivative` with dt_s = 1.
    For sigma above 1.5 frames, orders 0, 1, 2: 0.531 sigma^-0.5, 0.376 sigma^-1.5, 0.460 sigma^-2.5.
    """
    return float(_full_kernel(sigma_frames, order, truncate, torch.empty(0, dtype=torch.float64)).norm())


def gap_aware_stencil(
    there: Tensor,
    segment: Tensor | None,
    sigma_frames: float,
    order: Order,
    *,
    truncate: float = TRUNCATE,
    min_share: float = 1.0,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Return the kernel of `gaussian_derivative` for every frame, (..., N, 2 h + 1), corrected for missing frames.
    A neighbour is used where its mirror image is measured and both are in the segment; polynomials stay exact. `there`
    (..., N) marks measured frames; segment (..., N) is -1 outside any, None is one segment. NaN where less than
    `min_share` of the Gaussian's weight is measured.

    Raises:
        SettingsError: an order other than 0, 1, 2, or a width that is not positive.
    """
    half = _half_width(sigma_frames, order, truncate)
    like = torch.empty(0, dtype=dtype, device=there.device)
    gauss, step = _gaussian(sigma_frames, half, like)
    kept = gauss * paired(there, segment, half)
    share = kept.sum(-1) / gauss.sum()
    # sums of equal terms may differ in their last digits, in float32 by 1e-6
    enough = (share >= min_share - 1e-5) & (_determinant(kept, step, order) > 0)
    stencil = _with_exact_moments(torch.where(enough[..., None], kept, gauss), step, order)
    return torch.where(enough[..., None], stencil, torch.nan)


def _half_width(sigma_frames: float, order: int, truncate: float) -> int:
    """Return the half width of the window; at least 1, which a derivative needs."""
    if order not in (0, 1, 2):
        raise SettingsError(refusal("order", expected="0, 1 or 2", got=str(order), do="differentiate twice"))
    if not (sigma_frames > 0 and truncate > 0):
        got = f"sigma_frames {sigma_frames}, truncate {truncate}"
        raise SettingsError(refusal("Gaussian", expected="a positive width", got=got, do="raise it"))
    return max(1, math.ceil(truncate * sigma_frames))


def _gaussian(sigma_frames: float, half: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Gaussian and its abscissae in units of sigma."""
    step = torch.arange(-half, half + 1, dtype=like.dtype, device=like.device)
    return torch.exp(-0.5 * (step / sigma_frames) ** 2), step


def _full_kernel(sigma_frames: float, order: Order, truncate: float, like: Tensor) -> Tensor:
    gauss, step = _gaussian(sigma_frames, _half_width(sigma_frames, order, truncate), like)
    return _with_exact_moments(gauss, step, order)


def _determinant(gauss: Tensor, step: Tensor, order: int) -> Tensor:
    """Return a number (...) that is zero where the remaining weights do not determine the derivative."""
    m0, m2, m4 = ((gauss * step**power).sum(-1) for power in (0, 2, 4))
    return (m0, m2, m0 * m4 - m2**2)[order]


def _with_exact_moments(gauss: Tensor, step: Tensor, order: int) -> Tensor:
    """Correct weights (..., 2 h + 1) to exact moments 0 .. order + 1, as a weighted Savitzky-Golay fit."""
    m0, m2, m4 = ((gauss * step**power).sum(-1, keepdim=True) for power in (0, 2, 4))
    if order == 0:
        return gauss / m0
    if order == 1:
        return gauss * step / m2
    return gauss * 2 * (m0 * step**2 - m2) / (m0 * m4 - m2**2)
