from collections.abc import Sequence

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.motion.settings import check_separations
from sphereorient.motion.stencil import paired

FEWEST_POINTS = 3  # points that determine a rotation


def omega_from_orientations(
    R_lab_body: Tensor, dt_s: float, separations: Sequence[int], segment: Tensor | None = None, min_separations: int = 1
) -> tuple[Tensor, Tensor]:
    """Return omega_lab (..., N, 3), rad/s, averaged over symmetric separations, and its standard error (..., N, 3).
    A separation m gives log(R[k + m] R[k - m]^T) / (2 m dt), weight m^2, optimal for white attitude noise. It damps f
    cycles per frame by sin(2 pi f m) / (2 pi f m). 2 max(m) |omega| dt must stay well below pi (not checked). The error
    comes from the scatter of the separations; NaN with fewer than two.
    Raises ShapeError (R_lab_body does not end in (N, 3, 3)), SettingsError (no separation, one below 1, or twice).
    Source: the paper, section III, angular velocity from the increment T; docs/errata.md E4 and E6.

    Args:
        R_lab_body: (..., N, 3, 3), orientations; NaN where missing; orthogonality is not checked.
        dt_s: time between frames.
        separations: values of m, frames, from 1 up, each once.
        segment: (..., N) int, number of the segment, -1 outside any; None is one segment.
        min_separations: number of separations that a frame needs, else NaN.
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    if R_lab_body.dim() < 3:
        got = str(tuple(R_lab_body.shape))
        raise ShapeError(refusal("R_lab_body", expected="shape (..., N, 3, 3)", got=got, do="pass all frames at once"))
    check_separations(separations)
    there = R_lab_body.isfinite().all((-1, -2))
    usable, R = usable_separations(there, separations, segment), torch.where(there[..., None, None], R_lab_body, 0.0)
    # frames that wrap around an end are never used
    turns = torch.stack([R.roll(-m, -3) @ R.roll(m, -3).mT for m in separations], dim=-3)  # (..., N, S, 3, 3)
    return mean_over_separations(turns, usable, dt_s, separations, min_separations)


def to_body(R_lab_body: Tensor, x_lab: Tensor) -> Tensor:
    """Return the body components R^T x (..., 3) of vectors in lab components, in the unit of x.
    It also serves alpha: the derivative of R^T omega_lab is R^T alpha_lab, because omega x omega vanishes.
    Source: docs/errata.md E6.
    """
    check_tail("R_lab_body", R_lab_body, 3, 3)
    check_tail("x_lab", x_lab, 3)
    return (R_lab_body.mT @ x_lab[..., None])[..., 0]


def usable_separations(there: Tensor, separations: Sequence[int], segment: Tensor | None) -> Tensor:
    """Return for S separations whether both ends are in the frame's segment, (..., N, S) bool."""
    half = max(separations)
    return paired(there, segment, half)[..., half + torch.as_tensor(separations, device=there.device)]


def omega_stencil(usable: Tensor, separations: Sequence[int], min_separations: int, dtype: torch.dtype) -> Tensor:
    """Return the weights (..., N, 2 max(m) + 1), per frame, of orientation errors in omega; NaN where omega is."""
    m = torch.as_tensor(separations, device=usable.device)
    half, weight = max(separations), m.to(dtype) ** 2 * usable
    total = weight.sum(-1, keepdim=True)
    slope = weight / (2 * m * torch.where(total > 0, total, 1))
    stencil = usable.new_zeros(*usable.shape[:-1], 2 * half + 1, dtype=dtype)
    stencil[..., half + m], stencil[..., half - m] = slope, -slope
    return torch.where((usable.sum(-1) >= max(min_separations, 1))[..., None], stencil, torch.nan)


def mean_over_separations(
    turns: Tensor, usable: Tensor, dt_s: float, separations: Sequence[int], min_separations: int
) -> tuple[Tensor, Tensor]:
    """Return the weighted mean omega of S separations and its standard error, (..., N, 3), rad/s.
    `turns` (..., N, S, 3, 3) lead from frame k - m to k + m, lab; those not `usable` (..., N, S) are left out.
    """
    # a turn that is not used may be half a turn, where log has no gradient
    turns = torch.where(usable[..., None, None], turns, torch.eye(3, dtype=turns.dtype, device=turns.device))
    m = torch.as_tensor(separations, dtype=turns.dtype, device=turns.device)
    omega = so3.log(turns) / (2 * dt_s * m[:, None])  # (..., N, S, 3)
    weight = (m**2 * usable)[..., None]
    total, count = weight.sum(-2), usable.sum(-1)[..., None]
    safe_total = torch.where(total > 0, total, 1)
    mean = (weight * omega).sum(-2) / safe_total
    chi2 = (weight * (omega - mean[..., None, :]).square()).sum(-2)
    variance = chi2 / ((count - 1).clamp(min=1) * safe_total)
    enough = count >= max(min_separations, 1)
    scattered = enough & (count > 1) & (variance > 0)
    # the root's gradient at 0 is infinite: without any scatter the answer is 0 by itself
    alike = torch.where(enough & (count > 1), 0.0, torch.nan)
    error = torch.where(scattered, torch.where(scattered, variance, 1).sqrt(), alike)
    return torch.where(enough, mean, torch.nan), error


def kabsch(points_a: Tensor, points_b: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the rotation (..., 3, 3) from points_a (..., K, 3) onto points_b, any unit, by weighted least squares.
    Both sets are centred first. It is proper also for mirror images; points on one line leave it undetermined (not
    checked). Weights (..., K) are not negative; None: all equal.
    Source: W. Kabsch, Acta Cryst. A32, 922 (1976); the paper's R_kabsch, its increment T, docs/errata.md E8.
    """
    check_tail("points_a", points_a, 3)
    check_tail("points_b", points_b, *points_a.shape[-2:])
    w = torch.ones_like(points_a[..., 0]) if weights is None else weights
    w = (w / w.sum(-1, keepdim=True))[..., None]
    a = points_a - (w * points_a).sum(-2, keepdim=True)
    b = points_b - (w * points_b).sum(-2, keepdim=True)
    return so3.nearest_rotation((w * b).mT @ a)


def omega_from_markers(
    points_lab: Tensor, dt_s: float, separations: Sequence[int], segment: Tensor | None = None, min_separations: int = 1
) -> tuple[Tensor, Tensor]:
    """Return omega_lab and its standard error as `omega_from_orientations`, from markers seen in both frames of a pair.
    `points_lab` (..., N, K, 3), any unit, is NaN where a marker is not seen. The body components stay unknown.
    Source: the paper, section III, R_kabsch; docs/errata.md E8.
    """
    check_tail("points_lab", points_lab, 3)
    check_separations(separations)
    seen = points_lab.isfinite().all(-1)  # (..., N, K)
    points = torch.where(seen[..., None], points_lab, 0.0)
    usable = usable_separations(seen.sum(-1) >= FEWEST_POINTS, separations, segment)
    both = torch.stack([seen.roll(-m, -2) & seen.roll(m, -2) for m in separations], dim=-2)  # (..., N, S, K)
    common = both.sum(-1) >= FEWEST_POINTS
    # equal weights keep the mean defined where the turn is not used
    weights = torch.where(common[..., None], both, True).to(points.dtype)
    before, after = (torch.stack([points.roll(side * m, -3) for m in separations], -3) for side in (1, -1))
    return mean_over_separations(kabsch(before, after, weights), usable & common, dt_s, separations, min_separations)
