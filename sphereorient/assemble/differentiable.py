"""From fitted candidates to one differentiable soft track; docs/differentiable.md connects it to the cameras."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.trellis import soft_path
from sphereorient.errors import SettingsError, check_tail, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftTrack:
    """Mean poses of N frames over their candidates, NaN in frames without any; differentiable."""

    R_lab_body: Tensor  # (..., N, 3, 3)
    position_lab_mm: Tensor  # (..., N, 3)
    marginals: Tensor  # (..., N, C), probability of each candidate
    free_energy: Tensor  # (...), of the soft path


def soft_track(
    R_lab_body: Tensor,
    position_lab_mm: Tensor,
    misfit: Tensor,
    mask: Tensor,
    *,
    turn_rad: float,
    temperature: float = 1.0,
) -> SoftTrack:
    """Weigh candidates by their fit to the pictures and by the rotation from frame to frame; return their mean poses.

    Args:
        R_lab_body: (..., N, C, 3, 3), candidates; masked ones may hold anything.
        position_lab_mm: (..., N, C, 3), of the candidates.
        misfit: (..., N, C), cost of each, such as half the mean squared residual.
        mask: (..., N, C) bool, True for a candidate.
        turn_rad: standard deviation of the rotation between neighbouring frames; grows with the frames of a gap.
        temperature: of the soft path, in units of the costs.

    Raises:
        ShapeError: the inputs differ in frames or candidates.
        SettingsError: `turn_rad` or the temperature is not above 0.
    """
    check_tail("R_lab_body", R_lab_body, *mask.shape, 3, 3)
    check_tail("position_lab_mm", position_lab_mm, *mask.shape, 3)
    check_tail("misfit", misfit, *mask.shape)
    if not turn_rad > 0:
        raise SettingsError(refusal("turn_rad", expected="above 0", got=f"{turn_rad:g}", do="give a typical rotation"))
    unit = torch.eye(3, dtype=R_lab_body.dtype, device=R_lab_body.device)
    R = torch.where(mask[..., None, None], R_lab_body, unit)  # 0 times NaN would reach the gradients
    X = torch.where(mask[..., None], position_lab_mm, 0.0)
    soft = soft_path(turning_costs(R, mask, turn_rad), mask, temperature, torch.where(mask, misfit, 0.0))
    position = torch.where(mask.any(-1)[..., None], (soft.marginals[..., None] * X).sum(-2), torch.nan)
    return SoftTrack(
        R_lab_body=expected_orientation(R, soft.marginals),
        position_lab_mm=position,
        marginals=soft.marginals,
        free_energy=soft.free_energy,
    )


def turning_costs(R_lab_body: Tensor, mask: Tensor, turn_rad: float) -> Tensor:
    """Return the edges (..., N - 1, C, C) of `soft_track`: half the squared rotation, in units of `turn_rad`.
    R_lab_body (..., N, C, 3, 3) is finite everywhere; an edge starts at the last frame with candidates in the mask.
    """
    frame = torch.arange(mask.shape[-2], device=mask.device)
    last = torch.where(mask.any(-1), frame, 0).cummax(-1).values[..., :-1]  # of the frames up to each one
    R_before = R_lab_body.gather(-4, last[..., None, None, None].expand_as(R_lab_body[..., 1:, :, :, :]))
    turn = so3.geodesic_distance(R_before[..., :, None, :, :], R_lab_body[..., 1:, None, :, :, :])
    frames = (frame[1:] - last)[..., None, None]
    return 0.5 * (turn / (turn_rad * frames)).square()


def expected_orientation(R_lab_body: Tensor, marginals: Tensor) -> Tensor:
    """Return the rotation (..., N, 3, 3) with the least weighted mean squared chord to R_lab_body (..., N, C, 3, 3).
    NaN does not count; marginals (..., N, C) are not negative; NaN where all are 0. The gradient is always finite.
    Source: chordal mean, Hartley et al. 2013, Rotation averaging, 5.1; projected by `so3.nearest_rotation`.

    Raises:
        ShapeError: candidates and marginals differ in shape.
    """
    check_tail("R_lab_body", R_lab_body, *marginals.shape[-1:], 3, 3)
    known = torch.where(R_lab_body.isnan(), 0.0, R_lab_body)
    mean = so3.nearest_rotation((marginals[..., None, None].to(known) * known).sum(-3))
    return torch.where((marginals.sum(-1) > 0)[..., None, None], mean, torch.nan)
