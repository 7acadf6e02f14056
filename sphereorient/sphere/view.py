import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import check_tail
from sphereorient.sphere.texture import sample_spline, sample_texture

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class DiskView:
    """Pixels of a square picture filled by a sphere's disk; view frame x right, y down, z to the centre."""

    size_px: int
    inside: Tensor  # (S, S) bool, the pixels of the disk
    normal_view: Tensor  # (P, 3), outward normals at the P pixels inside, view frame, row by row

    def picture(self, values: Tensor, outside: float = 0.0) -> Tensor:
        """Return pictures (..., S, S) from the values (..., P) of the disk's pixels."""
        picture = values.new_full((*values.shape[:-1], self.size_px, self.size_px), outside)
        picture[..., self.inside] = values
        return picture

    def paint(self, texture: Tensor, R_view_body: Tensor) -> Tensor:
        """Return the paint (..., P) of a map (H, 2 H) at orientations (..., 3, 3); differentiable."""
        return paint_seen(texture.to(R_view_body.dtype), self.normal_view.to(R_view_body.dtype), R_view_body)

    def render(self, texture: Tensor, R_view_body: Tensor, outside: float = 0.0) -> Tensor:
        """Return pictures (..., S, S), one sample per pixel; `SphereRenderer` integrates over pixels."""
        return self.picture(self.paint(texture, R_view_body), outside)


def paint_seen(texture: Tensor, normal_view: Tensor, R_view_body: Tensor, *, smooth: bool = False) -> Tensor:
    """Return the paint (..., P) of a map (H, 2 H) at outward normals (..., P, 3), for all pictures.
    `R_view_body` (..., 3, 3) takes body components to the frame of the normals; `smooth`: spline, otherwise bilinear.
    """
    check_tail("R_view_body", R_view_body, 3, 3)
    return (sample_spline if smooth else sample_texture)(texture, (normal_view @ R_view_body).to(texture.dtype))


def disk_offsets(size_px: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return pixel centres of a square, (S, S, 2) as (right, down), in disk radii."""
    at = (torch.arange(size_px, dtype=dtype) + 0.5) * (2.0 / size_px) - 1.0
    down, right = torch.meshgrid(at, at, indexing="ij")
    return torch.stack([right, down], dim=-1)


def orthographic_view(size_px: int, dtype: torch.dtype = torch.float32) -> DiskView:
    """Return the view from infinity: the pixel at (x, y) radii has the normal (x, y, -sqrt(1 - x^2 - y^2)).
    Source: paper section III (templates); docs/errata.md A4 lists the neglected effects.
    """
    origin = torch.nn.functional.pad(disk_offsets(size_px), (0, 1))
    normal, depth2 = sphere_normals(origin, origin.new_tensor([0.0, 0.0, 1.0]), origin.new_zeros(3), 1.0)
    inside = depth2 > 0
    return DiskView(size_px=size_px, inside=inside, normal_view=normal[inside].to(dtype))


def perspective_view(size_px: int, distance_radii: float, dtype: torch.dtype = torch.float32) -> DiskView:
    """Return the view from `distance_radii` (above 1) to the sphere's centre; the visible cap fills the disk.
    Source: docs/errata.md A4 (the rim lies asin(1 / distance) in front of the great circle).
    """
    offset = disk_offsets(size_px)
    inside = offset.square().sum(-1) < 1
    limb_slope = 1.0 / (distance_radii**2 - 1.0) ** 0.5  # tan of the cone's half angle
    ray = torch.nn.functional.pad(offset[inside] * limb_slope, (0, 1), value=1.0)
    normal, _ = sphere_normals(torch.zeros(3, dtype=ray.dtype), ray, ray.new_tensor([0.0, 0.0, distance_radii]), 1.0)
    return DiskView(size_px=size_px, inside=inside, normal_view=normal.to(dtype))


def sphere_normals(
    origin: Tensor, direction: Tensor, centre: Tensor, radius: float | Tensor, corner: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return unit normals (..., 3) where rays first meet a sphere, and 1 - (ray distance / radius)^2, (...).
    A missing ray gets the normal at its nearest approach. `origin`, `direction` and `centre` are (..., 3), `radius` ()
    or (...), in one frame and unit. `corner` (radii^2) above 0 rounds the limb: twice differentiable, normals within
    about sqrt(corner) of the limb are shifted inwards.
    """
    check_tail("direction", direction, 3)
    radius = torch.as_tensor(radius, dtype=direction.dtype, device=direction.device)[..., None]
    direction = direction / direction.norm(dim=-1, keepdim=True)
    nearest = nearest_approach(centre - origin, direction)
    depth2 = radius**2 - nearest.square().sum(-1, keepdim=True)
    if corner > 0:
        depth = radius * smooth_positive(depth2 / radius**2, corner).sqrt()
    else:
        hit = depth2 > 0
        # A floor keeps the root's gradient finite at the limb.
        depth = torch.where(hit, depth2, 1.0).maximum(1e-12 * radius**2).sqrt()
        depth = torch.where(hit, depth, 0.0)
    normal = nearest - depth * direction
    normal = normal / normal.norm(dim=-1, keepdim=True).maximum(1e-12 * radius)
    return normal, (depth2 / radius**2)[..., 0]


def nearest_approach(to_centre: Tensor, direction: Tensor, axis: int = -1) -> Tensor:
    """Return the vectors from a sphere's centre to the nearest points of lines of sight; x, y, z are along `axis`.
    `to_centre` leads from a point of a line to the centre, `direction` is the line's unit direction.
    """
    return (to_centre * direction).sum(axis, keepdim=True) * direction - to_centre


def fitted_circle(points: Floats, weight: Floats | None = None) -> tuple[float, float, float]:
    """Return centre and radius of the best circle through points (K, 2), by Kasa's linear least squares (1976)."""
    root = np.ones(len(points)) if weight is None else np.sqrt(weight)
    columns = np.column_stack([2 * points, np.ones(len(points))])
    u, v, c = np.linalg.lstsq(columns * root[:, None], (points**2).sum(1) * root, rcond=None)[0].tolist()
    return u, v, math.sqrt(max(c + u * u + v * v, 0.0))


def smooth_positive(x: Tensor, width: float) -> Tensor:
    """Return max(x, 0), rounded over about `width`; always positive."""
    root = (x * x + width * width).sqrt()
    # The second form avoids the difference of nearly equal numbers.
    return torch.where(x > 0, 0.5 * (x + root), 0.5 * width * width / (root + x.abs()))


def polynomials(across: Tensor, order: int) -> Tensor:
    """Return all monomials of x and y up to an order, (..., K, P), at points (..., 2, P)."""
    x, y = across[..., 0, :], across[..., 1, :]
    columns = [torch.ones_like(x)]
    last = columns
    for _ in range(order):
        last = [last[0] * x, *(column * y for column in last)]
        columns = [*columns, *last]
    return torch.stack(columns, dim=-2)
