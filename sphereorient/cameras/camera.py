from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from sphereorient.cameras.covariance import ParameterCovariance


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Half lines in the lab along which pixels see."""

    origin_lab_mm: Tensor  # (..., 3), a point of the ray: the projection centre, or the refracting wall's liquid side
    direction_lab: Tensor  # (..., 3), unit length, away from the camera


class Camera(Protocol):
    """A calibrated camera: lab points to pixels (u, v), also outside the picture, and pixels to rays.
    Methods take any leading shape (else ShapeError), compute in the argument's dtype, and are differentiable in it and
    in camera parameters that require gradients. A point without an image is NaN, with gradient 0.
    """

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the picture, px."""

    @property
    def R_cam_lab(self) -> Tensor:
        """(3, 3) float64, takes lab components to camera components (x right, y down, z forward)."""

    @property
    def T_cam_lab_mm(self) -> Tensor:
        """(3,) float64: X_cam = R_cam_lab X_lab + T_cam_lab_mm."""

    @property
    def covariance(self) -> ParameterCovariance | None:
        """Covariance of the parameters from a calibration."""

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2) as (u, v), px; NaN behind the camera."""

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the rays of pixels (..., 2); behind a wall they start on its liquid side."""

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) at which the same camera without distortion images what `uv_px` images."""

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) that `undistort` takes to `uv_px`."""
