import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import check_points


def triangulate(rays_a: Rays, rays_b: Rays) -> tuple[Tensor, Tensor]:
    """Return the middle (..., 3), lab, mm, of the shortest segment between two rays, and its length (...), mm.
    Both are NaN, with gradient 0, for parallel rays; the rays broadcast. Source: common perpendicular (textbook).
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


def R_cam_view(direction_cam: Tensor) -> Tensor:
    """Return the smallest rotation (..., 3, 3) from the camera's z axis to directions (..., 3), camera frame.
    It takes view to camera components; the last column is the unit direction. NaN, gradient 0, for the backward one.
    Source: docs/errata.md A1 (the paper's R_persp has the axis of OpenGL's camera); Rodrigues, axis z x direction.
    """
    check_points("direction_cam", direction_cam, 3)
    unit = direction_cam / direction_cam.norm(dim=-1, keepdim=True)
    x, y, z = unit.unbind(-1)
    defined = 1 + z > 4 * torch.finfo(z.dtype).eps
    share = 1 / torch.where(defined, 1 + z, torch.ones_like(z))  # (1 - cos) / sin^2: exact also at direction = z
    rows = [1 - x * x * share, -x * y * share, x, -x * y * share, 1 - y * y * share, y, -x, -y, z]
    R = torch.stack(rows, dim=-1).reshape(*x.shape, 3, 3)
    return torch.where(defined[..., None, None], R, torch.full_like(R, torch.nan))


def _cross(a: Tensor, b: Tensor) -> Tensor:
    product: Tensor = torch.linalg.cross(*torch.broadcast_tensors(a, b))  # type: ignore[no-untyped-call]
    return product
