from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor

from sphereorient.cameras import Camera, ParameterCovariance
from sphereorient.cameras.checks import camera_error, check_points
from sphereorient.cameras.parameters import AnyCamera, with_parameters
from sphereorient.errors import CameraError, ShapeError, refusal

DAMPING = 1e-4  # at the start, relative to the information's diagonal
LEAST, MOST = 1e-12, 1e10  # of the damping; above the upper limit no step helps
FAR = 1e6  # residual of a point that a trial camera does not see
SIGMA_PX = 0.05  # least error of points: good centroids, corners of drawn boards (0.03 to 0.07)
UNDETERMINED = 1e-9  # smallest eigenvalue of the scaled information: less is zero in float64


def slopes_along(function: Callable[[Tensor], Tensor], at: Tensor, directions: Sequence[Tensor] | Tensor) -> Tensor:
    """Return derivatives along K directions (shape of `at`) of a function, (..., K) for a function that returns (...).
    Source: double vjp (Townsend 2017); one call of the function. Forward differentiation takes K and ten times as long.
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
    """Return the unknowns (K,) that minimise the sum of squared `residuals` (n,), or of soft L1 losses, linear beyond
    `soft`. NaN counts as FAR; a step whose residuals raise CameraError is rejected. `slopes`: (n, K). Ends after
    `steps`, or if the cost decreases by less than the share `gain`. scipy's least_squares needs three times as many
    slopes for a whole calibration.
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
    """Invert an information matrix; undetermined parameters get a huge variance or, with `names`, CameraError."""
    scale = _scale(information)
    values, vectors = torch.linalg.eigh(scale[:, None] * information * scale)
    if names and float(values[0]) < UNDETERMINED:
        part = vectors[:, 0].abs()
        loose = [name for name, share in zip(names, part.tolist(), strict=True) if share > 0.3 * float(part.max())]
        do = "add points at other depths, tilt the plate, or fix some of these parameters"
        raise camera_error("points", "a determined camera", f"no information on {', '.join(loose)}", do)
    whole: Tensor = scale[:, None] * ((vectors / values.clamp_min(1e-14)) @ vectors.mT) * scale
    return (whole + whole.mT) / 2


def fit_to_points(camera: AnyCamera, names: Sequence[str], x_lab_mm: Tensor, uv_px: Tensor) -> AnyCamera:
    """Fit the parameters `names` of any camera, also behind a port, to lab points (n, 3), mm, and pixels (n, 2).
    The start must be near. The covariance is from the residuals, at least 0.05 px. Raises CameraError (too few points,
    numbers that are not finite, or undetermined parameters, named), ShapeError (arrays of another shape).
    """
    x_lab_mm, uv_px = checked_points(x_lab_mm, uv_px)
    size, least = len(names), -(-len(names) // 2)
    if len(x_lab_mm) < least:
        expected, do = f"{least} or more for {size} parameters", "add points, or fix some parameters"
        raise camera_error("points", expected, f"{len(x_lab_mm)}", do)
    start = cast(AnyCamera, replace(cast(Any, camera), covariance=None))

    def expected_px(change: Tensor) -> Tensor:
        return with_parameters(start, names, change).project(x_lab_mm).reshape(-1)

    def slopes(change: Tensor) -> Tensor:
        return slopes_along(expected_px, change, torch.eye(size, dtype=torch.float64))

    zero = torch.zeros(size, dtype=torch.float64)
    change = least_squares(lambda change: expected_px(change).detach() - uv_px.reshape(-1), slopes, zero)
    slope, missed = torch.nan_to_num(slopes(change)), expected_px(change).detach() - uv_px.reshape(-1)
    spare = max(uv_px.numel() - size, 1)
    sigma_px = max(float(torch.nan_to_num(missed, nan=FAR).square().sum() / spare) ** 0.5, SIGMA_PX)
    matrix = sigma_px**2 * inverse_information(slope.mT @ slope, names)
    covariance = ParameterCovariance(names=tuple(names), matrix=matrix)
    return cast(AnyCamera, replace(cast(Any, with_parameters(start, names, change)), covariance=covariance))


def checked_points(x_lab_mm: Tensor, uv_px: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (n, 3) and pixels (n, 2) as float64 on the CPU; refuse other shapes and non-finite numbers."""
    for name, numbers, size in (("x_lab_mm", x_lab_mm, 3), ("uv_px", uv_px, 2)):
        check_points(name, numbers, size)
        if numbers.dim() != 2:
            got, do = str(tuple(numbers.shape)), "pass one row per point"
            raise ShapeError(refusal(name, expected=f"shape (n, {size})", got=got, do=do))
        bad = (~torch.isfinite(numbers)).any(-1).nonzero()[:, 0].tolist()
        if bad:
            raise camera_error(f"{name}, row {bad[0]}", "finite numbers", "others", "leave such points out")
    if len(x_lab_mm) != len(uv_px):
        got, do = f"{len(x_lab_mm)} points and {len(uv_px)} pixels", "pass one pixel per point"
        raise ShapeError(refusal("uv_px", expected="as many rows as x_lab_mm", got=got, do=do))
    return x_lab_mm.detach().double().cpu(), uv_px.detach().double().cpu()


def rms_px(camera: Camera, x_lab_mm: Tensor, uv_px: Tensor) -> float:
    """Return the rms distance, px, of the images of points from their pixels; NaN if a point has no image."""
    return float((camera.project(x_lab_mm).detach() - uv_px).square().sum(-1).mean().sqrt())


def _scale(information: Tensor) -> Tensor:
    known = information.diagonal()
    return torch.where(known > 0, known, torch.ones_like(known)).rsqrt()
