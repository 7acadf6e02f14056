"""Clean pictures for measuring estimators: exact perspective, even light, no rounding, nothing but white noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, PinholeCamera, Rays
from sphereorient.errors import CameraError, refusal
from sphereorient.sphere import reduced_texture, sample_texture, sphere_normals
from sphereorient.synth.aperture import aperture_matrix, fine_places
from sphereorient.synth.window import reach_px

SUPERSAMPLING = 4  # rays per pixel and axis: with soft borders, the picture is right to a hundredth of the step
RENDERED_AT_ONCE = 2  # more leave the cache
LOOK = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))  # R_cam_lab: along lab +y, lab z up


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanOptics:
    """Light, blur and noise of clean pictures; the same as the Cramér-Rao bound is computed for."""

    black: float = 40.0  # grey level of black paint, and of what lies behind the ball
    white: float = 200.0  # grey level of white paint
    noise_share: float = 0.05  # standard deviation of a pixel's noise over white - black
    sigma_px: float = 0.55  # of the optics' Gaussian; the pixel's square comes on top


@dataclass(frozen=True, kw_only=True, eq=False)
class CleanSet:
    """N pictures of a ball at random places in random attitudes, with the truth; made by `clean_set`."""

    pictures: Tensor  # (N, H, W) float32, grey levels, not rounded
    camera: Camera
    optics: CleanOptics
    diameter_mm: float
    diameter_px: float  # of the ball's picture on the axis
    R_lab_body: Tensor  # (N, 3, 3) float64
    position_lab_mm: Tensor  # (N, 3) float64, of the ball's centre


def clean_set(
    texture: Tensor,
    count: int,
    *,
    seed: int,
    diameter_px: float = 80.0,
    diameter_mm: float = 18.0,
    distance_mm: float = 260.0,
    optics: CleanOptics | None = None,
) -> CleanSet:
    """Draw places and attitudes and render them.

    Args:
        texture: (H, 2 H), the map, 0 black .. 1 white.
        count: N.
        seed: same seed, same pictures.
        diameter_px: of the ball on the axis; the picture is four times as wide and the ball wholly inside.
        diameter_mm: of the ball.
        distance_mm: of the camera from the plane in which the ball's centre lies; near, so that perspective counts.
        optics: light, blur and noise.
    """
    optics = optics or CleanOptics()
    rng = torch.Generator().manual_seed(seed)
    side = 4 * math.ceil(diameter_px)
    f_px = diameter_px / diameter_mm * distance_mm
    camera = PinholeCamera(
        image_size=(side, side),
        R_cam_lab=torch.tensor(LOOK, dtype=torch.float64),
        T_cam_lab_mm=torch.tensor([0.0, 0.0, distance_mm], dtype=torch.float64),
        centre_px=torch.full((2,), 0.5 * (side - 1), dtype=torch.float64),
        f_px=torch.tensor(f_px, dtype=torch.float64),
    )
    # Off the axis the picture is a little longer than the diameter, and the blur needs room.
    reach_mm = (0.5 * side - 0.55 * diameter_px - 5 - 4 * optics.sigma_px) / f_px * distance_mm
    aside = reach_mm * (2 * torch.rand(count, 2, generator=rng, dtype=torch.float64) - 1)
    position = torch.stack([aside[:, 0], torch.zeros(count, dtype=torch.float64), aside[:, 1]], dim=-1)
    R = so3.random_rotations(count, generator=rng)
    clean = render_clean(texture, camera, position, R, diameter_mm=diameter_mm, optics=optics)
    sigma = optics.noise_share * (optics.white - optics.black)
    return CleanSet(
        pictures=clean + sigma * torch.randn(clean.shape, generator=rng),
        camera=camera,
        optics=optics,
        diameter_mm=diameter_mm,
        diameter_px=diameter_px,
        R_lab_body=R,
        position_lab_mm=position,
    )


def render_clean(
    texture: Tensor,
    camera: Camera,
    position_lab_mm: Tensor,
    R_lab_body: Tensor,
    *,
    diameter_mm: float,
    optics: CleanOptics,
    supersampling: int = SUPERSAMPLING,
) -> Tensor:
    """Render pictures without noise.

    Args:
        texture: (H, 2 H), the map, 0 black .. 1 white.
        camera: any model; its rays make the perspective and the distortion.
        position_lab_mm: (N, 3) float64, centres of the ball.
        R_lab_body: (N, 3, 3) float64.
        diameter_mm: of the ball.
        optics: light and blur.
        supersampling: rays per pixel and axis.

    Returns:
        (N, H, W) float32, grey levels.

    Raises:
        CameraError: a ball that is not wholly inside the picture, or not wholly before the camera or in the liquid.
    """
    width, height = camera.image_size
    middle_px = camera.project(position_lab_mm)
    reach = reach_px(camera, position_lab_mm, diameter_mm / 2)
    half = math.ceil(reach + 4 * optics.sigma_px) + 1
    size = 2 * half + 1
    corner = middle_px.round().long() - half  # (N, 2) as (left, top)
    if not ((corner >= 0) & (corner <= torch.tensor([width, height]) - size)).all():
        do = "move it towards the middle"
        raise CameraError(refusal("position_lab_mm", expected="a ball inside the picture", got="one beyond", do=do))
    at = fine_places(size, supersampling)
    down, right = torch.meshgrid(at, at, indexing="ij")
    reached = (right - half).square() + (down - half).square() < (reach + 1.5) ** 2
    place = torch.stack([right[reached], down[reached]], dim=-1)
    aperture = aperture_matrix(size, supersampling, optics.sigma_px)
    texture = reduced_texture(texture, supersampling * 2 * reach).double()
    pictures = torch.full((len(middle_px), height, width), optics.black, dtype=torch.float32)
    for rows in torch.split(torch.arange(len(middle_px)), RENDERED_AT_ONCE):
        fine = torch.zeros(len(rows), *reached.shape, dtype=torch.float64)
        fine[:, reached] = _fine_picture(
            texture,
            camera,
            place + corner[rows, None],
            position_lab_mm[rows],
            R_lab_body[rows],
            diameter_mm / 2,
            supersampling,
        )
        windows = (aperture @ fine @ aperture.mT * (optics.white - optics.black)).float()
        for k, window in zip(rows.tolist(), windows, strict=True):
            left, top = corner[k].tolist()
            pictures[k, top : top + size, left : left + size] += window
    return pictures


def _fine_picture(
    texture: Tensor,
    camera: Camera,
    uv_px: Tensor,
    position_lab_mm: Tensor,
    R_lab_body: Tensor,
    radius_mm: float,
    supersampling: int,
) -> Tensor:
    """Paint that rays (K, P) see, times the share of the ray that the ball fills."""
    rays = camera.rays(uv_px)
    centre = position_lab_mm[:, None]
    normal, _ = sphere_normals(rays.origin_lab_mm, rays.direction_lab, centre, radius_mm)
    # The limb as wide as a fine sample: a step would be right to a 32nd of a pixel only.
    middle_px = camera.project(position_lab_mm)[:, None]
    beside = camera.rays(middle_px + uv_px.new_tensor([1.0 / supersampling, 0.0]))
    fine_mm = _passes_mm(beside, centre)
    share = ((radius_mm - _passes_mm(rays, centre)) / fine_mm + 0.5).clamp(0, 1)
    seen: Tensor = share * sample_texture(texture, normal @ R_lab_body)
    return seen


def _passes_mm(rays: Rays, centre_lab_mm: Tensor) -> Tensor:
    """Return by how much rays (K, P) pass centres (K, 1, 3), mm."""
    to_centre = centre_lab_mm - rays.origin_lab_mm
    aside_mm: Tensor = torch.linalg.cross(rays.direction_lab, to_centre).norm(dim=-1)
    return aside_mm
