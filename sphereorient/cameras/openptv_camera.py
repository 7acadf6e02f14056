from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.brown import PolynomialCamera
from sphereorient.cameras.checks import check_positive
from sphereorient.cameras.model import Key, middle_of_picture


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenPTVCamera(PolynomialCamera):
    """Perspective about `centre_px`, distorted about the middle of the picture; sensor in mm, its y up.
    k in mm^-2, mm^-4, mm^-6; p in 1/mm and in OpenPTV's order: its p1 goes with r^2 + 2 x^2, OpenCV's with r^2 + 2 y^2.
    Source: OpenPTV: sensor shift, polynomial, affine part x' = scx x - sin(she) y, y' = cos(she) y (its classic form).
    """

    f_mm: Tensor  # (), principal distance
    pixel_pitch_mm: Tensor  # (2,)
    scx: Tensor  # (), scale of x
    she: Tensor  # (), shear, rad

    MODEL: ClassVar[str] = "openptv"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f", "f_mm", positive=True),
        Key("pixel_pitch", "pixel_pitch_mm", ("pixel_pitch_u", "pixel_pitch_v"), positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v")),
        Key("k", "k", ("k1", "k2", "k3"), default=0.0),
        Key("p", "p", ("p1", "p2"), default=0.0),
        Key("scx", "scx", default=1.0, positive=True),
        Key("she", "she", default=0.0),
    )

    def __post_init__(self) -> None:
        check_positive("cos(she)", torch.as_tensor(self.she, dtype=torch.float64).cos())
        super().__post_init__()

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_mm / self.pixel_pitch_mm

    @property
    def _p_opencv(self) -> Tensor:
        return self.p.flip(0)

    def _plane(self, uv_px: Tensor, distorted: bool) -> Tensor:
        xy_mm = (uv_px - middle_of_picture(self.image_size).to(uv_px)) * self.pixel_pitch_mm.to(uv_px)
        xy_mm = xy_mm * xy_mm.new_tensor([1.0, -1.0])
        if not distorted:
            return xy_mm
        x, y = xy_mm.unbind(-1)
        y = y / self.she.to(y).cos()
        x = (x + self.she.to(y).sin() * y) / self.scx.to(x)
        return torch.stack([x, y], dim=-1)

    def _pixel(self, xy: Tensor, distorted: bool) -> Tensor:
        if distorted:
            x, y = xy.unbind(-1)
            she = self.she.to(x)
            xy = torch.stack([self.scx.to(x) * x - she.sin() * y, she.cos() * y], dim=-1)
        uv_px = xy * xy.new_tensor([1.0, -1.0]) / self.pixel_pitch_mm.to(xy)
        return uv_px + middle_of_picture(self.image_size).to(xy)
