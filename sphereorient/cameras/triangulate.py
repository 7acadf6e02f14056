"""From two lines of sight to a point."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import check_points


def triangulate(rays_a: Rays, rays_b: Rays) -> tuple[Tensor, Tensor]:
    """Return the middle of the shortest segment between two rays, and its length.

    Args:
        rays_a: origin (..., 3) mm and unit direction (..., 3), lab.
        rays_b: the same of the other camera; broadcasts against `rays_a`.

    Returns:
        Points (..., 3), lab, mm, and gaps (...), mm, not negative. Both NaN, with gradient 0, for parallel rays.

    Raises:
        ShapeError: a last axis is not 3.

    Source: the common perpendicular of two skew lines (textbook).
    """
    for name, rays in (("rays_a", rays_a), ("rays_b", rays_b)):
        check_points(f"{name}.origin_lab_mm", rays.origin_lab_mm, 3)
        check_points(f"{name}.direction_lab", rays.direction_lab, 3)
    a, b = rays_a.direction_lab, rays_b.direction_lab
    baseline = rays_b.origin_lab_mm - rays_a.origin_lab_mm
    normal = _cross(a, b)  # its length is the sine of the angle: no cancellation at small angles
    sine2 = normal.square().sum(-1, keepdim=True)
    crossing = sine2 > (16 * torch.finfo(sine2.dtype).eps) ** 2  # below it the sine is rounding only
    sine2 = torch.where(crossing, sine2, torch.ones_like(sine2))
    along_a = (_cross(baseline, b) * normal).sum(-1, keepdim=True) / sine2
    along_b = (_cross(baseline, a) * normal).sum(-1, keepdim=True) / sine2
    point = 0.5 * (rays_a.origin_lab_mm + along_a * a + rays_b.origin_lab_mm + along_b * b)
    gap = ((baseline * normal).sum(-1, keepdim=True) / sine2.sqrt()).abs()
    nan = torch.full_like(gap, torch.nan)
    return torch.where(crossing, point, nan), torch.where(crossing, gap, nan)[..., 0]


def _cross(a: Tensor, b: Tensor) -> Tensor:
    product: Tensor = torch.linalg.cross(*torch.broadcast_tensors(a, b))  # type: ignore[no-untyped-call]
    return product
