"""From the map as the pictures blur it to the paint itself, as far as noise allows."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from sphereorient.mapping.grid import READS, look_up, solve_map, texel_areas, texel_weights
from sphereorient.synth.textures import map_directions

# Nodes and weights of the 5-point Gauss-Hermite rule for a unit normal.
NODES = (-2.8569700138728, -1.3556261799742659, 0.0, 1.3556261799742659, 2.8569700138728)
SHARES = (0.011257411327721, 0.22207592200561264, 0.5333333333333333, 0.22207592200561264, 0.011257411327721)
NOISE = 1.0e-3  # variance of the blurred map's errors over that of what sharpening may add
ITERATIONS = 200


def blur_matrix(direction_body: Tensor, blur_rad: float, height: int) -> csr_matrix:
    """Return what a map's coefficients (T,) look like, blurred by a Gaussian, in some directions: (M, T).

    Args:
        direction_body: (M, 3) unit, float64.
        blur_rad: standard deviation of the Gaussian, rad.
        height: H of the map.
    """
    texels = 2 * height * height
    helper = torch.where(
        direction_body[:, 2:].abs() < 0.9,
        direction_body.new_tensor([0.0, 0.0, 1.0]),
        direction_body.new_tensor([1.0, 0.0, 0.0]),
    )
    right = torch.nn.functional.normalize(torch.linalg.cross(helper, direction_body), dim=-1)
    up = torch.linalg.cross(direction_body, right)
    start = np.arange(0, len(direction_body) * READS + 1, READS)
    total = csr_matrix((len(direction_body), texels))
    for a, share_a in zip(NODES, SHARES, strict=True):
        for b, share_b in zip(NODES, SHARES, strict=True):
            place, weight = texel_weights(direction_body + blur_rad * (a * right + b * up), height)
            entries = (share_a * share_b * weight).reshape(-1).numpy()
            total = total + csr_matrix((entries, place.reshape(-1).numpy(), start), shape=total.shape)
    return total


def sharpened(blurred: Tensor, blur_rad: float, noise: float = NOISE) -> Tensor:
    """Undo a Gaussian blur as far as noise allows.

    Args:
        blurred: (H, 2 H), coefficients of the map as the pictures blur it.
        blur_rad: standard deviation of that blur, rad.
        noise: the more of it, the less is undone.

    Returns:
        Coefficients of the paint's map, (H, 2 H) float64; `look_up` reads its values.

    Source: Tikhonov 1963, the slope's square as the penalty.
    """
    height = len(blurred)
    direction = map_directions(height).reshape(-1, 3)
    seen = look_up(blurred.double(), direction).numpy()
    area = texel_areas(height).reshape(-1).numpy()
    blur = blur_matrix(direction, blur_rad, height)
    weighted = blur.multiply(area[:, None]).tocsr()
    found: Tensor = solve_map(
        (blur.T @ weighted).tocsr(),
        np.asarray(weighted.T @ seen),
        height,
        noise * blur_rad**2,
        ITERATIONS,
    )
    return found
