"""Turns between two sets of points, and angular velocity from markers without an absolute orientation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import check_tail
from sphereorient.motion.angular_velocity import check_separations, mean_over_separations, usable_separations

FEWEST = 3  # points that determine a turn


def kabsch(points_a: Tensor, points_b: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the rotation (..., 3, 3) from the first set of points onto the second, best in least squares.

    Both sets are centred first. The result is a proper rotation also for points in a plane and for mirror images;
    points on one line leave the rotation about it undetermined (not checked).

    Args:
        points_a: (..., K, 3), any unit.
        points_b: (..., K, 3), same unit and frame, point by point.
        weights: (..., K), not negative; None weighs all alike.

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
    points_lab: Tensor,
    dt_s: float,
    separations: Sequence[int],
    *,
    segment: Tensor | None = None,
    min_separations: int = 1,
) -> tuple[Tensor, Tensor]:
    """Return the angular velocity from tracked markers, in lab components, as `omega_from_orientations`.

    The rotation between two frames is found from the markers seen in both. The body components stay unknown.

    Args:
        points_lab: (..., N, K, 3), markers in the lab, any unit; NaN where a marker is not seen.
        dt_s: time between frames.
        separations: values of m, frames, from 1 up, each once.
        segment: (..., N) int, number of the segment, -1 outside any; None is one segment.
        min_separations: number of separations that a frame needs, else NaN.

    Source: the paper, section III, R_kabsch; docs/errata.md E8.
    """
    check_tail("points_lab", points_lab, 3)
    check_separations(separations)
    seen = points_lab.isfinite().all(-1)  # (..., N, K)
    points = torch.where(seen[..., None], points_lab, 0.0)
    usable = usable_separations(seen.sum(-1) >= FEWEST, separations, segment)
    turns, enough = [], []
    for m in separations:
        both = seen.roll(-m, -2) & seen.roll(m, -2)
        common = both.sum(-1) >= FEWEST
        # equal weights keep the mean defined where the turn is not used
        weights = torch.where(common[..., None], both, True).to(points.dtype)
        turns.append(kabsch(points.roll(m, -3), points.roll(-m, -3), weights))
        enough.append(common)
    usable = usable & torch.stack(enough, dim=-1)
    unit = torch.eye(3, dtype=points.dtype, device=points.device)
    stacked = torch.where(usable[..., None, None], torch.stack(turns, dim=-3), unit)
    return mean_over_separations(stacked, usable, dt_s, separations, min_separations)
