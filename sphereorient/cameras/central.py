"""What cameras with one projection centre share: the rigid motion, the perspective, the scale to pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import Rays
from sphereorient.cameras.checks import as_parameter, check_image_size, check_points, check_rotation
from sphereorient.cameras.covariance import ParameterCovariance


@dataclass(frozen=True, kw_only=True, eq=False)
class CentralCamera(ABC):
    """A camera all of whose rays meet in one point; a model adds its focal length and its distortion.

    Parameters are float64 tensors; those that require gradients receive them.
    """

    image_size: tuple[int, int]  # W, H px
    R_cam_lab: Tensor  # (3, 3)
    T_cam_lab_mm: Tensor  # (3,), X_cam = R_cam_lab X_lab + T
    centre_px: Tensor  # (2,), pixel of the optical axis
    covariance: ParameterCovariance | None = None  # as of a calibration

    # Names in cameras.yaml -> field, and place in it; rotation and translation, which all have, are not among them.
    PARAMETERS: ClassVar[Mapping[str, tuple[str, int | None]]]

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        check_image_size("image_size", self.image_size)
        object.__setattr__(self, "image_size", tuple(self.image_size))
        self._set_parameter("R_cam_lab", 3, 3)
        self._set_parameter("T_cam_lab_mm", 3)
        self._set_parameter("centre_px", 2)
        check_rotation("R_cam_lab", self.R_cam_lab)

    def _set_parameter(self, name: str, *shape: int) -> None:
        object.__setattr__(self, name, as_parameter(name, getattr(self, name), *shape))

    @property
    def centre_lab_mm(self) -> Tensor:
        """(3,), lab, mm: the point that all rays leave from."""
        return -(self.R_cam_lab.mT @ self.T_cam_lab_mm)

    @property
    @abstractmethod
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope X/Z and Y/Z on the axis."""

    @abstractmethod
    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return where the same camera without lens distortion would show what pixels (..., 2) show, (..., 2) px."""

    @abstractmethod
    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) that `undistort` takes to `uv_px`, px."""

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Return where lab points appear.

        Args:
            x_lab_mm: (..., 3), lab, mm.

        Returns:
            (..., 2) as (u, v), px, also outside the picture; NaN for points that are not before the camera.

        Raises:
            ShapeError: the last axis is not 3.

        Source: DESIGN section 2 (X_cam = R X_lab + T, x_u = f X/Z).
        """
        check_points("x_lab_mm", x_lab_mm, 3)
        x_cam_mm = x_lab_mm @ self.R_cam_lab.to(x_lab_mm).mT + self.T_cam_lab_mm.to(x_lab_mm)
        depth = x_cam_mm[..., 2:]
        before = depth > 0
        # Both branches of where need a finite argument, or the gradient of the unused one is NaN.
        slope = x_cam_mm[..., :2] / torch.where(before, depth, torch.ones_like(depth))
        uv_px = self.distort(slope * self.focal_px.to(slope) + self.centre_px.to(slope))
        return torch.where(before, uv_px, torch.full_like(uv_px, torch.nan))

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the lines of sight of pixels.

        Args:
            uv_px: (..., 2) as (u, v), px.

        Returns:
            Rays with origin (..., 3), the projection centre, and direction (..., 3), lab.

        Raises:
            ShapeError: the last axis is not 2.
        """
        check_points("uv_px", uv_px, 2)
        slope = (self.undistort(uv_px) - self.centre_px.to(uv_px)) / self.focal_px.to(uv_px)
        direction_cam = torch.cat([slope, torch.ones_like(slope[..., :1])], dim=-1)
        direction_cam = direction_cam / direction_cam.norm(dim=-1, keepdim=True)
        direction_lab = direction_cam @ self.R_cam_lab.to(uv_px)  # rows: R_lab_cam applied to every direction
        return Rays(origin_lab_mm=self.centre_lab_mm.to(uv_px).expand_as(direction_lab), direction_lab=direction_lab)
