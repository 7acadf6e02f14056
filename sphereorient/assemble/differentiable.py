"""From fitted candidates to one soft track: the last link of a chain from cameras, paint and light to a track's error.

The links: `cameras` (rays), `orient.soft_picture` (grey levels), `orient.implicit` (fit of each candidate),
`assemble.soft_path` (which candidate), here (what the track then is). docs/differentiable.md puts them together.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.soft_path import expected_orientation, soft_path
from sphereorient.errors import SettingsError, check_tail, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftTrack:
    """Poses of N frames, means over candidates by their probability; made by `soft_track`."""

    R_lab_body: Tensor  # (..., N, 3, 3), NaN in frames without candidates
    position_lab_mm: Tensor  # (..., N, 3), NaN in frames without candidates
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
    """Weigh candidates by how well they fit the pictures and how little they turn from frame to frame.

    Args:
        R_lab_body: (..., N, C, 3, 3), candidates; what stands at masked ones does not matter.
        position_lab_mm: (..., N, C, 3), theirs.
        misfit: (..., N, C), cost of each, such as half the mean squared residual.
        mask: (..., N, C) bool, True where there is a candidate.
        turn_rad: standard deviation of the turn from one frame to the next; over a gap it grows with the frames.
        temperature: of the soft path, in units of the costs; above 0.

    Returns:
        The track, differentiable in candidates and misfits.

    Raises:
        ShapeError: the parts are not of the same frames and candidates.
        SettingsError: `turn_rad` or the temperature is not above 0.
    """
    check_tail("R_lab_body", R_lab_body, *mask.shape, 3, 3)
    check_tail("position_lab_mm", position_lab_mm, *mask.shape, 3)
    check_tail("misfit", misfit, *mask.shape)
    if not turn_rad > 0:
        raise SettingsError(refusal("turn_rad", expected="above 0", got=f"{turn_rad:g}", do="give a typical turn"))
    view = torch.eye(3, dtype=R_lab_body.dtype, device=R_lab_body.device)
    R = torch.where(mask[..., None, None], R_lab_body, view)  # 0 times NaN would reach the gradients
    X = torch.where(mask[..., None], position_lab_mm, 0.0)
    edges = turning_costs(R, mask, turn_rad)
    soft = soft_path(edges, mask, temperature, torch.where(mask, misfit, 0.0))
    there = mask.any(-1)[..., None]
    return SoftTrack(
        R_lab_body=expected_orientation(R, soft.marginals),
        position_lab_mm=torch.where(there, (soft.marginals[..., None] * X).sum(-2), torch.nan),
        marginals=soft.marginals,
        free_energy=soft.free_energy,
    )


def turning_costs(R_lab_body: Tensor, mask: Tensor, turn_rad: float) -> Tensor:
    """Return what `soft_path` takes: half the squared turn from one candidate to the next, in units of `turn_rad`.

    Args:
        R_lab_body: (..., N, C, 3, 3), finite everywhere.
        mask: (..., N, C) bool; an edge into a frame comes from the last frame before it that has candidates.
        turn_rad: as `soft_track`.

    Returns:
        (..., N - 1, C, C), from row to column.
    """
    frame = torch.arange(mask.shape[-2], device=mask.device)
    last = torch.where(mask.any(-1), frame, 0).cummax(-1).values[..., :-1]  # of the frames up to each one
    R_before = R_lab_body.gather(-4, last[..., None, None, None].expand_as(R_lab_body[..., 1:, :, :, :]))
    turn = so3.geodesic_distance(R_before[..., :, None, :, :], R_lab_body[..., 1:, None, :, :, :])
    frames = (frame[1:] - last)[..., None, None]
    return 0.5 * (turn / (turn_rad * frames)).square()
