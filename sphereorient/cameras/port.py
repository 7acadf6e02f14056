from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from sphereorient.cameras.camera import Camera, ParameterCovariance, Rays
from sphereorient.cameras.checks import as_parameter, camera_error, check_points
from sphereorient.cameras.model import CentralCamera, Key

UNIT_TOLERANCE = 1e-3  # of |normal| - 1, for normals written with three digits; the length is not used
STEPS = 12  # of Newton's method, before the differentiable ones; 11 suffice up to 89.9 degrees of incidence


@dataclass(frozen=True, kw_only=True, eq=False)
class Port:
    """A flat transparent wall with air in front of it and liquid behind it; float64, may require gradients."""

    normal: Tensor  # (3,), lab, unit length to three digits, towards the camera
    offset_mm: Tensor  # (), normal . X of the wall's liquid side, lab
    thickness_mm: Tensor  # ()
    n_glass: Tensor  # (), index of the wall, relative to the air's
    n_fluid: Tensor  # (), index of the liquid, relative to the air's

    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("normal", "normal", ("normal_x", "normal_y", "normal_z")),
        Key("offset", "offset_mm"),
        Key("thickness", "thickness_mm"),
        Key("n_glass", "n_glass"),
        Key("n_fluid", "n_fluid"),
    )

    def __post_init__(self) -> None:
        for key in self.KEYS:
            shape = (len(key.parts),) if key.parts else ()
            object.__setattr__(self, key.field, as_parameter(f"port, {key.field}", getattr(self, key.field), *shape))
        length = float(self.normal.detach().norm())
        if abs(length - 1) > UNIT_TOLERANCE:
            do = "write the wall's normal in lab axes, towards the camera"
            raise camera_error("port, normal", "a vector of length 1", f"{length:.6g}", do)
        do = "write the index relative to the air's, or the thickness in mm"
        for name, smallest in (("thickness_mm", 0.0), ("n_glass", 1.0), ("n_fluid", 1.0)):
            number = float(getattr(self, name).detach())
            if number < smallest:
                raise camera_error(f"port, {name}", f"{smallest:g} or more", f"{number:.6g}", do)

    @property
    def normal_lab(self) -> Tensor:
        """(3,), the normal with length 1 to the last digit."""
        unit: Tensor = self.normal / torch.linalg.vector_norm(self.normal)
        return unit

    @property
    def air_side_mm(self) -> Tensor:
        """(), normal . X of the wall's air side, lab."""
        return self.offset_mm + self.thickness_mm

    def refract(self, air: Rays) -> Rays:
        """Refract rays in air (whole lines) into the liquid, from the wall's liquid side; NaN, gradient 0, if away.
        Source: Snell's law divides the direction's part along the wall by the index (docs/cameras.md).
        """
        d = air.direction_lab
        normal = self.normal_lab.to(d)
        n_glass, n_fluid = self.n_glass.to(d), self.n_fluid.to(d)
        cosine = -(d @ normal)[..., None]
        passes = cosine > 0
        cosine = torch.where(passes, cosine, torch.ones_like(cosine))
        along_wall = torch.where(passes, d, -normal) + cosine * normal  # length: the sine in air
        # n cos(angle inside) = sqrt(n^2 - sin^2), in a form that is exactly the cosine at n = 1.
        in_glass = (n_glass.square() - 1 + cosine.square()).sqrt()
        in_fluid = (n_fluid.square() - 1 + cosine.square()).sqrt()
        height = (air.origin_lab_mm @ normal)[..., None] - self.air_side_mm.to(d)
        outer = air.origin_lab_mm + height / cosine * torch.where(passes, d, -normal)
        origin = outer + self.thickness_mm.to(d) * (along_wall / in_glass - normal)
        direction = (along_wall - in_fluid * normal) / n_fluid
        origin, direction = (torch.where(passes, part, torch.nan) for part in (origin, direction))
        return Rays(origin_lab_mm=origin, direction_lab=direction)

    def entry_point(self, x_lab_mm: Tensor, centre_lab_mm: Tensor) -> Tensor:
        """Return where light from points (..., 3) in the liquid to a centre (3,) in air leaves the wall; lab, mm.
        NaN, with gradient 0, for points that are not in the liquid. Source: Snell's law (textbook).
        """
        normal = self.normal_lab.to(x_lab_mm)
        centre = centre_lab_mm.to(x_lab_mm)
        height = centre @ normal - self.air_side_mm.to(x_lab_mm)
        depth = self.offset_mm.to(x_lab_mm) - x_lab_mm @ normal
        inside = depth >= 0
        way = torch.where(inside[..., None], x_lab_mm, centre) - centre
        along_wall = way - (way @ normal)[..., None] * normal
        share = self._share_in_air(along_wall.square().sum(-1), height, torch.where(inside, depth, height))
        point = centre - height * normal + share[..., None] * along_wall
        return torch.where(inside[..., None], point, torch.full_like(point, torch.nan))

    def _share_in_air(self, across2: Tensor, height: Tensor, depth: Tensor) -> Tensor:
        """Return the fraction in air of the light's path along the wall, in (0, 1].
        With s the sine in air the path is height tan + thickness s / sqrt(n_g^2 - s^2) + depth s / sqrt(n_f^2 - s^2).
        Divided by its length it is g(share) = 1 below, free of square roots of the length, so that gradients exist at s
        = 0. g is increasing and concave: Newton converges from below, from the share of steep rays.
        """
        layers = [(self.thickness_mm.to(depth), self.n_glass.to(depth)), (depth, self.n_fluid.to(depth))]

        def newton(share: Tensor) -> Tensor:
            value, slope = share - 1, torch.ones_like(share)
            for thick, n in layers:
                straight2 = (n * height).square()
                root2 = straight2 + (n.square() - 1) * share.square() * across2
                root = root2.sqrt()
                value = value + thick * share / root
                slope = slope + thick * straight2 / (root2 * root)
            return share - value / slope

        with torch.no_grad():
            share = newton(torch.zeros_like(depth))  # steep rays: 1 / (1 + thickness / (n_g H) + depth / (n_f H))
            for _ in range(STEPS):
                share = newton(share)
        # One further step carries the root's first derivative, another the second.
        return newton(newton(share))


@dataclass(frozen=True, kw_only=True, eq=False)
class PortCamera:
    """Any camera model behind a flat wall; R, T and image_size are those of the camera in air.
    `undistort` and `distort` correct the lens, not the refraction, which depends on depth.
    """

    camera: Camera  # in air
    port: Port
    covariance: ParameterCovariance | None = None  # of the parameters of camera and port
    image_size: tuple[int, int] = field(init=False)
    R_cam_lab: Tensor = field(init=False)
    T_cam_lab_mm: Tensor = field(init=False)

    def __post_init__(self) -> None:
        for name in ("image_size", "R_cam_lab", "T_cam_lab_mm"):
            object.__setattr__(self, name, getattr(self.camera, name))
        if self.covariance is None:
            object.__setattr__(self, "covariance", self.camera.covariance)
        normal, wall = self.port.normal_lab.detach(), float(self.port.air_side_mm.detach())
        if isinstance(self.camera, CentralCamera):
            stands = float(self.camera.centre_lab_mm.detach() @ normal)
            if stands <= wall:
                expected = f"a camera before the wall, its centre beyond normal . X = {wall:.6g} mm"
                do = "write the normal towards the camera, and offset and thickness in mm in the lab"
                raise camera_error("port", expected, f"{stands:.6g} mm", do)
        if not bool((self.camera.R_cam_lab[2].detach() @ normal) < 0):
            do = "write the normal towards the camera"
            got = f"normal {[round(part, 6) for part in normal.tolist()]}, away from it"
            raise camera_error("port", "a wall that the camera looks at", got, do)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Undistort pixels (..., 2) of the camera in air."""
        return self.camera.undistort(uv_px)

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) that `undistort` takes to `uv_px`, px."""
        return self.camera.distort(uv_px)

    def across_lab(self, x_lab_mm: Tensor) -> Tensor:
        """Return the direction of the camera in air."""
        return self.camera.across_lab(x_lab_mm)

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the rays in the liquid of pixels (..., 2), from the wall's liquid side; NaN outside the wall."""
        return self.port.refract(self.camera.rays(uv_px))

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project points in the liquid (..., 3), lab, mm, to pixels (..., 2); NaN for points outside the liquid."""
        check_points("x_lab_mm", x_lab_mm, 3)
        if isinstance(self.camera, CentralCamera):
            return self.camera.project(self.port.entry_point(x_lab_mm, self.camera.centre_lab_mm))
        return self.camera.project(self._apparent_point(x_lab_mm))

    def _apparent_point(self, x_lab_mm: Tensor) -> Tensor:
        """Return the points in air with the same image as `x_lab_mm` in the liquid, for cameras without one centre.
        Each iteration shifts the point along the wall by its ray's distance from the target. At most 1 - 1/n of the
        distance is left for steep rays, nothing for parallel rays.
        """
        normal = self.port.normal_lab.to(x_lab_mm)
        inside = (x_lab_mm @ normal <= self.port.offset_mm.to(x_lab_mm))[..., None]
        apparent = x_lab_mm
        missed = torch.zeros_like(x_lab_mm)
        for _ in range(40):  # iterations; one is exact for parallel rays
            ray = self.rays(self.camera.project(apparent))
            to_go = ((x_lab_mm - ray.origin_lab_mm) @ normal) / (ray.direction_lab @ normal)
            missed = x_lab_mm - ray.origin_lab_mm - to_go[..., None] * ray.direction_lab
            apparent = apparent + missed
        close = 1e3 * torch.finfo(missed.dtype).eps * (1 + x_lab_mm.norm(dim=-1, keepdim=True))
        found = missed.norm(dim=-1, keepdim=True) < close
        return torch.where(inside & found, apparent, torch.full_like(apparent, torch.nan))


def in_air(camera: Camera) -> Any:
    """Return the camera model itself, without the wall."""
    return camera.camera if isinstance(camera, PortCamera) else camera
