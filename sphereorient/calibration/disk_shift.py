"""The perspective bias of dots: the centroid of a disk's image is not the image of its centre."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import check_points

RIM_POINTS = 8  # of each disk; terms beyond the second order of the rim are negligible


def disk_centre_shift(
    camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, points_plate: Tensor, dot_diameter: Tensor
) -> Tensor:
    """Return the centroids of the images of disks minus the images of their centres.

    A measured centroid minus this shift is the image of the dot's centre. The centroid is an integral along the rim
    (Green), the rim a trigonometric polynomial through RIM_POINTS points; image blur does not move it.

    Args:
        camera: any camera, also behind a port.
        R_lab_plate: (..., 3, 3), takes plate components to lab components.
        T_lab_plate: (..., 3), lab, mm: X_lab = R_lab_plate X_plate + T_lab_plate.
        points_plate: (..., n, 3), the disks' centres, plate frame, mm; the disks lie in the plane z = const.
        dot_diameter: (..., n), mm; 0 for a corner, whose shift is 0.

    Returns:
        (..., n, 2), px; NaN where a part of the disk is not imaged. Differentiable in everything.

    Raises:
        ShapeError: the last axis of points_plate is not 3.

    Source: Green's theorem, area = 1/2 loop(u dv - v du), area times centroid_u = 1/2 loop(u^2 dv), likewise v.
    """
    check_points("points_plate", points_plate, 3)
    angle = torch.arange(RIM_POINTS, dtype=torch.float64, device=points_plate.device) * (2 * math.pi / RIM_POINTS)
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).to(points_plate)
    # A corner has no rim and would give 0/0: it gets a rim here, and its shift is set to 0 below.
    is_disk = dot_diameter > 0
    radius = torch.where(is_disk, dot_diameter, torch.ones_like(dot_diameter)) / 2
    centres = points_plate[..., None, :]
    around = torch.cat([centres, centres + radius[..., None, None] * circle], dim=-2)
    uv_px = camera.project(around @ R_lab_plate[..., None, :, :].mT + T_lab_plate[..., None, None, :])
    rim = uv_px[..., 1:, :] - uv_px[..., :1, :]
    along = _slope_matrix(rim) @ rim  # d/d angle
    u, v = rim.unbind(-1)
    du, dv = along.unbind(-1)
    twice_area = (u * dv - v * du).sum(-1)
    shift = torch.stack([(u * u * dv).sum(-1), -(v * v * du).sum(-1)], dim=-1) / twice_area[..., None]
    return torch.where(is_disk[..., None], shift, torch.zeros_like(shift))


def _slope_matrix(like: Tensor) -> Tensor:
    """Return the (RIM_POINTS, RIM_POINTS) matrix of d/d angle of the trigonometric polynomial through the points.

    Source: Trefethen, Spectral Methods in MATLAB, eq. (3.10), even number of points.
    """
    k = torch.arange(RIM_POINTS, device=like.device)
    apart = (k[:, None] - k[None, :]).to(torch.float64) * (math.pi / RIM_POINTS)
    sign = 1.0 - 2.0 * ((k[:, None] - k[None, :]) % 2)
    slope = 0.5 * sign / torch.tan(torch.where(apart == 0, torch.ones_like(apart), apart))
    return torch.where(apart == 0, torch.zeros_like(slope), slope).to(like)
