"""The telecentric camera: all rays are parallel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import as_parameter, check_image_size, check_points, check_positive, check_rotation
from sphereorient.cameras.covariance import ParameterCovariance


@dataclass(frozen=True, kw_only=True, eq=False)
class TelecentricCamera:
    """Orthographic projection: u = X_cam / scale + centre (DESIGN section 2, `telecentric`).

    It sees points at every depth, and the picture does not depend on the depth; the rays begin in the plane z = 0 of
    the camera frame.
    """

    image_size: tuple[int, int]  # W, H px
    R_cam_lab: Tensor  # (3, 3)
    T_cam_lab_mm: Tensor  # (3,), X_cam = R_cam_lab X_lab + T; the third number moves no picture
    centre_px: Tensor  # (2,), pixel of X_cam = Y_cam = 0
    scale_mm_px: Tensor  # (), mm in the lab per pixel
    covariance: ParameterCovariance | None = None  # as of a calibration

    PARAMETERS: ClassVar[Mapping[str, tuple[str, int | None]]] = {
        "scale": ("scale_mm_px", None),
        "centre_u": ("centre_px", 0),
        "centre_v": ("centre_px", 1),
    }

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        check_image_size("image_size", self.image_size)
        object.__setattr__(self, "image_size", tuple(self.image_size))
        shapes = {"R_cam_lab": (3, 3), "T_cam_lab_mm": (3,), "centre_px": (2,), "scale_mm_px": ()}
        for name, shape in shapes.items():
            object.__setattr__(self, name, as_parameter(name, getattr(self, name), *shape))
        check_rotation("R_cam_lab", self.R_cam_lab)
        check_positive("scale_mm_px", self.scale_mm_px)

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Return where lab points (..., 3), mm, appear: (..., 2) as (u, v), px, also outside the picture.

        Raises:
            ShapeError: the last axis is not 3.
        """
        check_points("x_lab_mm", x_lab_mm, 3)
        x_cam_mm = x_lab_mm @ self.R_cam_lab[:2].to(x_lab_mm).mT + self.T_cam_lab_mm[:2].to(x_lab_mm)
        return x_cam_mm / self.scale_mm_px.to(x_lab_mm) + self.centre_px.to(x_lab_mm)

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the lines of sight of pixels.

        Args:
            uv_px: (..., 2) as (u, v), px.

        Returns:
            Rays with origin (..., 3) in the camera's plane z = 0, mm, and one direction (..., 3), lab.

        Raises:
            ShapeError: the last axis is not 2.
        """
        check_points("uv_px", uv_px, 2)
        x_cam_mm = (uv_px - self.centre_px.to(uv_px)) * self.scale_mm_px.to(uv_px)
        x_cam_mm = torch.cat([x_cam_mm, torch.zeros_like(x_cam_mm[..., :1])], dim=-1)
        R_cam_lab = self.R_cam_lab.to(uv_px)
        origin_lab_mm = (x_cam_mm - self.T_cam_lab_mm.to(uv_px)) @ R_cam_lab
        return Rays(origin_lab_mm=origin_lab_mm, direction_lab=R_cam_lab[2].expand_as(origin_lab_mm))

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px
