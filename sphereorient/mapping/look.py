"""What the pictures say of map and attitudes at once: residuals, and how they change with either."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from sphereorient.mapping.grid import READS, SplinePaint
from sphereorient.pose.fit import grey_by_pose, residuals
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.model import SphereView
from sphereorient.pose.pixels import Pixels

DEPTH_MIN = 0.2  # cosine of the slant beyond which a pixel tells nothing of the map
POSE = 6  # rows of the pose in a linear problem


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """L disks at one pose each, compared with a map, P pixels each; made by `look`."""

    view: SphereView
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
        fitter: with views and light; its own map is not looked at.
        texture: (H, 2 H), the map, blurred as the pictures are.
        pixels: of B * C disks, the cameras of an instant next to each other.
        position_lab_mm: (B, 3).
        R_lab_body: (B, 3, 3).
        blur_px: of the pictures.
    """
    paint = SplinePaint(texture, 0.0)
    model = replace(fitter.model(fitter.optics.fine), paint=paint, blur_px=blur_px)
    at = residuals(pixels, position_lab_mm, R_lab_body, None, model, len(fitter.views))
    depth = (1 - at.view.across.square().sum(1)).clamp_min(0).sqrt()
    return Look(
        view=at.view,
        reads=paint.reads,
        inner=pixels.inner,
        depth=depth,
        step=at.lit,
        residual=at.residual,
        weight=at.weight,
        variance=at.variance,
        # Near the limb the map learns nothing, and so cannot tell the pose anything either.
        by_pose=grey_by_pose(at.view, at.lit * (depth > DEPTH_MIN), at.over),
        by_light=at.design[:, POSE:],
    )
