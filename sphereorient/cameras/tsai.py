from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.checks import camera_error, check_points
from sphereorient.cameras.model import CentralCamera, Key

FOLD = -4.0 / 27.0  # below this value of kappa1 r_u^2 the cubic has no root on the branch that holds the picture


@dataclass(frozen=True, kw_only=True, eq=False)
class TsaiCamera(CentralCamera):
    """Perspective with Tsai's x_u = x_d (1 + kappa1 r_d^2), r_d distorted, on the sensor, mm (docs/conventions.md)."""

    f_mm: Tensor  # (), effective focal length
    pixel_pitch_mm: Tensor  # (2,)
    sx: Tensor  # (), horizontal scale
    kappa1: Tensor  # (), 1/mm^2

    MODEL: ClassVar[str] = "tsai"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f", "f_mm", positive=True),
        Key("pixel_pitch", "pixel_pitch_mm", ("pixel_pitch_u", "pixel_pitch_v"), positive=True),
        Key("sx", "sx", default=1.0, positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v")),
        Key("kappa1", "kappa1", default=0.0),
    )

    def __post_init__(self) -> None:
        """Refuse also a distortion that folds inside the picture."""
        super().__post_init__()
        width, height = self.image_size
        corners = self.centre_px.new_tensor([(u, v) for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5)])
        r2 = float(self._sensor_mm(corners).detach().square().sum(-1).max())
        kappa1 = float(self.kappa1.detach())
        if 1.0 + 3.0 * kappa1 * r2 <= 0:  # d r_u / d r_d at the farthest corner
            expected = f"above {-1.0 / (3.0 * r2):.4g} 1/mm^2, where the picture's farthest corner folds over"
            do = "correct the camera or calibrate again"
            raise camera_error("kappa1", expected, f"{kappa1:.4g}", do)

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_mm / self._mm_per_px

    @property
    def _mm_per_px(self) -> Tensor:
        return self.pixel_pitch_mm / torch.stack([self.sx, torch.ones_like(self.sx)])

    def _sensor_mm(self, uv_px: Tensor) -> Tensor:
        return (uv_px - self.centre_px.to(uv_px)) * self._mm_per_px.to(uv_px)

    def _scaled_about_centre(self, uv_px: Tensor, scale: Tensor) -> Tensor:
        exists = ~torch.isnan(scale)[..., None]
        scale = torch.where(exists, scale[..., None], torch.ones_like(scale[..., None]))  # NaN would reach the gradient
        moved = self.centre_px.to(uv_px) + (uv_px - self.centre_px.to(uv_px)) * scale
        return torch.where(exists, moved, torch.full_like(moved, torch.nan))

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Undistort pixels (..., 2); NaN beyond the fold of the polynomial, which lies outside the picture."""
        check_points("uv_px", uv_px, 2)
        bend = self.kappa1.to(uv_px) * self._sensor_mm(uv_px).square().sum(-1)
        unfolded = 1.0 + 3.0 * bend > 0
        return self._scaled_about_centre(uv_px, torch.where(unfolded, 1.0 + bend, torch.full_like(bend, torch.nan)))

    def distort(self, uv_px: Tensor) -> Tensor:
        """Distort pixels (..., 2); NaN where there is no solution (kappa1 < 0, outside the picture)."""
        check_points("uv_px", uv_px, 2)
        bend = self.kappa1.to(uv_px) * self._sensor_mm(uv_px).square().sum(-1)
        return self._scaled_about_centre(uv_px, shrinkage(bend))


def shrinkage(bend: Tensor) -> Tensor:
    """Return s = r_d / r_u, the root of s (1 + bend s^2) = 1 with s(0) = 1, for bend = kappa1 r_u^2 of any shape.
    No unit; NaN, with gradient 0, at and below -4/27, where the root does not exist.
    Source: Cardano's closed form; z = sqrt(27 |bend| / 4), s = 3 sin(asin(z) / 3) / z (bend < 0; sinh for bend > 0).
    """
    exists = bend > FOLD
    bend = torch.where(exists, bend, torch.zeros_like(bend))
    with torch.no_grad():
        # The floor avoids 0/0; the Newton steps remove its error (1e-9).
        z = (27.0 / 4.0 * bend.abs()).sqrt().clamp_min(1e-4)
        s = torch.where(bend < 0, (z.clamp_max(1.0).asin() / 3).sin(), (z.asinh() / 3).sinh()) * 3 / z
    # sqrt has no gradient at 0. The first Newton step carries the root's first derivative, the second its second.
    for _ in range(2):
        s = s - (s * (1 + bend * s * s) - 1) / (1 + 3 * bend * s * s)
    return torch.where(exists, s, torch.full_like(s, torch.nan))
