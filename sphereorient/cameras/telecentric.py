from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import check_points
from sphereorient.cameras.model import CameraModel, Key


@dataclass(frozen=True, kw_only=True, eq=False)
class TelecentricCamera(CameraModel):
    """Orthographic projection: u = X_cam / scale + centre, at every depth; T_z changes no picture."""

    scale_mm_px: Tensor  # (), mm in the lab per pixel

    MODEL: ClassVar[str] = "telecentric"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("scale", "scale_mm_px", positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2)."""
        check_points("x_lab_mm", x_lab_mm, 3)
        x_cam_mm = x_lab_mm @ self.R_cam_lab[:2].to(x_lab_mm).mT + self.T_cam_lab_mm[:2].to(x_lab_mm)
        return x_cam_mm / self.scale_mm_px.to(x_lab_mm) + self.centre_px.to(x_lab_mm)

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the parallel rays of pixels (..., 2), which start in the camera's plane z = 0."""
        check_points("uv_px", uv_px, 2)
        x_cam_mm = (uv_px - self.centre_px.to(uv_px)) * self.scale_mm_px.to(uv_px)
        x_cam_mm = torch.cat([x_cam_mm, torch.zeros_like(x_cam_mm[..., :1])], dim=-1)
        R_cam_lab = self.R_cam_lab.to(uv_px)
        origin_lab_mm = (x_cam_mm - self.T_cam_lab_mm.to(uv_px)) @ R_cam_lab
        return Rays(origin_lab_mm=origin_lab_mm, direction_lab=R_cam_lab[2].expand_as(origin_lab_mm))
