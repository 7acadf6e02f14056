"""The renderer of the painted sphere: lines of sight to paint and coverage, pixels, light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from sphereorient.cameras import Camera, Rays
from sphereorient.cameras.telecentric import TelecentricCamera
from sphereorient.errors import CameraError, SettingsError, check_tail, refusal
from sphereorient.sphere.texture import check_texture_shape, reduced_texture, sample_spline, sample_texture
from sphereorient.sphere.view import smooth_positive, sphere_normals

RIM = 0.02  # rounding of the limb in smooth pictures, radii^2: the least depth of a look-up is 0.1 radii
SHADE = 0.02  # rounding of a lamp's cosine in smooth pictures: the light does not end at a kink
RIM_POINTS = 16  # that show how far a sphere's picture reaches; between two of them it reaches 2 % further
RIM_MARGIN = 1.04  # for that, and for the cap that a near camera sees larger (2 % at five radii)
SAMPLES = 1 << 18  # lines of sight computed at once: more leave the cache


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereSight:
    """What lines of sight see of a sphere; made by `see_sphere`."""

    paint: Tensor  # (..., P), grey of the map; beyond the limb, that of the nearest approach
    normal: Tensor  # (..., P, 3), outward unit normals, frame of the lines
    depth2: Tensor  # (..., P), 1 - (distance of the line from the centre, radii)^2: above 0 where it hits

    @property
    def distance_radii(self) -> Tensor:
        """(..., P), distance of the lines from the centre."""
        return (1.0 - self.depth2).clamp_min(1e-12).sqrt()


def see_sphere(
    rays: Rays, centre: Tensor, R: Tensor, texture: Tensor, radius: float | Tensor = 1.0, *, smooth: bool = False
) -> SphereSight:
    """Look up the paint that lines of sight see; every picture of a sphere is made from this.

    Args:
        rays: lines of sight of P pixels, (..., P, 3), in any frame and unit.
        centre: (..., 3), of the sphere, same frame and unit.
        R: (..., 3, 3), body to that frame.
        texture: (H, 2 H), looked up in its own dtype.
        radius: () or (..., 1), same unit.
        smooth: twice differentiable: a spline for the map, the limb rounded. Else bilinear and exact.
    """
    check_tail("position_lab_mm", centre, 3)
    check_tail("R_lab_body", R, 3, 3)
    corner = RIM if smooth else 0.0
    normal, depth2 = sphere_normals(rays.origin_lab_mm, rays.direction_lab, centre[..., None, :], radius, corner)
    # Rows: n @ R is R^T n, the normal in body components.
    paint = (sample_spline if smooth else sample_texture)(texture, (normal @ R).to(texture.dtype))
    return SphereSight(paint=paint.to(normal.dtype), normal=normal, depth2=depth2)


def lambert(normal: Tensor, towards: Tensor, strength: Tensor | float, corner: float = 0.0) -> Tensor:
    """Return the light (...) of lamps on matt surfaces.

    Args:
        normal: (..., 3), unit normals.
        towards: (..., K, 3), unit directions to the lamps, same frame.
        strength: of each lamp, (K,) or one number.
        corner: width over which the shadow's edge is rounded, cosine.
    """
    cosine = normal @ towards.mT
    cosine = smooth_positive(cosine, corner) if corner > 0 else cosine.clamp_min(0)
    light: Tensor = (cosine * strength).sum(-1)
    return light


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How pixels integrate what lines of sight see."""

    blur_px: float = 0.55  # standard deviation of the optics' Gaussian; the pixel's square comes on top
    outside: float = 0.0  # grey beside the sphere: 0 as black paint, 1 as white paint
    supersampling: int = 4  # lines of sight per pixel and axis


class SphereRenderer(nn.Module):
    """Pictures of a painted sphere, differentiable in orientation, position, radius and texture.

    Args:
        texture: (H, 2 H), 0 black .. 1 white; an `nn.Parameter` stays one, anything else becomes a buffer.
        radius_mm: of the sphere.
        camera: whose full picture is rendered; None for the orthographic view along z (x right, y down).
        size_px: side of the orthographic picture, which a sphere at the origin fills; see `orthographic_camera`.
        sampling: blur, background, lines of sight per pixel.

    Raises:
        SettingsError: both a camera and a size, or neither; a radius that is not positive.
        ShapeError: a texture that is not (H, 2 H).
    """

    texture: Tensor

    def __init__(
        self,
        texture: Any,
        *,
        radius_mm: float = 1.0,
        camera: Camera | None = None,
        size_px: int | None = None,
        sampling: Sampling | None = None,
    ) -> None:
        super().__init__()
        if (camera is None) == (size_px is None):
            got, do = "both" if camera else "neither", "choose a camera's picture or the size of a disk"
            raise SettingsError(refusal("renderer", expected="camera or size_px", got=got, do=do))
        if not radius_mm > 0:
            do = "pass the sphere's radius"
            raise SettingsError(refusal("radius_mm", expected="a number above 0", got=f"{radius_mm:g}", do=do))
        if isinstance(texture, nn.Parameter):
            self.texture = texture
        else:
            self.register_buffer("texture", torch.as_tensor(texture))
        check_texture_shape(self.texture)
        self.radius_mm = radius_mm
        self.camera = orthographic_camera(size_px, 2 * radius_mm / size_px) if size_px else cast("Camera", camera)
        self.sampling = sampling or Sampling()

    def forward(self, R_lab_body: Any, position_mm: Any = None, radius_mm: Tensor | None = None) -> Tensor:
        """Render.

        Args:
            R_lab_body: (..., 3, 3), body to lab, or to the view without a camera.
            position_mm: (..., 3), centre of the sphere; None for the origin.
            radius_mm: (...), instead of the renderer's own.

        Returns:
            (..., H, W) in the dtype of R_lab_body, 0 black paint .. 1 white paint.

        Raises:
            CameraError: a sphere that is not wholly before the camera, or not wholly in the liquid.
        """
        R = torch.as_tensor(R_lab_body, device=self.texture.device)
        check_tail("R_lab_body", R, 3, 3)
        # A few mm less half a metre: single precision would move the picture.
        exact = R.dtype if isinstance(self.camera, TelecentricCamera) else torch.float64
        position = torch.as_tensor((0.0,) * 3 if position_mm is None else position_mm).to(R.device, exact)
        check_tail("position_mm", position, 3)
        radius = torch.as_tensor(self.radius_mm if radius_mm is None else radius_mm).to(position)
        shape = np.broadcast_shapes(R.shape[:-2], position.shape[:-1], radius.shape)
        flat = (R.expand(*shape, 3, 3), position.expand(*shape, 3), radius.expand(shape))
        picture = self._pictures(*(x.reshape(-1, *x.shape[len(shape) :]) for x in flat))
        return picture.reshape(*shape, *picture.shape[1:])

    def _pictures(self, R: Tensor, position: Tensor, radius: Tensor) -> Tensor:
        """Render K spheres, each in a window that its picture just fills, (K, H, W)."""
        (width, height), sampling = self.camera.image_size, self.sampling
        samples = sampling.supersampling
        middle_px = self.camera.project(position)  # (K, 2)
        reach = reach_px(self.camera, position.detach(), float(radius.amax()) if len(radius) else 1.0)
        half = math.ceil(reach + 4 * sampling.blur_px) + 1
        size = 2 * half + 1
        # Spheres may leave the picture: beyond its edges there is room for a window.
        limit = torch.tensor([width, height], device=position.device)
        corner = (middle_px.detach().round().long() - half).clamp_min(-size).minimum(limit)
        fine_px = fine_pixels(size, samples).to(position)
        down, right = torch.meshgrid(fine_px, fine_px, indexing="ij")
        reached = (right - half).square() + (down - half).square() < (reach + 1.5) ** 2
        place = torch.stack([right[reached], down[reached]], dim=-1)
        aperture = aperture_matrix(size, samples, sampling.blur_px).to(R)
        texture = reduced_texture(self.texture.to(R.dtype), samples * 2 * reach / RIM_MARGIN)
        windows = [R.new_zeros(0, size, size)]
        for k in torch.split(torch.arange(len(R), device=R.device), max(1, SAMPLES // len(place))):
            rays = self.camera.rays(place + corner[k, None])
            # The limb as wide as a fine sample: a step would count samples, and its derivative be noise.
            beside = self.camera.rays(middle_px[k, None].detach() + position.new_tensor([1.0 / samples, 0.0]))
            to_centre = position[k, None] - beside.origin_lab_mm
            fine_mm = torch.linalg.cross(beside.direction_lab, to_centre).norm(dim=-1).detach()
            seen = see_sphere(rays, position[k], R[k].to(position), texture, radius[k, None])
            share = ((1.0 - seen.distance_radii) * radius[k, None] / fine_mm + 0.5).clamp(0, 1)
            fine = R.new_zeros(len(k), *reached.shape)
            fine[:, reached] = (share * (seen.paint - sampling.outside)).to(R.dtype)
            windows.append(aperture @ fine @ aperture.mT)
        canvas = R.new_full((len(R), height + 2 * size, width + 2 * size), sampling.outside)
        across = torch.arange(size, device=R.device)
        rows, columns = (corner[:, axis, None] + size + across for axis in (1, 0))
        at = (torch.arange(len(R), device=R.device)[:, None, None], rows[:, :, None], columns[:, None, :])
        canvas = canvas.index_put(at, torch.cat(windows), accumulate=True)
        return canvas[:, size : size + height, size : size + width]


def orthographic_camera(size_px: int, mm_px: float) -> TelecentricCamera:
    """Return the orthographic view along lab z: x right, y down, the lab's origin in the middle of a square."""
    return TelecentricCamera(
        image_size=(size_px, size_px),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
        centre_px=torch.full((2,), 0.5 * (size_px - 1), dtype=torch.float64),
        scale_mm_px=torch.tensor(mm_px, dtype=torch.float64),
    )


def fine_pixels(size_px: int, supersampling: int) -> Tensor:
    """Return the middles of the fine samples along one axis, (size supersampling,) float64, px.

    Whole numbers are pixel centres: the first pixel spans -0.5 .. 0.5.
    """
    return (torch.arange(size_px * supersampling, dtype=torch.float64) + 0.5) / supersampling - 0.5


def aperture_matrix(size_px: int, supersampling: int, sigma_px: float) -> Tensor:
    """Return the exact weights of fine samples in pixels, (S, S supersampling) float64; picture = A fine A^T.

    Args:
        size_px: S, side of the picture.
        supersampling: fine samples per pixel and axis.
        sigma_px: standard deviation of the optics' Gaussian; 0 leaves the pixel's own square.

    Source: a box of one pixel convolved with a Gaussian is the difference of two normal distribution functions.
    """
    offset = fine_pixels(size_px, supersampling) - torch.arange(size_px, dtype=torch.float64)[:, None]
    if sigma_px > 0:
        ndtr = torch.special.ndtr
        weight = ndtr((offset + 0.5) / sigma_px) - ndtr((offset - 0.5) / sigma_px)
    else:
        weight = (offset.abs() < 0.5).double()
    rows: Tensor = weight / supersampling
    return rows


def rim_directions(camera: Camera, position_lab_mm: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return unit directions from centres (..., 3) to their rims, (..., count, 3), and the lines of sight (..., 3)."""
    sight = camera.rays(camera.project(position_lab_mm)).direction_lab
    across = torch.linalg.cross(sight, camera.R_cam_lab[0].to(sight).expand_as(sight))
    across = across / across.norm(dim=-1, keepdim=True)
    angle = torch.arange(count, dtype=sight.dtype, device=sight.device) * (2 * math.pi / count)
    second = torch.linalg.cross(sight, across)
    return angle.cos()[:, None] * across[..., None, :] + angle.sin()[:, None] * second[..., None, :], sight


def reach_px(camera: Camera, position_lab_mm: Tensor, radius_mm: float) -> float:
    """Return the greatest distance of spheres' rims from the pictures of their centres, px, 4 % for safety.

    Args:
        camera: any model, also behind a port.
        position_lab_mm: (N, 3), centres.
        radius_mm: of the spheres.

    Raises:
        CameraError: a sphere that is not wholly before the camera, or not wholly in the liquid.
    """
    if len(position_lab_mm) == 0:
        return 1.0
    rim, sight = rim_directions(camera, position_lab_mm, RIM_POINTS)
    # The point nearest to the camera is not on the rim, but it too must be in the liquid.
    offset_mm = radius_mm * torch.cat([RIM_MARGIN * rim, -sight[:, None]], dim=1)
    rim_px = camera.project(position_lab_mm[:, None] + offset_mm)
    reach = float((rim_px - camera.project(position_lab_mm)[:, None]).norm(dim=-1).max())
    if math.isnan(reach):
        do = "move it away from the camera or the wall"
        raise CameraError(refusal("position_lab_mm", expected="a ball that is seen whole", got="another", do=do))
    return reach


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintedBall:
    """A ball, its paint and its light for `expected_grey`. One dtype; every tensor may require gradients."""

    texture: Tensor  # (H, 2 H), 0 black paint .. 1 white paint
    radius_mm: float
    edge_mm: float  # standard deviation of the optics' and the pixel's blur at the ball
    ambient: Tensor  # (), light from everywhere
    lamps_lab: Tensor  # (K, 3), towards each lamp, as long as it is bright (Lambert)
    black: Tensor  # (), grey level of black paint in light 1
    white: Tensor  # (), grey level of white paint in light 1
    behind: Tensor  # () or of the pixels' shape, grey level without the ball


def expected_grey(rays: Rays, position_lab_mm: Tensor, R_lab_body: Tensor, ball: PaintedBall) -> Tensor:
    """Return the grey levels of pixels, twice differentiable in cameras, pose, paint and light, limb included.

    Slower and simpler in its optics than `SphereRenderer`: one line of sight a pixel, the blur in the coverage alone.

    Args:
        rays: lines of sight of P pixels, (..., P, 3), of any camera; its parameters receive gradients through them.
        position_lab_mm: (..., 3), centre of the ball.
        R_lab_body: (..., 3, 3).
        ball: paint and light.

    Returns:
        (..., P): shaded paint times the share of the pixel that the ball fills, and the background for the rest.
    """
    seen = see_sphere(rays, position_lab_mm, R_lab_body, ball.texture, ball.radius_mm, smooth=True)
    # Half of depth2 is the distance from the limb, in radii, near the limb; and it has no kink in the middle.
    coverage = torch.special.ndtr(0.5 * seen.depth2 * (ball.radius_mm / ball.edge_mm))
    strength = ball.lamps_lab.norm(dim=-1)
    light = ball.ambient + lambert(seen.normal, ball.lamps_lab / strength[:, None], strength, SHADE)
    grey = (ball.black + (ball.white - ball.black) * seen.paint) * light
    seen_grey: Tensor = coverage * grey + (1.0 - coverage) * ball.behind
    return seen_grey
