"""The perspective bias of dots: the centroid of a disk's picture is not the picture of its centre."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient.cameras.camera import Camera
from sphereorient.cameras.checks import check_points

RIM_POINTS = 8  # of each disk; the centroid is third order in the rim, whose terms beyond the second order are nil


def disk_centre_shift(
    camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, points_plate: Tensor, dot_diameter: Tensor
) -> Tensor:
    """Return the centroids of the pictures of disks minus the pictures of their centres.

    A measured centre minus this shift is the picture of the dot's centre. The centroid is an integral along the rim
    (Green), the rim a trigonometric polynomial through RIM_POINTS points; blur of the picture does not move it.

    Args:
        camera: any camera, also behind a port.
        R_lab_plate: (..., 3, 3), takes plate components to lab components.
        T_lab_plate: (..., 3), lab, mm: X_lab = R_lab_plate X_plate + T_lab_plate.
        points_plate: (..., n, 3), the disks' centres, plate frame, mm; the disks lie in the plane z = const.
        dot_diameter: (..., n), mm; 0 where there is no disk, whose shift is then 0.

    Returns:
        (..., n, 2), px; NaN where a part of the disk has no picture. Differentiable in everything.

    Raises:
        ShapeError: the last axes are not as above.
    """
    check_points("points_plate", points_plate, 3)
    angle = torch.arange(RIM_POINTS, dtype=torch.float64, device=points_plate.device) * (2 * math.pi / RIM_POINTS)
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=-1).to(points_plate)
    # A corner has no rim; half a picture of it would be 0/0, so it gets a rim and its shift is wiped out below.
    is_disk = dot_diameter > 0
    radius = torch.where(is_disk, dot_diameter, torch.ones_like(dot_diameter)) / 2
    rim_plate = points_plate[..., None, :] + radius[..., None, None] * circle
    rim_px = _project(camera, R_lab_plate, T_lab_plate, rim_plate)
    centre_px = _project(camera, R_lab_plate, T_lab_plate, points_plate[..., None, :])
    shift = _centroid(rim_px - centre_px)
    return torch.where(is_disk[..., None], shift, torch.zeros_like(shift))


def _project(camera: Camera, R_lab_plate: Tensor, T_lab_plate: Tensor, points_plate: Tensor) -> Tensor:
    x_lab_mm = points_plate @ R_lab_plate[..., None, :, :].mT + T_lab_plate[..., None, None, :]
    return camera.project(x_lab_mm)


def _centroid(rim: Tensor) -> Tensor:
    """Return the centroid (..., 2) of the area within a closed smooth curve through points (..., RIM_POINTS, 2).

    Source: Green's theorem, area = 1/2 loop(u dv - v du), area times centroid_u = 1/2 loop(u^2 dv), likewise v.
    """
    along = _slope_matrix(rim) @ rim  # d/d angle
    u, v = rim.unbind(-1)
    du, dv = along.unbind(-1)
    twice_area = (u * dv - v * du).sum(-1)
    return torch.stack([(u * u * dv).sum(-1), -(v * v * du).sum(-1)], dim=-1) / twice_area[..., None]


def _slope_matrix(like: Tensor) -> Tensor:
    """Return the (RIM_POINTS, RIM_POINTS) matrix of d/d angle of the trigonometric polynomial through the points.

    Source: Trefethen, Spectral Methods in MATLAB, eq. (3.10), even number of points.
    """
    k = torch.arange(RIM_POINTS, device=like.device)
    apart = (k[:, None] - k[None, :]).to(torch.float64) * (math.pi / RIM_POINTS)
    sign = 1.0 - 2.0 * ((k[:, None] - k[None, :]) % 2)
    slope = 0.5 * sign / torch.tan(torch.where(apart == 0, torch.ones_like(apart), apart))
    return torch.where(apart == 0, torch.zeros_like(slope), slope).to(like)
