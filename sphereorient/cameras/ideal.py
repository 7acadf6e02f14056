"""Cameras without distortion."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import camera_error, check_points
from sphereorient.cameras.model import CameraModel, CentralCamera, Key


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera(CentralCamera):
    """Perspective without distortion and with square pixels."""

    f_px: Tensor  # (), focal length, px

    MODEL: ClassVar[str] = "pinhole"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f_px", "f_px", optional=True, positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )
    ALSO: ClassVar[tuple[str, ...]] = ("vfov_deg",)

    @classmethod
    def completed(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return the keys with f_px from vfov_deg (one of both, else CameraError), and a default centre."""
        f_px, vfov_deg = values["f_px"], values["vfov_deg"]
        if (f_px is None) == (vfov_deg is None):
            got, do = "none" if f_px is None else "both", "write one of the two"
            raise camera_error("vfov_deg, f_px", "exactly one", got, do)
        values = super().completed(values)
        return values if vfov_deg is None else values | {"f_px": focal_of_field(values["image_size"][1], vfov_deg)}

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px.expand(2)


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


def focal_of_field(height_px: int, vfov_deg: float) -> float:
    """Return the focal length, px, for a vertical field of `vfov_deg`, 0 to 180 degrees (else CameraError)."""
    if not 0.0 < vfov_deg < 180.0:
        raise camera_error("vfov_deg", "an angle between 0 and 180", f"{vfov_deg:g}")
    return 0.5 * height_px / math.tan(math.radians(vfov_deg) / 2)
