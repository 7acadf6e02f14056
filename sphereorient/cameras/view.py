"""The view frame: the camera frame turned towards the sphere."""

from __future__ import annotations

import torch
from torch import Tensor

from sphereorient.cameras.checks import check_points


def R_cam_view(direction_cam: Tensor) -> Tensor:
    """Return the smallest rotation that takes the camera's z axis to a direction.

    Args:
        direction_cam: (..., 3), camera frame, any length above zero.

    Returns:
        (..., 3, 3), takes view components to camera components; its last column is the unit direction.
        NaN, with gradient 0, straight backwards, where the rotation is not defined.

    Raises:
        ShapeError: the last axis is not 3.

    Source: ERRATA A1 (the paper's R_persp has the axis of OpenGL's camera); Rodrigues' formula with z x direction.
    """
    check_points("direction_cam", direction_cam, 3)
    unit = direction_cam / direction_cam.norm(dim=-1, keepdim=True)
    x, y, z = unit.unbind(-1)
    defined = 1 + z > 4 * torch.finfo(z.dtype).eps
    share = 1 / torch.where(defined, 1 + z, torch.ones_like(z))  # (1 - cos) / sin^2: exact also at direction = z
    rows = [1 - x * x * share, -x * y * share, x, -x * y * share, 1 - y * y * share, y, -x, -y, z]
    R = torch.stack(rows, dim=-1).reshape(*x.shape, 3, 3)
    return torch.where(defined[..., None, None], R, torch.full_like(R, torch.nan))
