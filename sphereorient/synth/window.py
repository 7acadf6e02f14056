"""How far a ball's picture reaches: as the camera itself shows it, also through a wall."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.errors import CameraError, refusal

AROUND = 16  # points of the rim; between two of them it reaches by 2 % further
MARGIN = 1.04  # for that, and for the cap that a near camera sees larger (2 % at five radii)


def reach_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> float:
    """Return the greatest distance, px, of balls' rims from the pictures of their centres, 4 % for safety.

    Args:
        camera: any model, also behind a port.
        position_lab_mm: (N, 3), centres.
        radius_mm: of the balls.

    Raises:
        CameraError: a ball that is not wholly before the camera, or not wholly in the liquid.
    """
    if len(position_lab_mm) == 0:
        return 1.0
    middle_px = camera.project(position_lab_mm)
    sight = camera.rays(middle_px).direction_lab
    across = torch.linalg.cross(sight, camera.R_cam_lab[0].to(sight).expand_as(sight))
    across = across / across.norm(dim=-1, keepdim=True)
    angle = torch.arange(AROUND, dtype=sight.dtype) * (2 * math.pi / AROUND)
    second = torch.linalg.cross(sight, across)
    rim = angle.cos()[:, None] * across[:, None] + angle.sin()[:, None] * second[:, None]  # (N, AROUND, 3)
    # The point nearest to the camera is not on the rim, but it too must be in the liquid.
    offset_mm = radius_mm * torch.cat([MARGIN * rim, -sight[:, None]], dim=1)
    rim_px = camera.project(position_lab_mm[:, None] + offset_mm)
    reach = float((rim_px - middle_px[:, None]).norm(dim=-1).max())
    if math.isnan(reach):
        do = "move it away from the camera or the wall"
        raise CameraError(refusal("position_lab_mm", expected="a ball that is seen whole", got="another", do=do))
    return reach
