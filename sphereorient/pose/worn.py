"""Worn paint, dirt that rotates with the ball, and errors of the map: found, and not used."""

import math

import numpy as np
import torch
from torch import Tensor

from sphereorient.pose.compiled import fitted_residuals
from sphereorient.pose.model import UNSEEN, SphereModel, surface_normals
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses
from sphereorient.sphere.texture import map_directions, unseen_share
from sphereorient.sphere.texture_table import TextureTable, octahedral_cells, texture_table

UNUSED_PAINT = "unused_paint"  # key in a track's provenance, see `worn_text`
CELLS = 48  # per axis, in which the paint of all pictures is averaged: 2.6 degrees
CHANGED = 0.15  # of the step from black to white: paint that differs by more is worn; right maps differ by 0.1
SLACK = 0.1  # standard deviation of a cell with few pixels
LIMB = 0.95  # radii from the disk's middle; farther out paint is too foreshortened
ROWS = 180  # of latitude, in the map of worn paint
SIDE = 256  # cells per axis of that map's table


def worn_cells(pixels: Pixels, fit: FittedPoses, use: Tensor, model: SphereModel, changed: float = CHANGED) -> Tensor:
    """Return where the paint differs from the map, (CELLS^2,) bool, octahedral cells of the body's directions.
    From the fits of B * C disks, those in `use` (B, C) bool; differences that rotate with the ball are paint, fixed
    ones light. `changed`: least difference, as a share of the step from black to white.
    """
    cameras = use.shape[1]
    at = fitted_residuals(pixels, fit, model)
    normal_lab, _ = surface_normals(at.view, pixels)
    normal = fit.R_lab_body.to(normal_lab.dtype).repeat_interleave(cameras, 0).mT @ normal_lab
    cells = octahedral_cells(normal[:, 0], normal[:, 1], normal[:, 2], CELLS).reshape(-1)
    # Without the robust weights, which are 0 on worn paint.
    counted = pixels.inside & ~pixels.clipped & use.reshape(-1, 1) & (at.view.aside < LIMB)
    slope = at.lit / at.variance * counted
    sums = [torch.zeros(CELLS**2).index_add(0, cells, (slope * part).reshape(-1)) for part in (at.residual, at.lit)]
    return (sums[0] / (sums[1] + SLACK**-2)).abs() > changed


def without(paint: TextureTable, worn: Tensor) -> TextureTable:
    """Return a table of paint in which worn cells, as of `worn_cells`, are unknown too."""
    x, y, z = map_directions(ROWS).float().unbind(-1)
    unknown = worn_texels(worn, ROWS)
    if paint.unseen is not None:
        unknown = unknown | (paint.unseen.sample(torch.stack([x, y, z]).flatten(1)[None])[0] > UNSEEN).reshape(x.shape)
    return TextureTable(paint.rows, paint.blur_rad, texture_table(unknown.float(), paint.blur_rad, SIDE))


def worn_texels(worn: Tensor, height: int) -> Tensor:
    """Return the texels (H, 2 H) bool of an equirectangular map in worn cells, as of `worn_cells`."""
    x, y, z = map_directions(height).float().unbind(-1)
    return worn[octahedral_cells(x, y, z, math.isqrt(len(worn)))]


def worn_share(worn: Tensor) -> float:
    """Return the share of the sphere in worn cells, as of `worn_cells`."""
    return unseen_share(worn_texels(worn, ROWS))


def worn_text(worn: Tensor) -> str:
    """Return worn cells (CELLS^2,) bool as hexadecimal digits, for a track."""
    return np.packbits(worn.numpy()).tobytes().hex()


def worn_of_text(text: str) -> Tensor:
    """Return the worn cells of a text that `worn_text` made; raise ValueError for another one."""
    return torch.from_numpy(np.unpackbits(np.frombuffer(bytes.fromhex(text), np.uint8)).astype(bool))
