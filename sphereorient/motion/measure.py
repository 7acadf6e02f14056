from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sphereorient.errors import ShapeError, check_tail, refusal
from sphereorient.motion.angular_velocity import omega_from_orientations, omega_stencil, to_body, usable_separations
from sphereorient.motion.settings import MotionSettings
from sphereorient.motion.stencil import Order, apply, compose, gap_aware_stencil, propagated_sigma
from sphereorient.so3 import nearest_rotation

M_PER_MM = 1e-3
RATE_UNITS = {"velocity": "m_s", "acceleration": "m_s2"}
RATE_UNITS |= {"omega_lab": "rad_s", "omega_body": "rad_s", "alpha_lab": "rad_s2", "alpha_body": "rad_s2"}
POSES = {"position_smooth": "position_lab_mm", "position_smooth_cov": "position_cov_mm2"}
POSES |= {"orientation_smooth": "R_lab_body", "orientation_smooth_cov": "orientation_cov_rad2"}
FIELDS = {name: f"{name}_{unit}" for name, unit in RATE_UNITS.items()}
FIELDS |= {f"{name}_sigma": f"{name}_sigma_{unit}" for name, unit in RATE_UNITS.items()}  # of `Motion`, by dataset


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Smooth poses, velocities and accelerations of N frames, (..., N, 3), matrices (..., N, 3, 3), NaN where unknown.
    Sigmas and covariances of `measure_motion` are those from white noise, without the low-pass bias, axis by axis.
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
    """Return smooth poses, velocity to alpha_body, and the errors of all, under the names of a track and in its units.
    Lengths of positions in another unit than mm are those of velocities, too.
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
    # neighbouring omegas share orientations: their noise is not white, that of the orientations is
    usable = usable_separations(R_lab_body.isfinite().all((-1, -2)), separations, segment)
    turn = omega_stencil(usable, separations, fewest, omega.dtype)
    omega_sigma = propagated_sigma(turn, sigma_rad.to(omega)) / dt_s
    return (omega, omega_sigma), (alpha, propagated_sigma(compose(slope, turn), sigma_rad.to(omega)) / dt_s**2)


def _stencil(x: Tensor, segment: Tensor, sigma_frames: float, order: Order, settings: MotionSettings) -> Tensor:
    there = x.isfinite().all(-1)
    share, reach = settings.min_share, settings.truncate
    return gap_aware_stencil(there, segment, sigma_frames, order, truncate=reach, min_share=share).to(x.dtype)


def _by_axis(sigma: Tensor | None, like: Tensor) -> Tensor:
    """Return sigma (..., N, 3); one number a frame counts for all three axes, none is NaN."""
    if sigma is None:
        return torch.full_like(like, torch.nan)
    sigma = sigma.to(like)
    return (sigma if sigma.dim() == like.dim() else sigma[..., None]).expand_as(like)


def _to_body(R_lab_body: Tensor, x_lab: Tensor) -> Tensor:
    """Turn to body components where there is an orientation, NaN elsewhere."""
    there = (R_lab_body.isfinite().all((-1, -2)) & x_lab.isfinite().all(-1))[..., None]
    # numbers in place of NaN, whose gradient would be NaN
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
