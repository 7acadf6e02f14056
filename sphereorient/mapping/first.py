"""The first map, of normalised disks laid over the sphere, and what the rounds begin with."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from sphereorient.mapping.cut import pixels_of
from sphereorient.mapping.disks import Disks, disk_places, view_normals
from sphereorient.mapping.footage import Footage
from sphereorient.mapping.grid import map_sums, solve_map
from sphereorient.mapping.rounds import Stage, optics_of, typical
from sphereorient.mapping.settings import PaintSettings
from sphereorient.pose.defocus import FIRST_BLUR_PX
from sphereorient.pose.fitter import CameraView, Fitter, unknown_light, widest_px

FIRST_SMOOTH = 0.02  # as the setting `smooth`, of the first map
CONTRAST = 0.3  # deviation of the first map about mid-grey
TEXEL_PX = 0.75  # of the widest disk's middle
ROW, FINEST_ROWS = 32, 512  # rows of the fitted map are a multiple of the one, and at most the other


def first_map(disks: Disks, R_lab_body: Tensor, height: int) -> Tensor:
    """Lay normalised disks over the sphere: a first map, (H, 2 H) float32, about mid-grey."""
    texels = 2 * height * height
    matrix, right = csr_matrix((texels, texels)), np.zeros(texels)
    for c in range(disks.layers.shape[1]):
        normal, share = view_normals(disks.size_px, float(disks.distance_radii[:, c].median()))
        place, _, depth = disk_places(normal, disks.distance_radii[:, c].median())
        at = ((place + 1) * (disks.size_px / 2) - 0.5).round().long()
        cell = at[1] * disks.size_px + at[0]
        grey = disks.layers[:, c, 0].flatten(1)[:, cell]
        body = (R_lab_body.mT.float() @ (disks.R_lab_view[:, c] @ normal)).mT
        weight = (share * depth.clamp_min(0).square())[None] * disks.told(torch.arange(len(disks)), c)[:, cell]
        more, told = map_sums(body.reshape(-1, 3), grey.reshape(-1), weight.reshape(-1), height)
        matrix, right = matrix + more, right + told
    even = solve_map(matrix, right, height, FIRST_SMOOTH * typical(matrix.diagonal()))
    return (0.5 + CONTRAST * even / even.std()).clamp(0, 1).float()


def first_stage(
    footage: Footage,
    frames: Tensor,
    R_lab_body: Tensor,
    texture: Tensor,
    settings: PaintSettings,
    extra_px: float = 0.0,
) -> Stage:
    """Make ready for the rounds: the pixels of some frames (n,), a map to begin with, light unknown.

    Args:
        footage: with the pictures.
        frames: (n,) int64.
        R_lab_body: (n, 3, 3).
        texture: (H, 2 H).
        settings: of the room.
        extra_px: standard deviation of the Gaussian that is laid over the pictures first, px.
    """
    blur_px = math.hypot(settings.blur_px or FIRST_BLUR_PX, extra_px)
    fitter = Fitter(
        views=footage.views,
        radius_mm=footage.radius_mm,
        optics=optics_of(texture, footage.views, blur_px),
        light=unknown_light(footage.views),
    )
    return Stage(
        frames=frames,
        pixels=pixels_of(footage, fitter, frames, settings.pixels, extra_px),
        use=footage.seen[frames],
        position_lab_mm=footage.position_lab_mm[frames],
        R_lab_body=R_lab_body,
        texture=texture,
        blur_px=blur_px,
        fitter=fitter,
        fixed=footage.fixed,
    )


def height_of(views: Sequence[CameraView], settings: PaintSettings) -> int:
    """Rows of the fitted map: texels a little finer than pixels in the widest disk's middle."""
    if settings.height is not None:
        return settings.height
    rows = math.pi / 2 / TEXEL_PX * widest_px(views)
    return min(FINEST_ROWS, max(2, round(rows / ROW)) * ROW)
