"""Cameras with polynomial distortion: Brown's, in OpenCV's model and OpenPTV's, and Tsai's radial one."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from sphereorient.cameras.checks import camera_error, check_points, check_positive
from sphereorient.cameras.model import CentralCamera, Key, middle_of_picture

FOLD = -4.0 / 27.0  # least kappa1 r_u^2 with a root of the cubic on the picture's branch
RIM_STEPS = 33  # tested points per side of the picture, with both corners


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
        """Check the fields, and refuse a distortion that folds inside the picture."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class PolynomialCamera(CentralCamera):
    """A lens with Brown's polynomial on a plane defined by the model."""

    k: Tensor  # (n,), radial k1, k2, ...

    def __post_init__(self) -> None:
        """Check the fields, and refuse a distortion that folds inside the picture, from its rim."""
        super().__post_init__()
        u, v = (torch.linspace(-0.5, side - 0.5, RIM_STEPS, dtype=torch.float64) for side in self.image_size)
        rim_px = torch.cat([torch.cartesian_prod(u, v[[0, -1]]), torch.cartesian_prod(u[[0, -1]], v)])
        lost = torch.isnan(self.undistort(rim_px).detach()).any(-1)
        if bool(lost.any()):
            got, do = "one that folds before ({:g}, {:g})".format(*rim_px[lost][0]), "correct it or calibrate again"
            raise camera_error("k, p", "a distortion that is invertible in the picture", got, do)

    @property
    def _p_opencv(self) -> Tensor:
        """(2,), tangential coefficients in OpenCV's order; default: zeros."""
        return torch.zeros(2, dtype=torch.float64)

    def _plane(self, uv_px: Tensor, distorted: bool) -> Tensor:
        """Return the points of pixels on the plane of the polynomial."""
        return (uv_px - self.centre_px.to(uv_px)) / self.focal_px.to(uv_px)

    def _pixel(self, xy: Tensor, distorted: bool) -> Tensor:
        """Invert `_plane`."""
        return xy * self.focal_px.to(xy) + self.centre_px.to(xy)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Undistort pixels (..., 2) to the last digits; NaN beyond the fold, which lies outside the picture."""
        check_points("uv_px", uv_px, 2)
        return self._pixel(straightened(self._plane(uv_px, True), self.k, self._p_opencv), False)

    def distort(self, uv_px: Tensor) -> Tensor:
        """Distort pixels (..., 2); NaN beyond the fold of the polynomial."""
        check_points("uv_px", uv_px, 2)
        return self._pixel(bent(self._plane(uv_px, False), self.k, self._p_opencv), True)


@dataclass(frozen=True, kw_only=True, eq=False)
class BrownCamera(PolynomialCamera):
    """Perspective with Brown-Conrady distortion of X/Z and Y/Z; k, p without unit, as OpenCV's k1, k2, p1, p2, k3."""

    f_px: Tensor  # (2,), fx and fy
    p: Tensor  # (2,), tangential p1, p2

    MODEL: ClassVar[str] = "brown"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("fx", "f_px", place=0, positive=True),
        Key("fy", "f_px", place=1),
        Key("cx", "centre_px", place=0),
        Key("cy", "centre_px", place=1),
        Key("k", "k", ("k1", "k2", "k3"), default=0.0),
        Key("p", "p", ("p1", "p2"), default=0.0),
    )

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px

    @property
    def _p_opencv(self) -> Tensor:
        return self.p


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenPTVCamera(PolynomialCamera):
    """Perspective about `centre_px`, distorted about the middle of the picture; sensor in mm, its y up.
    k in mm^-2, mm^-4, mm^-6; p in 1/mm and in OpenPTV's order: its p1 goes with r^2 + 2 x^2, OpenCV's with r^2 + 2 y^2.
    Source: OpenPTV: sensor shift, polynomial, affine part x' = scx x - sin(she) y, y' = cos(she) y (its classic form).
    """

    p: Tensor  # (2,), tangential p1, p2
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


def bent(xy: Tensor, k: Tensor, p: Tensor) -> Tensor:
    """Apply the polynomial to points (..., 2), any unit, about the distortion's centre; NaN, gradient 0, past the fold.
    k (n,): radial k1, k2, ..., unit^-2, -4, ... p (2,): tangential p1, p2 in OpenCV's order, unit^-1.
    Source: Brown 1966 as OpenCV writes it: x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2).
    """
    ahead = _before_fold(xy, k, p)
    moved, _ = _bent(torch.where(ahead, xy, torch.zeros_like(xy)), k.to(xy), p.to(xy))
    return torch.where(ahead, moved, torch.full_like(moved, torch.nan))


def straightened(xy_bent: Tensor, k: Tensor, p: Tensor) -> Tensor:
    """Invert `bent`: return the points (..., 2) with the image `xy_bent`; NaN, with gradient 0, without solution."""
    goal, kk, pp = xy_bent, k.to(xy_bent), p.to(xy_bent)
    with torch.no_grad():
        radius = goal.norm(dim=-1, keepdim=True)
        safe = torch.where(radius > 0, radius, torch.ones_like(radius))
        xy = goal * (_radius_before(radius, kk, math.sqrt(fold2(k))) / safe)
        for _ in range(8):  # Newton steps from the radial solution, whose error is as small as the tangential part
            xy = _newton(xy, goal, kk, pp)
        missed = (_bent(xy, kk, pp)[0] - goal).norm(dim=-1, keepdim=True)
        close = missed <= 1e4 * torch.finfo(goal.dtype).eps * radius  # rounding, magnified near a fold
        exists = close & _before_fold(xy, k, p)
        xy = torch.where(exists, xy, torch.zeros_like(xy))
    goal = torch.where(exists, goal, torch.zeros_like(goal))
    # Two more steps carry the implicit derivatives: one the first, two also the second.
    xy = _newton(_newton(xy, goal, kk, pp), goal, kk, pp)
    return torch.where(exists, xy, torch.full_like(xy, torch.nan))


def fold2(k: Tensor) -> float:
    """Return the squared radius at which the radial polynomial folds; infinite without fold."""
    # 1 + 3 k1 s + 5 k2 s^2 + ... = 0, solved for 1/s: the leading coefficient is then 1 for any k.
    roots = np.roots([1.0, *(each * (2 * n + 3) for n, each in enumerate(k.detach().tolist()))])
    inverse = float(roots.real[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].max(initial=0.0))
    return 1.0 / inverse if inverse > 1e-300 else math.inf


def _bent(xy: Tensor, k: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
    """Return moved points and the entries xx, xy, yy of the symmetric Jacobian."""
    x, y = xy.unbind(-1)
    p1, p2 = p.unbind()
    r2 = x * x + y * y
    radial = 1 + r2 * _series(r2, k)
    rise = 2 * _series(r2, k * (torch.arange(len(k)).to(k) + 1))  # twice d radial / d r^2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    xx = radial + rise * x * x + 2 * p1 * y + 6 * p2 * x
    xy_slope = rise * x * y + 2 * p1 * x + 2 * p2 * y
    yy = radial + rise * y * y + 6 * p1 * y + 2 * p2 * x
    return torch.stack([u, v], dim=-1), torch.stack([xx, xy_slope, yy], dim=-1)


def _series(r2: Tensor, k: Tensor) -> Tensor:
    """Return k1 + k2 r2 + k3 r2^2 + ... in the shape of r2."""
    *others, total = k.unbind()
    for each in reversed(others):
        total = each + r2 * total
    return total


def _newton(xy: Tensor, goal: Tensor, k: Tensor, p: Tensor) -> Tensor:
    moved, jacobian = _bent(xy, k, p)
    dx, dy = (moved - goal).unbind(-1)
    a, b, c = jacobian.unbind(-1)
    step = torch.stack([c * dx - b * dy, a * dy - b * dx], dim=-1)
    return xy - step / (a * c - b * b)[..., None]


def _before_fold(xy: Tensor, k: Tensor, p: Tensor) -> Tensor:
    with torch.no_grad():
        a, b, c = _bent(xy, k.to(xy), p.to(xy))[1].unbind(-1)
        return ((xy.square().sum(-1) < fold2(k)) & (a * c - b * b > 0))[..., None]


def _radius_before(goal: Tensor, k: Tensor, fold: float) -> Tensor:
    by_r = k * (2 * torch.arange(len(k)).to(k) + 3)

    def value_and_slope(r: Tensor) -> tuple[Tensor, Tensor]:
        r2 = r * r
        return r * (1 + r2 * _series(r2, k)) - goal, 1 + r2 * _series(r2, by_r)

    low, high = torch.zeros_like(goal), goal.clamp_max(fold)
    for _ in range(10):  # until the root is in the upper half of the bracket, or 1000 times away from the goal
        half_is_beyond, is_below = value_and_slope(high / 2)[0] > 0, value_and_slope(high)[0] < 0
        high = torch.where(is_below, 2 * high, torch.where(half_is_beyond, high / 2, high)).clamp_max(fold)
    r = high
    for _ in range(30):  # bracketed Newton steps; at a fold, where Newton stalls, bisection alone reaches 1e-9
        value, slope = value_and_slope(r)
        low, high = torch.where(value < 0, r, low), torch.where(value < 0, high, r)
        better = r - value / slope
        r = torch.where((better >= low) & (better <= high), better, (low + high) / 2)
    return r
