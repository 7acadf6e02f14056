"""The camera without lens: straight perspective."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.central import CentralCamera
from sphereorient.cameras.checks import check_points, check_positive
from sphereorient.errors import CameraError, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera(CentralCamera):
    """Perspective without distortion and with square pixels (DESIGN section 2, `pinhole`)."""

    f_px: Tensor  # (), focal length, px

    PARAMETERS: ClassVar[Mapping[str, tuple[str, int | None]]] = {
        "f_px": ("f_px", None),
        "centre_u": ("centre_px", 0),
        "centre_v": ("centre_px", 1),
    }

    def __post_init__(self) -> None:
        """Refuse what is no camera."""
        super().__post_init__()
        self._set_parameter("f_px")
        check_positive("f_px", self.f_px)

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px.expand(2)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) unchanged."""
        check_points("uv_px", uv_px, 2)
        return uv_px


def focal_of_field(height_px: int, vfov_deg: float) -> float:
    """Return the focal length, px, that spans `vfov_deg` degrees over the full height of the picture.

    Raises:
        CameraError: the angle is not between 0 and 180 degrees.
    """
    if not 0.0 < vfov_deg < 180.0:
        got = f"{vfov_deg:g}"
        raise CameraError(refusal("vfov_deg", expected="an angle between 0 and 180", got=got, do="correct the camera"))
    return 0.5 * height_px / math.tan(math.radians(vfov_deg) / 2)


def middle_of_picture(image_size: tuple[int, int]) -> Tensor:
    """Return the middle of a W x H picture, (2,) float64 px; whole numbers are pixel centres."""
    return (torch.tensor(image_size, dtype=torch.float64) - 1) / 2
