"""Derivatives, damped least squares and covariances of the calibration fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sphereorient.errors import CameraError, refusal

DAMPING = 1e-4  # at the start, relative to the information's diagonal
LEAST, MOST = 1e-12, 1e10  # of the damping; beyond the upper one no step helps
FAR = 1e6  # residual of a point that a trial camera does not see
UNDETERMINED = 1e-9  # smallest eigenvalue of the scaled information: float64 cannot tell less from zero


def slopes_along(function: Callable[[Tensor], Tensor], at: Tensor, directions: Sequence[Tensor] | Tensor) -> Tensor:
    """Return the derivatives of a function at a point along K directions, (..., K) where the function returns (...).

    The backward pass is linear in the weights of the outputs; its derivative by them is the slope. The function is
    called once for all directions; forward differentiation calls it for each and takes ten times as long.

    The directions have the shape of `at`.

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


def least_squares(
    residuals: Callable[[Tensor], Tensor],
    slopes: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    soft: float = torch.inf,
    gain: float = 1e-14,
    steps: int = 100,
) -> Tensor:
    """Return the unknowns (K,) that minimise the sum of squared residuals, or of their soft L1 losses.

    Normal equations: scipy's least_squares decomposes the whole Jacobian at each step, and its trust region starts at
    one sigma; it takes three times as many slopes of a whole calibration.

    Args:
        residuals: of unknowns (K,), (n,); NaN counts as FAR. A step whose residuals raise CameraError is rejected.
        slopes: of unknowns, (n, K).
        start: (K,).
        soft: residual beyond which the loss grows linearly.
        gain: relative decrease of the cost at which the iteration ends.
        steps: maximum number.

    Source: Marquardt 1963; weights of the soft L1 loss, Triggs et al. 2000 (appendix).
    """

    def tried(at: Tensor) -> tuple[Tensor, float]:
        try:
            missed = torch.nan_to_num(residuals(at), nan=FAR)
        except CameraError:
            return at, torch.inf
        share = (missed / soft).square()
        return missed, float((missed.square() / (1 + (1 + share).sqrt())).sum())

    at, damping = start, DAMPING
    missed, cost = tried(start)
    for _ in range(steps):
        slope = torch.nan_to_num(slopes(at))
        weight = (1 + (missed / soft).square()).rsqrt()
        information = slope.mT @ (weight[:, None] * slope)
        pull = slope.mT @ (weight * missed)
        scale = _scale(information)
        scaled = scale[:, None] * information * scale
        before = cost
        while damping < MOST:
            damped = scaled + damping * torch.eye(len(at), dtype=at.dtype)
            trial = at - scale * torch.linalg.solve(damped, scale * pull)
            missed_there, cost_there = tried(trial)
            if cost_there <= cost:
                at, missed, cost = trial, missed_there, cost_there
                damping = max(damping / 10, LEAST)
                break
            damping *= 10
        if before - cost <= gain * before:
            break
    return at


def inverse_information(information: Tensor, names: Sequence[str] = ()) -> Tensor:
    """Invert an information matrix of parameters in different units.

    A direction without information gets a huge variance; with `names` it is refused instead.

    Raises:
        CameraError: an undetermined direction; its parameters are named.
    """
    scale = _scale(information)
    values, vectors = torch.linalg.eigh(scale[:, None] * information * scale)
    if names and float(values[0]) < UNDETERMINED:
        part = vectors[:, 0].abs()
        loose = [name for name, share in zip(names, part.tolist(), strict=True) if share > 0.3 * float(part.max())]
        do = "add points at other depths, tilt the plate, or hold some of these parameters"
        got = f"no information on {', '.join(loose)}"
        raise CameraError(refusal("points", expected="a determined camera", got=got, do=do))
    inverse: Tensor = (vectors / values.clamp_min(1e-14)) @ vectors.mT
    whole: Tensor = scale[:, None] * inverse * scale
    return (whole + whole.mT) / 2


def _scale(information: Tensor) -> Tensor:
    known = information.diagonal()
    return torch.where(known > 0, known, torch.ones_like(known)).rsqrt()
