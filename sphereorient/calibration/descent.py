"""Robust least squares by Levenberg's and Marquardt's steps.

scipy's least_squares begins with a trust region of one sigma and doubles it: from a guess it takes 25 slopes of a whole
calibration, these steps take 6 to 8.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sphereorient.errors import CameraError

DAMPING = 1e-4  # at the start, of the information's diagonal
LEAST, MOST = 1e-12, 1e10  # of the damping; beyond the upper one no step helps
FAR = 1e6  # residual of what a trial does not show at all


def robust_least_squares(
    residuals: Callable[[Tensor], Tensor],
    slopes: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    soft: float,
    gain: float,
    steps: int,
) -> Tensor:
    """Return the unknowns (K,) at which the sum of soft L1 losses of residuals is least.

    Args:
        residuals: of unknowns (K,), (n,) in sigmas; NaN where nothing is to be seen counts as far off. A CameraError
            says that these unknowns make no camera: such a step is not taken.
        slopes: of unknowns, (n, K).
        start: (K,).
        soft: residual beyond which the loss grows linearly.
        gain: relative decrease of the cost at which it is done.
        steps: at most.

    Source: Marquardt 1963; weights of the soft L1 loss, Triggs et al. 2000 (appendix).
    """
    at, missed = start, _tried(residuals, start)
    cost, damping = _cost(missed, soft), DAMPING
    for _ in range(steps):
        slope = torch.nan_to_num(slopes(at))
        weight = (1 + (missed / soft).square()).rsqrt()
        information = slope.mT @ (weight[:, None] * slope)
        pull = slope.mT @ (weight * missed)
        diagonal = information.diagonal()
        diagonal = torch.where(diagonal > 0, diagonal, torch.ones_like(diagonal))  # what nothing depends on stays
        scale = diagonal.rsqrt()
        scaled = scale[:, None] * information * scale
        before = cost
        while damping < MOST:
            damped = scaled + damping * torch.eye(len(at), dtype=at.dtype)
            trial = at - scale * torch.linalg.solve(damped, scale * pull)
            missed_there = _tried(residuals, trial)
            if _cost(missed_there, soft) <= cost:
                at, missed, cost = trial, missed_there, _cost(missed_there, soft)
                damping = max(damping / 10, LEAST)
                break
            damping *= 10
        if before - cost <= gain * before:
            break
    return at


def _tried(residuals: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    try:
        return torch.nan_to_num(residuals(at), nan=FAR)
    except CameraError:
        return at.new_full((1,), torch.inf)


def _cost(missed: Tensor, soft: float) -> float:
    return float(soft**2 * ((1 + (missed / soft).square()).sqrt() - 1).sum())
