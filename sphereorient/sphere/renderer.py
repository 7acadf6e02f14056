import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from sphereorient.cameras import Camera, Rays
from sphereorient.cameras.model import TelecentricCamera
from sphereorient.errors import CameraError, SettingsError, ShapeError, check_tail, refusal, tensor_of
from sphereorient.so3 import check_rotations
from sphereorient.sphere.texture import known_paint, reduced_texture
from sphereorient.sphere.view import paint_seen, smooth_positive, sphere_normals

RIM = 0.02  # rounding of the limb, radii^2: the least depth is 0.1 radii
SHADE = 0.02  # rounding of a lamp's cosine: no kink in the light
RIM_POINTS = 16  # rim points per sphere; between them the picture extends 2 % farther
RIM_MARGIN = 1.04  # for these 2 %, and for the larger visible cap of a near sphere (2 % at five radii)
SAMPLES = 1 << 18  # rays computed at once, to stay in the cache


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereSight:
    """Paint and normals at rays."""

    paint: Tensor  # (..., P), grey of the map; beyond the limb, at the nearest approach
    normal: Tensor  # (..., P, 3), outward unit normals, frame of the rays
    depth2: Tensor  # (..., P), 1 - (distance of the ray from the centre, radii)^2: positive on a hit


def see_sphere(
    rays: Rays, centre: Tensor, R: Tensor, texture: Tensor, radius: float | Tensor = 1.0, *, smooth: bool = False
) -> SphereSight:
    """Return the paint of a map (H, 2 H) at rays (..., P, 3).
    `R` (..., 3, 3) takes body components to the rays' frame; `centre` (..., 3) and `radius`, () or (..., 1), are in its
    unit. `smooth`: twice differentiable (spline, rounded limb); otherwise bilinear and exact.
    """
    check_tail("position_lab_mm", centre, 3)
    check_tail("R_lab_body", R, 3, 3)
    corner = RIM if smooth else 0.0
    normal, depth2 = sphere_normals(rays.origin_lab_mm, rays.direction_lab, centre[..., None, :], radius, corner)
    paint = paint_seen(texture, normal, R, smooth=smooth).to(normal.dtype)
    return SphereSight(paint=paint, normal=normal, depth2=depth2)


def lambert(normal: Tensor, towards: Tensor, strength: Tensor | float, corner: float = 0.0) -> Tensor:
    """Return the light (...) on unit normals (..., 3) of Lambertian lamps in unit directions `towards` (..., K, 3).
    `strength` is (K,) or one number; `corner` rounds the shadow's edge (width in cosine; 0 is exact).
    """
    cosine = normal @ towards.mT
    cosine = smooth_positive(cosine, corner) if corner > 0 else cosine.clamp_min(0)
    light: Tensor = (cosine * strength).sum(-1)
    return light


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """How pixels integrate the sphere's picture."""

    blur_px: float = 0.55  # sigma of the optics; the pixel's box is added
    outside: float = 0.0  # background: 0 as black paint, 1 as white paint
    supersampling: int = 4  # rays per pixel and axis


class SphereRenderer(nn.Module):
    """Render a painted sphere, differentiable in orientation, position, radius and texture.

    Args:
        texture: (H, 2 H), 0 black .. 1 white; NaN: unknown paint, shown as grey. An `nn.Parameter` is trained, anything
            else becomes a buffer.
        radius_mm: sphere radius.
        camera: camera of the picture; None for the orthographic view along z (x right, y down).
        size_px: side of the orthographic picture, filled by a sphere at the origin.
        sampling: blur, background grey, rays per pixel.

    Raises:
        SettingsError: not exactly one of camera and size_px, or a radius that is not positive.
        ShapeError: texture is not (H, 2 H), or not of numbers 0 .. 1.
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
        if size_px is not None and size_px < 1:
            do = "pass the side of the disk in pixels"
            raise SettingsError(refusal("size_px", expected="1 or more", got=f"{size_px:g}", do=do))
        if not radius_mm > 0:
            do = "pass the sphere's radius"
            raise SettingsError(refusal("radius_mm", expected="a number above 0", got=f"{radius_mm:g}", do=do))
        values = known_paint(texture)[0]
        if isinstance(texture, nn.Parameter):  # a new one if unknown paint was replaced
            self.texture = values if values is texture else nn.Parameter(values.detach())
        else:
            self.register_buffer("texture", values)
        self.radius_mm = radius_mm
        self.camera = orthographic_camera(size_px, 2 * radius_mm / size_px) if size_px else cast("Camera", camera)
        self.sampling = sampling or Sampling()

    def forward(self, R_lab_body: Any, position_mm: Any = None, radius_mm: Tensor | None = None) -> Tensor:
        """Return pictures (..., H, W), 0 black paint .. 1 white paint, of spheres with orientation (..., 3, 3).
        `R_lab_body` sets the dtype; without a camera it leads to the view. `position_mm` (..., 3) is the origin if
        None.

        Raises:
            CameraError: sphere not wholly in front of the camera, or not wholly in the liquid.
            ShapeError: orientations that are no rotations, or shapes that do not agree.
        """
        R = tensor_of("R_lab_body", R_lab_body).to(self.texture.device)
        check_rotations("R_lab_body", R)
        # Single precision would move the picture: differences of mm at half a metre.
        exact = R.dtype if isinstance(self.camera, TelecentricCamera) else torch.float64
        position = torch.as_tensor((0.0,) * 3 if position_mm is None else position_mm).to(R.device, exact)
        check_tail("position_mm", position, 3)
        radius = torch.as_tensor(self.radius_mm if radius_mm is None else radius_mm).to(position)
        shape = _common_shape(R, position, radius)
        if position.numel() == 3 and radius.numel() == 1:  # one position: the rays are computed once
            position, radius = position.reshape(1, 3), radius.reshape(1)
        else:
            position, radius = position.expand(*shape, 3).reshape(-1, 3), radius.expand(shape).reshape(-1)
        picture = self._pictures(R.expand(*shape, 3, 3).reshape(-1, 3, 3), position, radius)
        return picture.reshape(*shape, *picture.shape[1:])

    def _pictures(self, R: Tensor, position: Tensor, radius: Tensor) -> Tensor:
        """Render spheres R (K, 3, 3) in windows that fit them, (K, H, W); position and radius have K rows or one."""
        (width, height), sampling = self.camera.image_size, self.sampling
        samples = sampling.supersampling
        middle_px = self.camera.project(position)
        reaches = reach_px(self.camera, position.detach(), float(radius.amax()) if len(radius) else 1.0)
        reach = float(reaches.max()) if len(reaches) else 1.0
        half = math.ceil(reach + 4 * sampling.blur_px) + 1
        size = 2 * half + 1
        # Spheres may leave the picture: the canvas is larger by a window.
        limit = torch.tensor([width, height], device=position.device)
        corner = (middle_px.detach().round().long() - half).clamp_min(-size).minimum(limit)
        fine_px = fine_pixels(size, samples).to(position)
        down, right = torch.meshgrid(fine_px, fine_px, indexing="ij")
        reached = (right - half).square() + (down - half).square() < (reach + 1.5) ** 2
        fine_at = torch.stack([right[reached], down[reached]], dim=-1)
        aperture = aperture_matrix(size, samples, sampling.blur_px).to(R)
        texture = reduced_texture(self.texture.to(R.dtype), samples * 2 * reach / RIM_MARGIN)
        across = torch.arange(size, device=R.device)
        pictures = [R.new_zeros(0, height, width)]
        every = torch.arange(len(R), device=R.device)
        for k in torch.split(every, max(1, SAMPLES // len(fine_at))):
            at = k if len(position) > 1 else every[:1]
            rays = self.camera.rays(fine_at + corner[at, None])
            # A limb one sample wide: the derivative of a step is noisy.
            beside = self.camera.rays(middle_px[at, None].detach() + position.new_tensor([1.0 / samples, 0.0]))
            to_centre = position[at, None] - beside.origin_lab_mm
            fine_mm = torch.linalg.cross(beside.direction_lab, to_centre).norm(dim=-1).detach()
            seen = see_sphere(rays, position[at], R[k].to(position), texture, radius[at, None])
            distance_radii = (1.0 - seen.depth2).clamp_min(1e-12).sqrt()
            share = ((1.0 - distance_radii) * radius[at, None] / fine_mm + 0.5).clamp(0, 1)
            fine = R.new_zeros(len(k), *reached.shape)
            fine[:, reached] = (share * (seen.paint - sampling.outside)).to(R.dtype)
            window = aperture @ fine @ aperture.mT
            if len(position) == 1:  # nothing is scattered
                left, top = corner[0].tolist()
                sides = left, width - left - size, top, height - top - size
                pictures.append(torch.nn.functional.pad(window, sides) + sampling.outside)
                continue
            canvas = R.new_full((len(k), height + 2 * size, width + 2 * size), sampling.outside)
            rows, columns = ((corner[at, axis, None] + size + across).expand(len(k), -1) for axis in (1, 0))
            place = (every[: len(k), None, None], rows[:, :, None], columns[:, None, :])
            canvas = canvas.index_put(place, window, accumulate=True)
            pictures.append(canvas[:, size : size + height, size : size + width])
        return torch.cat(pictures)


def _common_shape(R: Tensor, position: Tensor, radius: Tensor) -> tuple[int, ...]:
    """Return the leading shape of R (..., 3, 3), position (..., 3) and radius (...); raise ShapeError without one."""
    shapes = R.shape[:-2], position.shape[:-1], radius.shape
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError as error:
        got, do = ", ".join(str(tuple(one)) for one in shapes), "pass one position and radius for each, or for all"
        expected = "leading shapes that agree of R_lab_body, position_mm and radius_mm"
        raise ShapeError(refusal("renderer", expected=expected, got=got, do=do)) from error


def orthographic_camera(size_px: int, mm_px: float) -> TelecentricCamera:
    """Return the orthographic camera along lab z: x right, y down, lab origin at the centre of a square picture."""
    return TelecentricCamera(
        image_size=(size_px, size_px),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
        centre_px=torch.full((2,), 0.5 * (size_px - 1), dtype=torch.float64),
        scale_mm_px=torch.tensor(mm_px, dtype=torch.float64),
    )


def fine_pixels(size_px: int, supersampling: int) -> Tensor:
    """Return sample positions along one axis, (size supersampling,) float64, px; integers are pixel centres."""
    return (torch.arange(size_px * supersampling, dtype=torch.float64) + 0.5) / supersampling - 0.5


def aperture_matrix(size_px: int, supersampling: int, sigma_px: float) -> Tensor:
    """Return weights A (S, S supersampling) float64, picture = A fine A^T, for a pixel box and a Gaussian `sigma_px`.
    Source: the convolution is a difference of two normal distribution functions.
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
    """Return unit directions from centres (..., 3) to the rim, (..., count, 3), and the rays' directions (..., 3)."""
    sight = camera.rays(camera.project(position_lab_mm)).direction_lab
    across = torch.linalg.cross(sight, camera.across_lab(position_lab_mm).to(sight).expand_as(sight))
    across = across / across.norm(dim=-1, keepdim=True)
    angle = torch.arange(count, dtype=sight.dtype, device=sight.device) * (2 * math.pi / count)
    second = torch.linalg.cross(sight, across)
    return angle.cos()[:, None] * across[..., None, :] + angle.sin()[:, None] * second[..., None, :], sight


def reach_px(camera: Camera, position_lab_mm: Tensor, radius_mm: Tensor | float) -> Tensor:
    """Return the largest distances (...) from projected centres to rims, px, plus 4 %, for centres (..., 3), mm, lab.
    `radius_mm` is one number or (...).

    Raises:
        CameraError: sphere not wholly in front of the camera, or not wholly in the liquid.
    """
    rim, sight = rim_directions(camera, position_lab_mm, RIM_POINTS)
    # The point nearest to the camera, not on the rim, must be in the liquid too.
    offset_mm = torch.as_tensor(radius_mm)[..., None, None] * torch.cat(
        [RIM_MARGIN * rim, -sight[..., None, :]], dim=-2
    )
    rim_px = camera.project(position_lab_mm[..., None, :] + offset_mm)
    reach: Tensor = (rim_px - camera.project(position_lab_mm)[..., None, :]).norm(dim=-1).amax(-1)
    if bool(reach.isnan().any()):
        do = "move it away from the camera or the wall"
        raise CameraError(refusal("position_lab_mm", expected="a wholly visible ball", got="another", do=do))
    return reach


@dataclass(frozen=True, kw_only=True, eq=False)
class PaintedBall:
    """Sphere with paint and light for `expected_grey`; of one dtype, gradients allowed."""

    texture: Tensor  # (H, 2 H), 0 black paint .. 1 white paint
    radius_mm: float
    edge_mm: float  # sigma of the blur by optics and pixel, at the sphere
    ambient: Tensor  # (), ambient light
    lamps_lab: Tensor  # (K, 3), towards each lamp; the length is its brightness (Lambert)
    black: Tensor  # (), grey level of black paint in light 1
    white: Tensor  # (), grey level of white paint in light 1
    behind: Tensor  # () or the pixels' shape, background grey level


def expected_grey(rays: Rays, position_lab_mm: Tensor, R_lab_body: Tensor, ball: PaintedBall) -> Tensor:
    """Return grey levels (..., P) of rays (..., P, 3), twice differentiable in cameras, pose, paint and light.
    `position_lab_mm` is (..., 3), `R_lab_body` (..., 3, 3). Optically simpler than `SphereRenderer`: one ray per pixel.
    """
    seen = see_sphere(rays, position_lab_mm, R_lab_body, ball.texture, ball.radius_mm, smooth=True)
    # 0.5 depth2 is the distance from the limb, radii, near the limb; it has no kink at the centre.
    coverage = torch.special.ndtr(0.5 * seen.depth2 * (ball.radius_mm / ball.edge_mm))
    strength = ball.lamps_lab.norm(dim=-1)
    light = ball.ambient + lambert(seen.normal, ball.lamps_lab / strength[:, None], strength, SHADE)
    grey = (ball.black + (ball.white - ball.black) * seen.paint) * light
    seen_grey: Tensor = coverage * grey + (1.0 - coverage) * ball.behind
    return seen_grey
