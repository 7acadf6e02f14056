"""The interface of all cameras (rays, projection, covariance of parameters), and the geometry of rays."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Protocol

import torch
from torch import Tensor

from sphereorient.cameras.checks import camera_error, check_points

PARALLEL = 1e-6  # sine of the angle below which neighbouring lines of sight are parallel
ASYMMETRY = 1e-6  # of the correlation matrix; allows covariances written with seven digits


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Lines of sight of pixels, as half lines in the lab."""

    origin_lab_mm: Tensor  # (..., 3), a point of the ray: the projection centre, or the refracting wall's liquid side
    direction_lab: Tensor  # (..., 3), unit length, away from the camera


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterCovariance:
    """Covariance of the small changes that `with_parameters` applies."""

    names: tuple[str, ...]  # P different names, as in `parameter_names`
    matrix: Tensor  # (P, P) float64, in the products of the parameters' units

    def __post_init__(self) -> None:
        names, matrix = tuple(self.names), torch.as_tensor(self.matrix, dtype=torch.float64).detach()
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "matrix", matrix)
        if not names or len(set(names)) < len(names):
            got, do = ", ".join(names) or "none", "name every parameter once"
            raise camera_error("covariance, parameters", "different names", got, do)
        if matrix.shape != (len(names), len(names)):
            expected, do = f"{len(names)} rows of {len(names)} numbers", "write a row and a column for each parameter"
            raise camera_error("covariance, matrix", expected, f"shape {tuple(matrix.shape)}", do)
        do = "calibrate again, or remove the covariance"
        if not bool(torch.isfinite(matrix).all()) or bool((matrix.diagonal() < 0).any()):
            raise camera_error("covariance, matrix", "finite numbers, none below zero on the diagonal", "others", do)
        sigma = matrix.diagonal().sqrt()
        scale = torch.where(sigma > 0, sigma, torch.ones_like(sigma))  # units differ: check correlations
        correlation = matrix / (scale[:, None] * scale)
        asymmetry = float((correlation - correlation.mT).abs().max())
        if asymmetry > ASYMMETRY:
            got = f"entries that differ by {asymmetry:.2g} of the sigmas' product"
            raise camera_error("covariance, matrix", "a symmetric matrix", got, do)
        smallest = float(torch.linalg.eigvalsh((correlation + correlation.mT) / 2)[0])
        if smallest < -ASYMMETRY * len(matrix):
            got = f"{smallest:.2g} among the correlations' eigenvalues"
            raise camera_error("covariance, matrix", "no negative eigenvalue", got, do)

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each parameter, in its own unit."""
        return dict(zip(self.names, self.matrix.diagonal().sqrt().tolist(), strict=True))

    def of(self, cameras: Iterable[str]) -> "ParameterCovariance | None":
        """Return the block of some of the cameras, for names like cam1.f; None without parameters of them."""
        wanted = set(cameras)
        kept = [k for k, name in enumerate(self.names) if name.rpartition(".")[0] in wanted]
        if not kept:
            return None
        return ParameterCovariance(names=tuple(self.names[k] for k in kept), matrix=self.matrix[kept][:, kept])


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

    def across_lab(self, x_lab_mm: Tensor) -> Tensor:
        """Return the unit direction, (3,) or (..., 3), in which the radius of a sphere at points (..., 3) appears."""

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return pixels (..., 2) without distortion: those of the same object in the same camera without distortion."""

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) whose undistorted ones are `uv_px`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarserCamera:
    """A camera whose pixels are means of `factor` times `factor` pixels of another camera."""

    camera: Camera
    factor: int
    image_size: tuple[int, int] = field(init=False)  # incomplete pixels at the right and below are left out
    R_cam_lab: Tensor = field(init=False)
    T_cam_lab_mm: Tensor = field(init=False)
    covariance: ParameterCovariance | None = field(init=False)  # its parameters are in the pixels of `camera`

    def __post_init__(self) -> None:
        for name in ("R_cam_lab", "T_cam_lab_mm", "covariance"):
            object.__setattr__(self, name, getattr(self.camera, name))
        width, height = self.camera.image_size
        object.__setattr__(self, "image_size", (width // self.factor, height // self.factor))

    def _fine(self, uv_px: Tensor) -> Tensor:
        return (uv_px + 0.5) * self.factor - 0.5

    def _coarse(self, uv_px: Tensor) -> Tensor:
        return (uv_px + 0.5) / self.factor - 0.5

    def project(self, x_lab_mm: Tensor) -> Tensor:
        """Project lab points (..., 3), mm, to pixels (..., 2)."""
        return self._coarse(self.camera.project(x_lab_mm))

    def rays(self, uv_px: Tensor) -> Rays:
        """Return the rays of pixels (..., 2)."""
        return self.camera.rays(self._fine(uv_px))

    def across_lab(self, x_lab_mm: Tensor) -> Tensor:
        """Return the direction of the original camera."""
        return self.camera.across_lab(x_lab_mm)

    def undistort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) of the camera without distortion."""
        return self._coarse(self.camera.undistort(self._fine(uv_px)))

    def distort(self, uv_px: Tensor) -> Tensor:
        """Return the pixels (..., 2) that `undistort` takes to `uv_px`."""
        return self._coarse(self.camera.distort(self._fine(uv_px)))


def triangulate(rays_a: Rays, rays_b: Rays) -> tuple[Tensor, Tensor]:
    """Return the middle (..., 3), lab, mm, of the shortest segment between two rays, and its length (...), mm.
    Both are NaN, with gradient 0, for parallel rays; the rays broadcast. Source: common perpendicular (textbook).
    """
    for name, rays in (("rays_a", rays_a), ("rays_b", rays_b)):
        check_points(f"{name}.origin_lab_mm", rays.origin_lab_mm, 3)
        check_points(f"{name}.direction_lab", rays.direction_lab, 3)
    a, b = rays_a.direction_lab, rays_b.direction_lab
    baseline = rays_b.origin_lab_mm - rays_a.origin_lab_mm
    normal = _cross(a, b)  # its length is the sine of the angle: no cancellation at small angles
    sine2 = normal.square().sum(-1, keepdim=True)
    crossing = sine2 > (16 * torch.finfo(sine2.dtype).eps) ** 2  # below it the sine is rounding only
    sine2 = torch.where(crossing, sine2, torch.ones_like(sine2))
    along_a = (_cross(baseline, b) * normal).sum(-1, keepdim=True) / sine2
    along_b = (_cross(baseline, a) * normal).sum(-1, keepdim=True) / sine2
    point = 0.5 * (rays_a.origin_lab_mm + along_a * a + rays_b.origin_lab_mm + along_b * b)
    gap = ((baseline * normal).sum(-1, keepdim=True) / sine2.sqrt()).abs()
    return torch.where(crossing, point, torch.nan), torch.where(crossing, gap, torch.nan)[..., 0]


def nearest_point(rays: Sequence[Rays]) -> tuple[Tensor, Tensor]:
    """Return the point (..., 3), lab, mm, with the least sum of squared distances from two or more rays, and the
    largest distance (...), mm, between any two of them; for two rays, as `triangulate`. All have one leading shape; NaN
    rays are left out. Both results are NaN, with gradient 0, for parallel rays or fewer than two.
    """
    if len(rays) == 2:
        return triangulate(*rays)
    gaps = torch.stack([triangulate(one, other)[1] for one, other in combinations(rays, 2)])
    crossing = torch.isfinite(gaps)
    gap = torch.where(crossing, gaps, 0.0).amax(0)
    view = torch.eye(3, dtype=gap.dtype, device=gap.device)
    normal, pull = view.new_zeros(*gap.shape, 3, 3), view.new_zeros(*gap.shape, 3)
    for ray in rays:
        there = torch.isfinite(ray.direction_lab + ray.origin_lab_mm).all(-1, keepdim=True)
        origin, direction = (torch.where(there, part, 0.0) for part in (ray.origin_lab_mm, ray.direction_lab))
        across = torch.where(there[..., None], view - direction[..., :, None] * direction[..., None, :], 0.0)
        normal = normal + across
        pull = pull + (across @ origin[..., None])[..., 0]
    known = crossing.any(0)
    point = torch.linalg.solve(torch.where(known[..., None, None], normal, view), pull)
    return torch.where(known[..., None], point, torch.nan), torch.where(known, gap, torch.nan)


def R_cam_view(direction_cam: Tensor) -> Tensor:
    """Return the smallest rotation (..., 3, 3) from the camera's z axis to directions (..., 3), camera frame.
    It takes view to camera components; the last column is the unit direction. NaN, gradient 0, for the backward one.
    Source: docs/errata.md A1 (the paper's R_persp has the axis of OpenGL's camera); Rodrigues, axis z x direction.
    """
    check_points("direction_cam", direction_cam, 3)
    unit = direction_cam / direction_cam.norm(dim=-1, keepdim=True)
    x, y, z = unit.unbind(-1)
    defined = 1 + z > 4 * torch.finfo(z.dtype).eps
    share = 1 / torch.where(defined, 1 + z, torch.ones_like(z))  # (1 - cos) / sin^2: exact also at direction = z
    rows = [1 - x * x * share, -x * y * share, x, -x * y * share, 1 - y * y * share, y, -x, -y, z]
    R = torch.stack(rows, dim=-1).reshape(*x.shape, 3, 3)
    return torch.where(defined[..., None, None], R, torch.full_like(R, torch.nan))


def R_lab_view(camera: Camera, uv_px: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) from view to lab components at pixels (..., 2): z of a view is the line of sight."""
    return camera.R_cam_lab.mT @ R_cam_view(camera.rays(uv_px).direction_lab @ camera.R_cam_lab.mT)


def without_perspective(camera: Camera, uv_px: Tensor, R_lab_body: Tensor) -> Tensor:
    """Return orientations (..., 3, 3) as if the lines of sight at pixels (..., 2) were parallel to the camera's axis.
    Source: the paper, section III, R_persp; its sign by docs/errata.md A1.
    """
    R_cam_lab = camera.R_cam_lab
    to_axis = R_cam_view(camera.rays(uv_px).direction_lab @ R_cam_lab.mT).mT
    return R_cam_lab.mT @ to_axis @ R_cam_lab @ R_lab_body


def centre_lab_mm(camera: Camera) -> Tensor:
    """Return the origin (3,) of the camera's frame, lab, mm: the projection centre of a central camera."""
    return -(camera.R_cam_lab.mT @ camera.T_cam_lab_mm)


def perspective_centre_lab_mm(camera: Camera, position_lab_mm: Tensor) -> Tensor:
    """Return the point (..., 3) in which the lines of sight near positions (..., 3), mm, lab, meet: the projection
    centre, behind a port its image; a point far away if they are parallel.
    """
    X = position_lab_mm.double()
    uv = camera.project(X)
    near = camera.rays(torch.stack([uv, uv + uv.new_tensor([1.0, 0.0]), uv + uv.new_tensor([0.0, 1.0])]))
    origin, direction = near.origin_lab_mm, near.direction_lab
    if torch.equal(origin[0], origin[1]):
        return origin[0]
    aside = _cross(X - origin[1:], direction[1:]).norm(dim=-1).mean(0)  # of X, from lines of the next pixels
    sine = _cross(direction[:1].expand_as(direction[1:]), direction[1:]).norm(dim=-1).mean(0)
    distance: Tensor = aside / sine.maximum(PARALLEL * aside)
    return X - distance[..., None] * direction[0]


def sphere_disk_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return middle (..., 2) and radius (...), px, of a sphere's picture at positions (..., 3), mm, lab.
    The radius is along the camera's x, of a fisheye lens about its axis.
    """
    aside = camera.across_lab(position_lab_mm) * radius_mm
    centre, rim = camera.project(torch.stack([position_lab_mm, position_lab_mm + aside]))
    return centre, (rim - centre).norm(dim=-1)


def sphere_radius_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> Tensor:
    """Return the radius (...), px, of `sphere_disk_px`."""
    return sphere_disk_px(camera, position_lab_mm, radius_mm)[1]


def holds_disk(camera: Camera, centre_px: Tensor, radius_px: Tensor) -> Tensor:
    """Return whether the whole disk lies in the picture, (...) bool, for centres (..., 2) and radii (...), px."""
    low, high = centre_px - radius_px[..., None], centre_px + radius_px[..., None]
    return ((low >= 0) & (high < centre_px.new_tensor(camera.image_size))).all(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    product: Tensor = torch.linalg.cross(*torch.broadcast_tensors(a, b))  # type: ignore[no-untyped-call]
    return product
