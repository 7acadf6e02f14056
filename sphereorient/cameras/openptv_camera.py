"""OpenPTV's camera: Brown's polynomial in mm about the middle of the sensor, then a shear."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.brown_polynomial import bent, straightened
from sphereorient.cameras.central import CentralCamera
from sphereorient.cameras.checks import check_points, check_positive, check_unfolded
from sphereorient.cameras.pinhole import middle_of_picture


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenPTVCamera(CentralCamera):
    """Perspective about `centre_px`, distorted about the middle of the picture; sensor in mm, its y up.

    Source: OpenPTV's order of operations: sensor shift, polynomial, affine part x' = scx x - sin(she) y,
    y' = cos(she) y (its classic form).
    """

    f_mm: Tensor  # (), principal distance
    pixel_pitch_mm: Tensor  # (2,)
    k: Tensor  # (3,), k1, k2, k3: mm^-2, mm^-4, mm^-6
    p: Tensor  # (2,), OpenPTV's p1, p2, 1/mm: p1 goes with r^2 + 2 x^2, OpenCV's p1 with r^2 + 2 y^2
    scx: Tensor  # (), scale of x
    she: Tensor  # (), shear, rad

    PARAMETERS: ClassVar[Mapping[str, tuple[str, int | None]]] = {
        "f": ("f_mm", None),
        "pixel_pitch_u": ("pixel_pitch_mm", 0),
        "pixel_pitch_v": ("pixel_pitch_mm", 1),
        "centre_u": ("centre_px", 0),
        "centre_v": ("centre_px", 1),
        "k1": ("k", 0),
        "k2": ("k", 1),
        "k3": ("k", 2),
        "p1": ("p", 0),
        "p2": ("p", 1),
        "scx": ("scx", None),
        "she": ("she", None),
    }

    def __post_init__(self) -> None:
        """Refuse what is no camera, and a distortion that folds the picture."""
        super().__post_init__()
        shapes: dict[str, tuple[int, ...]] = {
            "f_mm": (), "pixel_pitch_mm": (2,), "k": (3,), "p": (2,), "scx": (), "she": ()
        }  # fmt: skip
        for name, shape in shapes.items():
            self._set_parameter(name, *shape)
        for name in ("f_mm", "pixel_pitch_mm", "scx"):
            check_positive(name, getattr(self, name))
        check_positive("cos(she)", self.she.cos())
        check_unfolded("k, p", self)

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_mm / self.pixel_pitch_mm

    def _sensor_mm(self, uv_px: Tensor) -> Tensor:
        """Return where pixels lie on the sensor, (..., 2) mm from its middle, x right, y up."""
        xy_mm = (uv_px - middle_of_picture(self.image_size).to(uv_px)) * self.pixel_pitch_mm.to(uv_px)
        return xy_mm * xy_mm.new_tensor([1.0, -1.0])

    def _pixel(self, xy_mm: Tensor) -> Tensor:
        uv_px = xy_mm * xy_mm.new_tensor([1.0, -1.0]) / self.pixel_pitch_mm.to(xy_mm)
        return uv_px + middle_of_picture(self.image_size).to(xy_mm)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return where the same camera without lens distortion would show what a pixel shows.

        Args:
            uv_px: (..., 2), px.

        Returns:
            (..., 2), px, to the last digits (Newton); NaN where no point before the fold of the polynomial goes, which
            lies outside the picture.
        """
        check_points("uv_px", uv_px, 2)
        x, y = self._sensor_mm(uv_px).unbind(-1)
        y = y / self.she.to(y).cos()
        x = (x + self.she.to(y).sin() * y) / self.scx.to(x)
        return self._pixel(straightened(torch.stack([x, y], dim=-1), self.k, self.p.flip(0)))

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixel that `undistort` takes to `uv_px`.

        Args:
            uv_px: (..., 2), px.

        Returns:
            (..., 2), px; NaN beyond the fold of the polynomial.
        """
        check_points("uv_px", uv_px, 2)
        x, y = bent(self._sensor_mm(uv_px), self.k, self.p.flip(0)).unbind(-1)
        she = self.she.to(x)
        return self._pixel(torch.stack([self.scx.to(x) * x - she.sin() * y, she.cos() * y], dim=-1))
