from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.motion.settings import MotionSettings, check_separations
from sphereorient.motion.stencil import Order, apply, compose, gap_aware_stencil, paired, propagated_sigma
from sphereorient.so3 import nearest_rotation

FEWEST_POINTS = 3  # points that determine a rotation
M_PER_MM = 1e-3
RATE_UNITS = {"velocity": "m_s", "acceleration": "m_s2"}
RATE_UNITS |= {"omega_lab": "rad_s", "omega_body": "rad_s", "alpha_lab": "rad_s2", "alpha_body": "rad_s2"}
POSES = {"position_smooth": "position_lab_mm", "position_smooth_cov": "position_cov_mm2"}
POSES |= {"orientation_smooth": "R_lab_body", "orientation_smooth_cov": "orientation_cov_rad2"}
FIELDS = {name: f"{name}_{unit}" for name, unit in RATE_UNITS.items()}
FIELDS |= {f"{name}_sigma": f"{name}_sigma_{unit}" for name, unit in RATE_UNITS.items()}  # of `Motion`, by dataset


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
    # frames that wrap around an end are not used
    turns = torch.stack([R.roll(-m, -3) @ R.roll(m, -3).mT for m in separations], dim=-3)  # (..., N, S, 3, 3)
    return mean_over_separations(turns, usable, dt_s, separations, min_separations)


def to_body(R_lab_body: Tensor, x_lab: Tensor) -> Tensor:
    """Return the body components R^T x (..., 3) of vectors in lab components, in the unit of x.
    Also for alpha: the derivative of R^T omega_lab is R^T alpha_lab, because omega x omega is 0.
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
    """Return the weights (..., N, 2 max(m) + 1), per frame, of orientation errors in omega; NaN where omega is NaN."""
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
    # an unused rotation may be by 180 degrees, where log has no gradient
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
    # the root's gradient at 0 is infinite; without scatter the result is 0
    alike = torch.where(enough & (count > 1), 0.0, torch.nan)
    error = torch.where(scattered, torch.where(scattered, variance, 1).sqrt(), alike)
    return torch.where(enough, mean, torch.nan), error


def kabsch(points_a: Tensor, points_b: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the rotation (..., 3, 3) from points_a (..., K, 3) onto points_b, any unit, by weighted least squares.
    Both sets are centred first. It is proper also for mirror images; collinear points leave it undetermined (not
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
    # equal weights keep the mean defined for unused rotations
    weights = torch.where(common[..., None], both, True).to(points.dtype)
    before, after = (torch.stack([points.roll(side * m, -3) for m in separations], -3) for side in (1, -1))
    return mean_over_separations(kabsch(before, after, weights), usable & common, dt_s, separations, min_separations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Smooth poses, velocities and accelerations of N frames, (..., N, 3), matrices (..., N, 3, 3), NaN if unknown.
    Sigmas and covariances of `measure_motion` are from white noise, without the low-pass bias, axis by axis.
    """

    position_lab_mm: Tensor
    position_cov_mm2: Tensor
    R_lab_body: Tensor
    orientation_cov_rad2: Tensor  # of delta in R_true = exp([delta]x) R_lab_body, lab components
    velocity_m_s: Tensor
    velocity_sigma_m_s: Tensor
    acceleration_m_s2: Tensor
    acceleration_sigma_m_s2: Tensor
    omega_lab_rad_s: Tensor
    omega_lab_sigma_rad_s: Tensor
    omega_body_rad_s: Tensor
    omega_body_sigma_rad_s: Tensor
    alpha_lab_rad_s2: Tensor
    alpha_lab_sigma_rad_s2: Tensor
    alpha_body_rad_s2: Tensor
    alpha_body_sigma_rad_s2: Tensor


def datasets_of(found: Motion, length_unit: str = "mm") -> dict[str, Any]:
    """Return smooth poses, velocity to alpha_body, and the errors of all, under the names and in the units of a track.
    Positions and velocities are in `length_unit`.
    """
    parts = {name: getattr(found, own).numpy() for name, own in (POSES | FIELDS).items()}
    rates = ("velocity", "acceleration") if length_unit != "mm" else ()
    return {name: part / M_PER_MM if name.startswith(rates) else part for name, part in parts.items()}


def measure_motion(
    position_mm: Tensor,
    R_lab_body: Tensor,
    segment: Tensor,
    frame_rate_hz: float,
    settings: MotionSettings,
    sigmas: tuple[Tensor | None, Tensor | None] = (None, None),
) -> Motion:
    """Return smooth pose, velocity, acceleration, omega, alpha of all frames whose neighbours determine them, else NaN.
    Positions are smoothed with the Gaussian of velocity, orientations with that of alpha, by the chordal mean on SO(3).
    Nothing crosses the ends of a segment; single lost frames are bridged. Body components need the frame's orientation.
    Raises ShapeError (wrong last axes, or unequal numbers of frames).
    Source: the paper, section III; docs/errata.md E4 and E6; the mean: Moakher 2002, SIAM J. Matrix Anal. 24, 1.

    Args:
        position_mm: (..., N, 3), lab; NaN where missing.
        R_lab_body: (..., N, 3, 3), orientations; NaN where missing.
        segment: (..., N) int, number of the segment, -1 outside any.
        frame_rate_hz: constant.
        settings: widths and limits.
        sigmas: of the position's coordinates, mm, and of delta in R_true = exp([delta]x) R, rad, (..., N) or
            (..., N, 3) each; None or NaN: unknown.
    """
    check_tail("position_mm", position_mm, 3)
    check_tail("R_lab_body", R_lab_body, 3, 3)
    if not position_mm.shape[:-1] == R_lab_body.shape[:-2] == segment.shape or segment.dim() == 0:
        shapes = ", ".join(str(tuple(x.shape)) for x in (position_mm, R_lab_body, segment))
        do = "give all three the same frames"
        raise ShapeError(refusal("motion", expected="(..., N, 3), (..., N, 3, 3), (..., N)", got=shapes, do=do))
    dt_s = 1.0 / frame_rate_hz
    found: dict[str, Tensor] = {}
    R, eye = R_lab_body.flatten(-2), torch.eye(3, dtype=position_mm.dtype, device=position_mm.device)
    position_sigma, orientation_sigma = (_by_axis(sigma, position_mm) for sigma in sigmas)
    for name, covariance, width, x, sigma in (
        ("position_lab_mm", "position_cov_mm2", settings.velocity_sigma_frames, position_mm, position_sigma),
        ("R_lab_body", "orientation_cov_rad2", settings.alpha_sigma_frames, R, orientation_sigma),
    ):
        stencil = _stencil(x, segment, width, 0, settings)
        found[name], found[covariance] = apply(stencil, x), propagated_sigma(stencil, sigma).square()[..., None] * eye
    found["R_lab_body"] = nearest_rotation(found["R_lab_body"].reshape(R_lab_body.shape))
    moves: tuple[tuple[str, str, float, Order], ...] = (
        ("velocity", "m_s", settings.velocity_sigma_frames, 1),
        ("acceleration", "m_s2", settings.acceleration_sigma_frames, 2),
    )
    for name, unit, width, order in moves:
        stencil, scale = _stencil(position_mm, segment, width, order, settings), M_PER_MM / dt_s**order
        sigma = propagated_sigma(stencil, position_sigma)
        found[f"{name}_{unit}"], found[f"{name}_sigma_{unit}"] = apply(stencil, position_mm) * scale, sigma * scale
    omega, alpha = _rotation(R_lab_body, orientation_sigma, segment, dt_s, settings)
    for name, unit, (x, sigma) in (("omega", "rad_s", omega), ("alpha", "rad_s2", alpha)):
        found[f"{name}_lab_{unit}"], found[f"{name}_lab_sigma_{unit}"] = x, sigma
        found[f"{name}_body_{unit}"] = _to_body(R_lab_body, x)
        found[f"{name}_body_sigma_{unit}"] = _sigma_in_body(R_lab_body, x, sigma, orientation_sigma)
    return Motion(**found)


def _rotation(
    R_lab_body: Tensor, sigma_rad: Tensor, segment: Tensor, dt_s: float, settings: MotionSettings
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return omega_lab and its sigma, alpha_lab and its sigma."""
    separations, fewest = settings.separations, settings.min_separations
    omega, _ = omega_from_orientations(R_lab_body, dt_s, separations, segment=segment, min_separations=fewest)
    slope = _stencil(omega, segment, settings.alpha_sigma_frames, 1, settings)
    alpha = apply(slope, omega) / dt_s
    # omegas of neighbours have orientations in common: the orientations' noise is white, theirs is not
    usable = usable_separations(R_lab_body.isfinite().all((-1, -2)), separations, segment)
    turn = omega_stencil(usable, separations, fewest, omega.dtype)
    omega_sigma = propagated_sigma(turn, sigma_rad.to(omega)) / dt_s
    return (omega, omega_sigma), (alpha, propagated_sigma(compose(slope, turn), sigma_rad.to(omega)) / dt_s**2)


def _stencil(x: Tensor, segment: Tensor, sigma_frames: float, order: Order, settings: MotionSettings) -> Tensor:
    there = x.isfinite().all(-1)
    share, reach = settings.min_share, settings.truncate
    return gap_aware_stencil(there, segment, sigma_frames, order, truncate=reach, min_share=share).to(x.dtype)


def _by_axis(sigma: Tensor | None, like: Tensor) -> Tensor:
    """Return sigma (..., N, 3); one number per frame is for all three axes; None gives NaN."""
    if sigma is None:
        return torch.full_like(like, torch.nan)
    sigma = sigma.to(like)
    return (sigma if sigma.dim() == like.dim() else sigma[..., None]).expand_as(like)


def _to_body(R_lab_body: Tensor, x_lab: Tensor) -> Tensor:
    """Rotate to body components if there is an orientation, else NaN."""
    there = (R_lab_body.isfinite().all((-1, -2)) & x_lab.isfinite().all(-1))[..., None]
    # replace NaN, whose gradient is NaN
    R, x = torch.where(there[..., None], R_lab_body, 0.0), torch.where(there, x_lab, 0.0)
    return torch.where(there, to_body(R, x), torch.nan)


def _sigma_in_body(R_lab_body: Tensor, x_lab: Tensor, x_sigma: Tensor, sigma_rad: Tensor) -> Tensor:
    """Return the sigmas of R^T x by axis; an orientation error delta adds delta x x, independent of that of x."""
    from_x = _to_body(R_lab_body.square(), x_sigma.square())
    unit = torch.eye(3, dtype=x_lab.dtype, device=x_lab.device).expand(*x_lab.shape, 3)
    turned = torch.linalg.cross(unit, x_lab[..., None, :])  # (..., 3, 3), row j: delta along axis j crossed with x
    lever = torch.stack([_to_body(R_lab_body, turned[..., j, :]) for j in range(3)], dim=-1)  # (..., 3 body, 3 lab)
    from_R = (lever.square() * sigma_rad.to(x_lab)[..., None, :].square()).sum(-1)
    return (from_x + from_R).sqrt()
