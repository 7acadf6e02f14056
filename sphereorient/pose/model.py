"""The measuring model: the painted sphere in the pixels of a camera, blurred, and its derivatives by the pose."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sphereorient.pose.light import LATER, Light, Shading
from sphereorient.pose.pixels import Pixels
from sphereorient.so3.linalg import cross_first_axis
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.sphere.view import nearest_approach

SPREAD_MIN = 0.02  # least share of the blur's variance left inside the limb: keeps the look-up off the limb itself
RIM_NODES = 4  # look-ups along the radius near the limb, where the paint is compressed
DEPTH_MIN = 0.03  # least depth of a look-up below the limb, radii: the slope of the paint is infinite on the limb


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereModel:
    """What a picture of the sphere depends on, its pose aside."""

    radius_mm: float
    paint: TextureTable  # blurred by `blur_px` as seen at the disk's middle
    blur_px: float  # standard deviation of optics, pixel and whatever was laid over the frame, px
    light: Light  # of the C cameras
    shading: Shading = LATER  # how far a frame's light may differ from it


@dataclass(frozen=True, kw_only=True, eq=False)
class SphereView:
    """The sphere in the pixels of L disks at one pose each; made by `sphere_view`."""

    paint: Tensor  # (L, P), blurred paint seen, 0 .. 1
    coverage: Tensor  # (L, P), share of the pixel's blurred aperture that the sphere fills
    across: Tensor  # (L, 2, P), place on the disk along the camera's x and y, radii
    paint_by_rotation: Tensor  # (L, 3, P), derivative by delta in exp([delta]x) R, 1/rad
    paint_by_position: Tensor  # (L, 3, P), derivative by the centre, lab, 1/mm
    coverage_by_position: Tensor  # (L, 3, P), 1/mm


def sphere_view(pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, model: SphereModel) -> SphereView:
    """Render the sphere at position_lab_mm (L, 3) and R_lab_body (L, 3, 3) through pixels with a Gaussian aperture.
    Two look-ups per pixel, four near the limb, reproduce mean and width of the Gaussian cut off at the limb, as the
    curvature stretches it over the paint. Derivatives hold their spread fixed. The model's light is not used.
    Source: docs/errata.md A4 (the cap and the ellipse that a perspective camera sees); mean and variance of a cut-off
    Gaussian, Johnson, Kotz and Balakrishnan 1994, section 13.10.
    """
    radius_mm, blur_px = model.radius_mm, model.blur_px
    d = pixels.direction
    R = R_lab_body.to(d.dtype)
    # In double precision, once: half a metre less half a metre.
    to_centre = (position_lab_mm[:, :, None] - pixels.origin.double()).to(d.dtype)
    aside = nearest_approach(to_centre, d, 1)
    nearest = (aside * aside).sum(1).sqrt().clamp_min(1e-6 * radius_mm)
    outward = aside / nearest[:, None]  # unit, from the centre to the line of sight
    q0 = nearest / radius_mm
    distance = to_centre[..., 0].norm(dim=1, keepdim=True)
    blur = blur_px * (pixels.pitch_mm[:, None] + pixels.pitch_rad[:, None] * distance) / radius_mm
    # Half of an aperture on the limb of a disk lies within blur^2 / 2 less than within a straight edge.
    edge = (1.0 - 0.5 * blur * blur - q0) / blur
    coverage = torch.special.ndtr(edge)
    density = torch.exp(-0.5 * edge * edge) * (1.0 / math.sqrt(2.0 * math.pi))
    pull = density / coverage.clamp_min(1e-4)
    q = (q0 - blur * pull).clamp(0.0, 1.0)
    inner = pixels.inner
    variance = (1.0 - pull * (edge + pull)).clamp(SPREAD_MIN, 1.0)[:, :inner]
    spread = blur * variance.sqrt() * q[:, :inner]
    at = torch.stack([q[:, :inner] - spread, q[:, :inner] + spread], dim=1)
    middle = _LineOfSight(d[..., :inner], outward[..., :inner], nearest[:, :inner])
    parts = [_sample(at, variance[:, None], middle, R, model)]
    if inner < d.shape[-1]:
        outer = slice(inner, None)
        at, moves = _rim_nodes(q0[:, outer], blur, coverage[:, outer], density[:, outer], q[:, outer])
        rim = _LineOfSight(d[..., outer], outward[..., outer], nearest[:, outer])
        parts.append(_sample(at, moves, rim, R, model))
    body, turn, shift = (torch.cat(pieces, dim=-1) for pieces in zip(*parts, strict=True))
    return SphereView(
        paint=body,
        coverage=coverage,
        across=q[:, None] * (pixels.axes @ outward),
        paint_by_rotation=turn,
        paint_by_position=shift,
        coverage_by_position=(density / (blur * radius_mm))[:, None] * outward,
    )


def _rim_nodes(q0: Tensor, blur: Tensor, coverage: Tensor, density: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Return look-ups near the limb, quantiles of the cut-off Gaussian, and their derivatives, (L, n, P) each."""
    share = ((torch.arange(RIM_NODES, dtype=q0.dtype, device=q0.device) + 0.5) / RIM_NODES)[:, None]
    z = torch.special.ndtri((share * coverage[:, None]).clamp(1e-6, 1 - 1e-6))
    # The limb holds a node back the more, the nearer it is.
    moves = 1.0 - share * density[:, None] / (torch.exp(-0.5 * z * z) * (1.0 / math.sqrt(2.0 * math.pi)))
    middle = middle[:, None]
    return middle + middle * (q0[:, None] + blur[:, None] * z - middle), moves.clamp(0.0, 1.0)


class _LineOfSight(NamedTuple):
    direction: Tensor  # (L, 3, P), unit
    outward: Tensor  # (L, 3, P), unit, from the centre to the line
    nearest: Tensor  # (L, P), distance of the centre from the line, mm


def _sample(
    at: Tensor, moves: Tensor, line: _LineOfSight, R: Tensor, model: SphereModel
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean paint of look-ups (L, P) and derivatives (L, 3, P); `at` in radii, `moves` per pixel moved."""
    d, outward, nearest = line
    # In body components, as the texture: the derivatives are rotated back once, at the end.
    sight_b, outward_b = (R.mT @ d)[:, :, None], (R.mT @ outward)[:, :, None]
    qt = at.clamp(0.0, math.sqrt(1.0 - DEPTH_MIN**2))
    depth = (1.0 - qt * qt).sqrt()
    normal_b = qt[:, None] * outward_b - depth[:, None] * sight_b
    value, slope = model.paint.sample(normal_b.flatten(2))
    value, slope = value.reshape(qt.shape), slope.reshape(normal_b.shape)
    # Moving the centre along -outward lets the look-up slide outwards over the sphere.
    slide = (slope * outward_b).sum(1) + qt / depth * (slope * sight_b).sum(1)
    radial = (moves * slide).mean(1)
    flat_b = (qt[:, None] * slope).mean(2)
    by_sight, by_outward = (flat_b * sight_b[:, :, 0]).sum(1), (flat_b * outward_b[:, :, 0]).sum(1)
    # Across the radius a look-up stays at its share of it, q / q0.
    flat = R @ flat_b - by_sight[:, None] * d - by_outward[:, None] * outward
    shift = flat * (-1.0 / nearest)[:, None] - (radial / model.radius_mm)[:, None] * outward
    return value.mean(1), R @ cross_first_axis(slope, normal_b).mean(2), shift
