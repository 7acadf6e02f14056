"""The painted sphere in the pixels of a camera, blurred, with its derivatives by the pose."""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.model import UNSEEN, SphereModel, SphereView
from sphereorient.pose.pixels import Pixels
from sphereorient.so3 import cross_first_axis
from sphereorient.sphere.view import nearest_approach

SPREAD_MIN = 0.02  # least share of the blur's variance inside the limb: keeps the look-up away from the limb
RIM_NODES = 6  # look-ups along the radius near the limb, where the paint is compressed
DEPTH_MIN = 0.03  # least depth of a look-up below the limb, radii: the slope of the paint is infinite on the limb
COVER_MIN = 1e-4  # of a pixel, so that paint is defined beyond the limb


def sphere_view(pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, model: SphereModel) -> SphereView:
    """Render the sphere at position_lab_mm (L, 3) and R_lab_body (L, 3, 3) through pixels with a Gaussian aperture.
    If it moves during the exposure: the mean of `pixels.instants` instants, with the given pose in the middle.
    """
    X, R = position_lab_mm, R_lab_body
    if pixels.instants == 1:
        return _view_at(pixels, X, R, model)
    instants, shares = exposure_instants(pixels.instants)
    turn, move = pixels.moved[:, :3], pixels.moved[:, 3:]
    return _mean_view([_view_at(pixels, X + at * move, so3.exp(at * turn) @ R, model) for at in instants], shares)


@cache
def exposure_instants(instants: int) -> tuple[list[float], list[float]]:
    """Return instants from -1/2 to 1/2 of the exposure, and their weights: Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(instants)
    return (nodes / 2).tolist(), (weights / 2).tolist()


def _mean_view(views: Sequence[SphereView], shares: Sequence[float]) -> SphereView:
    """Return the weighted mean of views over the exposure; paint is weighted by coverage as well."""

    def mean(parts: Sequence[Tensor]) -> Tensor:
        total = parts[0] * shares[0]
        for part, share in zip(parts[1:], shares[1:], strict=True):
            total = total + part * share
        return total

    coverage = mean([view.coverage for view in views])
    counts = [view.coverage + COVER_MIN for view in views]
    whole = mean(counts)
    masks = [view.known for view in views if view.known is not None]

    def painted(name: str) -> Tensor:
        parts: list[Tensor] = [getattr(view, name) for view in views]
        return mean(
            [part * (count if part.ndim == 2 else count[:, None]) for part, count in zip(parts, counts, strict=True)]
        ) / (whole if parts[0].ndim == 2 else whole[:, None])

    return SphereView(
        **{name: painted(name) for name in ("paint", "across", "aside", "paint_by_rotation", "paint_by_position")},
        coverage=coverage,
        outward=torch.nn.functional.normalize(painted("outward"), dim=1),
        coverage_by_position=mean([view.coverage_by_position for view in views]),
        known=torch.stack(masks).all(0) if masks else None,
        blur=views[0].blur,
    )


def _view_at(pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, model: SphereModel) -> SphereView:
    """Render the sphere at rest, as `sphere_view`.
    Two look-ups per pixel, six near the limb, reproduce mean and width of the Gaussian cut off at the limb, as the
    curvature stretches it over the paint. Derivatives hold their spread fixed. The model's light is not used.
    Source: docs/errata.md A4 (the cap and the ellipse that a perspective camera sees); mean and variance of a cut-off
    Gaussian, Johnson, Kotz and Balakrishnan 1994, section 13.10.
    """
    radius_mm, blur_px = model.radius_mm, model.blur_px
    d = pixels.direction
    R = R_lab_body.to(d.dtype)
    # In double precision: the difference of two distances of half a metre.
    to_centre = (position_lab_mm[:, :, None] - pixels.origin.double()).to(d.dtype)
    aside = nearest_approach(to_centre, d, 1)
    nearest = (aside * aside).sum(1).sqrt().clamp_min(1e-6 * radius_mm)
    outward = aside / nearest[:, None]  # unit, from the centre to the line of sight
    q0 = nearest / radius_mm
    distance = to_centre[..., 0].norm(dim=1, keepdim=True)
    blur = blur_px * (pixels.pitch_mm[:, None] + pixels.pitch_rad[:, None] * distance) / radius_mm
    # The limb is curved: an aperture is half covered blur^2 / 2 radii inside it.
    edge = (1.0 - 0.5 * blur * blur - q0) / blur
    coverage, density, pull, variance = limb_shape(edge)
    q = (q0 - blur * pull).clamp(0.0, 1.0)
    inner = pixels.inner
    # The paint's blur is uniform over the surface: its mean is shifted by as much towards the disk's middle.
    seen = q * (1.0 + blur * blur * variance)
    variance, middle = variance[:, :inner], seen[:, :inner]
    spread = blur * variance.sqrt() * middle
    at = torch.stack([middle - spread, middle + spread], dim=1)
    line = d, outward, nearest
    parts = [_sample(at, variance[:, None], [part[..., :inner] for part in line], R, model)]
    if inner < d.shape[-1]:
        outer = slice(inner, None)
        z, moves = rim_shape(coverage[:, None, outer], density[:, None, outer])
        middle = seen[:, None, outer]
        at = middle + middle * (q0[:, None, outer] + blur[:, None] * z - middle)
        parts.append(_sample(at, moves, [part[..., outer] for part in line], R, model))
    body, turn, shift, *known = (torch.cat(pieces, dim=-1) for pieces in zip(*parts, strict=True))
    return SphereView(
        paint=body,
        coverage=coverage,
        across=q[:, None] * (pixels.axes @ outward),
        outward=outward,
        aside=q,
        paint_by_rotation=turn,
        paint_by_position=shift,
        coverage_by_position=(density / (blur * radius_mm))[:, None] * outward,
        known=known[0] if known else None,
        blur=blur,
    )


def limb_shape(edge: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return how a limb cuts a Gaussian aperture `edge` (...) standard deviations inside it: the share that is left,
    the density at the limb, the inward shift of the rest's mean (standard deviations), and its variance.
    """
    coverage = torch.special.ndtr(edge)
    density = torch.exp(-0.5 * edge * edge) * (1.0 / math.sqrt(2.0 * math.pi))
    pull = density / coverage.clamp_min(1e-4)
    return coverage, density, pull, (1.0 - pull * (edge + pull)).clamp(SPREAD_MIN, 1.0)


def rim_shape(coverage: Tensor, density: Tensor) -> tuple[Tensor, Tensor]:
    """Return look-ups along the radius near the limb (the means of equal parts of the cut-off Gaussian, in standard
    deviations), and how far each moves with the sphere, (L, n, P) each, for coverage and density (L, 1, P).
    Paint that is linear within each part is averaged exactly. With quantiles the ball would be rotated by 0.03 degrees.
    """
    counted = coverage.clamp_min(1e-4)
    share = torch.arange(RIM_NODES + 1, dtype=coverage.dtype, device=coverage.device)[:, None] / RIM_NODES
    end = torch.special.ndtri((share * counted).clamp(1e-7, 1 - 1e-7))
    height = torch.exp(-0.5 * end * end) * (share > 0) * (1.0 / math.sqrt(2.0 * math.pi))
    z = -RIM_NODES * height.diff(dim=-2) / counted
    # The nearer a node is to the limb, the less it moves.
    moves = 1.0 - density / counted * (RIM_NODES * (share * end).diff(dim=-2) - z)
    return z, moves.clamp(0.0, 1.0)


def _sample(at: Tensor, moves: Tensor, line: Sequence[Tensor], R: Tensor, model: SphereModel) -> tuple[Tensor, ...]:
    """Return the mean paint of look-ups (L, P), its derivatives (L, 3, P), and where the paint is known, (L, P) bool,
    unless everywhere; `at` in radii, `moves` per pixel moved.
    `line`: direction and outward, unit (L, 3, P), and the distance from the centre (L, P), mm, of lines of sight.
    """
    d, outward, nearest = line
    # In body components, as the texture; the derivatives are rotated to the lab at the end.
    sight_b, outward_b = (R.mT @ d)[:, :, None], (R.mT @ outward)[:, :, None]
    qt = at.clamp(0.0, math.sqrt(1.0 - DEPTH_MIN**2))
    depth = (1.0 - qt * qt).sqrt()
    normal_b = qt[:, None] * outward_b - depth[:, None] * sight_b
    value, slope = model.paint.sample(normal_b.flatten(2))
    value, slope = value.reshape(qt.shape), slope.reshape(normal_b.shape)
    shares = [] if model.paint.unseen is None else [model.paint.unseen.sample(normal_b.flatten(2))[0]]
    known = [share.reshape(qt.shape).amax(1) < UNSEEN for share in shares]
    # If the centre moves along -outward, the look-up moves outwards over the sphere.
    slide = (slope * outward_b).sum(1) + qt / depth * (slope * sight_b).sum(1)
    radial = (moves * slide).mean(1)
    flat_b = (qt[:, None] * slope).mean(2)
    by_sight, by_outward = (flat_b * sight_b[:, :, 0]).sum(1), (flat_b * outward_b[:, :, 0]).sum(1)
    # Across the radius a look-up moves by its share of the radius, q / q0.
    flat = R @ flat_b - by_sight[:, None] * d - by_outward[:, None] * outward
    shift = flat * (-1.0 / nearest)[:, None] - (radial / model.radius_mm)[:, None] * outward
    return value.mean(1), R @ cross_first_axis(slope, normal_b).mean(2), shift, *known
