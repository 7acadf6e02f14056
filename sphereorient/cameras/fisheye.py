"""The fisheye camera: angles instead of slopes."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.brown import PolynomialCamera
from sphereorient.cameras.checks import camera_error
from sphereorient.cameras.model import CentralCamera, Key, middle_of_picture

NEAR_AXIS = 0.03  # rad; below it the series in the angle are exact to 1e-16


@dataclass(frozen=True, kw_only=True, eq=False)
class FisheyeCamera(PolynomialCamera):
    """Kannala-Brandt's lens, OpenCV's `fisheye` model: a point at the angle theta from the axis, below pi, appears at
    the distance f theta (1 + k1 theta^2 + ... + k4 theta^8) from `centre_px`. With k = 0 it is equidistant. Pixels
    beyond the fold of the polynomial, or theta = pi, have no line of sight (NaN): often the corners.
    Source: Kannala and Brandt 2006, eq. (6), without their asymmetric terms.
    """

    f_px: Tensor  # (2,), fx and fy, px per rad on the axis

    MODEL: ClassVar[str] = "fisheye"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("fx", "f_px", place=0, optional=True, positive=True),
        Key("fy", "f_px", place=1, optional=True),
        Key("cx", "centre_px", place=0, optional=True),
        Key("cy", "centre_px", place=1, optional=True),
        Key("k", "k", ("k1", "k2", "k3", "k4"), default=0.0),
    )
    ALSO: ClassVar[tuple[str, ...]] = ("vfov_deg",)

    def __post_init__(self) -> None:
        CentralCamera.__post_init__(self)  # a fold in the picture's corners is usual

    @classmethod
    def completed(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return the keys with fx and fy from vfov_deg (else CameraError), and a default centre."""
        (_, height), vfov_deg = values["image_size"], values["vfov_deg"]
        given = [name for name in ("fx", "fy", "vfov_deg") if values[name] is not None]
        if given not in (["fx", "fy"], ["vfov_deg"]):
            do = "write one of the two"
            raise camera_error("fx, fy, vfov_deg", "fx and fy, or vfov_deg", ", ".join(given) or "none", do)
        if vfov_deg is not None:
            if not 0.0 < vfov_deg < 360.0:
                raise camera_error("vfov_deg", "an angle between 0 and 360", f"{vfov_deg:g}")
            values = values | dict.fromkeys(("fx", "fy"), height / math.radians(vfov_deg))
        middle = dict(zip(("cx", "cy"), middle_of_picture(values["image_size"]).tolist(), strict=True))
        return values | {name: place for name, place in middle.items() if values[name] is None}

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per rad on the axis."""
        return self.f_px

    def across_lab(self, x_lab_mm: Tensor) -> Tensor:
        """Return unit directions (..., 3) about the axis, in which the picture of a sphere is widest."""
        R_cam_lab = self.R_cam_lab.to(x_lab_mm)
        x, y, _ = (x_lab_mm.detach() @ R_cam_lab.mT + self.T_cam_lab_mm.to(x_lab_mm)).unbind(-1)
        angle = torch.atan2(x, -y)  # 0 on the axis: the camera's x
        return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(x)], -1) @ R_cam_lab

    def _flattened(self, x_cam_mm: Tensor) -> tuple[Tensor, Tensor]:
        """Return points at their angle from the axis, rad, in their direction about it; seen unless behind on it."""
        aside2, depth = x_cam_mm[..., :2].square().sum(-1, keepdim=True), x_cam_mm[..., 2:]
        near = (depth > 0) & (aside2 < NEAR_AXIS**2 * depth.square())
        seen = near | (aside2 > torch.finfo(depth.dtype).eps * depth.square())  # less is rounding only
        one = torch.ones_like(depth)
        ahead = torch.where(near, depth, one)
        t2 = torch.where(near, aside2, torch.zeros_like(aside2)) / ahead.square()
        series = (1 - t2 * (1 / 3 - t2 * (1 / 5 - t2 * (1 / 7 - t2 / 9)))) / ahead  # of atan(t) / t
        aside = torch.where(near | ~seen, one, aside2).sqrt()
        share = torch.where(near, series, torch.atan2(aside, depth) / aside)
        return x_cam_mm[..., :2] * share, seen

    def _direction_cam(self, flat: Tensor) -> Tensor:
        seen = flat.detach().square().sum(-1, keepdim=True) < math.pi**2
        flat = torch.where(seen, flat, torch.zeros_like(flat))  # NaN would reach the gradient
        angle2 = flat.square().sum(-1, keepdim=True)
        near = angle2 < NEAR_AXIS**2
        small = torch.where(near, angle2, torch.zeros_like(angle2))
        angle = torch.where(near, torch.ones_like(angle2), angle2).sqrt()
        sine = 1 - small / 6 * (1 - small / 20 * (1 - small / 42 * (1 - small / 72)))  # of sin(x) / x, then cos(x)
        cosine = 1 - small / 2 * (1 - small / 12 * (1 - small / 30 * (1 - small / 56)))
        sine, cosine = torch.where(near, sine, angle.sin() / angle), torch.where(near, cosine, angle.cos())
        direction_cam = torch.cat([flat * sine, cosine], -1)
        return torch.where(seen, direction_cam, torch.full_like(direction_cam, torch.nan))
