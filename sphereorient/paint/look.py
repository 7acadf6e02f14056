"""What the pictures say of map and attitudes at once: residuals, and how they change with either."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from sphereorient.orient.eye import Fitter
from sphereorient.orient.light import polynomials
from sphereorient.orient.picture import View, sphere_view
from sphereorient.orient.pixels import Pixels
from sphereorient.orient.refine import NOISE_MIN, TUKEY, light_columns
from sphereorient.paint.grid import READS, SplinePaint

ROUNDS = 2  # of the robust weights
DEPTH_MIN = 0.2  # cosine of the slant beyond which a pixel tells nothing of the map
RIDGE = 1e-7
EVERY = 4  # the scatter is read off from every so-many-th pixel


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """L disks at one pose each, compared with a map, P pixels each; made by `look`."""

    view: View
    reads: list[tuple[Tensor, Tensor]]  # of the inner and the outer pixels: texels and weights, (L, n * P', 16) each
    inner: int  # so many first pixels read `reads[0]`
    depth: Tensor  # (L, P), cosine of the slant under which it is seen
    step: Tensor  # (L, P), grey levels from black to white paint, the frame's own light included, coverage too
    residual: Tensor  # (L, P), grey levels
    weight: Tensor  # (L, P), robust, 0 .. 1
    variance: Tensor  # (L, P), grey levels^2
    by_pose: Tensor  # (L, 6, P), grey levels per rad (delta) and per mm
    by_light: Tensor  # (L, K, P), what the coefficients of a frame's own light multiply

    @property
    def precision(self) -> Tensor:
        """Weight over variance, (L, P).

        What the light is wrong by grows towards the limb, and so the paint seen there counts less; where no paint is
        read any more, the limb itself tells the place.
        """
        slanted = torch.where(self.depth > DEPTH_MIN, self.depth.square(), 1.0)
        return self.weight / self.variance * slanted


def look_ups(at: Look, factor: Tensor, texels: int) -> csr_matrix:
    """Return by how much each pixel changes with each texel, (L * P, T) float32: factor (L, P) times its reading."""
    places, values, counts = [], [], []
    for k, (place, share) in enumerate(at.reads):
        pixels = slice(0, at.inner) if k == 0 else slice(at.inner, None)
        own = factor[:, pixels]
        nodes = place.shape[1] // own.shape[1]
        several = (len(own), nodes, own.shape[1], READS)
        scaled = share.reshape(several) * (own / nodes)[:, None, :, None]
        places.append(place.reshape(several).transpose(1, 2).flatten(2))
        values.append(scaled.transpose(1, 2).flatten(2))
        counts.append(torch.full(own.shape, nodes * READS))
    count = torch.cat(counts, dim=1)
    start = np.concatenate([[0], count.reshape(-1).cumsum(0).numpy()])
    # Disk after disk, the inner pixels before the outer ones.
    columns = torch.cat([part.flatten(1) for part in places], dim=1).reshape(-1).to(torch.int32)
    entries = torch.cat([part.flatten(1) for part in values], dim=1).reshape(-1).float()
    return csr_matrix((entries.numpy(), columns.numpy(), start), shape=(count.numel(), texels))


def look(
    fitter: Fitter, texture: Tensor, pixels: Pixels, position_lab_mm: Tensor, R_lab_body: Tensor, blur_px: float
) -> Look:
    """Compare pictures with a map, each frame's light at its best.

    Args:
        fitter: with eyes and light; its own map is not looked at.
        texture: (H, 2 H), the map, blurred as the pictures are.
        pixels: of B * C disks, the cameras of an instant next to each other.
        position_lab_mm: (B, 3).
        R_lab_body: (B, 3, 3).
        blur_px: of the pictures.
    """
    cameras = len(fitter.eyes)
    X, R = position_lab_mm.repeat_interleave(cameras, 0), R_lab_body.repeat_interleave(cameras, 0)
    paint = SplinePaint(texture, 0.0)
    view = sphere_view(pixels, X, R, fitter.radius_mm, paint, blur_px)
    shading = fitter.shading
    columns, difference, black = light_columns(view, fitter.light, shading)
    noise = fitter.light.noise.repeat(len(position_lab_mm), 1)
    beyond = (1 - view.coverage) * pixels.behind
    target = pixels.grey - beyond
    expected, weight = pixels.grey, pixels.inside.to(columns.dtype)
    for _ in range(ROUNDS):
        found = _solved(columns, target, weight / _variance(expected, noise))
        painted = (found[:, None] @ columns)[:, 0]
        residual, expected = target - painted, painted + beyond
        variance = _variance(expected, noise)
        variance = variance * _scatter(residual, variance, pixels.inside).clamp_min(1.0)[:, None] ** 2
        weight = (1 - residual.square() / (TUKEY**2 * variance)).clamp_min(0).square() * pixels.inside
    tints = polynomials(view.across, max(shading.difference, shading.black))
    n = (shading.difference + 1) * (shading.difference + 2) // 2
    gain = (found[:, None, :n] @ tints[:, :n])[:, 0]
    offset = (found[:, None, n:] @ tints[:, : columns.shape[1] - n])[:, 0]
    step, ground = difference * gain, black * gain + offset
    lit = (view.coverage * step)[:, None]
    over = (view.paint * step + ground - pixels.behind)[:, None]
    depth = (1 - view.across.square().sum(1)).clamp_min(0).sqrt()
    # Near the limb the map learns nothing, and so cannot tell the pose anything either.
    told = lit * (depth > DEPTH_MIN)[:, None]
    by_pose = torch.cat(
        [told * view.paint_by_rotation, told * view.paint_by_position + over * view.coverage_by_position], dim=1
    )
    return Look(
        view=view,
        reads=paint.reads,
        inner=pixels.inner,
        depth=depth,
        step=lit[:, 0],
        residual=residual,
        weight=weight,
        variance=variance,
        by_pose=by_pose,
        by_light=columns,
    )


def _solved(columns: Tensor, target: Tensor, precision: Tensor) -> Tensor:
    """Weighted least squares over the pixels, (L, K)."""
    weighted = columns * precision[:, None]
    normal, right = (weighted @ columns.mT).double(), (weighted @ target[..., None]).double()
    floor = RIDGE * normal.diagonal(dim1=1, dim2=2).clamp_min(0) + 1e-12
    solution: Tensor = torch.linalg.solve(normal + torch.diag_embed(floor), right)[..., 0]
    return solution.to(columns.dtype)


def _variance(grey: Tensor, noise: Tensor) -> Tensor:
    """Noise expected at grey levels (L, P) by the curves (L, 4)."""
    grey = grey.clamp_min(0.0)
    a, b, c, d = noise[..., None].unbind(1)
    variance: Tensor = a + grey * (b + grey * (c + grey * d))
    return variance.clamp_min(NOISE_MIN)


def _scatter(residual: Tensor, variance: Tensor, inside: Tensor) -> Tensor:
    """Robust standard deviation of the residuals over the noise expected, (L,)."""
    scaled = (residual * variance.rsqrt()).abs()[:, ::EVERY]
    scaled = torch.where(inside[:, ::EVERY], scaled, torch.nan)
    return 1.4826 * torch.nan_to_num(scaled.nanmedian(-1).values)
