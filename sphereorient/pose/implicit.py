"""A converged fit of poses with its derivatives, by the implicit function theorem (docs/differentiable.md).
At the minimum of sum r(pose, theta)^2 / 2 the gradient g is 0, so that d pose / d theta = -H^-1 dg/dtheta with H =
dg/dpose. `implicit_pose` fits without a graph and then takes one Newton step -H^-1 g with H constant. The fit of
`track` does not serve: it keeps weights, light and slopes fixed, in single precision.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SettingsError, ShapeError, check_tail, refusal

_Residual = Callable[[Tensor, Tensor], Tensor]  # R_lab_body (B, 3, 3), position_lab_mm (B, 3) -> (B, M)

START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9  # of Levenberg and Marquardt, relative to the diagonal
EASE, STIFFEN = 0.2, 5.0  # factors after a good and after a bad step
FLAT = 1e-6  # 1/rad^2 and 1/mm^2: a direction with less (sigma above 1000 rad or 1 m) is undetermined
ARRIVED_RAD, ARRIVED_MM = 1e-3, 1e-2  # largest Newton step of a converged fit


@dataclass(frozen=True, kw_only=True, eq=False)
class ImplicitPose:
    """B fitted poses, differentiable in all that the residuals depend on."""

    R_lab_body: Tensor  # (B, 3, 3), NaN in frames not used
    position_lab_mm: Tensor  # (B, 3), NaN in frames not used
    cost: Tensor  # (B,), half the sum of squared residuals at these poses, differentiable too; 0 in frames not used
    arrived: Tensor  # (B,) bool, converged; other poses are where the fit ended, with gradient 0


def implicit_pose(
    residual: _Residual,
    R_start_lab_body: Tensor,
    start_lab_mm: Tensor,
    *,
    use: Tensor | None = None,
    iterations: int = 30,
) -> ImplicitPose:
    """Fit poses by least squares and return them with gradients to all tensors in the residuals.
    An undetermined direction stays at the start, with gradient 0.
    Source: implicit function theorem; the Newton-step form, Look and others 2020 (Differentiable implicit layers).

    Args:
        residual: (B, 3, 3) and (B, 3) to (B, M), row b of pose b alone, in standard deviations, 0 where not
            counted; twice differentiable in the pose by torch.func (`expected_grey` is), once in the rest.
        R_start_lab_body: (B, 3, 3), start.
        start_lab_mm: (B, 3), start.
        use: (B,) bool, frames to fit; the others, of finite residual derivatives, are NaN with gradient 0.
        iterations: Levenberg-Marquardt steps, the same for all. The graph does not grow with them.

    Raises:
        ShapeError: starts, `use` and residuals differ in shape.
        SettingsError: no iterations.
    """
    use = _checked(R_start_lab_body, start_lab_mm, use, iterations)
    known = use & R_start_lab_body.isfinite().all(-1).all(-1) & start_lab_mm.isfinite().all(-1)
    # Unused frames get a finite pose: 0 times NaN would reach the gradients.
    place = torch.where(known[:, None], start_lab_mm, 0.0).sum(0) / known.sum().clamp_min(1)
    view = torch.eye(3, dtype=R_start_lab_body.dtype, device=R_start_lab_body.device)
    R = torch.where(known[:, None, None], R_start_lab_body, view).detach()
    X = torch.where(known[:, None], start_lab_mm, place).detach()

    def counted(R_lab_body: Tensor, position_lab_mm: Tensor) -> Tensor:
        r = residual(R_lab_body, position_lab_mm)
        if r.shape[:-1] != known.shape:
            got, do = str(tuple(r.shape)), "return one row a pose"
            raise ShapeError(refusal("residual", expected=f"shape ({len(known)}, M)", got=got, do=do))
        return torch.where(known[:, None], r, 0.0)

    with torch.no_grad():
        R, X = _levenberg_marquardt(counted, R, X, iterations)
    step = _newton_step(lambda delta: counted(*moved_by(R, X, delta)), torch.zeros_like(X).repeat(1, 2))
    arrived = known & (step[:, :3].norm(dim=-1) < ARRIVED_RAD) & (step[:, 3:].norm(dim=-1) < ARRIVED_MM)
    step = torch.where(arrived[:, None], step, 0.0)
    R_fitted, X_fitted = so3.exp(step[:, :3]) @ R, X + step[:, 3:]
    cost = 0.5 * counted(R_fitted, X_fitted).square().sum(-1)
    return ImplicitPose(
        R_lab_body=torch.where(known[:, None, None], R_fitted, torch.nan),
        position_lab_mm=torch.where(known[:, None], X_fitted, torch.nan),
        cost=cost,
        arrived=arrived.detach(),
    )


def _newton_step(residuals: Callable[[Tensor], Tensor], still: Tensor) -> Tensor:
    """Return the Newton step (B, 6) from `still`, no change, to the minimum; the Hessian has no gradient."""
    slope = torch.func.grad(lambda delta: 0.5 * residuals(delta).square().sum())
    gradient = slope(still)
    with torch.no_grad():  # the Hessian (B, 6, 6): J^T J is biased
        columns = torch.func.vmap(lambda axis: torch.func.jvp(slope, (still,), (axis,))[1])(_axes(still))
        curvature = columns.movedim(0, -1)
        rounding = 10 * torch.finfo(curvature.dtype).eps
        # Undetermined directions get no step.
        inverse = torch.linalg.pinv(0.5 * (curvature + curvature.mT), atol=FLAT, rtol=rounding, hermitian=True)
    step: Tensor = -(inverse @ gradient[..., None])[..., 0]
    return step


def _levenberg_marquardt(residual: _Residual, R: Tensor, X: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    """Return the poses (B, 3, 3), (B, 3) with the least sum of squares (Marquardt 1963); no step increases it."""
    damping = torch.full_like(X[:, 0], START_DAMPING)
    still = torch.zeros_like(X).repeat(1, 2)
    for _ in range(iterations):
        r, slopes = _linearised(lambda delta, R=R, X=X: residual(*moved_by(R, X, delta)), still)  # type: ignore[misc]
        normal, pull = slopes @ slopes.mT, (slopes @ r[..., None])[..., 0]
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        floor = damping[:, None] * diagonal + FLAT  # a flat direction gets no step
        step: Tensor = torch.linalg.solve_ex(normal + torch.diag_embed(floor), -pull[..., None]).result[..., 0]
        R_next, X_next = moved_by(R, X, step)
        # Near the minimum, sums of squares differ only by rounding.
        slack = 1.0 + 8.0 * torch.finfo(X.dtype).eps
        better = residual(R_next, X_next).square().sum(-1) <= r.square().sum(-1) * slack
        R, X = torch.where(better[:, None, None], R_next, R), torch.where(better[:, None], X_next, X)
        damping = (damping * torch.where(better, EASE, STIFFEN)).clamp(LEAST_DAMPING, MOST_DAMPING)
    return so3.nearest_rotation(R), X


def moved_by(R_lab_body: Tensor, position_lab_mm: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Apply errors (B, 6), rad and mm, lab, to poses from the left; Cayley's rotation is smooth at 0."""
    half = so3.hat(0.5 * delta[..., :3])
    scale = 2.0 / (1.0 + 0.25 * delta[..., :3].square().sum(-1))
    turned = R_lab_body + scale[..., None, None] * ((half + half @ half) @ R_lab_body)
    return turned, position_lab_mm + delta[..., 3:]


def _linearised(residuals: Callable[[Tensor], Tensor], delta: Tensor) -> tuple[Tensor, Tensor]:
    """Return the residuals (B, M) and their slopes (B, 6, M); row b depends on delta b alone: six jvps suffice."""
    along = torch.func.vmap(lambda axis: torch.func.jvp(residuals, (delta,), (axis,))[:2])
    values, slopes = along(_axes(delta))
    return values[0], slopes.movedim(0, 1)


def _axes(delta: Tensor) -> Tensor:
    return torch.eye(6, dtype=delta.dtype, device=delta.device)[:, None].expand(6, *delta.shape)


def _checked(R: Tensor, X: Tensor, use: Tensor | None, iterations: int) -> Tensor:
    check_tail("start_lab_mm", X, 3)
    if X.ndim != 2:
        got, do = str(tuple(X.shape)), "put all poses into one batch"
        raise ShapeError(refusal("start_lab_mm", expected="shape (B, 3)", got=got, do=do))
    check_tail("R_start_lab_body", R, len(X), 3, 3)
    if iterations < 1:
        raise SettingsError(refusal("iterations", expected="at least 1", got=str(iterations), do="take 30"))
    if use is None:
        return torch.ones(len(X), dtype=torch.bool, device=X.device)
    check_tail("use", use, len(X))
    return use
