"""The canonical view: which direction of the sphere each pixel of a disk shows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient.errors import check_tail


@dataclass(frozen=True, kw_only=True, eq=False)
class DiskView:
    """A square picture that the disk of a sphere just fills; made by the functions below, read by the renderers.

    View frame: x right, y down, z from the camera to the sphere's centre.
    """

    size_px: int
    inside: Tensor  # (S, S) bool, the pixels of the disk
    normal_view: Tensor  # (P, 3), outward normals at the P pixels inside, view frame, row by row

    def picture(self, values: Tensor, outside: float = 0.0) -> Tensor:
        """Put the values of the disk's pixels, (..., P), into pictures (..., S, S)."""
        picture = values.new_full((*values.shape[:-1], self.size_px, self.size_px), outside)
        picture[..., self.inside] = values
        return picture


def disk_offsets(size_px: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the pixel centres of a square in units of the disk's radius, (S, S, 2) as (right, down)."""
    at = (torch.arange(size_px, dtype=dtype) + 0.5) * (2.0 / size_px) - 1.0
    down, right = torch.meshgrid(at, at, indexing="ij")
    return torch.stack([right, down], dim=-1)


def orthographic_view(size_px: int, dtype: torch.dtype = torch.float32) -> DiskView:
    """View a sphere from infinitely far: a pixel at (x, y) radii shows the normal (x, y, -sqrt(1 - x^2 - y^2)).

    Args:
        size_px: side of the picture, px; the disk fills it.
        dtype: of the normals.

    Source: paper section III (templates); ERRATA A4 says what it neglects.
    """
    offset = disk_offsets(size_px)
    depth2 = 1.0 - offset.square().sum(-1)
    inside = depth2 > 0
    normal = torch.cat([offset[inside], -depth2[inside].sqrt()[:, None]], dim=-1)
    return DiskView(size_px=size_px, inside=inside, normal_view=normal.to(dtype))


def perspective_view(size_px: int, distance_radii: float, dtype: torch.dtype = torch.float32) -> DiskView:
    """View a sphere from a finite distance along the line to its centre; the visible cap fills the disk.

    Args:
        size_px: side of the picture, px; the limb touches its edges.
        distance_radii: distance of the projection centre from the sphere's centre, in radii, above 1.
        dtype: of the normals.

    Source: ERRATA A4 (the rim lies asin(1 / distance) before the great circle).
    """
    offset = disk_offsets(size_px)
    inside = offset.square().sum(-1) < 1
    limb_slope = 1.0 / (distance_radii**2 - 1.0) ** 0.5  # tan of the cone's half angle
    ray = torch.nn.functional.pad(offset[inside] * limb_slope, (0, 1), value=1.0)
    normal, _ = sphere_normals(torch.zeros(3, dtype=ray.dtype), ray, ray.new_tensor([0.0, 0.0, distance_radii]), 1.0)
    return DiskView(size_px=size_px, inside=inside, normal_view=normal.to(dtype))


def sphere_normals(origin: Tensor, direction: Tensor, centre: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Intersect rays with a sphere and return the outward unit normals at the near side.

    Args:
        origin: (..., 3), start of the rays, any one frame and unit.
        direction: (..., 3), same frame, any length.
        centre: (..., 3), of the sphere, same frame and unit.
        radius: of the sphere, same unit.

    Returns:
        Normals (..., 3), and whether the ray hits (...) bool; where it misses, the normal at the nearest approach.
    """
    check_tail("direction", direction, 3)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    to_centre = centre - origin
    along = (to_centre * direction).sum(-1, keepdim=True)
    nearest = along * direction - to_centre  # from the sphere's centre to the ray's nearest point
    depth2 = radius**2 - nearest.square().sum(-1, keepdim=True)
    hit = depth2 > 0
    # The square root's gradient is infinite at the limb: a floor keeps it finite, and misses have no depth.
    depth = torch.where(hit, depth2, torch.ones_like(depth2)).clamp_min(1e-12 * radius**2).sqrt()
    normal = nearest - torch.where(hit, depth, torch.zeros_like(depth)) * direction
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12 * radius)
    return normal, hit[..., 0]
